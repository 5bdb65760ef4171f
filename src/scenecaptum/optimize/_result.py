"""``Optimization``: the result of ``minimize``, with its table and figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from ..visualization import (
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
    new_figure,
    shorten,
    style_axes,
    write_at,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

REQUIRED_SIGMAS = 2.0  # standard errors by which the metric must be below the goal
_NAME_WIDTH = 36


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
        The change as a fraction of its range; for a colour, that of the channel that changed most.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    fraction: float


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
    metric
        Name of the metric.
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
        return self.after.is_below(self.below)

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot both scenes at the same exposure, and the metric at every step, into ``figure`` if given."""
        part: Any = figure or new_figure(WIDTH, 2.9)
        before, after, history = part.subplots(1, 3, width_ratios=[1.25, 1.25, 1])
        exposure = automatic_exposure(self.before.image)
        for ax, name, measured in ((before, "before", self.before), (after, "after", self.after)):
            ax.imshow(display_image(measured.image, exposure).numpy(force=True))
            title = f"{name}: {_format_metric(measured)}"
            ax.set_title(title, fontsize=TEXT, loc="left", parse_math=False)
            ax.set_axis_off()
            ax.set_anchor("N")
        history.plot(range(len(self.history)), self.history, color=RAISES, linewidth=1.2)
        history.axhline(self.below, color="0.4", linestyle="--", linewidth=1)
        write_at(
            history, "goal", (0, self.below), (3, -9), xycoords=("axes fraction", "data"), fontsize=SMALL
        )
        style_axes(history, self.metric, x="step", size=TEXT)
        part.suptitle(self._outcome(), fontsize=TITLE, x=0.01, ha="left", parse_math=False)
        return figure_of(part)

    def __str__(self) -> str:
        """Return a text table: the value of every changed parameter before and after, and the metric."""
        names = shorten([moved.label for moved in self.moved], _NAME_WIDTH)
        cells = [
            (name, _format_values(moved.before), _format_values(moved.after), f"{moved.fraction:.0%}")
            for name, moved in zip(names, self.moved, strict=True)
        ]
        return "\n".join([*grid(("moved", "before", "after", "of its range"), cells), "", self._outcome()])

    __repr__ = __str__

    def _outcome(self) -> str:
        outcome = f"{'' if self.reached else 'not '}below the goal of {self.below:g}"
        return f"{self.metric} {_format_metric(self.before)} → {_format_metric(self.after)}, {outcome}"


def _format_metric(measured: Measured) -> str:
    return format_with_error(measured.value, measured.error, digits=2)


def _format_values(value: torch.Tensor) -> str:
    return " ".join(f"{entry:.3g}" for entry in value.flatten().tolist())
