"""Comparison of gradients with sampling-based sensitivity analysis: Morris's and Sobol's methods, from SALib."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ..attr import Result, Targets
from ..checkpoint import Folder, Stopwatch, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    Budget,
    GradientEstimator,
    Metric,
    Point,
    Progress,
    Stream,
    TransformSelector,
    delete_one_jackknife,
    derived_seeds,
)
from ..protocols import Renderer
from ..visualization import unit_of_change
from ._dgsm import Derivatives, Problem, interval_gradients, render_count, sample_derivatives
from ._scalars import Intervals, Scalar, position_factors, values_at
from ._sensitivity_result import SensitivityComparison, SensitivityIndex

RESOLVED = 2.0  # standard errors between two ranks that count as distinct
_MIN_SAMPLES = 2  # of any kind, for an error estimate
_GRID_LEVELS = 4  # of Morris's design
_CONFIDENCE, _HALF_WIDTH = 0.95, 1.959964  # of SALib's intervals: level, and half-width in standard errors
_BOOTSTRAP_RESAMPLES = 200


def compare_sensitivity(  # noqa: PLR0913 -- the options of dgsm, and three sample sizes
    renderer: Renderer,
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
    """Compare gradients and DGSM with Morris's elementary effects and Sobol's indices, in results and cost.

    All four methods use the same parameters and intervals. Morris's and Sobol's methods treat the metric as a
    black box: they need ``trajectories · (parameters + 1)`` and ``base_samples · (parameters + 2)`` renders, here
    with common random numbers. A gradient needs one render and one backward pass for all parameters together.

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
        Size of the set of most sensitive parameters whose stability is tracked; at most all parameters but one.
    trajectories
        Number of Morris trajectories, on a grid of four levels.
    base_samples
        Number of Sobol base samples, a power of 2.
    spp
        Samples per pixel of each render and each gradient; the renderer's by default.

    Returns
    -------
    SensitivityComparison
        A list for a list of targets, computed from the same renders; the seconds of each are those of all targets.

    Raises
    ------
    SceneCaptumError
        If SALib is missing (``pip install 'scenecaptum[compare]'``), there are fewer than two parameters, or as
        for ``dgsm``.

    References
    ----------
    Morris, "Factorial sampling plans for preliminary computational experiments", Technometrics 33, 1991;
    Campolongo, Cariboni and Saltelli, 2007 (μ*).
    Saltelli et al., "Variance based sensitivity analysis of model output", Computer Physics Communications 181,
    2010 (total index). Herman and Usher, "SALib", Journal of Open Source Software, 2017.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    _require_salib()
    options: dict[str, Any] = {"seed": seed, "spp": spp, "show_progress": show_progress}
    black_box = _BlackBox.of(renderer, metric, target, parameters, bounds, **options)
    scalars = black_box.scalars
    if len(scalars) < 2:
        raise SceneCaptumError(
            f"compare_sensitivity needs at least 2 parameters to rank, not {len(scalars)}."
        )
    top = min(whole_number("top", top), len(scalars) - 1)
    base_samples = _power_of_two(base_samples)
    derivatives = sample_derivatives(black_box, points)
    local = _local(black_box, top)
    morris = _morris(black_box, whole_number("trajectories", trajectories, _MIN_SAMPLES), top)
    sobol, sampled = _sobol(black_box, base_samples, top)
    bounded = [_dgsm(*pair, scalars, top) for pair in zip(derivatives, sampled, strict=True)]
    results = []
    for k, one in enumerate(black_box.metrics):
        order = np.argsort([-value for value in sobol[k].values.values()], kind="stable")
        ordered = tuple(scalars[i] for i in order)
        results.append(
            SensitivityComparison(
                ordered, local[k], bounded[k], morris[k], sobol[k], one.label, unit_of_change(one.unit)
            )
        )
    return results if isinstance(target, list) else results[0]


class _BlackBox(Problem):
    """A problem whose metrics are evaluated without derivatives."""

    @property
    def problem(self) -> dict[str, Any]:
        """SALib's problem definition on the unit cube; a new one for each call, since SALib modifies it."""
        count = len(self.scalars)
        return {"num_vars": count, "names": [s.name for s in self.scalars], "bounds": [[0.0, 1.0]] * count}

    def salib_seed(self, number: int) -> int:
        """Return a seed for SALib, never 0, which SALib takes for no seed."""
        return derived_seeds(self.seed, Stream.SENSITIVITY_DESIGN, 1, number)[0] or 1

    def evaluate(self, design: np.ndarray, description: str) -> np.ndarray:
        """Return the metrics at rows of positions, ``(targets, rows)``, rendered with common random numbers."""
        seed = self.salib_seed(0)
        rows = []
        with torch.no_grad():
            for positions in tqdm(design, disable=not self.show_progress, desc=description, unit="render"):
                inputs = {**self.values, **values_at(self.scalars, positions)}
                output = self.metrics[0].metric(self.renderer(inputs, seed=seed, spp=self.spp))
                rows.append([metric.value_of(output) for metric in self.metrics])
        evaluated = np.array(rows).T
        for metric, values in zip(self.metrics, evaluated, strict=True):
            if not np.ptp(values):
                raise SceneCaptumError(
                    f"The metric {metric.name} is {values[0]:g} in every sampled scene: there is nothing to rank."
                )
        return evaluated


def _local(black_box: _BlackBox, top: int) -> list[SensitivityIndex]:
    watch = Stopwatch(black_box.renderer)
    budget = Budget.split(black_box.spp, DEFAULT_REPLICATES, black_box.seed)
    with Progress("gradient", show=black_box.show_progress) as bar:
        bar.expect(budget.replicates[0])
        selector = TransformSelector(
            "auto", black_box.renderer, black_box.values, smoothed=black_box.metrics[0].is_smoothed
        )
        gradients = GradientEstimator(black_box.renderer, black_box.metrics, budget, selector, bar)
        point = Point(black_box.values, factors=position_factors(black_box.scalars))
        estimates = interval_gradients(gradients, 0, point, black_box.scalars)
    seconds, method = watch.seconds, "gradient × range"
    indices = []
    for replicates, adjoints in estimates:
        count = len(replicates)
        running = _running_means(replicates).abs().numpy()
        errors = (replicates.std(0) / math.sqrt(count)).numpy()
        renders = render_count(adjoints) / count
        indices.append(_index(method, black_box.scalars, running, errors, renders, top, seconds))
    return indices


def _running_means(samples: torch.Tensor) -> torch.Tensor:
    return samples.cumsum(0) / torch.arange(1, len(samples) + 1)[:, None]


def _dgsm(
    derivatives: Derivatives, sampled: np.ndarray, scalars: Sequence[Scalar], top: int
) -> SensitivityIndex:
    """Bound the total indices, with the variance of the metric in Sobol's samples, which are rendered anyway."""
    count, metric = len(derivatives.values), torch.from_numpy(sampled)
    variance, variance_error = delete_one_jackknife(lambda kept: metric[kept].var(), len(metric))
    if not variance > 0:
        raise SceneCaptumError(
            f"The metric is {metric[0]:g} in every sampled scene: there is nothing to rank."
        )
    nu, nu_error = delete_one_jackknife(lambda kept: derivatives.squares[kept].mean(0), count)
    scale = 1 / (math.pi**2 * variance)
    error = scale * torch.hypot(nu_error, nu * variance_error / variance)
    bounds = (scale * _running_means(derivatives.squares)).numpy()
    return _index("DGSM bound", scalars, bounds, error.numpy(), derivatives.renders, top, derivatives.seconds)


def _morris(black_box: _BlackBox, trajectories: int, top: int) -> list[SensitivityIndex]:
    from SALib.analyze import morris as analysis
    from SALib.sample import morris

    design = morris.sample(
        black_box.problem, trajectories, num_levels=_GRID_LEVELS, seed=black_box.salib_seed(1)
    )

    def analyse(values: np.ndarray, resamples: int) -> Any:
        return analysis.analyze(
            black_box.problem,
            design[: len(values)],
            values,
            num_resamples=resamples,
            conf_level=_CONFIDENCE,
            num_levels=_GRID_LEVELS,
            seed=black_box.salib_seed(2),
        )

    return _sampling_indices("Morris μ*", "mu_star", black_box, design, analyse, trajectories, top)[0]


def _sobol(black_box: _BlackBox, base_samples: int, top: int) -> tuple[list[SensitivityIndex], np.ndarray]:
    """Return the indices of each metric, and its values at the independent samples of the design."""
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol

    design = sobol.sample(
        black_box.problem, base_samples, calc_second_order=False, seed=black_box.salib_seed(3)
    )

    def analyse(values: np.ndarray, resamples: int) -> Any:
        return analysis.analyze(
            black_box.problem,
            values,
            calc_second_order=False,
            num_resamples=resamples,
            conf_level=_CONFIDENCE,
            seed=black_box.salib_seed(4),
        )

    indices, evaluated = _sampling_indices("Sobol total", "ST", black_box, design, analyse, base_samples, top)
    rows = evaluated.reshape(len(evaluated), base_samples, -1)
    return indices, np.concatenate([rows[..., 0], rows[..., -1]], axis=1)


def _sampling_indices(
    method: str,
    key: str,
    black_box: _BlackBox,
    design: np.ndarray,
    analyse: Callable[[np.ndarray, int], Any],
    count: int,
    top: int,
) -> tuple[list[SensitivityIndex], np.ndarray]:
    """Evaluate a design of ``count`` samples; analyse all, and the first 2, 3, ... to see when ranks are stable.

    ``analyse`` returns SALib's results, of which ``key`` is the index, for the first values of the design.
    """
    watch = Stopwatch(black_box.renderer)
    evaluated = black_box.evaluate(design, method)
    seconds, renders = watch.seconds, len(design) // count
    indices = []
    for values in evaluated:
        running = np.full((count, len(black_box.scalars)), np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the first few samples may all be equal
            for k in range(_MIN_SAMPLES, count + 1):
                running[k - 1] = analyse(values[: k * renders], _MIN_SAMPLES)[key]
        found = analyse(values, _BOOTSTRAP_RESAMPLES)
        running[-1], errors = found[key], np.asarray(found[f"{key}_conf"]) / _HALF_WIDTH
        indices.append(_index(method, black_box.scalars, running, errors, renders, top, seconds))
    return indices, evaluated


def _index(
    method: str,
    scalars: Sequence[Scalar],
    running: np.ndarray,
    errors: np.ndarray,
    renders_per_sample: float,
    top: int,
    seconds: float,
) -> SensitivityIndex:
    """Summarise a method from its estimates after each sample, the rows of ``running``."""
    names = [scalar.name for scalar in scalars]
    order = np.argsort(-running[-1], kind="stable")
    last, following = order[top - 1], order[top]
    margin = running[-1, last] - running[-1, following]
    stable_after = _samples_until_stable(running, top)
    return SensitivityIndex(
        method=method,
        values=dict(zip(names, running[-1].tolist(), strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        renders=len(running) * renders_per_sample,
        renders_until_stable=stable_after * renders_per_sample,
        stable=stable_after < len(running),
        top=tuple(names[k] for k in order[:top]),
        resolved=bool(margin > RESOLVED * math.hypot(errors[last], errors[following])),
        seconds=seconds,
    )


def _samples_until_stable(running: np.ndarray, top: int) -> int:
    """Return the number of samples after which the set of the ``top`` largest values no longer changes."""
    sets = [frozenset(np.argsort(-row, kind="stable")[:top].tolist()) for row in running]
    count = len(sets)
    while count > _MIN_SAMPLES and sets[count - 2] == sets[-1]:
        count -= 1
    return count


def _power_of_two(count: int) -> int:
    count = whole_number("base_samples", count, _MIN_SAMPLES)
    if count & (count - 1):
        below = 2 ** (count.bit_length() - 1)
        raise SceneCaptumError(
            f"base_samples must be a power of 2, such as {below} or {2 * below}, not {count}."
        )
    return count


def _require_salib() -> None:
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise SceneCaptumError(
            "compare_sensitivity() needs SALib: pip install 'scenecaptum[compare]'. validation.dgsm() "
            "estimates global sensitivity without it."
        ) from error
