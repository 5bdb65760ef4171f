"""Spatial daylight autonomy."""

from __future__ import annotations

import torch

from ..metrics import Band, Measure
from ._checks import positive, share
from ._lower_limits import LowerLimits
from ._metric import RELAXATION, Hours, PointMetric, mean_over_hours
from ._plan_values import PlanValues, hours_with
from ._sky_matrix import SkyMatrix
from ._step import step

NO_BLINDS = (
    "blinds are not modeled: this is spatial daylight autonomy without blind operation, not conformant with "
    "IES LM-83, and an upper bound of its value"
)


class SpatialDaylightAutonomy(PointMetric):
    """Spatial daylight autonomy without blinds in %: share of the points that are daylit for half of the hours.

    A point counts if it has at least ``threshold`` lx in at least the ``fraction`` of the hours: sDA300/50% by
    default. IES LM-83 closes blinds in every hour in which direct sun of 1000 lx reaches more than 2 % of the
    points. This is not modeled: the value is *sDA without blind operation, not conformant with LM-83*, and an
    upper bound of sDA with blinds.

    Parameters
    ----------
    sky, during, relaxation
        See `DaylightMetric`. The share of the hours is relaxed by the same width, in units of its logarithm.
    threshold
        In lx.
    fraction
        Of the hours, above 0 and up to 1.

    Attributes
    ----------
    caution
        That the value is not that of LM-83.

    References
    ----------
    IES LM-83-12, "Spatial daylight autonomy (sDA) and annual sunlight exposure (ASE)": definition, period (8 am to
    6 pm, 3650 hours) and limits (55 % nominally accepted, 75 % preferred).
    """

    caution = NO_BLINDS
    counts_points = True

    def __init__(
        self,
        sky: SkyMatrix,
        threshold: float = 300.0,
        fraction: float = 0.5,
        *,
        during: Hours = "occupied",
        relaxation: float = RELAXATION,
    ) -> None:
        super().__init__(sky, during=during, relaxation=relaxation)
        self.threshold = positive("threshold", threshold)
        self.fraction = share("fraction", positive("fraction", fraction))

    @property
    def measure(self) -> Measure:
        """Name and unit; the limits of LM-83 for its own threshold and fraction."""
        standard = (self.threshold, self.fraction) == (300.0, 0.5)
        return LowerLimits(
            "spatial daylight autonomy without blinds",
            f"sDA{self.threshold:g}/{100 * self.fraction:g}%",
            unit="%",
            better="higher",
            bands=_LIMITS if standard else (),
            above=f"at least 75 %, {_AS_IF.format('preferred')}" if standard else "",
            source="IES LM-83" if standard else "",
            definition=f"share of the points with at least {self.threshold:g} lx in at least "
            f"{100 * self.fraction:g} % of the {self._period_in_full}",
        )

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        autonomy = mean_over_hours(step(values, self.threshold, relaxation))
        return 100 * step(autonomy, self.fraction, relaxation)

    def _on_plan(self, values: torch.Tensor) -> PlanValues:
        autonomy = mean_over_hours(step(values, self.threshold, 0.0))
        level = 100 * self.fraction
        return PlanValues(
            100 * autonomy,
            hours_with(self.threshold, self.period),
            (level,),
            f"from {level:g} % on (line), a point counts for {self.measure.symbol}",
        )

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"{super().extra_repr()}, threshold={self.threshold:g}, fraction={self.fraction:g}"


_AS_IF = "which would be '{}' if it were sDA with blinds"
_LIMITS = (
    Band(55.0, "below 55 %, the limit for nominal acceptance"),
    Band(75.0, f"at least 55 %, {_AS_IF.format('nominally accepted')}"),
)
