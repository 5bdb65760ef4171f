"""Folding values that wandered out of their bounds back into them, differentiably."""

from __future__ import annotations

import math

import torch

from .errors import SceneCaptumError

# How far above an open bound a folded value stays, in units of the interval's width, or of 1 where it has none.
# The next float would be inside too, but an index of refraction of 1e-45 renders as NaN, and below 1e-4 Mitsuba
# holds a roughness fixed, so that it has no derivative.
OPEN_MARGIN = 1e-3


def reflect(values: torch.Tensor, low: float, high: float, *, open_low: bool = False) -> torch.Tensor:
    """Reflect what lies outside ``[low, high]`` at the bounds, as often as it takes to get inside.

    Example
    -------
    >>> reflect(torch.tensor([0.25, -0.25, 1.25, 2.25]), 0.0, 1.0)
    tensor([0.2500, 0.2500, 0.7500, 0.2500])
    >>> reflect(torch.tensor([-3.0, 7.0]), 0.0, math.inf)
    tensor([3., 7.])

    Values inside come back bit for bit. Noise that is symmetric about a value stays spread over the interval,
    where clipping would pile it up on the bounds, and the derivative is 1 or −1 everywhere, never 0: at a bound
    it is the one from inside.

    Parameters
    ----------
    values
        A floating point tensor of any shape.
    low, high
        The bounds; either may be infinite.
    open_low
        Whether ``low`` itself is outside. What is folded then stays at least ``OPEN_MARGIN`` above it.

    Returns
    -------
    Tensor
        Of the same shape. NaN stays NaN, and an infinity does not become finite.

    Raises
    ------
    SceneCaptumError
        Where ``low`` is not below ``high``.
    """
    if not low < high:
        raise SceneCaptumError(f"The bounds must be a low and a higher value, not {low!r} and {high!r}.")
    outside = (values <= low if open_low else values < low) | (values > high)
    # Of millions of texels few lie outside, and finding their numbers is quicker than a mask.
    (where,) = outside.reshape(-1).nonzero(as_tuple=True)
    flat = values.reshape(-1)
    folded = _fold(flat[where], low, high)
    floor = low
    if open_low and math.isfinite(low):
        floor += OPEN_MARGIN * (high - low if math.isfinite(high) else max(1.0, abs(low)))
    # The fold rounds, so that it may end one float beyond a bound; correcting this must not stop the derivative.
    correction = (folded.clamp(floor, high) - folded).detach()
    return flat.index_copy(0, where, folded + correction).reshape(values.shape)


def _fold(values: torch.Tensor, low: float, high: float) -> torch.Tensor:
    if math.isfinite(low) and math.isfinite(high):
        width = high - low
        offset = (values - low).remainder(2 * width)  # a triangle wave has twice the interval's period
        return low + torch.where(offset > width, 2 * width - offset, offset)
    if math.isfinite(low):
        return torch.where(values < low, 2 * low - values, values)
    if math.isfinite(high):
        return torch.where(values > high, 2 * high - values, values)
    return values
