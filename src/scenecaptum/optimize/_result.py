"""``Optimization``: what a search has changed and reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import torch

from ..denoising import denoise
from ..images import LUMINANCE_WEIGHTS
from ..scene import with_unit
from ..visualization import (
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    automatic_exposure,
    characters_per_line,
    display_image,
    figure_of,
    format_with_error,
    grid,
    new_figure,
    rounded,
    shorten,
    style_axes,
    wrapped_lines,
    write_at,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

REQUIRED_SIGMAS = 2.0  # standard errors by which the metric must be below the goal
_NAME_WIDTH = 36
Whole: TypeAlias = Literal["range", "value", "light"]  # of a change that is a fraction


@dataclass(frozen=True)
class Measured:
    """The metric of a scene.

    Attributes
    ----------
    value, error
        The metric and its standard error; of a relaxed metric, such as a glare rating, by its definition.
    image
        The render, ``(H, W, 3)`` linear radiance.
    relaxed, relaxed_error
        The relaxed metric, which the search differentiates; None for other metrics.
    """

    value: float
    error: float
    image: torch.Tensor
    relaxed: float | None = None
    relaxed_error: float = 0.0

    @property
    def order(self) -> tuple[float, float]:
        """What designs are compared by: the metric, and where that counts points or sources, the relaxed one."""
        return self.value, self.relaxed or 0.0

    def is_below(self, goal: float) -> bool:
        """Whether the metric is below a goal by two standard errors, relaxed and by its definition."""
        pairs = [(self.value, self.error)]
        if self.relaxed is not None:
            pairs.append((self.relaxed, self.relaxed_error))
        return all(value + REQUIRED_SIGMAS * error < goal for value, error in pairs)


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
        The change as a fraction of its range or value, of a texture that of its mean; for a colour, that of the
        channel that changed most, and for a light that changed in one direction, that of its luminance.
    whole
        What that is a fraction of: its ``"range"``, its ``"value"`` where the range is infinite, or the
        ``"light"`` of a lamp or sky.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    fraction: float
    whole: Whole = "range"

    @property
    def extent(self) -> str:
        """How far it was changed: ``"by 31 % of its range"``, ``"31 % less"`` light, or ``"switched on"``.

        ``"by up to 31 %"`` if one channel of a colour changed more than another.
        """
        percent, is_light = f"{100 * self.fraction:.0f} %", self.whole == "light"
        if is_light and not self.before.any():
            return "switched on"
        if is_light and not self.after.any():
            return "switched off"
        if is_light and bool((self.after <= self.before).all()):
            return f"{percent} less"
        if is_light and bool((self.after >= self.before).all()):
            return f"{percent} more"
        changes = (self.after - self.before).abs().flatten()
        least = changes.min() / changes.max() if changes.any() else 1.0
        up_to = "" if f"{100 * self.fraction * least:.0f} %" == percent else "up to "
        return f"by {up_to}{percent} of its {'range' if self.whole == 'range' else 'value'}"


def changed_fraction(before: torch.Tensor, after: torch.Tensor, length: torch.Tensor, whole: Whole) -> float:
    """Return a change as a fraction of a length, or of a light; with limits, a light may change its colour."""
    change = after - before
    if whole == "light" and bool(before.any()):
        if bool((change <= 0).all() or (change >= 0).all()):
            return abs(_amount(change) / _amount(before))
        length = before.abs().max()
    return change.abs().max().item() / length.item()


def _amount(light: torch.Tensor) -> float:
    """Return the luminance of a light with three channels, otherwise the sum of its channels."""
    weights = LUMINANCE_WEIGHTS if light.numel() == len(LUMINANCE_WEIGHTS) else [1.0] * light.numel()
    return (light.double().flatten() @ light.new_tensor(weights).double()).item()


@dataclass(frozen=True, repr=False)
class Optimization:
    """The result of ``minimize``; prints as a table.

    Attributes
    ----------
    values
        The optimized scene: ``renderer(values)`` renders it.
    moved
        The parameters that were changed, most salient first, then those that were only brought inside their
        limits; all others were kept constant, or were at a bound and could not go on.
    before, after
        The metric and the render of both scenes, from samples independent of the optimization steps.
    history
        The metric at each step, with the noise of that step's render.
    below
        The goal.
    metric, unit
        Name and unit of the metric.
    note
        What the errors of a goal that was reached leave out: for a rating of a picture, the resolution. Of one
        that was missed, which parameters are at the limit of their change or range.
    shows_a_view
        Whether the images are pictures, and not the points of a sensor grid.
    """

    values: Mapping[str, torch.Tensor]
    moved: tuple[Moved, ...]
    before: Measured
    after: Measured
    history: tuple[float, ...]
    below: float
    metric: str
    unit: str = ""
    note: str = ""
    shows_a_view: bool = True

    @property
    def was_below(self) -> bool:
        """Whether the scene was below the goal from the start, so that nothing was changed."""
        return not self.moved and self.before.is_below(self.below)

    @property
    def reached(self) -> bool:
        """Whether the metric is below the goal by two standard errors."""
        return self.after.is_below(self.below)

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot both scenes, denoised, at one exposure, and the metric at every step, into ``figure`` if given.

        The points of a sensor grid are no picture, and only the steps are plotted.
        The last point is the value that was measured apart from the steps, of a relaxed metric by its definition;
        if the goal was missed, that of the best step.
        """
        height, width, _ = self.before.image.shape
        renders, curve = WIDTH / 2 * height / width if self.shows_a_view else 0.0, 1.6
        title = wrapped_lines(self.outcome, characters_per_line(WIDTH, TITLE))
        part: Any = figure or new_figure(WIDTH, renders + curve + 1 + (len(title) - 1) * 1.3 * TITLE / 72)
        if self.shows_a_view:
            axes = part.subplot_mosaic([["before", "after"], ["history"] * 2], height_ratios=[renders, curve])
            self._draw_renders(axes["before"], axes["after"])
            history = axes["history"]
        else:
            history = part.add_subplot()
        steps = max(1, len(self.history))
        history.plot(range(len(self.history)), self.history, color=RAISES, linewidth=1.2)
        history.axhline(self.below, color="0.4", linestyle="--", linewidth=1)
        # With samples of its own, and where the goal is reached after a last step that is shortened.
        end = (steps, self.after.value)
        history.plot(*end, "o", color=RAISES, markersize=5, clip_on=False)
        confirmed = "confirmed" if self.reached else "measured again"
        is_relaxed = self.after.relaxed is not None
        confirmed += "\nby the definition" if is_relaxed else ""
        # On the side of the point that is away from the line of the goal.
        align = "top" if self.after.value < self.below else "bottom"
        write_at(history, confirmed, end, (8, 0), va=align, fontsize=SMALL)
        history.margins(y=0.25 if is_relaxed else 0.12)  # for two lines beside the point
        history.set_xlim(left=-0.02 * steps, right=(1.22 if is_relaxed else 1.17) * steps)
        # Away from the curve's end, and from the axis below a goal that is missed.
        side = -9 if self.reached else 3
        write_at(
            history, "goal", (0, self.below), (3, side), xycoords=("axes fraction", "data"), fontsize=SMALL
        )
        of_steps = f"{self.metric}, relaxed at the steps" if is_relaxed else self.metric
        # Not the last value of the curve, which lies beyond the goal.
        step = "step (the last one is shortened as far as the goal allows)" if self.reached else "step"
        style_axes(history, of_steps, x=step, size=TEXT)
        history.locator_params(axis="x", integer=True)
        part.suptitle("\n".join(title), fontsize=TITLE, x=0.01, ha="left", parse_math=False)
        return figure_of(part)

    def _draw_renders(self, before: Axes, after: Axes) -> None:
        exposure = automatic_exposure(self.before.image)
        for ax, name, measured in ((before, "before", self.before), (after, "after", self.after)):
            ax.imshow(display_image(denoise(measured.image), exposure).numpy(force=True))
            ax.set_title(f"{name}: {self._format(measured)}", fontsize=TEXT, loc="left", parse_math=False)
            ax.set_axis_off()

    def __str__(self) -> str:
        """Return a text table: the value of every changed parameter before and after, and the metric."""
        names = shorten([with_unit(moved.label, moved.name) for moved in self.moved], _NAME_WIDTH)
        cells = [
            (name, _format_values(moved.before), _format_values(moved.after), moved.extent)
            for name, moved in zip(names, self.moved, strict=True)
        ]
        table = [*grid(("changed", "before", "after", "change"), cells), ""] if self.moved else []
        return "\n".join([*table, *filter(None, [self.outcome, self.note])])

    __repr__ = __str__

    @property
    def outcome(self) -> str:
        """What was reached, in a sentence."""
        goal = f"the goal of {self.below:g} {self.unit}".rstrip()
        if self.was_below:
            return f"{self.metric} {self._format(self.before)}, already below {goal}"
        if self.reached:
            outcome = f"below {goal}"
        elif self.after.value < self.below:
            outcome = f"below {goal}, but not by two standard errors: use more samples"
        else:
            outcome = f"not below {goal}"
        if not self.moved:
            return f"{self.metric} {self._format(self.before)}, {outcome}; the search found no lower value"
        return f"{self.metric} {self._format(self.before)} → {self._format(self.after)}, {outcome}"

    def _format(self, measured: Measured) -> str:
        return f"{format_with_error(measured.value, measured.error)} {self.unit}".rstrip()


def _format_values(value: torch.Tensor) -> str:
    return " ".join(rounded(entry, 4) for entry in value.flatten().tolist())
