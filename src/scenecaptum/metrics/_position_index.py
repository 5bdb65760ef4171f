"""Guth position index of glare sources."""

from __future__ import annotations

import torch

_DOWNWARD_STRETCH = 1.15  # of directions below the line of sight


def position_index(directions: torch.Tensor) -> torch.Tensor:
    """Return the Guth position index of each direction: from 1 on the line of sight to at most 16.

    Above the line of sight it is Guth's formula in the IES Lighting Handbook and CIE 117,
    ``ln P = (35.2 − 0.31889 τ − 1.22 exp(−2τ/9)) 10⁻³ σ + (21 + 0.26667 τ − 0.002963 τ²) 10⁻⁵ σ²``, where σ is the
    angle from the line of sight and τ the angle between the vertical and the plane through the direction and the
    line of sight, in degrees. Below it, as in evalglare 3.06, the direction is stretched downward by 1.15 on the
    plane in front of the eye and ``ln P = 6.49 10⁻³ σ + 21 10⁻⁵ σ²``, which is Guth's formula at τ = 90°. Older
    versions of evalglare used Iwata's.

    Parameters
    ----------
    directions
        ``(..., 3)`` unit vectors, x right, y up, z along the line of sight.

    Returns
    -------
    Tensor
        ``(...)``.

    Notes
    -----
    The lower branch was verified: it reproduces the index image of ``evalglare -p`` up to the rounding of the
    image format, and the indices that ``evalglare -d`` prints to 2e-6.
    """
    x, y, z = directions.unbind(-1)
    below = y < 0
    sigma = torch.rad2deg(torch.atan2(torch.hypot(x, torch.where(below, _DOWNWARD_STRETCH * y, y)), z))
    tau = torch.rad2deg(torch.atan2(x.abs(), y))
    linear = torch.where(below, 6.49, 35.2 - 0.31889 * tau - 1.22 * torch.exp(-2 * tau / 9))
    square = torch.where(below, 21.0, 21 + 0.26667 * tau - 0.002963 * tau**2)
    return torch.exp(linear * 1e-3 * sigma + square * 1e-5 * sigma**2).clamp(max=16.0)
