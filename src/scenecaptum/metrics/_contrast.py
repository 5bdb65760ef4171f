"""Contrast ratio of an image."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ._checks import cast_like, photometric_luminance
from ._measure import Measure
from ._percentile import banded_percentile, check_percentage


class ContrastRatio(torch.nn.Module):
    """Ratio of a high to a low percentile of an image's luminance; independent of the exposure.

    Example
    -------
    >>> ContrastRatio()(torch.ones(4, 8, 3))
    tensor(1.)

    Parameters
    ----------
    low, high
        The two percentiles, from 0 to 100.
    width
        Half-width, in percentile points, of the band over which each is averaged (see `LuminancePercentile`).
    floor
        Lower limit of both luminances, so that the ratio of a black image is finite.

    Raises
    ------
    SceneCaptumError
        If a setting is invalid or, from ``forward``, a value of the image is negative or not finite.
    """

    measure = Measure("contrast ratio")

    def __init__(
        self, low: float = 5.0, high: float = 95.0, *, width: float = 1.0, floor: float = 1e-6
    ) -> None:
        super().__init__()
        self.low = check_percentage("low", low)
        self.high = check_percentage("high", high)
        self.width = check_percentage("width", width)
        self.floor = floor
        if self.low >= self.high:
            raise SceneCaptumError(f"low must be below high; here low is {low!r} and high {high!r}.")
        if not floor > 0:
            raise SceneCaptumError(f"floor must be a positive luminance, not {floor!r}.")

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the ratio of an ``(H, W, 3)`` image, a 0-d dimensionless tensor."""
        values = photometric_luminance(image, 1.0).flatten()
        bright = banded_percentile(values, self.high, self.width)
        dark = banded_percentile(values, self.low, self.width)
        return cast_like(bright.clamp(min=self.floor) / dark.clamp(min=self.floor), image)

    def extra_repr(self) -> str:
        """Show the percentiles and the width."""
        return f"low={self.low:g}, high={self.high:g}, width={self.width:g}"
