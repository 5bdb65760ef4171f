"""Derivative-based global sensitivity measures (DGSM): mean squared derivatives that bound total Sobol indices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

from ..attr import Result, Targets, target_list
from ..checkpoint import Folder, Stopwatch, with_checkpoint
from ..errors import check_seed, whole_number
from ..estimation import (
    Adjoints,
    Budget,
    GradientEstimator,
    Metric,
    Point,
    Progress,
    Stream,
    TargetedMetric,
    TransformSelector,
    delete_one_jackknife,
    derived_seeds,
    input_values,
)
from ..protocols import Capabilities, Renderer
from ..visualization import (
    align_with_errors,
    format_with_error,
    grid,
    pluralize,
    rounded,
    shorten,
    unit_of_change,
)
from ._scalars import INTERVAL_NOTE, Intervals, Scalar, Values, find_scalars, point_at

P = TypeVar("P", bound="Problem")

_REPLICATES_PER_POINT = 2  # their difference estimates the noise of rendering
_NAME_WIDTH, _MAX_ROWS = 34, 40


def dgsm(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    target: Targets = None,
    *,
    parameters: Sequence[str] | None = None,
    bounds: Intervals = None,
    points: int = 32,
    seed: int = 0,
    spp: int | None = None,
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> Result:
    """Estimate the mean squared derivative of a metric over the intervals of all parameters.

    A plain gradient is local to the current values; DGSM averages over all values in the intervals. A parameter
    with a small bound has little influence anywhere. All parameters share the same points, so the number of
    renders need not grow with the number of parameters, unlike for Sobol's and Morris's methods.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> found = dgsm(renderer, metrics.MeanLuminance(), parameters=["floor.*", "light.*"], points=8)
    >>> [row.label for row in found.rows]
    ['light: radiance', 'floor: reflectance', 'light: surface reflectance']

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``.
    parameters
        Names or globs of the inputs to vary; all by default. Each is varied by one number, its largest element,
        with all ratios of elements kept: a colour changes its brightness and keeps its hue.
    bounds
        ``(low, high)`` of that number by name or glob. By default the physical bounds; if they are infinite (the
        radiance of a lamp, an index of refraction), from 0.5 to 1.5 times the value.
    points
        Number of scenes to sample, from a scrambled Sobol sequence.
    seed, checkpoint, show_progress
        As for ``ablation_test``.
    spp
        Samples per pixel at each point, split over two replicates. Their difference estimates the noise, which is
        subtracted from the squared derivatives. The renderer's by default.

    Returns
    -------
    DGSM
        With standard errors from the jackknife over the points. It treats the points as independent, so for a
        Sobol sequence the errors are rather too large. A list for a list of targets.

    Raises
    ------
    SceneCaptumError
        If a name, interval or setting is invalid, or as for ``VanillaSceneGradient``.

    References
    ----------
    Sobol and Kucherenko, "Derivative based global sensitivity measures and their link with global sensitivity
    indices", Mathematics and Computers in Simulation 79, 2009 (the bound for uniform parameters), and
    "A new derivative based importance criterion for groups of variables and its link with the global sensitivity
    indices", Computer Physics Communications 181, 2010.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "show_progress": show_progress}
    problem = Problem.of(renderer, metric, target, parameters, bounds, **options)
    pairs = zip(sample_derivatives(problem, points), problem.metrics, strict=True)
    results = [summarise_derivatives(sampled, problem.scalars, one) for sampled, one in pairs]
    return results if isinstance(target, list) else results[0]


@dataclass(frozen=True)
class Problem:
    """The metrics of a scene as functions of the positions of its parameters in their intervals."""

    renderer: Renderer
    metrics: Sequence[TargetedMetric]
    scalars: Sequence[Scalar]
    values: Values
    seed: int
    spp: int | None
    show_progress: bool

    @classmethod
    def of(
        cls: type[P],
        renderer: Renderer,
        metric: Metric,
        target: Targets,
        parameters: Sequence[str] | None,
        bounds: Intervals,
        *,
        seed: int,
        spp: int | None,
        show_progress: bool,
    ) -> P:
        """Check the arguments of ``dgsm``."""
        values = input_values(renderer, None)
        scalars = find_scalars(renderer, values, parameters, bounds)
        spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
        metrics = [TargetedMetric(metric, element) for element in target_list(target)]
        return cls(renderer, metrics, scalars, values, check_seed("seed", seed), spp, show_progress)


@dataclass
class Derivatives:
    """Values and derivatives of a metric at sampled points, in float64.

    ``squares`` are unbiased estimates of the squared derivative with respect to the position in the interval; a
    single one may be negative.
    """

    squares: torch.Tensor  # (points, parameters)
    values: torch.Tensor  # (points,): the metric
    noise: torch.Tensor  # (points,): its variance from rendering
    renders: float  # and backward passes per point
    seconds: float


def sample_derivatives(problem: Problem, points: int) -> list[Derivatives]:
    """Compute the derivatives of each metric at points of a Sobol sequence."""
    renderer, scalars, spp = problem.renderer, problem.scalars, problem.spp
    count = whole_number("points", points, 3)  # the jackknife needs a variance of one point less
    (state,) = derived_seeds(problem.seed, Stream.DERIVATIVE_DESIGN, 1)
    sequence = torch.quasirandom.SobolEngine(len(scalars), scramble=True, seed=state)
    positions = sequence.draw(count, dtype=torch.float64).numpy()
    watch = Stopwatch(renderer)
    total = None if spp is None else spp * count
    budget = Budget.split(total, _REPLICATES_PER_POINT * count, problem.seed, count)
    sampled: list[list[tuple[torch.Tensor, Adjoints]]] = []
    with Progress("DGSM", show=problem.show_progress) as bar:
        bar.expect(sum(budget.replicates))
        selector = TransformSelector(
            "auto", renderer, problem.values, smoothed=problem.metrics[0].is_smoothed
        )
        gradients = GradientEstimator(renderer, problem.metrics, budget, selector, bar)
        for index, row in enumerate(positions):
            point = point_at(scalars, problem.values, row)
            sampled.append(interval_gradients(gradients, index, point, scalars))
    extra = gradients.extra_spp / total if total else 0.0
    return [_derivatives(of_metric, extra, watch.seconds) for of_metric in zip(*sampled, strict=True)]


def interval_gradients(
    gradients: GradientEstimator, index: int, point: Point, scalars: Sequence[Scalar]
) -> list[tuple[torch.Tensor, Adjoints]]:
    """Return for each metric the gradient with respect to the positions in the intervals, and its adjoints.

    The gradients are ``(replicates, parameters)`` in float64.
    """
    results, interrupted = gradients.estimate(index, point)
    if interrupted:
        raise KeyboardInterrupt
    return [
        (
            torch.stack([torch.stack(result.statistics[s.name].totals).double().sum(1) for s in scalars], 1),
            result.adjoints,
        )
        for result in results
    ]


def render_count(adjoints: Adjoints) -> float:
    """Return the number of renders and backward passes of a gradient, weighted by their samples."""
    return 2.0 + len(adjoints.bias_adjoints) / len(adjoints.per_replicate)


def _derivatives(
    sampled: Sequence[tuple[torch.Tensor, Adjoints]], extra: float, seconds: float
) -> Derivatives:
    gradients = torch.stack([gradient for gradient, _ in sampled])  # (points, replicates, parameters)
    adjoints = [adjoints for _, adjoints in sampled]
    return Derivatives(
        squares=gradients.mean(1).square() - gradients.var(1) / gradients.shape[1],
        values=torch.tensor([a.value - (a.bias or 0.0) for a in adjoints], dtype=torch.float64),
        noise=torch.tensor([(a.standard_error or 0.0) ** 2 for a in adjoints], dtype=torch.float64),
        renders=sum(map(render_count, adjoints)) / len(adjoints) + extra,
        seconds=seconds,
    )


def summarise_derivatives(
    derivatives: Derivatives, scalars: Sequence[Scalar], metric: TargetedMetric
) -> DGSM:
    """Average over the points, with jackknife standard errors."""
    count = len(derivatives.values)

    def mean_square(kept: torch.Tensor) -> torch.Tensor:
        return derivatives.squares[kept].mean(0)

    def metric_variance(kept: torch.Tensor) -> torch.Tensor:
        return derivatives.values[kept].var() - derivatives.noise[kept].mean()

    def upper_bound(kept: torch.Tensor) -> torch.Tensor:
        variance = metric_variance(kept)
        return torch.where(variance > 0, mean_square(kept) / (math.pi**2 * variance), torch.nan)

    nu, nu_error = delete_one_jackknife(mean_square, count)
    bound, bound_error = delete_one_jackknife(upper_bound, count)
    variance, variance_error = delete_one_jackknife(metric_variance, count)
    rows = [
        GlobalDerivative(
            name=scalar.name,
            label=scalar.label,
            low=scalar.low,
            high=scalar.high,
            nu=nu[k].item() / scalar.length**2,
            nu_error=nu_error[k].item() / scalar.length**2,
            bound=bound[k].item(),
            bound_error=bound_error[k].item(),
        )
        for k, scalar in enumerate(scalars)
    ]
    return DGSM(
        rows=tuple(rows[k] for k in nu.argsort(descending=True, stable=True).tolist()),
        metric=metric.label,
        variance=variance.item(),
        variance_error=variance_error.item(),
        points=count,
        renders=derivatives.renders * count,
        seconds=derivatives.seconds,
        unit=unit_of_change(metric.unit),
    )


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
        is within the noise, at all points or without one of them.
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
    unit
        That of a change of the metric; empty if it has none. The variance has its square.
    """

    rows: tuple[GlobalDerivative, ...]
    metric: str
    variance: float
    variance_error: float
    points: int
    renders: float
    seconds: float
    unit: str = ""

    def text(self, top: int | None = _MAX_ROWS) -> str:
        """Return the table that ``print`` shows, of the first ``top`` parameters; None for all."""
        rows, squared = self.rows[:top], f"({self.unit})² " if self.unit else ""
        columns = {
            "parameter": shorten([row.label for row in rows], _NAME_WIDTH),
            "from": [rounded(row.low) for row in rows],
            "to": [rounded(row.high) for row in rows],
            f"ν, {squared}per unit squared": align_with_errors([(row.nu, row.nu_error) for row in rows]),
            "Sobol total at most": align_with_errors([(row.bound, row.bound_error) for row in rows]),
        }
        variance = format_with_error(self.variance, self.variance_error)
        summary = (
            f"{self.metric}: variance {variance} {squared}over the intervals, from gradients at {self.points} "
            f"points ({self.renders:g} renders and backward passes)"
        )
        hidden = len(self.rows) - len(rows)
        more = [f"… and {pluralize(hidden, 'parameter')} more"] if hidden else []
        rows_of_text = grid([*columns], list(zip(*columns.values(), strict=True)))
        return "\n".join([*rows_of_text, *more, "", summary, *self._unbounded(), INTERVAL_NOTE])

    def _unbounded(self) -> list[str]:
        """Return why the indices have no bounds, or these no errors; nothing if they do."""
        if not any(math.isnan(row.bound_error) for row in self.rows):
            return []
        if self.variance == self.variance_error == 0:
            return ["nan: the metric is the same at all points"]
        return [
            "nan: too noisy to tell, since the variance of the metric is within the noise of rendering;\n"
            "use more samples (spp=) or points (points=)"
        ]

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__
