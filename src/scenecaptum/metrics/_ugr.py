"""The unified glare rating of CIE 117."""

from __future__ import annotations

import torch

from ._glare import GlareRating
from ._sources import Sources

_LEAST = 1e-300  # a sum of sources that underflows still has a logarithm


class UnifiedGlareRating(GlareRating):
    """Unified glare rating, ``UGR = 8 log10(0.25 / Lb · Σ L² ω / P²)``, without a unit.

    L is the luminance of a source, ω its solid angle, P its Guth position index and Lb the luminance of the
    background, at least 1e-6 cd/m². Without a source the rating and its gradient are 0; where the brightest pixel
    is still inside the transition around the threshold, the rating is multiplied by that pixel's weight, so it
    starts from 0 without a jump. 10 is imperceptible, 16 just perceptible, 19 the limit for offices, 28 just
    uncomfortable.

    Example
    -------
    >>> from scenecaptum import Camera
    >>> camera = Camera.perspective(32, 32, fov_x=60)
    >>> picture = torch.full((32, 32, 3), 0.5)
    >>> picture[4:7, 14:18] = 100.0
    >>> UnifiedGlareRating(camera)(picture).item() > 19
    True

    Notes
    -----
    CIE 117-1995; sources, position index and background are those of evalglare 3.06 (see `GlareRating` for the
    parameters).
    """

    half_class = 1.5  # CIE 117: 10, 13, 16, 19, 22, 25, 28

    def _rate(self, luminance: torch.Tensor, found: Sources | None) -> torch.Tensor:
        if found is None:
            return 0.0 * luminance.sum()
        total = (found.luminance**2 * found.solid_angle / found.index**2).sum().clamp(min=_LEAST)
        return found.presence * 8 * torch.log10(0.25 * total / found.background)
