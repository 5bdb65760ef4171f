"""A percentile of the luminance whose derivative reaches more than two pixels."""

from __future__ import annotations

from numbers import Real

import torch

from ..errors import SceneCaptumError
from ._checks import like_input, photopic


class LuminancePercentile(torch.nn.Module):
    """Percentile of a picture's luminance, averaged over the percentiles within ``width`` of it.

    The average is exact for the linearly interpolated quantile function, ``∫ Q(t) dt / 2 width`` over
    ``[percentile − width, percentile + width]``, so every pixel in that band has a derivative. As ``width`` tends
    to 0 this tends to ``numpy.percentile``, which ``width=0`` is.

    Example
    -------
    >>> LuminancePercentile(50)(torch.ones(4, 8, 3))
    tensor(1.)

    Parameters
    ----------
    percentile
        From 0 (the darkest pixel) to 100 (the brightest).
    width
        Half-width of the band, in percentile points; what sticks out beyond 0 or 100 is cut off.
    efficacy
        Luminous efficacy in lm/W: 1 gives the relative luminance of the render, 179 gives cd/m² as in Radiance.

    Raises
    ------
    SceneCaptumError
        Where a percentage is none or, from ``forward``, a value of the image is negative or not finite.
    """

    def __init__(self, percentile: float = 95.0, *, width: float = 1.0, efficacy: float = 1.0) -> None:
        super().__init__()
        self.percentile = percent("percentile", percentile)
        self.width = percent("width", width)
        self.efficacy = efficacy

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the percentile of an ``(H, W, 3)`` image, a 0-d tensor, in its unit times ``efficacy``."""
        values = photopic(image, self.efficacy).flatten()
        return like_input(banded_percentile(values, self.percentile, self.width), image)

    def extra_repr(self) -> str:
        """Show which percentile, its band and the efficacy."""
        return f"percentile={self.percentile:g}, width={self.width:g}, efficacy={self.efficacy:g}"


def percent(name: str, value: float) -> float:
    """Return ``value`` if it lies from 0 to 100, or say what is wrong with the setting called ``name``."""
    if not isinstance(value, Real) or not 0 <= value <= 100:
        raise SceneCaptumError(f"{name} must be from 0 to 100, in percent, not {value!r}.")
    return float(value)


def banded_percentile(values: torch.Tensor, percentile: float, width: float) -> torch.Tensor:
    """Average the percentiles of ``values`` (1-d) from ``percentile − width`` to ``percentile + width``."""
    ordered = values.sort().values
    last = len(values) - 1
    low = max(percentile - width, 0.0) / 100 * last
    high = min(percentile + width, 100.0) / 100 * last
    rank = torch.arange(last + 1, dtype=values.dtype, device=values.device)
    if high > low:
        weight = (_hat_integral(high - rank) - _hat_integral(low - rank)) / (high - low)
    else:
        weight = (1 - (rank - low).abs()).clamp(min=0)
    return (weight * ordered).sum()


def _hat_integral(x: torch.Tensor) -> torch.Tensor:
    """Integrate the hat ``max(0, 1 − |t|)`` up to ``x``: linear interpolation spreads a value as a hat."""
    x = x.clamp(-1, 1)
    return 0.5 + x - x * x.abs() / 2
