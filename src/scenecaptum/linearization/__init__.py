"""A scene to first order: what a change of its parameters does to the picture and to metrics, with errors."""

# What users see.
__all__ = ["Derivative", "Designs", "Gradient", "Linearization", "Measured", "Slider"]

from ._designs import Designs as Designs
from ._designs import Measured as Measured
from ._linearization import Derivative as Derivative
from ._linearization import Gradient as Gradient
from ._linearization import Linearization as Linearization
from ._sliders import Design as Design
from ._sliders import Slider as Slider
