"""Global sensitivity from gradients: the mean squared derivative, which bounds the total Sobol index."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from ..attr._gradients import Gradients, Point, input_values
from ..attr._jackknife import Adjoints
from ..attr._method import listed
from ..attr._metric import Metric, TargetedMetric
from ..attr._passes import Budget
from ..attr._view import Viewer
from ..checkpoint import Folder, Stopwatch, with_checkpoint
from ..errors import check_seed, whole_number
from ._scalars import Intervals, Scalar, Values, find_scalars, point_at

if TYPE_CHECKING:
    from ..attr._method import Result, Targets

_PASSES = 2  # at each point: their difference tells the noise of rendering


@dataclass(frozen=True)
class GlobalDerivative:
    """One parameter's mean squared derivative.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable one.
    low, high
        The interval over which the parameter was varied, in its unit.
    nu, nu_error
        ``ν = E[(∂M/∂θ)²]`` per unit of the parameter, squared.
    bound, bound_error
        ``(high − low)² ν / (π² Var M)``: the total Sobol index is at most this. NaN where the variance of the
        metric is lost in the noise.
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
    """Derivative-based global sensitivity of every parameter, the largest first; prints as a table.

    Attributes
    ----------
    rows
        One for each parameter.
    metric
        What was differentiated.
    variance, variance_error
        The metric's variance over the intervals.
    points
        How many scenes.
    renders
        Renders and backward passes in all, each counted by its samples: 1 for as many as ``spp``.
    seconds
        How long that took.
    """

    rows: tuple[GlobalDerivative, ...]
    metric: str
    variance: float
    variance_error: float
    points: int
    renders: float
    seconds: float

    def __str__(self) -> str:
        from ..visualization import dgsm_text

        return dgsm_text(self)

    __repr__ = __str__


def dgsm(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
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
    """Average squared derivatives over the scenes that might have been, from our gradients.

    Where a plain gradient says what matters at this design, this says what matters over all of them. All
    parameters share the points, whose number need not grow with theirs as it has to for Sobol's and Morris's
    methods; what has a small bound can be left as it is.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> found = dgsm(renderer, metrics.MeanLuminance(), parameters=["floor.*", "light.*"], points=8)
    >>> [row.label for row in found.rows]
    ['light: radiance', 'floor: reflectance', 'light: reflectance']

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``.
    parameters
        Names or globs of the inputs that are varied; all by default. Each is moved by one number, its largest
        element, to which the others keep their ratio: a colour gets brighter and keeps its hue.
    bounds
        ``(low, high)`` of that number by name or glob. By default the physical bounds; where they are infinite
        (the radiance of a lamp, an index of refraction), from half the value to one and a half of it.
    points
        How many scenes, scattered by a scrambled Sobol sequence.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel at each point, split over two passes whose difference tells the noise, so that it does
        not count as sensitivity; the renderer's by default.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.
    show_progress
        Whether to show a progress bar.

    Returns
    -------
    DGSM
        With standard errors by the jackknife over the points, as of independent ones: for evenly scattered points
        they are too large rather than too small. A list for a list of targets.

    Raises
    ------
    SceneCaptumError
        Where a name, interval or setting does not fit, or as ``VanillaSceneGradient``.

    References
    ----------
    Sobol and Kucherenko, "Derivative based global sensitivity measures and their link with global sensitivity
    indices", Mathematics and Computers in Simulation 79, 2009 (the bound for uniform parameters), and
    "A new derivative based importance criterion for groups of variables and its link with the global sensitivity
    indices", Computer Physics Communications 181, 2010.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    values = input_values(renderer, None)
    scalars = find_scalars(renderer, values, parameters, bounds)
    spp = getattr(renderer, "spp", None) if spp is None else whole_number("spp", spp)
    check_seed("seed", seed)
    metrics = [TargetedMetric(metric, one) for one in listed(target)]
    found = sample_derivatives(
        renderer, metrics, scalars, values, points, seed=seed, spp=spp, show_progress=show_progress
    )
    results = [
        summarise_derivatives(one, scalars, TargetedMetric(metric, m.target).name)
        for one, m in zip(found, metrics, strict=True)
    ]
    return results if isinstance(target, list) else results[0]


@dataclass
class Derivatives:
    """What a metric does at points, in float64.

    Attributes
    ----------
    squares
        ``(points, parameters)``: the squared change over the whole interval at this slope, free of noise on
        average (a single one may be negative).
    values, noise
        ``(points,)``: the metric, and the variance that rendering puts into it.
    renders
        Renders and backward passes of each point.
    """

    squares: torch.Tensor
    values: torch.Tensor
    noise: torch.Tensor
    renders: float
    seconds: float


def sample_derivatives(
    renderer: Any,
    metrics: Sequence[TargetedMetric],
    scalars: Sequence[Scalar],
    values: Values,
    points: int,
    *,
    seed: int,
    spp: int | None,
    show_progress: bool,
) -> list[Derivatives]:
    """Take the derivatives of each metric at random points."""
    count = whole_number("points", points, 3)  # what is left when the jackknife leaves one out has a variance
    places = scatter(count, len(scalars), seed)
    watch = Stopwatch(renderer)
    total = None if spp is None else spp * count
    budget = Budget.split(total, _PASSES * count, seed, count)
    found: list[list[tuple[torch.Tensor, Adjoints]]] = []
    with tqdm(total=2 * sum(budget.passes), disable=not show_progress, desc="DGSM", unit="pass") as bar:
        gradients = Gradients(renderer, metrics, budget, Viewer("auto", renderer), bar)
        for index, place in enumerate(places):
            found.append(slopes(gradients, index, point_at(scalars, values, place), scalars))
    extra = gradients.extra / total if total else 0.0
    return [_derivatives(of_metric, extra, watch.seconds) for of_metric in zip(*found, strict=True)]


def slopes(
    gradients: Gradients, index: int, point: Point, scalars: Sequence[Scalar]
) -> list[tuple[torch.Tensor, Adjoints]]:
    """Return for each metric ``(passes, parameters)`` changes over the intervals, and its adjoints."""
    found, interrupted = gradients.at(index, point)
    if interrupted:
        raise KeyboardInterrupt
    return [
        (
            torch.stack([torch.stack(one.spreads[s.name].totals).double().sum(1) for s in scalars], 1),
            one.adjoints,
        )
        for one in found
    ]


def cost(adjoints: Adjoints) -> float:
    """Return renders and backward passes of a gradient, counted by their samples."""
    bias_pass = 0.0 if adjoints.bias_adjoint is None else 1 / len(adjoints.passes)
    return 2.0 + bias_pass


def scatter(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Return ``(count, dimensions)`` places in the unit cube, evenly scattered."""
    state = int(np.random.SeedSequence([seed, 5]).generate_state(1)[0])
    engine = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=state)
    drawn: np.ndarray = engine.draw(count, dtype=torch.float64).numpy()
    return drawn


def _derivatives(found: Sequence[tuple[torch.Tensor, Adjoints]], extra: float, seconds: float) -> Derivatives:
    passes = torch.stack([one for one, _ in found])  # (points, passes, parameters)
    seen = [adjoints for _, adjoints in found]
    return Derivatives(
        squares=passes.mean(1).square() - passes.var(1) / passes.shape[1],
        values=torch.tensor([one.value - (one.bias or 0.0) for one in seen], dtype=torch.float64),
        noise=torch.tensor([(one.standard_error or 0.0) ** 2 for one in seen], dtype=torch.float64),
        renders=sum(map(cost, seen)) / len(seen) + extra,
        seconds=seconds,
    )


def summarise_derivatives(found: Derivatives, scalars: Sequence[Scalar], metric: str) -> DGSM:
    """Average over the points, with standard errors by the jackknife."""
    nu, nu_error = jackknife_points(lambda kept: found.squares[kept].mean(0), len(found.values))
    bound, bound_error = _total_bound(found)
    variance, variance_error = jackknife_points(lambda kept: _variance(found, kept), len(found.values))
    rows = [
        GlobalDerivative(
            name=one.name,
            label=one.label,
            low=one.low,
            high=one.high,
            nu=nu[k].item() / one.length**2,
            nu_error=nu_error[k].item() / one.length**2,
            bound=bound[k].item(),
            bound_error=bound_error[k].item(),
        )
        for k, one in enumerate(scalars)
    ]
    return DGSM(
        rows=tuple(rows[k] for k in nu.argsort(descending=True, stable=True).tolist()),
        metric=metric,
        variance=variance.item(),
        variance_error=variance_error.item(),
        points=len(found.values),
        renders=found.renders * len(found.values),
        seconds=found.seconds,
    )


def _total_bound(found: Derivatives) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the upper bounds of the total Sobol indices, and their errors; NaN where nothing but noise varies."""

    def bound(kept: torch.Tensor) -> torch.Tensor:
        variance = _variance(found, kept)
        mean = found.squares[kept].mean(0)
        return torch.where(variance > 0, mean / (math.pi**2 * variance), torch.nan)

    return jackknife_points(bound, len(found.values))


def _variance(found: Derivatives, kept: torch.Tensor) -> torch.Tensor:
    return found.values[kept].var() - found.noise[kept].mean()


def jackknife_points(
    statistic: Callable[[torch.Tensor], torch.Tensor], count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a statistic of all points, given by their numbers, and its standard error."""
    numbers = torch.arange(count)
    without = torch.stack([statistic(numbers[numbers != k]) for k in range(count)])
    spread = (without - without.mean(0)).square().sum(0)
    return statistic(numbers), ((count - 1) / count * spread).sqrt()
