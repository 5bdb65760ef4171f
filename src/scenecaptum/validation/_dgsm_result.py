"""The result of the derivative-based global sensitivity measures, with its table."""

from __future__ import annotations

from dataclasses import dataclass

from ..visualization import align_with_errors, format_with_error, grid, pluralize, shorten

_NAME_WIDTH, _MAX_ROWS = 34, 40


@dataclass(frozen=True)
class GlobalDerivative:
    """Mean squared derivative with respect to one parameter.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable one.
    low, high
        The interval in which the parameter was varied, in its unit.
    nu, nu_error
        ``ν = E[(∂M/∂θ)²]`` per unit of the parameter, squared.
    bound, bound_error
        ``(high − low)² ν / (π² Var M)``: upper bound of the total Sobol index. NaN if the variance of the metric
        is below the noise.
    """

    name: str
    label: str
    low: float
    high: float
    nu: float
    nu_error: float
    bound: float
    bound_error: float


@dataclass(frozen=True, repr=False)
class DGSM:
    """Derivative-based global sensitivity of every parameter; prints as a table.

    Attributes
    ----------
    rows
        One per parameter, the largest first.
    metric
        Name of the metric.
    variance, variance_error
        Variance of the metric over the intervals.
    points
        Number of sampled scenes.
    renders
        Total number of renders and backward passes, in units of ``spp`` samples per pixel.
    seconds
        Wall-clock time.
    """

    rows: tuple[GlobalDerivative, ...]
    metric: str
    variance: float
    variance_error: float
    points: int
    renders: float
    seconds: float

    def text(self, top: int | None = _MAX_ROWS) -> str:
        """Return the table that ``print`` shows, of the first ``top`` parameters; None for all."""
        rows = self.rows[:top]
        columns = {
            "parameter": shorten([row.label for row in rows], _NAME_WIDTH),
            "from": [f"{row.low:.3g}" for row in rows],
            "to": [f"{row.high:.3g}" for row in rows],
            "ν, per unit squared": align_with_errors([(row.nu, row.nu_error) for row in rows]),
            "Sobol total at most": align_with_errors([(row.bound, row.bound_error) for row in rows]),
        }
        variance = format_with_error(self.variance, self.variance_error)
        summary = (
            f"{self.metric}: variance {variance} over the intervals, from gradients at {self.points} points "
            f"({self.renders:g} renders and backward passes)"
        )
        hidden = len(self.rows) - len(rows)
        more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
        return "\n".join([*grid([*columns], list(zip(*columns.values(), strict=True))), *more, "", summary])

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__
