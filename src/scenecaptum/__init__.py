"""Captum for 3D scenes: attribute any metric of a rendered image to the parameters of the scene.

Importing this package is cheap: Mitsuba, matplotlib and kornia load when they are first needed.
"""

from importlib import import_module
from types import ModuleType

from . import metrics as metrics
from .attr import AttributionInterrupted as AttributionInterrupted
from .attr import FeatureAblationScene as FeatureAblationScene
from .attr import GradientShapScene as GradientShapScene
from .attr import InputXGradientScene as InputXGradientScene
from .attr import IntegratedGradientsScene as IntegratedGradientsScene
from .attr import OcclusionScene as OcclusionScene
from .attr import SceneAttribution as SceneAttribution
from .attr import ShapleyValueScene as ShapleyValueScene
from .attr import SmoothGradScene as SmoothGradScene
from .attr import VanillaSceneGradient as VanillaSceneGradient
from .backend import activate as activate
from .camera import Camera as Camera
from .camera import View as View
from .errors import BackendError as BackendError
from .errors import SceneCaptumError as SceneCaptumError
from .grid import SensorGrid as SensorGrid
from .rendering import SceneRenderer as SceneRenderer

__version__ = "0.2.0"

_LAZY_ROOMS = {
    "explanation",
    "explore",
    "linearization",
    "optimize",
    "report",
    "studies",
    "tradeoff",
    "validation",
    "visualization",
}


def __getattr__(name: str) -> ModuleType:
    """Import a room when it is first used as an attribute."""
    if name in _LAZY_ROOMS:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
