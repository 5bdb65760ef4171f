"""Moving one parameter at a time along its own gradient, to see whether the metric changes as predicted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._gradients import input_values
from ..attr._metric import Metric, Target, TargetedMetric
from ..attr._passes import DEFAULT_PASSES, channel_totals
from ..attr._ranges import ranges
from ..errors import SceneCaptumError, check_seed, whole_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of a parameter's range: how far a step goes at most, and the room below which it turns round at a bound.
LONGEST, CRAMPED = 0.1, 0.01

# A step is short enough where bending takes less than this part of the slope; if not it is divided by SHORTER.
BENT, SHORTER, SHORTEST = 0.2, 4.0, 6

AGREES = 0.1  # relative difference of prediction and measurement, where their errors are smaller
CLEAR = 2.0  # standard errors


@dataclass(frozen=True)
class Ablated:
    """What moving one parameter does.

    Attributes
    ----------
    predicted, predicted_error
        The saliency ``‖g‖``: how much the metric should rise per unit of a step along the gradient.
    measured, measured_error
        How much it rises, from renders at 0, half a step and a step, with the bending taken out.
    step
        Length of the step, negative down the gradient; in the parameter's unit, over its channels.
    curvature
        Second derivative along the gradient.
    """

    name: str
    label: str
    predicted: float
    predicted_error: float
    measured: float
    measured_error: float
    step: float
    curvature: float

    @property
    def above_noise(self) -> bool:
        """Whether the measurement is told from 0."""
        return abs(self.measured) > CLEAR * self.measured_error

    @property
    def agrees(self) -> bool:
        """Whether prediction and measurement are the same within a tenth or 3 standard errors."""
        allowed = max(AGREES * self.predicted, 3 * math.hypot(self.predicted_error, self.measured_error))
        return abs(self.measured - self.predicted) <= allowed


@dataclass(frozen=True, repr=False)
class AblationTest:
    """The parameters by falling saliency, each with what moving it does; prints as a table."""

    rows: tuple[Ablated, ...]
    metric: str

    @property
    def kendall_tau(self) -> float | None:
        """How far the measured order is the computed one, from −1 to 1; None where no two are told apart.

        Of the pairs above the noise that either errors leave unresolved are ties and do not count.
        """
        signs = [
            math.copysign(1, (one.predicted - two.predicted) * (one.measured - two.measured))
            for one, two in _pairs([row for row in self.rows if row.above_noise])
            if _told_apart(one.measured, one.measured_error, two.measured, two.measured_error)
            and _told_apart(one.predicted, one.predicted_error, two.predicted, two.predicted_error)
        ]
        return sum(signs) / len(signs) if signs else None

    @property
    def verdict(self) -> str:
        """One sentence."""
        clear = [row for row in self.rows if row.above_noise]
        good = sum(row.agrees for row in clear)
        tau = "too few for an order" if self.kendall_tau is None else f"Kendall's τ {self.kendall_tau:.2f}"
        return (
            f"{good} of {len(clear)} parameters above the noise change {self.metric} as predicted; {tau}; "
            f"{len(self.rows) - len(clear)} below the noise"
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw prediction and measurement of each parameter, and the noise."""
        from ..visualization import plot_ablation

        return plot_ablation(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import ablation_text

        return ablation_text(self)

    __repr__ = __str__


def ablation_test(
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    top: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
) -> AblationTest:
    """Move each of the most salient parameters along its own gradient, and compare the change with the prediction.

    Every step is a part of the parameter's physical range, down the gradient unless a bound is near, and is
    shortened until the metric hardly bends on it; renders at half the step take out what bending is left. All
    renders of one parameter share their seeds, so that most of their noise cancels.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=64)
    >>> test = ablation_test(renderer, metrics.MeanLuminance(), top=2)
    >>> [row.agrees for row in test.rows]
    [True, True]

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must tell its ``bounds``.
    attribution
        The plain gradients to be tested; by default they are computed.
    top
        How many parameters.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel of every render, in all its replicates; the renderer's by default.
    replicates
        In how many independent passes each scene is rendered: their spread tells the errors.

    Raises
    ------
    SceneCaptumError
        Where the attribution is not one of plain gradients, or has no error bars.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport", with one step for all.
    """
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(target=target, seed=seed, spp=spp)
    if attribution.info.get("scale") != "unit" or attribution.covariance is None:
        raise SceneCaptumError(
            "An ablation test takes plain gradients with error bars: VanillaSceneGradient(...).attribute()."
        )
    values = input_values(renderer, None)
    spp = getattr(renderer, "spp", None) if spp is None else whole_number("spp", spp)
    count = whole_number("replicates", replicates, 2)
    seeds = np.random.SeedSequence([check_seed("seed", seed), 4]).generate_state(count).tolist()
    scenes = _Scenes(renderer, metric, target, values, seeds, spp and math.ceil(spp / count))
    return AblationTest(
        rows=tuple(
            _ablate(scenes, row, attribution[row.name])
            for row in attribution.ranking(whole_number("top", top))
            if row.saliency > 0
        ),
        metric=str(attribution.info["metric"]),
    )


class _Scenes:
    """Measures changed scenes, always with the same seeds."""

    def __init__(
        self,
        renderer: Any,
        metric: Metric,
        target: Target,
        values: Mapping[str, torch.Tensor],
        seeds: Sequence[int],
        spp: int | None,
    ) -> None:
        self.renderer = renderer
        self.values = values
        self.seeds = seeds
        self.spp = spp
        # What a metric holds fixed while it is differentiated, a threshold, is held fixed here too.
        held_at = getattr(metric, "held_at", None)
        self.metric = TargetedMetric(held_at(self._images({}).mean(0)) if held_at else metric, target)
        self.still = self.measure({})

    def _images(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        changed = {**self.values, **changes}
        with torch.no_grad():
            return torch.stack([self.renderer(changed, seed=seed, spp=self.spp) for seed in self.seeds])

    def measure(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the metric's jackknife pseudo-values, ``(replicates,)`` in float64."""
        images = self._images(changes)
        total, count = images.sum(0), len(images)
        whole = self.metric.value(total / count)
        without = [self.metric.value((total - image) / (count - 1)) for image in images]
        return count * whole - (count - 1) * torch.tensor(without, dtype=torch.float64)


def _ablate(scenes: _Scenes, row: Any, gradient: torch.Tensor) -> Ablated:
    value = scenes.values[row.name]
    totals = channel_totals(gradient)
    # Of a texture, all texels move alike: what single texels are said to do is mostly noise.
    uphill = (totals / totals.norm()).reshape(gradient.shape if gradient.ndim < 2 else (-1,)).to(value)
    step = _first_step(scenes.renderer, row.name, value, uphill)

    def rise(length: float) -> torch.Tensor:
        return scenes.measure({row.name: value + length * uphill}) - scenes.still

    for _ in range(SHORTEST):
        half, full = rise(step / 2), rise(step)
        slope, curvature = (4 * half - full) / step, 4 * (full - 2 * half) / step**2
        measured, error = _mean(slope)
        bending = abs(curvature.mean().item() * step / 2)
        if bending <= BENT * abs(measured) or error > BENT * abs(measured):
            break
        step /= SHORTER
    return Ablated(
        name=row.name,
        label=row.label,
        predicted=row.saliency,
        predicted_error=row.saliency_error,
        measured=measured,
        measured_error=error,
        step=step,
        curvature=curvature.mean().item(),
    )


def _first_step(renderer: Any, name: str, value: torch.Tensor, uphill: torch.Tensor) -> float:
    """Return a step down the gradient, or up it where a bound is near; its sign says which."""
    length = ranges(renderer, {name: value})[name].item()
    down, up = (_room(value, sign * uphill, *renderer.bounds[name]) for sign in (-1, 1))
    room, sign = (down, -1) if down >= min(CRAMPED * length, up) else (up, 1)
    # Only part of the way to a bound, which itself may be unphysical.
    return sign * min(LONGEST * length, 0.5 * room)


def _room(value: torch.Tensor, direction: torch.Tensor, low: float, high: float) -> float:
    """Return how far every element can go in a direction before one meets a bound."""
    direction = direction.expand_as(value)
    towards = torch.where(direction > 0, high - value, value - low)
    return (towards / direction.abs())[direction != 0].min().item()


def _mean(pseudo: torch.Tensor) -> tuple[float, float]:
    return pseudo.mean().item(), (pseudo.std() / math.sqrt(len(pseudo))).item()


def _pairs(rows: Sequence[Ablated]) -> list[tuple[Ablated, Ablated]]:
    return [(one, two) for number, one in enumerate(rows) for two in rows[number + 1 :]]


def _told_apart(one: float, one_error: float, two: float, two_error: float) -> bool:
    return abs(one - two) > CLEAR * math.hypot(one_error, two_error)
