"""Image metrics: torch modules that map an ``(H, W, 3)`` linear-radiance image to a scalar or a vector."""

from ._class_logit import ClassLogit as ClassLogit
from ._comparison import MeanSquaredError as MeanSquaredError
from ._comparison import StructuralSimilarity as StructuralSimilarity
from ._contrast import ContrastRatio as ContrastRatio
from ._dgi import DaylightGlareIndex as DaylightGlareIndex
from ._dgp import DaylightGlareProbability as DaylightGlareProbability
from ._glare import GlareRating as GlareRating
from ._illuminance import VerticalIlluminance as VerticalIlluminance
from ._luminance import MeanLuminance as MeanLuminance
from ._luminance import luminance as luminance
from ._luminance_map import plot_luminance as plot_luminance
from ._percentile import LuminancePercentile as LuminancePercentile
from ._perceptual import PerceptualDistance as PerceptualDistance
from ._position_index import position_index as position_index
from ._preprocessing import ResizeCropNormalize as ResizeCropNormalize
from ._shape_classifier import ShapeClassifier as ShapeClassifier
from ._sources import GlareSource as GlareSource
from ._ugr import UnifiedGlareRating as UnifiedGlareRating
