"""Daylight glare index (Hopkinson)."""

from __future__ import annotations

import torch

from ._glare import GlareRating
from ._measure import DGI
from ._sources import Sources

_MIN_SUM = 1e-300  # keeps the logarithm finite where the sum over sources underflows


class DaylightGlareIndex(GlareRating):
    """Daylight glare index, ``DGI = 10 log10 Σ 0.478 L^1.6 Ω^0.8 / (Lb + 0.07 √ω L)``, dimensionless.

    L is the luminance of a source, ω its solid angle, ``Ω = ω / P²`` its solid angle weighted by the Guth
    position index, and Lb the background luminance. Without a source the index and its gradient are 0; inside
    the transition around the threshold it is multiplied by the weight of the brightest pixel, as for
    `UnifiedGlareRating`. 16 is just perceptible, 24 just uncomfortable.

    Notes
    -----
    Hopkinson, Applied Ergonomics 3 (1972), 206–215, in evalglare's form (see `GlareRating` for the parameters).
    """

    measure = DGI

    def _rate(self, luminance: torch.Tensor, sources: Sources | None) -> torch.Tensor:
        if sources is None:
            return 0.0 * luminance.sum()
        weighted = (sources.solid_angle / sources.position_index**2) ** 0.8
        surround = sources.background + 0.07 * sources.solid_angle.sqrt() * sources.luminance
        total = (0.478 * sources.luminance**1.6 * weighted / surround).sum().clamp(min=_MIN_SUM)
        return sources.max_weight * 10 * torch.log10(total)
