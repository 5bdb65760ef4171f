"""Total annual illumination."""

from __future__ import annotations

import torch

from ..metrics import Measure
from ._metric import Hours, PointMetric
from ._sky_matrix import SkyMatrix


class TotalAnnualIllumination(PointMetric):
    """Total annual illumination in lx·h: the sum of the illuminance over all hours, as the mean over the points.

    It is linear in the coefficients, and not relaxed.

    Parameters
    ----------
    sky, during
        See `DaylightMetric`; by default all hours.

    References
    ----------
    CIE 157:2004, "Control of damage to museum objects by optical radiation", for limits of the annual exposure.
    """

    levels = tuple(step * 1e6 for step in (0.2, 0.5, 1.0, 2.0, 5.0, 10.0))
    measure = Measure(
        "total annual illumination",
        "TAI",
        unit="lx·h",
        definition="illuminance, added up over the hours of a year; mean over the points",
    )

    def __init__(self, sky: SkyMatrix, *, during: Hours = "all") -> None:
        super().__init__(sky, during=during, relaxation=0.0)

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return values.sum(-1, dtype=torch.float64)

    def extra_repr(self) -> str:
        """Show the sky."""
        return repr(self.sky)
