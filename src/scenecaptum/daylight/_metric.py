"""Base classes of the metrics of daylight coefficients."""

from __future__ import annotations

from abc import abstractmethod
from typing import Literal, TypeAlias

import torch

from ..errors import SceneCaptumError
from ..metrics import Measure
from ._checks import choice, positive
from ._illuminance import illuminance
from ._plan_values import PlanValues
from ._sky_matrix import SkyMatrix

Hours: TypeAlias = "Literal['occupied', 'daylight', 'all'] | torch.Tensor"
_PERIODS = {"occupied": "occupied hours", "daylight": "daylight hours", "all": "hours"}
_IN_FULL = {"occupied hours": " (8 am to 6 pm)", "daylight hours": " (the 4380 brightest)"}

# Measured in side-lit rooms (DaylightMetric, Notes). Spatial metrics need the width: with 3 % of noise in the
# coefficients of 40 points, the derivative of sDA spreads by 60 % at 0.02, by 20 % at 0.05, and by 4 % at 0.1.
RELAXATION = 0.1


class DaylightMetric(torch.nn.Module):
    """Base class of the metrics of daylight coefficients: a number from the illuminance of points over hours.

    All points have the same weight.

    Parameters
    ----------
    sky
        The sky of every hour.
    during
        The hours that count: ``"occupied"`` for 8 am to 6 pm of every day (`Weather.occupied`), ``"daylight"`` for
        the 4380 brightest of a year (`Weather.daylight`), ``"all"``, or a ``(hours,)`` bool mask. The first two
        need a sky with weather.
    relaxation
        Width of the transition at each threshold in units of ``ln illuminance``, so that the metric has a
        derivative: between ``exp(−3 relaxation)`` and ``exp(3 relaxation)`` times the threshold, what counts rises
        from 0 to 1 as a sigmoid (a cubic smoothstep). 0 gives the published definition, as does ``hard``.

    Attributes
    ----------
    sky
        The sky in the hours that count.
    period
        These hours in words, such as ``"occupied hours"``.
    counts_points
        Whether the published value is the share of the points that pass, which changes by whole points.
    greatest
        The published value where every point counts, of a metric that counts points; None for others.

    Notes
    -----
    In side-lit rooms, the default relaxation changes metrics that average over hours by up to 0.15 percentage
    points, and their derivatives are within 5 % of exact differences. Metrics that count points differ from the
    exact value by up to 3 percentage points with 200 points, and by up to 6 with 40 points: near a
    limit, ``hard`` decides.

    Raises
    ------
    SceneCaptumError
        If a setting is invalid, or the dates of the hours are needed and unknown; from ``forward``, if the
        coefficients do not fit the sky, or have values that are negative or not finite.
    """

    counts_points = False

    def __init__(self, sky: SkyMatrix, *, during: Hours = "occupied", relaxation: float = RELAXATION) -> None:
        super().__init__()
        self.sky = sky.select(hours_mask(sky, during))
        self.period = "chosen hours" if isinstance(during, torch.Tensor) else _PERIODS[during]
        self.relaxation = positive("relaxation", relaxation, or_zero=True)

    @property
    @abstractmethod
    def measure(self) -> Measure:
        """Name, unit, direction and classes."""

    @property
    def greatest(self) -> float | None:
        """The published value where every point counts; None of a metric that does not count points."""
        return 100.0 if self.counts_points else None

    @property
    def _period_in_full(self) -> str:
        return self.period + _IN_FULL.get(self.period, "")

    def forward(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Return the value for daylight coefficients ``(points, P, 3)``, a 0-d tensor."""
        return _cast(self._value(illuminance(coefficients, self.sky), self.relaxation), coefficients)

    def hard(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Return the value by the published definition, without relaxation and without a derivative."""
        with torch.no_grad():
            return _cast(self._value(illuminance(coefficients, self.sky), 0.0), coefficients)

    def in_words(self, coefficients: torch.Tensor) -> str:
        """Return what the value by the definition consists of, in a sentence; empty if it is one number."""
        return ""

    def step_of_a_point(self, coefficients: torch.Tensor) -> float | None:
        """Return what one point adds to a value that counts points, in its unit; None for others."""
        return 100 / len(coefficients) if self.counts_points else None

    def on_plan(self, coefficients: torch.Tensor) -> PlanValues:
        """Return what a map of the room shows for daylight coefficients ``(points, P, 3)``, without relaxation.

        It is the value of each point; of metrics that count points, what they compare with a limit; of others,
        the mean illuminance.
        """
        with torch.no_grad():
            return self._on_plan(illuminance(coefficients, self.sky))

    def _on_plan(self, values: torch.Tensor) -> PlanValues:
        """Return what a map shows for the illuminance ``(points, hours)`` in lx."""
        return PlanValues(mean_over_hours(values), "mean illuminance in lx")

    @abstractmethod
    def _value(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        """Return the value for the illuminance ``(points, hours)`` in lx, a 0-d tensor."""

    def extra_repr(self) -> str:
        """Show the sky and the relaxation."""
        return f"{self.sky!r}, relaxation={self.relaxation:g}"


class PointMetric(DaylightMetric):
    """Base class of the metrics that have a value for each point, whose mean is the metric.

    ``levels`` are those of the contours on a map of the room.
    """

    levels: tuple[float, ...] = (25.0, 50.0, 75.0)  # of shares in %

    def of_points(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Return the value of each point, ``(points,)``, in the unit of the metric."""
        return _cast(self._of_points(illuminance(coefficients, self.sky), self.relaxation), coefficients)

    def hard_of_points(self, coefficients: torch.Tensor) -> torch.Tensor:
        """Return the value of each point by the published definition, without relaxation or derivative."""
        with torch.no_grad():
            return _cast(self._of_points(illuminance(coefficients, self.sky), 0.0), coefficients)

    @abstractmethod
    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        """Return the value of each point for the illuminance ``(points, hours)`` in lx."""

    def _value(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        return self._of_points(values, relaxation).mean()

    def _on_plan(self, values: torch.Tensor) -> PlanValues:
        label = f"{self._map_name()} in {self.measure.unit}"
        return PlanValues(self._of_points(values, 0.0), label, self.levels)

    def _map_name(self) -> str:
        """Return what a map shows of each point, without its unit."""
        return self.measure.name


def hours_mask(sky: SkyMatrix, during: Hours) -> torch.Tensor:
    """Return which hours of a sky count, ``(hours,)`` bool."""
    if isinstance(during, torch.Tensor):
        return during
    if choice("during", during, ("occupied", "daylight", "all")) == "all":
        return torch.ones(sky.hours, dtype=torch.bool)
    if sky.weather is None:
        raise SceneCaptumError(
            f"during={during!r} needs the dates of the hours, which this sky does not have: create it with "
            "weather=, or give during='all' or a mask."
        )
    return sky.weather.occupied() if during == "occupied" else sky.weather.daylight()


def mean_over_hours(values: torch.Tensor) -> torch.Tensor:
    """Average ``(points, hours)`` in float64: shares of thousands of hours are compared with a threshold."""
    return values.mean(-1, dtype=torch.float64)


def _cast(value: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    return value.to(torch.promote_types(coefficients.dtype, torch.float32))
