"""Differentiable reflection of values at their bounds."""

from __future__ import annotations

import math

import torch

from ..errors import SceneCaptumError

# Minimum distance of a reflected value from an open bound, relative to the width of the interval, or to 1 if it is
# infinite. The next float would be inside too, but an index of refraction of 1e-45 renders as NaN, and below 1e-4
# Mitsuba clamps a roughness, so it has no derivative.
OPEN_MARGIN = 1e-3


def reflect(values: torch.Tensor, low: float, high: float, *, open_low: bool = False) -> torch.Tensor:
    """Reflect values outside ``[low, high]`` at the bounds, repeatedly until they lie inside.

    Example
    -------
    >>> reflect(torch.tensor([0.25, -0.25, 1.25, 2.25]), 0.0, 1.0)
    tensor([0.2500, 0.2500, 0.7500, 0.2500])
    >>> reflect(torch.tensor([-3.0, 7.0]), 0.0, math.inf)
    tensor([3., 7.])

    Values inside are returned unchanged. NaN stays NaN, and an infinity does not become finite. Unlike clipping,
    reflection does not accumulate noisy values at the bounds. The derivative is 1 or −1 everywhere, never 0; at a
    bound it is the one from inside. With ``open_low``, ``low`` itself is excluded, and reflected values stay at
    least ``OPEN_MARGIN`` above it.

    Raises
    ------
    SceneCaptumError
        If ``low`` is not below ``high``.
    """
    if not low < high:
        raise SceneCaptumError(f"The lower bound must be below the upper bound, not {low!r} and {high!r}.")
    outside = (values <= low if open_low else values < low) | (values > high)
    # Usually few of millions of texels lie outside; indexing them is faster than a mask.
    (indices,) = outside.reshape(-1).nonzero(as_tuple=True)
    flat = values.reshape(-1)
    folded = _fold(flat[indices], low, high)
    floor = low
    if open_low and math.isfinite(low):
        floor += OPEN_MARGIN * (high - low if math.isfinite(high) else max(1.0, abs(low)))
    # Rounding may leave a value one float beyond a bound; the correction must not change the derivative.
    correction = (folded.clamp(floor, high) - folded).detach()
    return flat.index_copy(0, indices, folded + correction).reshape(values.shape)


def clamp_inside(
    moved: torch.Tensor, start: torch.Tensor, low: float, high: float, margin: float
) -> torch.Tensor:
    """Clamp values that moved from ``start`` to a distance from their bounds, which may be degenerate.

    A value that starts nearer to a bound may stay there.

    Example
    -------
    >>> clamp_inside(torch.tensor([-1.0, 0.5, 2.0]), torch.tensor([0.5, 0.5, 1.0]), 0.0, 1.0, margin=0.01)
    tensor([0.0100, 0.5000, 1.0000])
    """
    lowest, highest = start.clamp(max=low + margin), start.clamp(min=high - margin)
    return torch.minimum(torch.maximum(moved, lowest), highest)


def _fold(values: torch.Tensor, low: float, high: float) -> torch.Tensor:
    if math.isfinite(low) and math.isfinite(high):
        width = high - low
        offset = (values - low).remainder(2 * width)  # triangle wave with a period of twice the width
        return low + torch.where(offset > width, 2 * width - offset, offset)
    if math.isfinite(low):
        return torch.where(values < low, 2 * low - values, values)
    if math.isfinite(high):
        return torch.where(values > high, 2 * high - values, values)
    return values
