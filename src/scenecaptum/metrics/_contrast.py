"""Contrast ratio of an image."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ._checks import cast_like, photometric_luminance
from ._measure import Measure
from ._percentile import banded_percentile, check_percentage


class ContrastRatio(torch.nn.Module):
    """Ratio of a high to a low percentile of an image's luminance.

    It is independent of the exposure, unless the low percentile is black: then it is a ratio to ``floor``, which
    means nothing, and results have a caution.

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
        bright, dark = (self._percentile(image, percentage) for percentage in (self.high, self.low))
        return cast_like(bright.clamp(min=self.floor) / dark.clamp(min=self.floor), image)

    def caution_of(self, image: torch.Tensor, target: object = None) -> str:
        """Return why the ratio of a picture ``image`` means nothing; empty if it means something.

        ``target`` has no meaning for a single number.
        """
        dark = self._percentile(image, self.low).item()
        if dark >= self.floor:
            return ""
        is_dark = "black" if dark == 0 else f"below {self.floor:g}"
        return (
            f"the {self.low:g}th percentile is {is_dark}: the ratio is to the floor of {self.floor:g} and means "
            "nothing"
        )

    def _percentile(self, image: torch.Tensor, percentage: float) -> torch.Tensor:
        return banded_percentile(photometric_luminance(image, 1.0).flatten(), percentage, self.width)

    def extra_repr(self) -> str:
        """Show the percentiles and the width."""
        return f"low={self.low:g}, high={self.high:g}, width={self.width:g}"
