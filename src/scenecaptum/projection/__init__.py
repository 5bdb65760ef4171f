"""What each pixel shows, and the projection of attributions from parameters to pixels."""

from ._export import export as export
from ._projection import heatmap as heatmap
from ._projection import shared_maximum as shared_maximum
from ._surfaces import SurfaceMap as SurfaceMap
from ._surfaces import TexelMap as TexelMap
