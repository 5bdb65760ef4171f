"""What each pixel shows, and the projection of attributions from parameters to pixels."""

# What users see; the other names are for the rooms above.
__all__ = [
    "ProjectedPixels",
    "SurfaceMap",
    "TexelMap",
    "export",
    "heatmap",
    "project_pixels",
    "shared_maximum",
]

from ._export import export as export
from ._light_maps import SHARES as SHARES
from ._light_maps import TEXTURE_NDIM as TEXTURE_NDIM
from ._light_maps import light_maps_left_out as light_maps_left_out
from ._pixels import ProjectedPixels as ProjectedPixels
from ._pixels import project_pixels as project_pixels
from ._pixels import sum_over_objects as sum_over_objects
from ._projection import DECADES as DECADES
from ._projection import DEFAULT_NORM as DEFAULT_NORM
from ._projection import MapNorm as MapNorm
from ._projection import clear_sum as clear_sum
from ._projection import heatmap as heatmap
from ._projection import mapped_parameters as mapped_parameters
from ._projection import normalized as normalized
from ._projection import objects_of_unclear_sign as objects_of_unclear_sign
from ._projection import shared_maximum as shared_maximum
from ._projection import used_by_objects as used_by_objects
from ._projection import views_without_map as views_without_map
from ._surfaces import SurfaceMap as SurfaceMap
from ._surfaces import TexelMap as TexelMap
