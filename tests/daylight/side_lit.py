"""Daylight coefficients of a room with a window in the south, by a formula."""

from __future__ import annotations

import torch

from scenecaptum.daylight import SkyPatches

_GLASS = 0.7
_INTERREFLECTED = 0.012  # of the irradiance of the window


def side_lit_room(
    patches: SkyPatches, depths: int = 8, columns: int = 5, *, direct_only: bool = False
) -> torch.Tensor:
    """Return coefficients ``(depths · columns, P, 3)`` in float64 of points at 0.25 m to 7.75 m from the window.

    The window is 4 m wide and goes from the height of the points to 1.9 m above them. A patch is seen if the
    direction to its center passes through it.
    """
    x, y = torch.meshgrid(
        torch.linspace(-1.8, 1.8, columns, dtype=torch.float64),
        torch.linspace(0.25, 7.75, depths, dtype=torch.float64),
        indexing="ij",
    )
    directions, size = patches.directions, patches.solid_angles
    south = -directions[:, 1].clamp(max=0)
    distance = y.flatten()[:, None] / south.clamp(min=1e-9)
    across = x.flatten()[:, None] + distance * directions[:, 0]
    up = distance * directions[:, 2]
    seen = (across.abs() < 2) & (up > 0) & (up < 1.9) & (south > 0)
    direct = seen * patches.projected_solid_angles
    reflected = 0.0 if direct_only else _INTERREFLECTED * size * south / (1 + y.flatten()[:, None] / 4)
    return (_GLASS * (direct + reflected))[..., None].expand(-1, -1, 3).contiguous()
