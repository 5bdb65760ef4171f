"""Luminance of a linear-radiance image."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ..images import LUMINANCE_WEIGHTS, check_image_shape
from ._measure import Measure, luminance_unit


def luminance(image: torch.Tensor) -> torch.Tensor:
    """Return the relative luminance of each pixel: Y of CIE XYZ for Rec. 709 primaries.

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.

    Returns
    -------
    Tensor
        ``(H, W)``, in the image's unit.

    Raises
    ------
    SceneCaptumError
        If the image does not have this shape.

    References
    ----------
    Recommendation ITU-R BT.709: the weights 0.2127, 0.7152 and 0.0722, as in Mitsuba and kornia.
    """
    check_image_shape(image)
    return (image * image.new_tensor(LUMINANCE_WEIGHTS)).sum(-1)


class MeanLuminance(torch.nn.Module):
    """Mean luminance of an image in cd/m², ``mean(efficacy · (0.2127 R + 0.7152 G + 0.0722 B))``.

    Example
    -------
    >>> MeanLuminance()(torch.ones(4, 8, 3))
    tensor(179.)

    Parameters
    ----------
    efficacy
        Luminous efficacy in lm/W that converts radiance to luminance: 179 as in Radiance; 1 for the mean in the
        unit of the render.
    mask
        ``(H, W)``, the pixels to average over (bool, or non-negative weights), such as
        ``renderer.mask("desk")``; all of them by default.

    Raises
    ------
    SceneCaptumError
        If the mask is empty or, from ``forward``, does not have the size of the image.

    Notes
    -----
    The weights are those of `luminance`.
    """

    mask: torch.Tensor | None

    def __init__(self, efficacy: float = 179.0, mask: torch.Tensor | None = None) -> None:
        super().__init__()
        if mask is not None and not mask.sum() > 0:
            raise SceneCaptumError("mask selects no pixel: its sum must be positive.")
        self.efficacy = efficacy
        self.register_buffer("mask", mask)

    @property
    def measure(self) -> Measure:
        """Name and unit."""
        where = "" if self.mask is None else " of the masked pixels"
        return Measure(f"mean luminance{where}", unit=luminance_unit(self.efficacy))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the mean over an ``(H, W, 3)`` image, a 0-d tensor, in the image's unit times ``efficacy``."""
        y = luminance(image)
        if self.mask is None:
            return self.efficacy * y.mean()
        if self.mask.shape != y.shape:
            raise SceneCaptumError(
                f"mask has shape {tuple(self.mask.shape)}; the image is {tuple(y.shape)} (height, width)."
            )
        weight = self.mask.to(y)
        return self.efficacy * (weight * y).sum() / weight.sum()

    def extra_repr(self) -> str:
        """Show the efficacy and whether a mask is set."""
        return f"efficacy={self.efficacy:g}" + ("" if self.mask is None else ", masked")
