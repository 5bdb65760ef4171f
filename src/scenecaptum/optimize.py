"""Minimize a metric by changing the few most salient parameters within their bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from tqdm import tqdm

from .attr import VanillaSceneGradient, range_lengths, summarize
from .denoising import denoise
from .errors import SceneCaptumError, near_misses, whole_number
from .estimation import (
    DEFAULT_REPLICATES,
    Budget,
    Denoise,
    Metric,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    at_values,
    channel_totals,
    derived_seeds,
    input_values,
    jackknife,
    render_images,
    with_image_transform,
)
from .protocols import Capabilities, Renderer
from .scene import clamp_inside
from .visualization import (
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    automatic_exposure,
    display_image,
    figure_of,
    format_with_error,
    grid,
    metric_symbol,
    metric_unit,
    new_figure,
    rounded,
    shorten,
    style_axes,
    write_at,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

Limit: TypeAlias = "float | Sequence[float]"

# Properties of emitters that are part of their construction.
CONSTRUCTION = ("cutoff_angle", "beam_width")
LEARNING_RATE = 0.05  # of Adam: approximate step size as a fraction of a parameter's range or limits
BISECTIONS = 3  # of the last step
BOUND_MARGIN = 0.01  # distance from a physical bound, which may be degenerate, as a fraction of the range
LIGHTEST = 0.85  # reflectance of a design: that of white matt paint
REQUIRED_SIGMAS = 2.0  # standard errors by which the metric must be below the goal
_NAME_WIDTH = 36


def minimize(  # noqa: PLR0913 -- options shared by all methods, plus its own
    renderer: Renderer,
    metric: Metric,
    below: float,
    *,
    inputs: Mapping[str, torch.Tensor] | None = None,
    target: Target = None,
    top: int = 5,
    change: float = 0.5,
    limits: Mapping[str, tuple[Limit, Limit]] | None = None,
    steps: int = 60,
    seed: int = 0,
    spp: int | None = None,
    denoise: Denoise = "auto",
    show_progress: bool = False,
) -> Optimization:
    """Lower a metric below a goal with torch's Adam, changing only the most salient parameters.

    Parameters are ranked by their effects over their ranges; all but the top ones, and the cones of spots, are
    kept constant. A colour changes per channel, a texture by one offset per channel for all texels; a lamp or a
    sky is dimmed, and keeps its colour; no reflectance is raised above 0.85, that of white paint. Every step
    renders with a new seed. The goal counts as reached once a measurement with independent samples confirms it;
    the last step is then shortened as far as the goal allows.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics, optimize
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=256)
    >>> found = optimize.minimize(renderer, metrics.MeanLuminance(), below=27, top=2)  # cd/m²
    >>> found.reached, len(found.moved)
    (True, 2)

    Parameters
    ----------
    renderer, metric
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``. To increase a metric, minimize its
        negative.
    below
        The goal, in the metric's unit.
    inputs
        The values to start from; by default the scene's own.
    target
        Index of the metric's output, if that is a vector.
    top
        Number of parameters to change.
    change
        Maximum change of each parameter, as a fraction of its physical range, or of its value if the range is
        infinite.
    limits
        Intervals ``(low, high)`` of values by name or glob, in place of ``change``; numbers, or one for each
        channel, within which a lamp may also change its colour:
        ``{"desk.pose.translation": ((-0.3, -0.5, 0), (0.3, 0, 0))}`` keeps a desk on the floor. Objects are not
        moved into others whose bounds they did not overlap before.
    steps
        Maximum number of steps.
    seed, show_progress
        As for ``VanillaSceneGradient``.
    spp
        Samples per pixel of each step and each measurement; the renderer's by default.
    denoise
        As for ``VanillaSceneGradient``; decided once, for the original scene.

    Returns
    -------
    Optimization
        Its ``reached`` is True if the goal was reached.

    Raises
    ------
    SceneCaptumError
        If an option is invalid, no parameter affects the metric, or an object starts inside another.

    References
    ----------
    Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015.
    """
    if not 0 < change <= 1:
        raise SceneCaptumError(
            f"change must be a fraction of a range, above 0 and at most 1, not {change!r}."
        )
    values = input_values(renderer, inputs)
    spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
    count = whole_number("steps", steps)
    ranking_seed, measurement_seed, *step_seeds = derived_seeds(seed, Stream.OPTIMIZATION, 2 + count)
    ranked = VanillaSceneGradient(renderer, metric).attribute(
        values, target=target, seed=ranking_seed, spp=spp, denoise=denoise
    )
    name = metric_symbol(ranked)
    fixed = _construction(renderer)
    movable = [row for row in ranked.ranking() if any(row.total) and row.name not in fixed]
    top_rows = movable[: whole_number("top", top)]
    if not top_rows:
        raise SceneCaptumError(f"No parameter affects {name}: all its gradients are 0.")
    budget = Budget.split(spp, DEFAULT_REPLICATES, measurement_seed)

    def render(changed: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
        return render_images(renderer, changed, budget.seeds[0], budget.spp[0])

    targeted = TargetedMetric(metric, target)
    selector = TransformSelector(denoise, renderer, values, smoothed=targeted.is_smoothed)
    (transformed,) = with_image_transform([targeted], render(values), selector)

    def measure(changed: Mapping[str, torch.Tensor]) -> Measured:
        images = render(changed)
        estimate = jackknife(at_values(transformed, renderer, changed), images)
        return Measured(estimate.value, estimate.standard_error or 0.0, torch.stack(images).mean(0))

    start = {row.name: values[row.name] for row in top_rows}
    optimizer = _BoundedAdam(renderer, start, change, _chosen_limits(values, start, limits or {}))

    def optimized() -> dict[str, torch.Tensor]:
        return values | {name: value.detach() for name, value in optimizer.values().items()}

    history: list[float] = []
    before = after = measure(values)
    for step_seed in tqdm(step_seeds, disable=not show_progress, desc=name, unit="step"):
        current = {**values, **optimizer.values()}
        image = renderer(current, seed=step_seed, spp=spp)
        value, adjoint = at_values(transformed, renderer, current).value_and_adjoint(image)
        history.append(value)
        # The value of a step is biased low, since the optimizer fits its noise: check with independent samples.
        if value < below:
            after = measure(optimized())
            if after.is_below(below):
                after = _shortened(optimizer, lambda: measure(optimized()), after, below)
                break
        optimizer.step(image, adjoint)
    else:
        after = measure(optimized())
    return Optimization(
        values=optimized(),
        moved=optimizer.summary({row.name: row.label for row in top_rows}),
        before=before,
        after=after,
        history=tuple(history),
        below=below,
        metric=name,
        unit=metric_unit(ranked),
    )


def _shortened(
    optimizer: _BoundedAdam, measure: Callable[[], Measured], reached: Measured, below: float
) -> Measured:
    """Shorten the last step as far as the goal allows, by bisection, and return what was measured there."""
    enough, too_short = 1.0, 0.0
    for _ in range(BISECTIONS):
        fraction = (enough + too_short) / 2
        optimizer.shorten_last_step(fraction)
        measured = measure()
        if measured.is_below(below) and not optimizer.colliding():
            enough, reached = fraction, measured
        else:
            too_short = fraction
    optimizer.shorten_last_step(enough)
    return reached


def _construction(renderer: Renderer) -> set[str]:
    """Return the parameters that a design does not change: the cone of a spot belongs to the lamp."""
    describe = Capabilities(renderer).parameters_table
    if describe is None:
        return set()
    return {name for name, parameter in describe().items() if parameter.role in CONSTRUCTION}


def _lamps(renderer: Renderer) -> set[str]:
    """Return the emitted light of lamps and skies, which a dimmer scales as a whole."""
    describe = Capabilities(renderer).parameters_table
    if describe is None:
        return set()
    return {
        name for name, one in describe().items() if one.kind == "emitters" and math.isinf(one.bounds.high)
    }


def design_bounds(renderer: Renderer, values: Mapping[str, torch.Tensor]) -> dict[str, tuple[float, float]]:
    """Return the bounds within which a design changes values: no paint is lighter than white paint."""
    bounds = dict(Capabilities(renderer).bounds or {})
    describe = Capabilities(renderer).parameters_table
    for name, parameter in (describe() if describe is not None else {}).items():
        if name in bounds and name in values and parameter.kind == "reflectance":
            low, high = bounds[name]
            bounds[name] = low, min(high, max(LIGHTEST, values[name].max().item()))
    return bounds


def _chosen_limits(
    values: Mapping[str, torch.Tensor],
    start: Mapping[str, torch.Tensor],
    limits: Mapping[str, tuple[Limit, Limit]],
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return the limits of the parameters in ``start`` that have some; names take precedence over globs."""
    chosen = {}
    for key, interval in sorted(limits.items(), key=lambda item: item[0] in values):
        names = [key] if key in values else [name for name in values if fnmatchcase(name, key)]
        if not names:
            raise SceneCaptumError(f"limits names {key!r}, which no input matches.{near_misses(key, values)}")
        for name in start.keys() & set(names):
            low, high = (torch.as_tensor(limit).to(start[name]) for limit in interval)
            if not bool((low <= high).all()) or low.ndim > 1 or start[name].ndim > 1:
                raise SceneCaptumError(
                    f"limits[{key!r}] must be (low, high) with low <= high, numbers or one for each channel of "
                    f"{name!r}, not {interval!r}; textures have none."
                )
            chosen[name] = low, high
    return chosen


class _BoundedAdam:
    """Adam on offsets from ``start`` by channel, in units of the ranges or, where there are some, of the limits.

    They stay within bounds, and within ``change`` or limits. A step that moves an object into another is refused
    for that object.
    """

    def __init__(
        self,
        renderer: Renderer,
        start: Mapping[str, torch.Tensor],
        change: float,
        limits: Mapping[str, tuple[torch.Tensor, torch.Tensor]],
    ) -> None:
        self.start = start
        self._collisions = Capabilities(renderer).collisions
        self._touching = self._pairs({name: torch.zeros_like(value) for name, value in start.items()})
        self._check_start()
        # Limits say how far to go: for a pose, farther than the range over which its effect is measured.
        spans = {name: float((high - low).max()) for name, (low, high) in limits.items()}
        self._ranges = {
            name: spans.get(name) or length.item() for name, length in range_lengths(renderer, start).items()
        }
        bounds = design_bounds(renderer, {n: value for n, value in start.items() if n not in limits})
        self._bounds = {name: bounds[name] for name in start}
        self._lamps = _lamps(renderer) - limits.keys()
        self._directions = {
            name: value / self._ranges[name]
            if name in self._lamps and value.any()
            else torch.ones_like(value)
            for name, value in start.items()
        }
        self._offsets = {
            name: value.new_zeros(1 if name in self._lamps else channel_totals(value).shape).requires_grad_()
            for name, value in start.items()
        }
        self._before = {name: offset.detach().clone() for name, offset in self._offsets.items()}
        self._after = self._before
        self._limits = {
            name: [(limit - value) / self._ranges[name] for limit in limits[name]]
            if name in limits
            else [torch.tensor(-change), torch.tensor(change)]
            for name, value in start.items()
        }
        self._adam = torch.optim.Adam(self._offsets.values(), lr=LEARNING_RATE)

    def values(self) -> dict[str, torch.Tensor]:
        """Return the current values as functions of the offsets."""
        current = {}
        for name, value in self.start.items():
            change = self._ranges[name] * self._directions[name] * self._offsets[name]
            moved = value + change.reshape(value.shape)
            margin = BOUND_MARGIN * self._ranges[name]
            current[name] = clamp_inside(moved, value, *self._bounds[name], margin)
        return current

    def step(self, image: torch.Tensor, adjoint: torch.Tensor) -> None:
        """Take one descent step, given the gradient of the metric with respect to the image."""
        self._adam.zero_grad()
        image.backward(adjoint)
        self._before = {name: offset.detach().clone() for name, offset in self._offsets.items()}
        self._adam.step()
        with torch.no_grad():
            for name, offset in self._offsets.items():
                low, high = (limit.reshape(-1).expand_as(offset) for limit in self._limits[name])
                offset.copy_(offset.clamp(low, high))
            for name in self.colliding():
                self._offsets[name].copy_(self._before[name])
        self._after = {name: offset.detach().clone() for name, offset in self._offsets.items()}

    def shorten_last_step(self, fraction: float) -> None:
        """Go back to a fraction of the last step."""
        with torch.no_grad():
            for name, offset in self._offsets.items():
                offset.copy_(torch.lerp(self._before[name], self._after[name], fraction))

    def _pairs(self, values: Mapping[str, torch.Tensor]) -> set[tuple[str, str]]:
        """Return the inputs that move objects into others, each with the name of the other."""
        if self._collisions is None:
            return set()
        return set(self._collisions({name: value.detach() for name, value in values.items()}))

    def _check_start(self) -> None:
        for name, other in sorted(self._pairs(self.start) - self._touching):
            raise SceneCaptumError(
                f"{name!r} starts with its object inside the bounds of {other!r}, which it does not touch as "
                "loaded: start from other values."
            )

    def colliding(self) -> set[str]:
        """Return the inputs that have moved an object into another."""
        return {name for name, _ in self._pairs(self.values()) - self._touching}

    def summary(self, labels: Mapping[str, str]) -> tuple[Moved, ...]:
        """Return the initial and current value of every parameter."""
        values = {name: value.detach() for name, value in self.values().items()}
        before, after = summarize(self.start), summarize(values)
        # Not of the offsets, which go on where a value has reached its bound.
        changes = {name: (values[name] - start).abs().max().item() for name, start in self.start.items()}
        return tuple(
            Moved(
                name,
                labels[name],
                before[name],
                after[name],
                changes[name] / self._longest(name),
                is_dimmed=name in self._lamps,
            )
            for name in self.start
        )

    def _longest(self, name: str) -> float:
        """Return the change of a value by an offset of 1."""
        return self._ranges[name] * (self._directions[name].abs().max().item() or 1.0)


@dataclass(frozen=True)
class Measured:
    """The metric of a scene.

    Attributes
    ----------
    value, error
        The metric and its standard error.
    image
        The render, ``(H, W, 3)`` linear radiance.
    """

    value: float
    error: float
    image: torch.Tensor

    def is_below(self, goal: float) -> bool:
        """Whether the metric is below a goal by two standard errors."""
        return self.value + REQUIRED_SIGMAS * self.error < goal


@dataclass(frozen=True)
class Moved:
    """A parameter that was changed.

    Attributes
    ----------
    name, label
        Its name in the scene, and a readable label.
    before, after
        Its values; for a texture, the mean over the texels.
    fraction
        The change as a fraction of its range or limits; for a colour, that of the channel that changed most.
    is_dimmed
        Whether it is the light of a lamp or sky, and the fraction one of its own value.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    fraction: float
    is_dimmed: bool = False

    @property
    def extent(self) -> str:
        """How far it was changed: ``"31 % of its range"``, or ``"31 % less"`` light."""
        percent = f"{100 * self.fraction:.0f} %"
        if not self.is_dimmed:
            return f"{percent} of its range"
        return f"{percent} {'less' if bool((self.after <= self.before).all()) else 'more'}"


@dataclass(frozen=True, repr=False)
class Optimization:
    """The result of ``minimize``; prints as a table.

    Attributes
    ----------
    values
        The optimized scene: ``renderer(values)`` renders it.
    moved
        The parameters that were changed, most salient first; all others were kept constant.
    before, after
        The metric and the render of both scenes, from samples independent of the optimization steps.
    history
        The metric at each step, with the noise of that step's render.
    below
        The goal.
    metric, unit
        Name and unit of the metric.
    """

    values: Mapping[str, torch.Tensor]
    moved: tuple[Moved, ...]
    before: Measured
    after: Measured
    history: tuple[float, ...]
    below: float
    metric: str
    unit: str = ""

    @property
    def reached(self) -> bool:
        """Whether the metric is below the goal by two standard errors."""
        return self.after.is_below(self.below)

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot both scenes, denoised, at one exposure, and the metric at every step, into ``figure`` if given."""
        height, width, _ = self.before.image.shape
        renders, curve = WIDTH / 2 * height / width, 1.6
        part: Any = figure or new_figure(WIDTH, renders + curve + 1)
        axes = part.subplot_mosaic([["before", "after"], ["history"] * 2], height_ratios=[renders, curve])
        before, after, history = axes.values()
        exposure = automatic_exposure(self.before.image)
        for ax, name, measured in ((before, "before", self.before), (after, "after", self.after)):
            ax.imshow(display_image(denoise(measured.image), exposure).numpy(force=True))
            title = f"{name}: {self._format(measured)}"
            ax.set_title(title, fontsize=TEXT, loc="left", parse_math=False)
            ax.set_axis_off()
        history.plot(range(len(self.history)), self.history, color=RAISES, linewidth=1.2)
        history.axhline(self.below, color="0.4", linestyle="--", linewidth=1)
        write_at(
            history, "goal", (0, self.below), (3, -9), xycoords=("axes fraction", "data"), fontsize=SMALL
        )
        style_axes(history, self.metric, x="step", size=TEXT)
        history.locator_params(axis="x", integer=True)
        part.suptitle(self.outcome, fontsize=TITLE, x=0.01, ha="left", parse_math=False)
        return figure_of(part)

    def __str__(self) -> str:
        """Return a text table: the value of every changed parameter before and after, and the metric."""
        names = shorten([moved.label for moved in self.moved], _NAME_WIDTH)
        cells = [
            (name, _format_values(moved.before), _format_values(moved.after), moved.extent)
            for name, moved in zip(names, self.moved, strict=True)
        ]
        return "\n".join([*grid(("changed", "before", "after", "by"), cells), "", self.outcome])

    __repr__ = __str__

    @property
    def outcome(self) -> str:
        """What was reached, in a sentence."""
        goal = f"the goal of {self.below:g} {self.unit}".rstrip()
        if self.reached:
            outcome = f"below {goal}"
        elif self.after.value < self.below:
            outcome = f"below {goal}, but not by two standard errors: use more samples"
        else:
            outcome = f"not below {goal}"
        return f"{self.metric} {self._format(self.before)} → {self._format(self.after)}, {outcome}"

    def _format(self, measured: Measured) -> str:
        return f"{format_with_error(measured.value, measured.error)} {self.unit}".rstrip()


def _format_values(value: torch.Tensor) -> str:
    return " ".join(rounded(entry) for entry in value.flatten().tolist())
