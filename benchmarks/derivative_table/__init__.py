"""The scenes of the table of derivatives: plugins, parameters, values and lighting."""

from ._case import ABOVE as ABOVE
from ._case import BELOW as BELOW
from ._case import Case as Case
from ._case import Row as Row
from ._lights import light_cases
from ._media import medium_cases
from ._surfaces import surface_cases

CASES = (*surface_cases(), *light_cases(), *medium_cases())

# What the summary counts together; plugins in none of these groups are materials.
GROUPS = {
    "textures and colours": ("bitmap", "checkerboard", "mesh_attribute", "volume", "spectra"),
    "lights": (
        *("area", "directionalarea", "point", "spot", "projector", "directional"),
        *("constant", "envmap", "sunsky", "timed_sunsky"),
    ),
    "media": (
        *("homogeneous", "heterogeneous", "fog"),
        *("hg", "isotropic", "rayleigh", "tabphase", "blendphase", "sggx"),
    ),
}

# Plugins of these categories without rows in the table.
WITHOUT_PARAMETERS = {
    "null": "fully transparent",
    "measured": "a table from a file",
    "measured_polarized": "a table from a file",
    "isotropic": "see the rows of its medium",
    "rayleigh": "see the rows of its medium",
}

# Cases for the tests: with eight seeds and these samples per pixel, every row is resolved within about a second.
QUICK = {
    "dielectric/opaque pane": 16,
    "thindielectric/opaque pane": 16,
    "roughdielectric/opaque pane": 16,
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
