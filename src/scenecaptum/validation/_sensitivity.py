"""Our gradients beside sampling-based sensitivity analysis: Morris's and Sobol's, through SALib."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from ..attr._gradients import Gradients, Point, input_values
from ..attr._method import listed
from ..attr._metric import Metric, TargetedMetric
from ..attr._passes import DEFAULT_PASSES, Budget
from ..attr._view import Viewer
from ..checkpoint import Folder, Stopwatch, with_checkpoint
from ..errors import SceneCaptumError, check_seed, whole_number
from ._dgsm import Derivatives, cost, jackknife_points, sample_derivatives, slopes
from ._scalars import Intervals, Scalar, Values, factors_of, find_scalars

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..attr._method import Result, Targets

CLEAR = 2.0  # standard errors
_LEAST = 2  # samples of any kind, below which nothing has an error
_LEVELS = 4  # of Morris's grid
_CONFIDENCE, _WIDTH = 0.95, 1.959964  # of SALib's intervals, and their half-width in standard errors
_RESAMPLES = 200


@dataclass(frozen=True)
class SensitivityIndex:
    """What one method says of every parameter, and what that took.

    Attributes
    ----------
    method
        Its name.
    values, errors
        By parameter name, with standard errors.
    renders
        How many renders and backward passes it took, each counted by its samples: 1 for as many as ``spp``.
    renders_until_stable
        How many it had taken when the set of the ``top`` parameters last changed.
    stable
        Whether that was before the end; if not, it may change again.
    top
        That set, the largest first.
    resolved
        Whether the last of them is told from the next one, by two standard errors; if not they are tied, and
        which of them belongs to the set is partly chance.
    seconds
        How long it took.
    """

    method: str
    values: Mapping[str, float]
    errors: Mapping[str, float]
    renders: float
    renders_until_stable: float
    stable: bool
    top: tuple[str, ...]
    resolved: bool
    seconds: float


@dataclass(frozen=True, repr=False)
class SensitivityComparison:
    """Four sensitivities of the same parameters over the same intervals; prints as a table.

    Attributes
    ----------
    parameters
        What was varied, with the interval of each, by falling total Sobol index.
    local
        Our plain gradient at the scene's own values, as the change over the interval: ``|∂M/∂θ| (high − low)``.
    dgsm
        The upper bound of the total Sobol index from our gradients at points over the intervals; the variance of
        the metric in it is that of Sobol's samples.
    morris
        ``μ*``, Morris's mean absolute elementary effect, as the change over the interval.
    sobol
        The total Sobol index.
    metric
        What was measured.
    """

    parameters: tuple[Scalar, ...]
    local: SensitivityIndex
    dgsm: SensitivityIndex
    morris: SensitivityIndex
    sobol: SensitivityIndex
    metric: str

    @property
    def methods(self) -> tuple[SensitivityIndex, ...]:
        """All four."""
        return self.local, self.dgsm, self.morris, self.sobol

    @property
    def agreement(self) -> dict[tuple[str, str], float]:
        """Kendall's τ-b between the values of every two methods: 1 for the same order, 0 for unrelated ones."""
        from scipy.stats import kendalltau

        return {
            (one.method, other.method): float(
                kendalltau(*([m.values[n] for n in one.values] for m in (one, other)))[0]
            )
            for one, other in combinations(self.methods, 2)
        }

    def plot(self, figure: Any = None) -> Figure:
        """Draw the methods side by side, and what each of them took."""
        from ..visualization import plot_sensitivity

        return plot_sensitivity(self, figure=figure)

    def __str__(self) -> str:
        from ..visualization import sensitivity_text

        return sensitivity_text(self)

    __repr__ = __str__


def compare_sensitivity(  # noqa: PLR0913 -- those of dgsm, and three sizes
    renderer: Any,
    metric: Metric,
    target: Targets = None,
    *,
    parameters: Sequence[str] | None = None,
    bounds: Intervals = None,
    top: int = 5,
    points: int = 32,
    trajectories: int = 16,
    base_samples: int = 64,
    seed: int = 0,
    spp: int | None = None,
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> Result:
    """Set our gradients beside Morris's elementary effects and Sobol's indices, with what each of them took.

    All four answer for the same parameters over the same intervals. Morris's and Sobol's methods see the metric as
    a black box: one takes ``trajectories · (parameters + 1)`` renders, the other ``base_samples · (parameters +
    2)``, all under one seed, so that most of the noise cancels in their differences. A gradient takes a render and
    a backward pass for all parameters together.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(8, 8), spp=8)
    >>> chosen = ["floor.*", "left_wall.*", "tall_box.*"]
    >>> found = compare_sensitivity(renderer, metrics.MeanLuminance(), parameters=chosen, points=8, base_samples=8)
    >>> found.sobol.renders, found.morris.renders, found.dgsm.renders, found.local.renders
    (40, 64, 16.0, 2.0)

    Parameters
    ----------
    renderer, metric, target, parameters, bounds, points, seed, checkpoint, show_progress
        As for ``dgsm``.
    top
        The size of the set that is to be stable; less where there are no more parameters.
    trajectories
        How many of Morris's, over a grid of four levels.
    base_samples
        How many of Sobol's base samples, a power of 2.
    spp
        Samples per pixel of each render and each gradient; the renderer's by default.

    Returns
    -------
    SensitivityComparison
        A list of them for a list of targets, from the same renders: each tells the seconds of all targets.

    Raises
    ------
    SceneCaptumError
        Where SALib is missing (``pip install 'scenecaptum[compare]'``), there are fewer than two parameters, or as
        ``dgsm``.

    References
    ----------
    Morris, "Factorial sampling plans for preliminary computational experiments", Technometrics 33, 1991;
    Campolongo, Cariboni and Saltelli, 2007 (μ*).
    Saltelli et al., "Variance based sensitivity analysis of model output", Computer Physics Communications 181,
    2010 (total index). Herman and Usher, "SALib", Journal of Open Source Software, 2017.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    _salib()
    values = input_values(renderer, None)
    scalars = find_scalars(renderer, values, parameters, bounds)
    if len(scalars) < 2:
        raise SceneCaptumError(f"A comparison takes at least 2 parameters to rank, not {len(scalars)}.")
    spp = getattr(renderer, "spp", None) if spp is None else whole_number("spp", spp)
    check_seed("seed", seed)
    metrics = [TargetedMetric(metric, one) for one in listed(target)]
    top = min(whole_number("top", top), len(scalars) - 1)
    base_samples = _power_of_two(base_samples)
    scenes = _Scenes(renderer, metrics, scalars, values, seed, spp, show_progress)
    derivatives = sample_derivatives(
        renderer, metrics, scalars, values, points, seed=seed, spp=spp, show_progress=show_progress
    )
    local = _local(scenes, top)
    morris = _morris(scenes, whole_number("trajectories", trajectories, _LEAST), top)
    sobol, sampled = _sobol(scenes, base_samples, top)
    bounds_of = [_dgsm(*pair, scalars, top) for pair in zip(derivatives, sampled, strict=True)]
    columns = zip(local, bounds_of, morris, sobol, strict=True)
    results = [
        _comparison(scalars, four, TargetedMetric(metric, one.target).name)
        for four, one in zip(columns, metrics, strict=True)
    ]
    return results if isinstance(target, list) else results[0]


@dataclass(frozen=True)
class _Scenes:
    """What is varied, and how it is rendered."""

    renderer: Any
    metrics: Sequence[TargetedMetric]
    scalars: Sequence[Scalar]
    values: Values
    seed: int
    spp: int | None
    show_progress: bool

    @property
    def problem(self) -> dict[str, Any]:
        """What SALib takes: places between 0 and 1. A fresh one each time, since SALib writes into it."""
        count = len(self.scalars)
        return {"num_vars": count, "names": [s.name for s in self.scalars], "bounds": [[0.0, 1.0]] * count}

    def state(self, number: int) -> int:
        """Return a seed for one of SALib's random choices, never 0, which it would take for none."""
        return int(np.random.SeedSequence([self.seed, 6, number]).generate_state(1)[0]) or 1

    def measure(self, places: np.ndarray, what: str) -> np.ndarray:
        """Return the metrics at rows of places, ``(targets, rows)``, all rendered with one seed."""
        seed = self.state(0)
        found = []
        with torch.no_grad():
            for row in tqdm(places, disable=not self.show_progress, desc=what, unit="render"):
                moved = {s.name: s.at(float(place)) for s, place in zip(self.scalars, row, strict=True)}
                output = self.metrics[0].metric(
                    self.renderer({**self.values, **moved}, seed=seed, spp=self.spp)
                )
                found.append([one.value_of(output) for one in self.metrics])
        measured = np.array(found).T
        for metric, values in zip(self.metrics, measured, strict=True):
            if not np.ptp(values):
                raise SceneCaptumError(
                    f"The metric {metric.name} is {values[0]:g} at every place: there is nothing to rank."
                )
        return measured


def _local(scenes: _Scenes, top: int) -> list[SensitivityIndex]:
    watch = Stopwatch(scenes.renderer)
    budget = Budget.split(scenes.spp, DEFAULT_PASSES, scenes.seed)
    with tqdm(
        total=2 * budget.passes[0], disable=not scenes.show_progress, desc="gradient", unit="pass"
    ) as bar:
        viewer = Viewer("auto", scenes.renderer)
        gradients = Gradients(scenes.renderer, scenes.metrics, budget, viewer, bar)
        point = Point(scenes.values, factors=factors_of(scenes.scalars))
        found = slopes(gradients, 0, point, scenes.scalars)
    seconds = watch.seconds
    indices = []
    for passes, adjoints in found:
        count = len(passes)
        means = passes.cumsum(0) / torch.arange(1, count + 1)[:, None]
        indices.append(
            _index(
                "gradient × range",
                scenes.scalars,
                means.abs().numpy(),
                (passes.std(0) / math.sqrt(count)).numpy(),
                cost(adjoints) / count,
                top,
                seconds,
            )
        )
    return indices


def _dgsm(found: Derivatives, sampled: np.ndarray, scalars: Sequence[Scalar], top: int) -> SensitivityIndex:
    """Bound the total indices, with the variance of the metric at Sobol's samples, which are there anyway."""
    count, metric = len(found.values), torch.from_numpy(sampled)
    variance, variance_error = jackknife_points(lambda kept: metric[kept].var(), len(metric))
    if not variance > 0:
        raise SceneCaptumError(
            f"The metric is {metric[0]:g} wherever it was looked at: there is nothing to rank."
        )
    nu, nu_error = jackknife_points(lambda kept: found.squares[kept].mean(0), count)
    means = found.squares.cumsum(0) / torch.arange(1, count + 1)[:, None]
    scale = 1 / (math.pi**2 * variance)
    error = scale * torch.hypot(nu_error, nu * variance_error / variance)
    bounds = (scale * means).numpy()
    return _index("DGSM bound", scalars, bounds, error.numpy(), found.renders, top, found.seconds)


def _morris(scenes: _Scenes, trajectories: int, top: int) -> list[SensitivityIndex]:
    from SALib.analyze import morris as analysis
    from SALib.sample import morris

    watch = Stopwatch(scenes.renderer)
    places = morris.sample(scenes.problem, trajectories, num_levels=_LEVELS, seed=scenes.state(1))
    each = len(scenes.scalars) + 1
    measured = scenes.measure(places, "Morris")
    seconds = watch.seconds

    def analyse(of_metric: np.ndarray, count: int, resamples: int) -> tuple[np.ndarray, np.ndarray]:
        found = analysis.analyze(
            scenes.problem,
            places[: count * each],
            of_metric[: count * each],
            num_resamples=resamples,
            conf_level=_CONFIDENCE,
            num_levels=_LEVELS,
            seed=scenes.state(2),
        )
        return np.asarray(found["mu_star"], float), np.asarray(found["mu_star_conf"], float)

    return [
        _sampled("Morris μ*", scenes, partial(analyse, one), trajectories, each, top, seconds)
        for one in measured
    ]


def _sobol(scenes: _Scenes, base_samples: int, top: int) -> tuple[list[SensitivityIndex], np.ndarray]:
    """Return the indices of each metric, and its values at the samples that are independent."""
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol

    watch = Stopwatch(scenes.renderer)
    places = sobol.sample(scenes.problem, base_samples, calc_second_order=False, seed=scenes.state(3))
    each = len(scenes.scalars) + 2
    measured = scenes.measure(places, "Sobol")
    seconds = watch.seconds

    def analyse(of_metric: np.ndarray, count: int, resamples: int) -> tuple[np.ndarray, np.ndarray]:
        found = analysis.analyze(
            scenes.problem,
            of_metric[: count * each],
            calc_second_order=False,
            num_resamples=resamples,
            conf_level=_CONFIDENCE,
            seed=scenes.state(4),
        )
        return np.asarray(found["ST"], float), np.asarray(found["ST_conf"], float)

    indices = [
        _sampled("Sobol total", scenes, partial(analyse, one), base_samples, each, top, seconds)
        for one in measured
    ]
    rows = measured.reshape(len(measured), base_samples, each)
    return indices, np.concatenate([rows[..., 0], rows[..., -1]], axis=1)


def _sampled(
    method: str,
    scenes: _Scenes,
    analyse: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    count: int,
    each: int,
    top: int,
    seconds: float,
) -> SensitivityIndex:
    """Analyse all samples, and what the first of them alone would have said."""
    running = np.full((count, len(scenes.scalars)), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the first few samples may be all alike
        for k in range(_LEAST, count + 1):
            running[k - 1], _ = analyse(k, _LEAST)
    running[-1], half_widths = analyse(count, _RESAMPLES)
    return _index(method, scenes.scalars, running, half_widths / _WIDTH, each, top, seconds)


def _index(
    method: str,
    scalars: Sequence[Scalar],
    running: np.ndarray,
    errors: np.ndarray,
    each: float,
    top: int,
    seconds: float,
) -> SensitivityIndex:
    """Put together what a method said after each of its samples, rows of ``running``, at a cost of ``each``."""
    names = [one.name for one in scalars]
    order = np.argsort(-running[-1], kind="stable")
    last, following = order[top - 1], order[top]
    settled = _settled(running, top)
    return SensitivityIndex(
        method=method,
        values=dict(zip(names, running[-1].tolist(), strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        renders=len(running) * each,
        renders_until_stable=settled * each,
        stable=settled < len(running),
        top=tuple(names[k] for k in order[:top]),
        resolved=bool(
            running[-1, last] - running[-1, following] > CLEAR * math.hypot(errors[last], errors[following])
        ),
        seconds=seconds,
    )


def _settled(running: np.ndarray, top: int) -> int:
    """Return after how many samples the set of the largest was what it is after all of them, and stayed so."""
    sets = [frozenset(np.argsort(-row, kind="stable")[:top].tolist()) for row in running]
    count = len(sets)
    while count > _LEAST and sets[count - 2] == sets[-1]:
        count -= 1
    return count


def _comparison(
    scalars: Sequence[Scalar], methods: tuple[SensitivityIndex, ...], metric: str
) -> SensitivityComparison:
    local, derivatives, morris, sobol = methods
    ordered = tuple(sorted(scalars, key=lambda one: -sobol.values[one.name]))
    return SensitivityComparison(ordered, local, derivatives, morris, sobol, metric)


def _power_of_two(count: int) -> int:
    count = whole_number("base_samples", count, _LEAST)
    if count & (count - 1):
        below = 2 ** (count.bit_length() - 1)
        raise SceneCaptumError(
            f"base_samples must be a power of 2, such as {below} or {2 * below}, not {count}."
        )
    return count


def _salib() -> None:
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise SceneCaptumError(
            "compare_sensitivity() needs SALib: pip install 'scenecaptum[compare]'. validation.dgsm() tells "
            "global sensitivity without it."
        ) from error
