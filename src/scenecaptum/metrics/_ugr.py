"""Unified glare rating (CIE 117)."""

from __future__ import annotations

import torch

from ._glare import GlareRating
from ._measure import UGR
from ._sources import Sources

_MIN_SUM = 1e-300  # keeps the logarithm finite where the sum over sources underflows


class UnifiedGlareRating(GlareRating):
    """Unified glare rating, ``UGR = 8 log10(0.25 / Lb · Σ L² ω / P²)``, dimensionless.

    L is the luminance of a source, ω its solid angle, P its Guth position index and Lb the background
    luminance, at least 1e-6 cd/m². Without a source the rating and its gradient are 0. If the brightest pixel
    lies inside the transition around the threshold, the rating is multiplied by that pixel's weight, so that it
    is continuous. 10 is imperceptible, 16 just perceptible, 19 the limit for offices, 28 just uncomfortable.

    Example
    -------
    >>> from scenecaptum import Camera
    >>> camera = Camera.perspective(32, 32, fov_x=60)
    >>> image = torch.full((32, 32, 3), 0.5)
    >>> image[4:7, 14:18] = 100.0
    >>> UnifiedGlareRating(camera)(image).item() > 19
    True

    Notes
    -----
    CIE 117-1995, with sources, position index and background as in evalglare 3.06 (see `GlareRating` for the
    parameters).
    """

    measure = UGR

    def _rate(self, luminance: torch.Tensor, sources: Sources | None) -> torch.Tensor:
        if sources is None:
            return 0.0 * luminance.sum()
        total = (sources.luminance**2 * sources.solid_angle / sources.position_index**2).sum()
        return sources.max_weight * 8 * torch.log10(0.25 * total.clamp(min=_MIN_SUM) / sources.background)
