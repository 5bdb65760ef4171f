"""Daylight provision of EN 17037."""

from __future__ import annotations

from typing import Literal

import torch

from ..metrics import Band, Measure
from ._checks import choice
from ._illuminance import illuminance
from ._lower_limits import LowerLimits
from ._metric import RELAXATION, DaylightMetric, Hours, mean_over_hours
from ._plan_values import PlanValues, hours_with
from ._sky_matrix import SkyMatrix
from ._step import step

Level = Literal["minimum", "medium", "high"]

# Target illuminance and minimum target illuminance in lx: table A.1.
_ILLUMINANCES = {"minimum": (300.0, 100.0), "medium": (500.0, 300.0), "high": (750.0, 500.0)}
_SHARES_OF_POINTS = (0.5, 0.95)
_SHARE_OF_HOURS = 0.5


class DaylightProvision(DaylightMetric):
    """Daylight provision of EN 17037 in %: how much of the required points are daylit; from 100 on, all of them.

    A point is daylit at an illuminance if it has at least that in at least half of the daylight hours. EN 17037
    wants half of the points daylit at a target, and 95 % at a minimum target: 300 and 100 lx for the level
    ``"minimum"``, 500 and 300 lx for ``"medium"``, 750 and 500 lx for ``"high"``. The value is the smaller of the
    two ratios of the daylit to the required share.

    Parameters
    ----------
    sky, during, relaxation
        See `DaylightMetric`; by default the 4380 daylight hours. The share of the hours is relaxed by the same
        width, in units of its logarithm.
    level
        ``"minimum"``, ``"medium"`` or ``"high"``.

    Notes
    -----
    The half of the hours is counted for each point. Some programs count the hours in which enough points reach the
    target at once, which can give another result where different points are bright at different times. Points
    within 0.5 m of the walls, which EN 17037 excludes, are for the caller to leave out.

    References
    ----------
    EN 17037:2018, "Daylight in buildings", table A.1, for vertical and inclined openings, by method 2 (calculation
    of illuminance).
    """

    def __init__(
        self,
        sky: SkyMatrix,
        level: Level = "minimum",
        *,
        during: Hours = "daylight",
        relaxation: float = RELAXATION,
    ) -> None:
        super().__init__(sky, during=during, relaxation=relaxation)
        self.level = choice("level", level, tuple(_ILLUMINANCES))

    @property
    def measure(self) -> Measure:
        """Name and unit, and the limit of 100 %."""
        return LowerLimits(
            f"daylight provision, {self.level} level",
            unit="%",
            better="higher",
            bands=(Band(100.0, f"below the {self.level} level"),),
            above=f"at least the {self.level} level",
            source="EN 17037, table A.1",
            definition=self._definition(),
        )

    def _definition(self) -> str:
        needs = " and ".join(
            f"{100 * share:g} % of the points have at least {target:g} lx"
            for target, share in zip(_ILLUMINANCES[self.level], _SHARES_OF_POINTS, strict=True)
        )
        return (
            f"in % of the points that EN 17037 requires: 100 % where {needs}, each for half of the "
            f"{self._period_in_full}; the smaller of the two ratios to what is required"
        )

    def in_words(self, coefficients: torch.Tensor) -> str:
        """Return the shares of the points that are daylit, the required ones, and which target decides."""
        with torch.no_grad():
            values = illuminance(coefficients, self.sky)
        shares = ", ".join(
            f"{target:g} lx at {100 * _daylit(values, target, 0.0).item():.3g} % of the points "
            f"({100 * required:g} required)"
            for target, required in zip(_ILLUMINANCES[self.level], _SHARES_OF_POINTS, strict=True)
        )
        return f"{shares}: {_ILLUMINANCES[self.level][self._deciding(values)]:g} lx decides"

    @property
    def greatest(self) -> float | None:
        """The value where every point is daylit: that of the larger required share."""
        return 100 / max(_SHARES_OF_POINTS)

    def step_of_a_point(self, coefficients: torch.Tensor) -> float:
        """Return what one point adds to the smaller of the two ratios, in %."""
        with torch.no_grad():
            deciding = self._deciding(illuminance(coefficients, self.sky))
        return 100 / (_SHARES_OF_POINTS[deciding] * len(coefficients))

    def _deciding(self, values: torch.Tensor) -> int:
        """Return which target has the smaller ratio by the definition: 0, or 1 for the minimum target."""
        target, minimum = self._ratios(values, 0.0)
        return 0 if target <= minimum else 1

    def _value(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return 100 * torch.minimum(*self._ratios(values, relaxation))

    def _ratios(self, values: torch.Tensor, relaxation: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the daylit share relative to the required one, at the target and at the minimum target."""
        target, minimum = (
            _daylit(values, target, relaxation) / required
            for target, required in zip(_ILLUMINANCES[self.level], _SHARES_OF_POINTS, strict=True)
        )
        return target, minimum

    def _on_plan(self, values: torch.Tensor) -> PlanValues:
        target = _ILLUMINANCES[self.level][self._deciding(values)]
        daylit = mean_over_hours(step(values, target, 0.0))
        level = 100 * _SHARE_OF_HOURS
        counts = f"from {level:g} % on (line), a point reaches the target that decides"
        return PlanValues(100 * daylit, hours_with(target, self.period), (level,), counts)

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"{super().extra_repr()}, level={self.level!r}"


def _daylit(values: torch.Tensor, illuminance: float, relaxation: float) -> torch.Tensor:
    """Return the share of the points that are daylit at an illuminance."""
    hours = mean_over_hours(step(values, illuminance, relaxation))
    return step(hours, _SHARE_OF_HOURS, relaxation).mean()
