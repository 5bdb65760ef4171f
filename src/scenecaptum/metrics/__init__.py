"""Image → number, as torch modules from an ``(H, W, 3)`` linear-radiance image to a scalar or a vector."""

from ._luminance import MeanLuminance as MeanLuminance
from ._luminance import luminance as luminance
