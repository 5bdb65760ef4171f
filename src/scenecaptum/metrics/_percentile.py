"""Percentile of the luminance, smoothed so that more than two pixels have a derivative."""

from __future__ import annotations

from numbers import Real

import torch

from ..errors import SceneCaptumError
from ._checks import cast_like, photometric_luminance
from ._measure import Measure, luminance_unit


class LuminancePercentile(torch.nn.Module):
    """Percentile of an image's luminance, averaged over the percentiles within ``width`` of it.

    The average is the exact integral of the linearly interpolated quantile function, ``∫ Q(t) dt / 2 width`` over
    ``[percentile − width, percentile + width]``, so every pixel in that band has a derivative. ``width=0`` is
    ``numpy.percentile``, and the limit for small widths.

    Example
    -------
    >>> LuminancePercentile(50)(torch.ones(4, 8, 3))
    tensor(179.)

    Parameters
    ----------
    percentile
        From 0 (the darkest pixel) to 100 (the brightest).
    width
        Half-width of the band, in percentile points; the band is clipped to 0 and 100.
    efficacy
        Luminous efficacy in lm/W that converts radiance to luminance, as for `MeanLuminance`.

    Raises
    ------
    SceneCaptumError
        If a percentage is out of range or, from ``forward``, a value of the image is negative or not finite.
    """

    def __init__(self, percentile: float = 95.0, *, width: float = 1.0, efficacy: float = 179.0) -> None:
        super().__init__()
        self.percentile = check_percentage("percentile", percentile)
        self.width = check_percentage("width", width)
        self.efficacy = efficacy

    @property
    def measure(self) -> Measure:
        """Name and unit."""
        return Measure(f"{self.percentile:g}th percentile of luminance", unit=luminance_unit(self.efficacy))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the percentile of an ``(H, W, 3)`` image, a 0-d tensor, in its unit times ``efficacy``."""
        values = photometric_luminance(image, self.efficacy).flatten()
        return cast_like(banded_percentile(values, self.percentile, self.width), image)

    def extra_repr(self) -> str:
        """Show percentile, width and efficacy."""
        return f"percentile={self.percentile:g}, width={self.width:g}, efficacy={self.efficacy:g}"


def check_percentage(name: str, value: float) -> float:
    """Return ``value`` if it is between 0 and 100; raise otherwise."""
    if not isinstance(value, Real) or not 0 <= value <= 100:
        raise SceneCaptumError(f"{name} must be from 0 to 100, in percent, not {value!r}.")
    return float(value)


def banded_percentile(values: torch.Tensor, percentile: float, width: float) -> torch.Tensor:
    """Average the percentiles of ``values`` (1-d) from ``percentile − width`` to ``percentile + width``."""
    sorted_values = values.sort().values
    last = len(values) - 1
    low = max(percentile - width, 0.0) / 100 * last
    high = min(percentile + width, 100.0) / 100 * last
    rank = torch.arange(last + 1, dtype=values.dtype, device=values.device)
    if high > low:
        weight = (_hat_integral(high - rank) - _hat_integral(low - rank)) / (high - low)
    else:
        weight = (1 - (rank - low).abs()).clamp(min=0)
    return (weight * sorted_values).sum()


def _hat_integral(x: torch.Tensor) -> torch.Tensor:
    """Integrate the hat function ``max(0, 1 − |t|)``, the basis of linear interpolation, up to ``x``."""
    x = x.clamp(-1, 1)
    return 0.5 + x - x * x.abs() / 2
