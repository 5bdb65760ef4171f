"""From a map to an action: lower a metric by moving the few parameters that matter most, within bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from .attr import VanillaSceneGradient
from .attr._gradients import input_values
from .attr._jackknife import jackknife, through_view
from .attr._metric import Metric, TargetedMetric
from .attr._passes import DEFAULT_PASSES, Budget, channel_totals, pictures
from .attr._ranges import ranges
from .attr._values import summarise
from .attr._view import Denoise, Viewer
from .errors import SceneCaptumError, check_seed, whole_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATE = 0.05  # of Adam: about how far a parameter moves in a step, as a fraction of its range
MARGIN = 0.01  # fraction of a range that is kept free at a physical bound, which itself may be degenerate
SURE = 2.0  # standard errors that the goal must lie above the metric


@dataclass(frozen=True)
class Measured:
    """What a scene measures.

    Attributes
    ----------
    value, error
        The metric and its standard error.
    image
        The scene's picture, ``(H, W, 3)`` linear radiance.
    """

    value: float
    error: float
    image: torch.Tensor


@dataclass(frozen=True)
class Moved:
    """A parameter that was moved.

    Attributes
    ----------
    name, label
        Its name in the scene, and a readable one.
    before, after
        What it was and what it is; of a texture the mean over its texels.
    fraction
        The part of its range that it went, of a colour the channel that went farthest.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    fraction: float


@dataclass(frozen=True, repr=False)
class Optimisation:
    """What ``minimize`` did; prints as a table.

    Attributes
    ----------
    values
        The changed scene: ``renderer(values)`` renders it.
    moved
        The parameters that were moved, most salient first; all others were held.
    before, after
        The metric and the picture of both scenes, from samples of their own.
    history
        The metric at each step, as noisy as the step's own render.
    below
        The goal.
    metric
        Its name.
    """

    values: Mapping[str, torch.Tensor]
    moved: tuple[Moved, ...]
    before: Measured
    after: Measured
    history: tuple[float, ...]
    below: float
    metric: str

    @property
    def reached(self) -> bool:
        """Whether the metric is below the goal by two standard errors."""
        return _is_below(self.after, self.below)

    def plot(self) -> Figure:
        """Draw the scene before and after, and the way between."""
        from .visualization import plot_optimisation

        return plot_optimisation(self)

    def __str__(self) -> str:
        from .visualization import optimisation_text

        return optimisation_text(self)

    __repr__ = __str__


def minimize(  # noqa: PLR0913 -- those of every method, and its own
    renderer: Any,
    metric: Metric,
    below: float,
    *,
    top: int = 5,
    change: float = 0.5,
    steps: int = 60,
    seed: int = 0,
    spp: int | None = None,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Optimisation:
    """Lower a metric below a goal by torch's Adam, moving only the parameters that can move it most.

    The ranking of gradient × range says which parameters these are; all others are held. A colour moves by
    channel, a texture by one colour for all of its texels. Every step renders with a seed of its own; the goal
    counts as reached once samples that took no part in the steps say so.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics, optimize
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=256)
    >>> found = optimize.minimize(renderer, metrics.MeanLuminance(), below=0.15, top=2)
    >>> found.reached, len(found.moved)
    (True, 2)

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``; the metric returns a scalar, and the renderer must tell its ``bounds``.
        To raise a metric, lower its negative.
    below
        The goal, in the metric's unit.
    top
        How many parameters are moved.
    change
        How far each may move at most, as a fraction of its physical range, or of its value where that is infinite.
    steps
        How many steps at most.
    seed
        Seed from which all others are drawn.
    spp
        Samples per pixel of each step, and of each measurement; the renderer's by default.
    denoise
        Whether a metric that is not linear sees denoised pictures, as for ``VanillaSceneGradient``; the scene as
        it is decides for all steps.
    show_progress
        Whether to show a progress bar.

    Returns
    -------
    Optimisation
        Whether the goal was reached is its ``reached``.

    Raises
    ------
    SceneCaptumError
        Where an option is wrong, or no parameter moves the metric.

    References
    ----------
    Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015.
    """
    if not 0 < change <= 1:
        raise SceneCaptumError(
            f"change must be a fraction of a range, above 0 and at most 1, not {change!r}."
        )
    values = input_values(renderer, None)
    spp = getattr(renderer, "spp", None) if spp is None else whole_number("spp", spp)
    count = whole_number("steps", steps)
    first, last, *each = (
        np.random.SeedSequence([check_seed("seed", seed), 6]).generate_state(2 + count).tolist()
    )
    ranked = VanillaSceneGradient(renderer, metric).attribute(
        scale="range", seed=first, spp=spp, denoise=denoise
    )
    leading = [row for row in ranked.ranking(whole_number("top", top)) if row.saliency > 0]
    if not leading:
        raise SceneCaptumError(f"No parameter moves {ranked.info['metric']}: all its gradients are 0.")
    budget = Budget.split(spp, DEFAULT_PASSES, last)

    def render(changed: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
        return pictures(renderer, changed, budget.seeds[0], budget.spp[0])

    (seen,) = through_view([TargetedMetric(metric)], render(values), Viewer(denoise, renderer))

    def measure(changed: Mapping[str, torch.Tensor]) -> Measured:
        images = render(changed)
        found = jackknife(seen, images)
        return Measured(found.value, found.standard_error or 0.0, torch.stack(images).mean(0))

    moves = _Moves(renderer, {row.name: values[row.name] for row in leading}, change)
    history: list[float] = []
    before = after = measure(values)
    for one in tqdm(each, disable=not show_progress, desc=str(ranked.info["metric"]), unit="step"):
        image = renderer({**values, **moves.values()}, seed=one, spp=spp)
        value, adjoint = seen.value_and_adjoint(image)
        history.append(value)
        # A step's own samples led it there: fresh ones decide.
        if value < below:
            after = measure(values | _detached(moves.values()))
            if _is_below(after, below):
                break
        moves.step(image, adjoint)
    else:
        after = measure(values | _detached(moves.values()))
    return Optimisation(
        values=values | _detached(moves.values()),
        moved=moves.summary({row.name: row.label for row in leading}),
        before=before,
        after=after,
        history=tuple(history),
        below=below,
        metric=str(ranked.info["metric"]),
    )


class _Moves:
    """How far each parameter has gone, by channel, in units of its range; and the optimizer that moves it.

    Parameters
    ----------
    renderer
        Tells the bounds.
    start
        The parameters where they begin.
    change
        How far each may go.
    """

    def __init__(self, renderer: Any, start: Mapping[str, torch.Tensor], change: float) -> None:
        self.start = start
        self.change = change
        self._lengths = {name: one.item() for name, one in ranges(renderer, start).items()}
        self._bounds = {name: renderer.bounds[name] for name in start}
        self._ways = {
            name: value.new_zeros(channel_totals(value).shape).requires_grad_()
            for name, value in start.items()
        }
        self._adam = torch.optim.Adam(self._ways.values(), lr=RATE)

    def values(self) -> dict[str, torch.Tensor]:
        """Return where the parameters are, as functions of the way."""
        found = {}
        for name, value in self.start.items():
            way = self._ways[name].reshape(value.shape if value.ndim < 2 else (-1,))
            low, high = self._bounds[name]
            margin = MARGIN * self._lengths[name]
            # A value that is nearer to its bound already may stay there.
            lowest, highest = value.clamp(max=low + margin), value.clamp(min=high - margin)
            found[name] = torch.minimum(torch.maximum(value + self._lengths[name] * way, lowest), highest)
        return found

    def step(self, image: torch.Tensor, adjoint: torch.Tensor) -> None:
        """Make one step down the metric, whose derivative by the image is ``adjoint``."""
        self._adam.zero_grad()
        image.backward(adjoint)
        self._adam.step()
        with torch.no_grad():
            for way in self._ways.values():
                way.clamp_(-self.change, self.change)

    def summary(self, labels: Mapping[str, str]) -> tuple[Moved, ...]:
        """Say where every parameter was and is."""
        before, after = summarise(self.start), summarise(self.values())
        return tuple(
            Moved(name, labels[name], before[name], after[name], self._ways[name].abs().max().item())
            for name in self.start
        )


def _detached(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value.detach() for name, value in values.items()}


def _is_below(measured: Measured, goal: float) -> bool:
    return measured.value + SURE * measured.error < goal
