"""The scenes of the table of derivatives: which parameters of which plugins, at which values, in which light."""

from ._case import ABOVE as ABOVE
from ._case import BELOW as BELOW
from ._case import Case as Case
from ._case import Row as Row
from ._lights import light_cases
from ._media import medium_cases
from ._surfaces import surface_cases

CASES = (*surface_cases(), *light_cases(), *medium_cases())

# Plugins of these categories that the table has no rows for.
WITHOUT_PARAMETERS = {
    "null": "lets everything pass",
    "measured": "a table from a file",
    "measured_polarized": "a table from a file",
    "isotropic": "rows are those of its medium",
    "rayleigh": "rows are those of its medium",
}

# Samples per pixel with which, under eight seeds, every row of a case settles within a second or so: the tests
# repeat these.
QUICK = {
    "dielectric/pane that lets nothing pass": 16,
    "thindielectric/pane that lets nothing pass": 16,
    "roughdielectric/pane that lets nothing pass": 16,
    "roughdielectric/lamp in the floor, alpha 0.001": 16,
    "roughdielectric/lamp in the floor, alpha 0.01": 16,
    "roughdielectric/lamp in the floor, alpha 0.05": 16,
    "roughdielectric/lamp in the floor, alpha 0.3": 16,
    "roughplastic/roughness": 128,
    "roughplastic/lamp in the floor, alpha 0.001": 16,
    "roughplastic/lamp in the floor, alpha 0.01": 16,
    "roughplastic/lamp in the floor, alpha 0.05": 16,
    "roughplastic/lamp in the floor, alpha 0.3": 16,
    "principled/opaque": 256,
    "principled/lamp in the floor, anisotropic 1": 16,
    "principled/lamp in the floor, clearcoat_gloss 0": 32,
    "principled/lamp in the floor, clearcoat_gloss 0.4": 16,
    "principled/lamp in the floor, clearcoat_gloss 0.9": 16,
    "principled/specular": 16,
    "principled/lamp in the floor, roughness 0.03": 16,
    "principled/lamp in the floor, roughness 0.1": 16,
    "principled/lamp in the floor, roughness 0.3": 16,
    "principledthin/lamp in the floor, anisotropic 1": 32,
    "hair/polyline": 32,
    "hair/dyed": 16,
    "hair/white": 16,
    "blendbsdf/of two diffuse": 16,
    "twosided/two sheets": 16,
    "normalmap/over roughplastic": 16,
    "polarizer/ball": 16,
    "retarder/ball": 16,
    "circular/ball": 16,
    "pplastic/ball": 256,
    "checkerboard/balls": 16,
    "mesh_attribute/vertex colours": 16,
    "volume/balls": 16,
    "spectra/rgb, rawconstant, uniform": 16,
    "area/lamps": 16,
    "area/in a mirror": 16,
    "point/lamps": 16,
    "spot/lamps": 64,
    "projector/slides": 16,
    "directional/suns": 16,
    "constant/sky": 16,
    "constant/coloured sky in mirror and glass": 16,
    "constant/dark sky beside a lamp": 16,
    "envmap/smooth": 16,
    "envmap/mostly black": 32,
    "envmap/scale 0 beside a lamp": 16,
}
