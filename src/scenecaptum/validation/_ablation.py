"""Moving one parameter at a time along its own gradient, to see whether the metric changes as predicted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_PASSES
from ..errors import SceneCaptumError, whole_number
from ._scenes import Scenes, first_step, mean_and_error, room, unit_gradient

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A step is short enough where bending takes less than this part of the slope; if not it is divided by SHORTER.
BENT, SHORTER, SHORTEST = 0.2, 4.0, 6

AGREES = 0.1  # relative difference of prediction and measurement, where their errors are smaller
CLEAR = 2.0  # standard errors
ORDERED = 0.95  # Kendall's τ

# The step of Beresna and Fiume: so much of the gradient itself.
FIXED = 0.01


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
    fixed, fixed_error
        How much it rises per unit on a step of one hundredth of the gradient, down it and at most to the bound, as
        in the paper, bending included; None where the bound leaves no room.
    """

    name: str
    label: str
    predicted: float
    predicted_error: float
    measured: float
    measured_error: float
    step: float
    curvature: float
    fixed: float | None = None
    fixed_error: float | None = None

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
    def is_confirmed(self) -> bool:
        """Whether all that is above the noise agrees, in size and in order."""
        tau = self.kendall_tau
        return all(row.agrees for row in self.rows if row.above_noise) and (tau is None or tau >= ORDERED)

    @property
    def verdict(self) -> str:
        """One sentence."""
        clear = [row for row in self.rows if row.above_noise]
        good = sum(row.agrees for row in clear)
        tau = "too few for an order" if self.kendall_tau is None else f"Kendall's τ {self.kendall_tau:.2f}"
        return (
            f"{'Confirmed' if self.is_confirmed else 'Not confirmed'}: "
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
    show_progress: bool = False,
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
    show_progress
        Whether to show a progress bar.

    Raises
    ------
    SceneCaptumError
        Where the attribution is not one of plain gradients, or has no error bars.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport": the ablation with a step of
    one hundredth of each gradient, which is measured here too.
    """
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(
            target=target, seed=seed, spp=spp, show_progress=show_progress
        )
    if attribution.info.get("scale") != "unit" or attribution.covariance is None:
        raise SceneCaptumError(
            "An ablation test takes plain gradients with error bars: VanillaSceneGradient(...).attribute()."
        )
    scenes = Scenes.split(renderer, metric, target, seed=seed, spp=spp, replicates=replicates)
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    with tqdm(rows, disable=not show_progress, desc="ablation", unit="parameter") as bar:
        return AblationTest(
            rows=tuple(_ablate(scenes, row, attribution[row.name]) for row in bar),
            metric=str(attribution.info["metric"]),
        )


def _ablate(scenes: Scenes, row: Any, gradient: torch.Tensor) -> Ablated:
    value = scenes.values[row.name]
    uphill = unit_gradient(gradient, value)
    step = first_step(scenes.renderer, row.name, value, uphill)

    def rise(step: float) -> torch.Tensor:
        return scenes.measure({row.name: value + step * uphill}) - scenes.still

    for _ in range(SHORTEST):
        half, full = rise(step / 2), rise(step)
        slope, curvature = (4 * half - full) / step, 4 * (full - 2 * half) / step**2
        measured, error = mean_and_error(slope)
        bending = abs(curvature.mean().item() * step / 2)
        if bending <= BENT * abs(measured) or error > BENT * abs(measured):
            break
        step /= SHORTER
    length = min(FIXED * row.saliency, room(value, -uphill, *scenes.renderer.bounds[row.name]))
    fixed, fixed_error = mean_and_error(rise(-length) / -length) if length > 0 else (None, None)
    return Ablated(
        name=row.name,
        label=row.label,
        predicted=row.saliency,
        predicted_error=row.saliency_error,
        measured=measured,
        measured_error=error,
        step=step,
        curvature=curvature.mean().item(),
        fixed=fixed,
        fixed_error=fixed_error,
    )


def _pairs(rows: Sequence[Ablated]) -> list[tuple[Ablated, Ablated]]:
    return [(one, two) for number, one in enumerate(rows) for two in rows[number + 1 :]]


def _told_apart(one: float, one_error: float, two: float, two_error: float) -> bool:
    return abs(one - two) > CLEAR * math.hypot(one_error, two_error)
