"""Image metrics: torch modules that map an ``(H, W, 3)`` linear-radiance image to a scalar or a vector."""

# What users see; the other names are for the rooms above and for extensions.
__all__ = [
    "Band",
    "ClassLogit",
    "ClassProbability",
    "ContrastRatio",
    "DaylightGlareIndex",
    "DaylightGlareProbability",
    "DetectionScore",
    "EmbeddingDistance",
    "GlareRating",
    "GlareSource",
    "LuminancePercentile",
    "MeanIlluminance",
    "MeanLuminance",
    "MeanSquaredError",
    "Measure",
    "MelanopicEDI",
    "PerCamera",
    "PerceptualDistance",
    "ResizeCropNormalize",
    "SegmentationScore",
    "ShapeClassifier",
    "Smoothed",
    "StructuralSimilarity",
    "UnifiedGlareRating",
    "Uniformity",
    "VerticalIlluminance",
    "luminance",
    "melanopic_ratio",
    "plot_luminance",
    "position_index",
]

from ._class_logit import ClassLogit as ClassLogit
from ._class_probability import ClassProbability as ClassProbability
from ._comparison import MeanSquaredError as MeanSquaredError
from ._comparison import StructuralSimilarity as StructuralSimilarity
from ._contrast import ContrastRatio as ContrastRatio
from ._detection import DetectionScore as DetectionScore
from ._dgi import DaylightGlareIndex as DaylightGlareIndex
from ._dgp import DaylightGlareProbability as DaylightGlareProbability
from ._embedding import EmbeddingDistance as EmbeddingDistance
from ._glare import NO_SOURCE as NO_SOURCE
from ._glare import GlareRating as GlareRating
from ._illuminance import VerticalIlluminance as VerticalIlluminance
from ._luminance import MeanLuminance as MeanLuminance
from ._luminance import luminance as luminance
from ._luminance_map import plot_luminance as plot_luminance
from ._mean_illuminance import MeanIlluminance as MeanIlluminance
from ._measure import Band as Band
from ._measure import Measure as Measure
from ._melanopic import MelanopicEDI as MelanopicEDI
from ._melanopic_spectra import melanopic_ratio as melanopic_ratio
from ._named import NamedMetric as NamedMetric
from ._named import import_metric as import_metric
from ._per_camera import PerCamera as PerCamera
from ._percentile import LuminancePercentile as LuminancePercentile
from ._perceptual import PerceptualDistance as PerceptualDistance
from ._position_index import position_index as position_index
from ._preprocessing import ResizeCropNormalize as ResizeCropNormalize
from ._segmentation import SegmentationScore as SegmentationScore
from ._shape_classifier import ShapeClassifier as ShapeClassifier
from ._shape_logit import shape_logit
from ._smoothed import Smoothed as Smoothed
from ._sources import GlareSource as GlareSource
from ._ugr import UnifiedGlareRating as UnifiedGlareRating
from ._uniformity import Uniformity as Uniformity

# By their names on the command line; a metric that needs a reference or a network of your own has none.
BY_NAME = {
    "luminance": NamedMetric(MeanLuminance, "mean luminance"),
    "percentile": NamedMetric(LuminancePercentile, "95th percentile of luminance"),
    "contrast": NamedMetric(ContrastRatio, "95th over 5th percentile of luminance"),
    "illuminance": NamedMetric(VerticalIlluminance, "vertical illuminance at the camera"),
    "mean-illuminance": NamedMetric(MeanIlluminance, "mean illuminance of a sensor grid"),
    "uniformity": NamedMetric(Uniformity, "smallest over mean illuminance of a sensor grid"),
    "ugr": NamedMetric(UnifiedGlareRating, "unified glare rating"),
    "dgp": NamedMetric(DaylightGlareProbability, "daylight glare probability"),
    "dgi": NamedMetric(DaylightGlareIndex, "daylight glare index"),
    "shape-logit": NamedMetric(
        shape_logit,
        "logits of the bundled classifier, with --target sphere, cube or cylinder",
    ),
}
