"""The daylight glare index of Hopkinson."""

from __future__ import annotations

import torch

from ._glare import GlareRating
from ._sources import Sources

_LEAST = 1e-300  # a sum of sources that underflows still has a logarithm


class DaylightGlareIndex(GlareRating):
    """Daylight glare index, ``DGI = 10 log10 Σ 0.478 L^1.6 Ω^0.8 / (Lb + 0.07 √ω L)``, without a unit.

    L is the luminance of a source, ω its solid angle, ``Ω = ω / P²`` that solid angle lessened by the Guth
    position index and Lb the luminance of the background. Without a source the index and its gradient are 0;
    inside the transition around the threshold it is multiplied by the weight of the brightest pixel, as is
    `UnifiedGlareRating`. 16 is just perceptible, 24 just uncomfortable.

    Notes
    -----
    Hopkinson, Applied Ergonomics 3 (1972), 206–215, in evalglare's form (see `GlareRating` for the parameters).
    """

    half_class = 2.0  # 16, 20, 24, 28

    def _rate(self, luminance: torch.Tensor, found: Sources | None) -> torch.Tensor:
        if found is None:
            return 0.0 * luminance.sum()
        weighted = (found.solid_angle / found.index**2) ** 0.8
        around = found.background + 0.07 * found.solid_angle.sqrt() * found.luminance
        total = (0.478 * found.luminance**1.6 * weighted / around).sum().clamp(min=_LEAST)
        return found.presence * 10 * torch.log10(total)
