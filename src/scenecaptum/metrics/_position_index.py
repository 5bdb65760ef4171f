"""How much less a source disturbs, the further it is from the line of sight."""

from __future__ import annotations

import torch

_BELOW = 1.15  # a source below the line of sight counts as this much further down


def position_index(directions: torch.Tensor) -> torch.Tensor:
    """Return the Guth position index of each direction: 1 on the line of sight, growing away from it, at most 16.

    Above the line of sight it is Guth's formula in the IES Lighting Handbook and CIE 117,
    ``ln P = (35.2 − 0.31889 τ − 1.22 exp(−2τ/9)) 10⁻³ σ + (21 + 0.26667 τ − 0.002963 τ²) 10⁻⁵ σ²``, where σ is the
    angle from the line of sight and τ the angle from the vertical of the plane that holds both, in degrees. Below
    it evalglare 3.06 stretches the direction downward by 1.15 on the plane in front of the eye and takes
    ``ln P = 6.49 10⁻³ σ + 21 10⁻⁵ σ²`` there, which is Guth's formula at τ = 90°; older versions used Iwata's.

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
    The lower branch was measured: it reproduces the picture of indices that ``evalglare -p`` writes to the
    rounding of the picture's format, and the indices that ``evalglare -d`` prints to 2e-6.
    """
    x, y, z = directions.unbind(-1)
    below = y < 0
    sigma = torch.rad2deg(torch.atan2(torch.hypot(x, torch.where(below, _BELOW * y, y)), z))
    tau = torch.rad2deg(torch.atan2(x.abs(), y))
    linear = torch.where(below, 6.49, 35.2 - 0.31889 * tau - 1.22 * torch.exp(-2 * tau / 9))
    square = torch.where(below, 21.0, 21 + 0.26667 * tau - 0.002963 * tau**2)
    return torch.exp(linear * 1e-3 * sigma + square * 1e-5 * sigma**2).clamp(max=16.0)
