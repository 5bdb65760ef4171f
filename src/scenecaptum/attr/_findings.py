"""What an explanation finds: sources, changes, rows of points, and a value by the definition."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..student import DISAGREEMENT_LEVEL, student_t

SIGNIFICANT = 2.0  # standard errors below which an effect is not stated
_ROUNDING = 1e-6  # relative, of single precision
NONLINEAR = 0.2  # of the rendered effect: a prediction that is off by more is marked
LACKING = 0.1  # of a change of a glare rating


@dataclass(frozen=True)
class Source:
    """An object of the picture that the metric depends on, such as a glare source.

    Attributes
    ----------
    name
        The object.
    place
        The centre of its share in the picture, ``"top left"``, or of its parts: ``"left and right"``. Parts with
        little of its share do not count.
    share, share_error
        Its share of the whole picture's part in the metric, from 0 to 1, and the standard error: of glare sources
        the share of the sum of ``L² ω / P²``, of other metrics that of ``|∂M/∂I · I|``.
    luminance
        The mean luminance of its part of the glare sources in cd/m², weighted by the share of each pixel in the
        glare, so above a meter's mean; None for other metrics.
    """

    name: str
    place: str
    share: float
    share_error: float
    luminance: float | None = None


@dataclass(frozen=True)
class Change:
    """A change of one parameter, and its effect on the metric.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable label.
    before, after
        Its values.
    predicted, predicted_error
        The effect to first order, from the gradient, and its standard error.
    measured, measured_error
        The effect of rendering the changed scene, with the same random numbers, and its standard error; None if it
        was not rendered.
    exact, exact_error
        The metric of the changed scene by its published definition, if that differs from the metric, and the
        standard error of its difference from that of the scene as it is, with the same random numbers.
    degrees_of_freedom
        Of the standard errors: one less than the replicates.
    missing
        How much more than in the scene as it is a glare rating lacks of lamps that cover pixels in part.
    relative
        By how much a glare rating changes whose threshold is five times the mean luminance, where the main source
        is near an absolute one; None elsewhere.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    predicted: float
    predicted_error: float
    measured: float | None = None
    measured_error: float | None = None
    exact: float | None = None
    exact_error: float | None = None
    degrees_of_freedom: int = 7
    missing: float = 0.0
    relative: float | None = None

    @property
    def is_clear(self) -> bool:
        """Whether its effect is clear of the noise, as predicted and as rendered."""
        if abs(self.predicted) <= SIGNIFICANT * self.predicted_error:
            return False
        return self.measured is None or abs(self.measured) > SIGNIFICANT * (self.measured_error or 0.0)

    @property
    def is_linear(self) -> bool:
        """Whether the rendered effect is close to the predicted one, or no different within the errors.

        The error of a few replicates is itself uncertain: by chance, two standard errors are exceeded by one in
        twelve of linear changes with 8 replicates, and those of a 99.7 % interval of Student's t by one in 300.
        """
        if self.measured is None:
            return True
        apart = abs(self.measured - self.predicted)
        error = math.hypot(self.predicted_error, self.measured_error or 0.0)
        noise = student_t(DISAGREEMENT_LEVEL, self.degrees_of_freedom) * error
        return apart <= max(noise, NONLINEAR * abs(self.measured))


def lacks_much(missing: float, change: float, error: float | None) -> bool:
    """Whether a change of a glare rating lacks much at the edges of lamps, and more than its noise."""
    return abs(missing) > max(LACKING * abs(change), error or 0.0)


@dataclass(frozen=True)
class Row:
    """A row of points of a sensor grid, and the effect of more light there on a metric of daylight.

    Attributes
    ----------
    number
        Its number, from 1.
    name
        Its place: ``"y = 5 m"``.
    side
        The side of the plan from which rows are counted: ``"top"``, or of columns ``"left"``.
    count
        The number of its points.
    value
        The mean of the metric over its points by the definition; None for metrics that points do not have.
    effect, effect_error
        The effect of 10 % more light at its points to first order, and its standard error.
    towards
        The direction in the scene that points to this side on the plan: ``"y"``, or ``"−z"`` where y is up.
    """

    number: int
    name: str
    side: str
    count: int
    value: float | None
    effect: float
    effect_error: float
    towards: str = "y"


@dataclass(frozen=True)
class Definition:
    """The value of a metric by its published definition, where its derivative needs a relaxed one.

    Attributes
    ----------
    value
        In the unit of the metric.
    verdict
        The meaning of its class; empty if the metric has no classes.
    points
        The number of points, if the value is the share of them that pass.
    error
        The standard error of the value; None if it is not known.
    step
        What one point adds to the value, if it counts points, by default their share; None for a mean over them.
    greatest
        The value where every point counts, if it counts points.
    """

    value: float
    verdict: str
    points: int | None = None
    error: float | None = None
    step: float | None = None
    greatest: float | None = None

    def __post_init__(self) -> None:
        if self.step is None and self.points:
            object.__setattr__(self, "step", 100 / self.points)
        if self.greatest is None and self.points:
            object.__setattr__(self, "greatest", 100.0)

    @property
    def counts_none(self) -> bool:
        """Whether no point counts, so that small changes have no effect."""
        return self.greatest is not None and self.value == 0

    @property
    def counts_all(self) -> bool:
        """Whether every point counts, so that small changes have no effect."""
        return self.greatest is not None and math.isclose(self.value, self.greatest, rel_tol=_ROUNDING)


def is_clear(effect: float, error: float | None) -> bool:
    """Whether an effect is clear of the noise."""
    return abs(effect) > SIGNIFICANT * (error or 0.0)


def are_far_apart(first: float, second: float, *errors: float | None) -> bool:
    """Whether two changes of a metric differ by more than the smaller one, and clearly more than their errors."""
    difference, error = abs(first - second), math.hypot(*(error or 0.0 for error in errors))
    return difference > min(abs(first), abs(second)) and is_clear(difference, error)
