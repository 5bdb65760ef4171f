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
from ..attr._passes import DEFAULT_PASSES, channel_totals
from ..attr._student import student_t
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ._scenes import CRAMPED, LONGEST, Scenes, mean_and_error, unit_gradient, view_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A step is short enough where bending takes less than this part of the slope; if not it is divided by SHORTER.
BENT, SHORTER, SHORTEST = 0.2, 4.0, 6

AGREES = 0.1  # relative difference of prediction and measurement, where their errors are smaller
CLEAR, SURE = 0.95, 0.997  # confidence that two numbers differ, and that prediction and measurement do
ORDERED = 0.95  # Kendall's τ

# The step of Beresna and Fiume: so much of the gradient itself.
FIXED = 0.01
SHORT = 0.99  # of the way to a bound, which itself may be unphysical


@dataclass(frozen=True)
class Ablated:
    """What moving one parameter does.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable one.
    predicted, predicted_error
        The saliency ``‖g‖``: how much the metric should rise per unit of a step along the gradient.
    measured, measured_error
        How much it rises, from renders at 0, half a step and a step, with the bending taken out.
    step
        Length of the step, negative down the gradient; in the parameter's unit, over its channels.
    curvature
        Second derivative along the gradient.
    degrees_of_freedom
        Of the errors.
    fixed, fixed_error
        How much it rises per unit on a step of one hundredth of the gradient, down it and short of the bound, as
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
    degrees_of_freedom: int
    fixed: float | None = None
    fixed_error: float | None = None

    @property
    def noise(self) -> float:
        """Below what a measurement is not told from 0, with 95 % confidence."""
        return student_t(CLEAR, self.degrees_of_freedom) * self.measured_error

    @property
    def above_noise(self) -> bool:
        """Whether the measurement is told from 0."""
        return abs(self.measured) > self.noise

    @property
    def agrees(self) -> bool:
        """Whether prediction and measurement are the same within a tenth or their errors (99.7 % confidence)."""
        error = math.hypot(self.predicted_error, self.measured_error)
        allowed = max(AGREES * self.predicted, student_t(SURE, self.degrees_of_freedom) * error)
        return abs(self.measured - self.predicted) <= allowed


@dataclass(frozen=True, repr=False)
class AblationTest:
    """The parameters by falling saliency, each with what moving it does; prints as a table.

    Attributes
    ----------
    rows
        One for each parameter.
    metric
        What was attributed.
    """

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
            if _told_apart(one, two, "measured") and _told_apart(one, two, "predicted")
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


def ablation_test(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    top: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> AblationTest:
    """Move each of the most salient parameters along its own gradient, and compare the change with the prediction.

    Every step is a part of the parameter's physical range, down the gradient unless a bound is near, and is
    shortened until the metric hardly bends on it; renders at half the step take out what bending is left. All
    renders of one parameter share their seeds, so that most of their noise cancels. The texels of a texture move
    alike, but for those that would leave their bounds: what the others do is scaled up by their part of the
    gradient.

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
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.
    show_progress
        Whether to show a progress bar.

    Returns
    -------
    AblationTest
        A row for each parameter with saliency; its ``is_confirmed`` and ``verdict`` judge them.

    Raises
    ------
    SceneCaptumError
        Where the attribution is not one of plain gradients, or has no error bars.

    References
    ----------
    Beresna and Fiume, "Scene Parameter Saliency via Differentiable Light Transport": the ablation with a step of
    one hundredth of each gradient, which is measured here too.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(
            target=target, seed=seed, spp=spp, show_progress=show_progress
        )
    if attribution.info.get("scale") != "unit" or attribution.covariance is None:
        raise SceneCaptumError(
            "An ablation test takes plain gradients with error bars: VanillaSceneGradient(...).attribute()."
        )
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes.split(renderer, metric, target, **options, denoise=view_of(attribution))
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    with tqdm(rows, disable=not show_progress, desc="ablation", unit="parameter") as bar:
        return AblationTest(
            rows=tuple(_ablate(scenes, row, attribution[row.name]) for row in bar),
            metric=str(attribution.info["metric"]),
        )


@dataclass(frozen=True)
class _Way:
    """How a parameter is moved.

    Attributes
    ----------
    direction
        That of its gradient, of length 1 over the channels, and 0 where an element stays.
    step
        Length of the step, negative down the gradient.
    share
        What part of the saliency belongs to what moves.
    """

    direction: torch.Tensor
    step: float
    share: float = 1.0


def _find_way(value: torch.Tensor, gradient: torch.Tensor, low: float, high: float) -> _Way:
    """Go down the gradient, or up it where a bound is near; without the elements at bounds where both are."""
    uphill = unit_gradient(gradient, value).expand_as(value)
    # Of an environment map the sun is brightest by far: where there is no range, the mean tells the size.
    length = high - low if math.isfinite(high - low) else value.abs().mean().item() or 1.0
    rooms = {sign: _rooms(value, sign * uphill, low, high) for sign in (-1, 1)}
    for sign, room in rooms.items():
        # Only part of the way to a bound, which itself may be unphysical.
        step = min(LONGEST * length, 0.5 * room.min().item())
        if step >= CRAMPED * length:
            return _Way(uphill, sign * step)
    total = channel_totals(gradient).double().norm()
    ways = []
    for sign, room in rooms.items():
        direction = torch.where(room >= LONGEST * length, uphill, 0.0)
        ways.append(_Way(direction, sign * LONGEST * length, ((gradient * direction).sum() / total).item()))
    return max(ways, key=lambda way: way.share)


def _rooms(value: torch.Tensor, direction: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Return how far each element can go in a direction before it meets a bound."""
    towards = torch.where(direction > 0, high - value, value - low)
    return torch.where(direction == 0, math.inf, towards / direction.abs())


def _ablate(scenes: Scenes, row: Any, gradient: torch.Tensor) -> Ablated:
    value, (low, high) = scenes.values[row.name], scenes.renderer.bounds[row.name]
    way = _find_way(value, gradient, low, high)

    def slope_on(step: float) -> torch.Tensor:
        rise = scenes.measure({row.name: value + step * way.direction}) - scenes.still
        return rise / (step * way.share)

    step = way.step
    for _ in range(SHORTEST):
        half, full = slope_on(step / 2), slope_on(step)
        measured, error = mean_and_error(2 * half - full)
        bending, bending_error = mean_and_error(2 * (full - half))
        # What is only noise would be more of it on a shorter step.
        if abs(bending) - 2 * bending_error <= BENT * abs(measured):
            break
        step /= SHORTER
    length = min(FIXED * row.saliency, SHORT * _rooms(value, -way.direction, low, high).min().item())
    fixed, fixed_error = mean_and_error(slope_on(-length)) if length > 0 else (None, None)
    return Ablated(
        name=row.name,
        label=row.label,
        predicted=row.saliency,
        predicted_error=row.saliency_error,
        measured=measured,
        measured_error=error,
        step=step,
        curvature=2 * bending / step,
        degrees_of_freedom=len(scenes.seeds) - 1,
        fixed=fixed,
        fixed_error=fixed_error,
    )


def _pairs(rows: Sequence[Ablated]) -> list[tuple[Ablated, Ablated]]:
    return [(one, two) for number, one in enumerate(rows) for two in rows[number + 1 :]]


def _told_apart(one: Ablated, two: Ablated, what: str) -> bool:
    error = math.hypot(getattr(one, f"{what}_error"), getattr(two, f"{what}_error"))
    degrees = min(one.degrees_of_freedom, two.degrees_of_freedom)
    return bool(abs(getattr(one, what) - getattr(two, what)) > student_t(CLEAR, degrees) * error)
