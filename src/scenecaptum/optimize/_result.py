"""``Optimization``: the result of ``minimize``, with its table and figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..visualization import (
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    automatic_exposure,
    display_image,
    new_figure,
    shorten,
    with_error,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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

    def plot(self) -> Figure:
        """Plot the scene before and after at the same exposure, and the metric at every step with the goal."""
        figure = new_figure(WIDTH, 2.9)
        panels = figure.subplot_mosaic([["before", "after", "history"]], width_ratios=[1.25, 1.25, 1])
        exposure = automatic_exposure(self.before.image)
        for name, measured in (("before", self.before), ("after", self.after)):
            panels[name].imshow(display_image(measured.image, exposure).numpy(force=True))
            panels[name].set_title(
                f"{name}: {_format_metric(measured)}", fontsize=TEXT, loc="left", parse_math=False
            )
            panels[name].set_axis_off()
            panels[name].set_anchor("N")
        self._plot_history(panels["history"])
        figure.suptitle(self._outcome(), fontsize=TITLE, x=0.01, ha="left", parse_math=False)
        return figure

    def _plot_history(self, ax: Axes) -> None:
        ax.plot(range(len(self.history)), self.history, color=RAISES, linewidth=1.2)
        ax.axhline(self.below, color="0.4", linestyle="--", linewidth=1)
        ax.annotate(
            "goal",
            (0, self.below),
            xycoords=("axes fraction", "data"),
            xytext=(3, -9),
            textcoords="offset points",
            fontsize=SMALL,
        )
        ax.set_xlabel("step", fontsize=TEXT)
        ax.set_title(self.metric, fontsize=TEXT, loc="left", parse_math=False)
        ax.tick_params(labelsize=SMALL)
        ax.spines[["top", "right"]].set_visible(False)

    def __str__(self) -> str:
        """Return a text table: the value of every changed parameter before and after, and the metric."""
        names = shorten([moved.label for moved in self.moved], _NAME_WIDTH)
        cells = [
            (name, _format_values(moved.before), _format_values(moved.after), f"{moved.fraction:.0%}")
            for name, moved in zip(names, self.moved, strict=True)
        ]
        head = ("moved", "before", "after", "of its range")
        widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            for row in (head, *cells)
        ]
        return "\n".join([*(line.rstrip() for line in lines), "", self._outcome()])

    __repr__ = __str__

    def _outcome(self) -> str:
        outcome = f"{'' if self.reached else 'not '}below the goal of {self.below:g}"
        return f"{self.metric} {_format_metric(self.before)} → {_format_metric(self.after)}, {outcome}"


def _format_metric(measured: Measured) -> str:
    return " ± ".join(filter(None, with_error(measured.value, measured.error, digits=2)))


def _format_values(value: torch.Tensor) -> str:
    return " ".join(f"{entry:.3g}" for entry in value.flatten().tolist())
