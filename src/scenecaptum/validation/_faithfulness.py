"""Whether attributions predict what changes of the scene do: infidelity and sensitivity-n."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import IntegratedGradientsScene, SceneAttribution, VanillaSceneGradient
from ..attr._baselines import Baselines, resolve_baselines
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_PASSES
from ..attr._ranges import Noise
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, check_seed, near_misses, whole_number
from ._scenes import Scenes, view_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Tensors = Mapping[str, torch.Tensor]
Statistic = Callable[[torch.Tensor, torch.Tensor], float]

_GRADIENTS = ("gradient per unit", "mean gradient per unit")
_NO_SHARES = (
    *_GRADIENTS,
    "gradient × range",
    "mean squared gradient per unit",
    "variance of the gradient per unit",
)


@dataclass(frozen=True, repr=False)
class Infidelity:
    """How far gradients miss the changes that random perturbations make; prints as a table.

    Attributes
    ----------
    predicted
        ``(n,)``: the sum of perturbation × attribution.
    measured
        ``(n, replicates)``: the metric of the scene minus that of the perturbed one, in independent replicates.
    metric, method
        What was attributed, and how.
    """

    predicted: torch.Tensor
    measured: torch.Tensor
    metric: str
    method: str

    @property
    def value(self) -> float:
        """The infidelity: the mean square of prediction minus measurement, without what noise adds to it."""
        return self._with_error(_mean_square_miss)[0]

    @property
    def standard_error(self) -> float:
        """Of ``value``: from the perturbations that were drawn, and from the noise of rendering."""
        return self._with_error(_mean_square_miss)[1]

    @property
    def missed(self) -> float:
        """``value`` as a part of the mean square change: 0 predicts everything, 1 no more than predicting none."""
        return self._with_error(_part_missed)[0]

    @property
    def missed_error(self) -> float:
        """Standard error of ``missed``."""
        return self._with_error(_part_missed)[1]

    def _with_error(self, statistic: Statistic) -> tuple[float, float]:
        return statistic_with_error(statistic, self.predicted, self.measured)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the measured change over the predicted one, of every perturbation."""
        from ..visualization import plot_infidelity

        return plot_infidelity(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import infidelity_text

        return infidelity_text(self)

    __repr__ = __str__


def infidelity(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    stdevs: float | Mapping[str, float] = 0.1,
    n_perturb_samples: int = 64,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> Infidelity:
    """Perturb all parameters at random, and compare the change of the metric with what gradients predict.

    ``E[(Iᵀ Φ − (M(θ) − M(θ − I)))²]`` over perturbations ``I``, as ``captum.metrics.infidelity``, with the noise
    of rendering taken out. All scenes share their seeds.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), spp=16)
    >>> infidelity(renderer, metrics.MeanLuminance(), n_perturb_samples=4).missed < 0.1  # linear in the light
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must tell its ``bounds``.
    attribution
        Gradients per unit, plain or SmoothGrad's; by default plain ones are computed.
    stdevs
        Standard deviation of the perturbations as a fraction of each parameter's range, a number or a mapping from
        names, globs or kinds; they are reflected at its bounds.
    n_perturb_samples
        How many perturbed scenes.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel of every scene, in all its replicates; the renderer's by default.
    replicates
        In how many independent passes each scene is rendered, 3 at least.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    Infidelity
        Its ``value`` is in the metric's unit, squared; ``missed`` is that part of what there was to predict.

    Raises
    ------
    SceneCaptumError
        Where the attribution is not one of gradients, or ``stdevs`` do not fit.

    References
    ----------
    Yeh et al., "On the (In)fidelity and Sensitivity of Explanations", NeurIPS 2019.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {
        "seed": seed,
        "spp": spp,
        "replicates": whole_number("replicates", replicates, 3),
    }
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(target=target, **options)
    if attribution.info.get("quantity") not in _GRADIENTS:
        raise SceneCaptumError(
            f"infidelity takes gradients per unit, VanillaSceneGradient's or SmoothGradScene's, not "
            f"{attribution.info.get('method', 'this')}'s attributions. For those there is sensitivity_n."
        )
    count = whole_number("n_perturb_samples", n_perturb_samples, 3)
    scenes = Scenes.split(renderer, metric, target, **options, denoise=view_of(attribution))
    values = {name: scenes.values[name] for name in parameters_of(attribution, scenes.values)}
    predicted, measured = [], []
    for perturbed in perturbations(renderer, values, stdevs, count, seed):
        moves = ((values[name] - perturbed[name]).double() * attribution[name].double() for name in values)
        predicted.append(sum(move.sum().item() for move in moves))
        measured.append(scenes.still - scenes.measure(perturbed))
    return Infidelity(
        predicted=torch.tensor(predicted, dtype=torch.float64),
        measured=torch.stack(measured),
        metric=str(attribution.info["metric"]),
        method=str(attribution.info["method"]),
    )


def perturbations(
    renderer: Any, values: Tensors, stdevs: float | Mapping[str, float], count: int, seed: int
) -> Iterator[dict[str, torch.Tensor]]:
    """Draw perturbed values, as SmoothGrad does."""
    noise = Noise(renderer, values, stdevs)
    for state in np.random.SeedSequence([check_seed("seed", seed), 5]).generate_state(count).tolist():
        yield noise.draw(state)


@dataclass(frozen=True, repr=False)
class SensitivityN:
    """How well sums of attributions rank what taking several parameters away does; prints as a table.

    Attributes
    ----------
    parameters
        How many parameters there are.
    sizes
        How many of them were taken away together.
    predicted
        For each size ``(subsets,)``: the sums of their attributions.
    measured
        For each size ``(subsets, replicates)``: the metric of the scene minus that without them.
    metric, method
        What was attributed, and how.
    """

    parameters: int
    sizes: tuple[int, ...]
    predicted: tuple[torch.Tensor, ...]
    measured: tuple[torch.Tensor, ...]
    metric: str
    method: str

    @property
    def correlations(self) -> tuple[float, ...]:
        """Pearson's correlation of both, for each size; NaN where either is the same for all subsets."""
        return tuple(value for value, _ in self._with_errors())

    @property
    def standard_errors(self) -> tuple[float, ...]:
        """Of the correlations: from the noise of rendering, and from the subsets where not all were taken."""
        return tuple(error for _, error in self._with_errors())

    def _with_errors(self) -> list[tuple[float, float]]:
        return [
            statistic_with_error(_pearson, *pair, drawn=len(pair[0]) < math.comb(self.parameters, size))
            for size, *pair in zip(self.sizes, self.predicted, self.measured, strict=True)
        ]

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the correlation over the size of the subsets."""
        from ..visualization import plot_sensitivity_n

        return plot_sensitivity_n(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import sensitivity_n_text

        return sensitivity_n_text(self)

    __repr__ = __str__


def sensitivity_n(  # noqa: PLR0913 -- those of every validation, and three of its own
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    baselines: Baselines = None,
    sizes: Sequence[int] | None = None,
    subsets: int = 32,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> SensitivityN:
    """Take random sets of n parameters away, and correlate the change with the sum of their attributions.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=32)
    >>> found = sensitivity_n(renderer, metrics.MeanLuminance(), sizes=[1], subsets=8)
    >>> found.correlations[0] > 0.8
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``IntegratedGradientsScene``.
    attribution
        Contributions compared with the same baselines; by default those of integrated gradients are computed.
    baselines
        What a parameter is set to when it is taken away, as for ``IntegratedGradientsScene``. One that is at its
        baseline already takes no part.
    sizes
        How many parameters are taken away together; by default up to six sizes from 1 to all but one.
    subsets
        How many sets of each size, all different: fewer where there are no more.
    seed
        Seed from which all others are drawn; all scenes share theirs.
    spp
        Samples per pixel of every scene, in all its replicates; the renderer's by default.
    replicates
        In how many independent passes each scene is rendered, 3 at least.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    SensitivityN
        A correlation, with its error, for each size.

    Raises
    ------
    SceneCaptumError
        Where the attribution is one of gradients or of groups, or fewer than three parameters have baselines other
        than their values.

    References
    ----------
    Ancona et al., "Towards better understanding of gradient-based attribution methods for Deep Neural Networks",
    ICLR 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {
        "seed": seed,
        "spp": spp,
        "replicates": whole_number("replicates", replicates, 3),
    }
    scenes = Scenes.split(renderer, metric, target, **options)
    attribution, absent = contributions(scenes, metric, attribution, target, baselines, **options)
    if len(absent) < 3:
        raise SceneCaptumError(
            f"sensitivity_n takes at least 3 parameters that are not yet at their baselines, not {len(absent)}."
        )
    chosen = _sizes(sizes, len(absent))
    draw = np.random.default_rng([check_seed("seed", seed), 6])
    totals = {name: attribution[name].double().sum().item() for name in absent}
    predicted, measured = [], []
    for size in chosen:
        sets = _subsets(list(absent), size, whole_number("subsets", subsets, 3), draw)
        predicted.append(torch.tensor([sum(totals[n] for n in one) for one in sets], dtype=torch.float64))
        measured.append(torch.stack([scenes.still - measure_without(scenes, absent, one) for one in sets]))
    return SensitivityN(
        parameters=len(absent),
        sizes=chosen,
        predicted=tuple(predicted),
        measured=tuple(measured),
        metric=str(attribution.info["metric"]),
        method=str(attribution.info["method"]),
    )


def contributions(
    scenes: Scenes,
    metric: Metric,
    attribution: SceneAttribution | None,
    target: Target,
    baselines: Baselines,
    **options: Any,
) -> tuple[SceneAttribution, dict[str, torch.Tensor]]:
    """Return an attribution of contributions, and the baselines of those parameters that are not there already."""
    if attribution is None:
        method = IntegratedGradientsScene(scenes.renderer, metric)
        attribution = method.attribute(target=target, baselines=baselines, **options)
    if attribution.info.get("quantity", "contribution") in _NO_SHARES:
        raise SceneCaptumError(
            f"{attribution.info['quantity'].capitalize()} says nothing about baselines. Take contributions, of "
            "IntegratedGradientsScene, ShapleyValueScene, FeatureAblationScene or InputXGradientScene."
        )
    absent = resolve_baselines(scenes.renderer, scenes.values, baselines)
    names = parameters_of(attribution, scenes.values)
    return attribution, {n: absent[n] for n in names if not torch.equal(absent[n], scenes.values[n])}


def measure_without(scenes: Scenes, absent: Tensors, names: Sequence[str]) -> torch.Tensor:
    """Return the metric's pseudo-values with some parameters at their baselines, ``(replicates,)``."""
    found = scenes.measure({name: absent[name] for name in names})
    if not torch.isfinite(found).all():
        raise SceneCaptumError(
            f"The metric {scenes.metric.name} is not finite with {len(names)} parameters at their baselines, "
            f"{names[0]!r} first. A logarithm of 0 is the usual cause: add a small constant inside it, or choose "
            "other baselines=."
        )
    return found


def parameters_of(attribution: SceneAttribution, values: Tensors) -> list[str]:
    """Return an attribution's parameters, the most salient first."""
    names = [row.name for row in attribution.ranking()]
    for name in names:
        if name not in values:
            raise SceneCaptumError(
                f"The attribution is to {name!r}, which is no input of the renderer.{near_misses(name, values)} "
                "Attribute to parameters, without groups=."
            )
    return names


def statistic_with_error(
    statistic: Statistic, predicted: torch.Tensor, measured: torch.Tensor, *, drawn: bool = True
) -> tuple[float, float]:
    """Return a statistic of ``(n,)`` predictions and ``(n, replicates)`` measurements, and its standard error.

    The error is the jackknife's over the replicates, and over the ``n`` where these were drawn at random.
    """
    columns = [_without(number, measured.shape[1]) for number in range(measured.shape[1])]
    error = _jackknife([statistic(predicted, measured[:, kept]) for kept in columns])
    if drawn:
        rows = [_without(number, len(predicted)) for number in range(len(predicted))]
        error = math.hypot(error, _jackknife([statistic(predicted[kept], measured[kept]) for kept in rows]))
    return statistic(predicted, measured), error


def _without(number: int, count: int) -> torch.Tensor:
    return torch.arange(count) != number


def _jackknife(left: Sequence[float]) -> float:
    values = torch.tensor(left, dtype=torch.float64)
    return math.sqrt((len(values) - 1) ** 2 / len(values)) * values.std().item()


def _mean_square_miss(predicted: torch.Tensor, measured: torch.Tensor) -> float:
    return _mean_square(predicted[:, None] - measured)


def _part_missed(predicted: torch.Tensor, measured: torch.Tensor) -> float:
    whole = _mean_square(measured)
    return _mean_square_miss(predicted, measured) / whole if whole else math.nan


def _mean_square(replicates: torch.Tensor) -> float:
    """Return the mean square of what replicates ``(n, R)`` measure, without their noise: the products of two."""
    count = replicates.shape[1]
    products = replicates.sum(1).square() - replicates.square().sum(1)
    return products.mean().item() / (count * (count - 1))


def _pearson(predicted: torch.Tensor, measured: torch.Tensor) -> float:
    both = torch.stack([predicted, measured.mean(1)])
    if bool((both.std(1) <= 1e-6 * both.abs().amax(1)).any()):
        return math.nan  # rounding would decide
    return torch.corrcoef(both)[0, 1].item()


def _sizes(sizes: Sequence[int] | None, count: int) -> tuple[int, ...]:
    if sizes is not None:
        return tuple(whole_number("sizes", size, 1, count - 1) for size in sizes)
    return tuple(sorted({round(size) for size in np.geomspace(1, count - 1, 6).tolist()}))


def _subsets(
    names: Sequence[str], size: int, count: int, draw: np.random.Generator
) -> Sequence[tuple[str, ...]]:
    """Return different subsets of so many names: all there are, or so many at random."""
    if math.comb(len(names), size) <= count:
        return list(itertools.combinations(names, size))
    chosen: dict[tuple[int, ...], None] = {}
    while len(chosen) < count:
        chosen[tuple(sorted(draw.choice(len(names), size, replace=False).tolist()))] = None
    return [tuple(names[index] for index in one) for one in chosen]
