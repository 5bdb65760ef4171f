"""Annual sunlight exposure."""

from __future__ import annotations

import torch

from ..metrics import Band, Measure
from ._checks import positive
from ._metric import RELAXATION, Hours, PointMetric
from ._plan_values import PlanValues
from ._sky_matrix import SkyMatrix
from ._step import step


class AnnualSunlightExposure(PointMetric):
    """Annual sunlight exposure in %: share of the points in direct sun for more than ``hours``.

    A point counts if the illuminance by direct sun is above ``threshold`` lx in more than ``hours`` hours:
    ASE1000,250h by default. Blinds stay open, as in IES LM-83.

    The coefficients must be those of direct light, without interreflection
    (``SceneRenderer(…, direct_sky=True)``), and the sky that of the sun
    (``SkyMatrix.from_weather(…, sun="only")``). The patches of a sky blur the sun. LM-83 wants its true position,
    which finer patches approach: use ``SkyPatches.reinhart(4)``, or a finer one.

    Parameters
    ----------
    sky, during, relaxation
        See `DaylightMetric`. The number of hours is relaxed by the same width, in units of its logarithm.
    threshold
        In lx.
    hours
        Number of hours in which direct sun is accepted.

    References
    ----------
    IES LM-83-12, "Spatial daylight autonomy (sDA) and annual sunlight exposure (ASE)": definition, period (8 am to
    6 pm, 3650 hours) and limits.
    """

    counts_points = True

    def __init__(
        self,
        sky: SkyMatrix,
        threshold: float = 1000.0,
        hours: float = 250.0,
        *,
        during: Hours = "occupied",
        relaxation: float = RELAXATION,
    ) -> None:
        super().__init__(sky, during=during, relaxation=relaxation)
        self.threshold = positive("threshold", threshold)
        self.hours = positive("hours", hours)

    @property
    def measure(self) -> Measure:
        """Name and unit; the limits of LM-83 for its own threshold and hours."""
        standard = (self.threshold, self.hours) == (1000.0, 250.0)
        return Measure(
            "annual sunlight exposure",
            f"ASE{self.threshold:g},{self.hours:g}h",
            unit="%",
            better="lower",
            bands=_LIMITS if standard else (),
            above="above 10 %, unsatisfactory visual comfort" if standard else "",
            source="IES LM-83" if standard else "",
            definition=f"share of the points with more than {self.threshold:g} lx of direct sun in more than "
            f"{self.hours:g} {self._period_in_full} of a year",
        )

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        sunny = step(values, self.threshold, relaxation, exclusive=True).sum(-1, dtype=torch.float64)
        return 100 * step(sunny, self.hours, relaxation, exclusive=True)

    def _on_plan(self, values: torch.Tensor) -> PlanValues:
        sunny = step(values, self.threshold, 0.0, exclusive=True).sum(-1, dtype=torch.float64)
        label = f"{self.period} with more than {self.threshold:g} lx of direct sun"
        counts = f"above {self.hours:g} hours (line), a point counts for {self.measure.symbol}"
        return PlanValues(sunny, label, (self.hours,), counts)

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"{super().extra_repr()}, threshold={self.threshold:g}, hours={self.hours:g}"


_LIMITS = (
    Band(3.0, "up to 3 %, clearly acceptable visual comfort"),
    Band(7.0, "up to 7 %, nominally acceptable visual comfort"),
    Band(10.0, "above 7 %, the limit for nominally acceptable visual comfort"),
)
