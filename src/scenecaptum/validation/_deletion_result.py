"""Deletion and insertion curves, with their table and figure."""

from __future__ import annotations

import itertools
import textwrap
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch

from ..visualization import (
    RAISES,
    SMALL,
    TEXT,
    WIDTH,
    align_decimals,
    figure_of,
    new_figure,
    shorten,
    with_error,
)
from ._drawing import means_and_errors, style_axes, table_lines, value_with_error
from ._scenes import mean_and_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAME_WIDTH, _NOTE_WIDTH = 36, 110


@dataclass(frozen=True, repr=False)
class DeletionInsertion:
    """Deletion and insertion curves of a ranking; prints as a table.

    Attributes
    ----------
    names, labels
        The parameters in the order of the ranking.
    moved
        ``(points,)``: number of parameters deleted or inserted at each point of the curves, from 0 to all.
    deletion
        ``(points, replicates)``: the metric with the first ``moved`` parameters at their baselines.
    insertion
        ``(points, replicates)``: the metric with all but the first ``moved`` parameters at their baselines.
    random
        ``(orders, points, replicates)``: deletion in random orders. Reversed, each is an insertion curve.
    metric, method
        Names of the metric and of the attribution method.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    moved: torch.Tensor
    deletion: torch.Tensor
    insertion: torch.Tensor
    random: torch.Tensor
    metric: str
    method: str

    @cached_property
    def deletion_area(self) -> tuple[float, float]:
        """Mean change of the metric from the original scene over the deletion curve, and its standard error.

        Larger is better: the first parameters change the metric most. If the metric falls, this is its original
        value minus the usual area under the curve; a rise counts in the same way.
        """
        return mean_and_error(self._area(self.deletion, self.moved))

    @cached_property
    def insertion_area(self) -> tuple[float, float]:
        """Mean difference of the metric from the original scene over the insertion curve, and its standard error.

        Smaller is better: the first parameters restore most of the metric.
        """
        return mean_and_error(self._area(self.insertion, self.moved))

    @cached_property
    def random_areas(self) -> torch.Tensor:
        """``(2, orders)``: the deletion and insertion areas of the random orders."""
        remaining = self.moved[-1] - self.moved.flip(0)
        deletions = [self._area(curve, self.moved).mean() for curve in self.random]
        insertions = [self._area(curve.flip(0), remaining).mean() for curve in self.random]
        return torch.stack([torch.stack(deletions), torch.stack(insertions)])

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        deletions, insertions = self.random_areas
        by_deletion = int((self.deletion_area[0] > deletions).sum())
        by_insertion = int((self.insertion_area[0] < insertions).sum())
        return (
            f"the order of {self.method} beats {by_deletion} of {len(deletions)} random orders by deletion and "
            f"{by_insertion} by insertion"
        )

    def _area(self, curve: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
        """Return the mean distance of a curve from the original scene, in each replicate."""
        change = curve - self.deletion[0]
        # The sign of the mean over the replicates: with signs of their own, noise would add to the distance.
        distance = change * change.mean(1, keepdim=True).sign()
        return torch.trapezoid(distance, moved.double() / moved[-1], dim=0)

    def plot(self, figure: Any = None) -> Figure:
        """Plot deletion and insertion side by side, over the number of moved parameters.

        Grey lines are random orders; error bars are standard errors of the change.

        Parameters
        ----------
        figure
            A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.
        """
        return _draw(self, figure)

    def __str__(self) -> str:
        return _text(self)

    __repr__ = __str__


def _text(curves: DeletionInsertion) -> str:
    names = shorten(["", *_steps(curves)], _NAME_WIDTH)
    moved = [str(count) for count in curves.moved.tolist()]
    original = curves.deletion[0]
    deletion, insertion = (
        align_decimals([value_with_error(*point) for point in means_and_errors(curve - original)])
        for curve in (curves.deletion, curves.insertion)
    )
    header = ("#", "moved", "deletion", "insertion")
    grid = [header, *zip(moved, names, deletion, insertion, strict=True)]
    value = value_with_error(*means_and_errors(original[None])[0])
    title = (
        f"{curves.metric} = {value}, and its change with the first # parameters at their baselines (deletion)\n"
        "or with all others at theirs (insertion)"
    )
    return "\n".join([title, "", *table_lines(grid), "", *_areas(curves), curves.verdict])


def _steps(curves: DeletionInsertion) -> list[str]:
    """Return a description of the parameters that move before each point but the first."""
    ends = curves.moved.tolist()
    steps = [curves.labels[start:end] for start, end in itertools.pairwise(ends)]
    return [labels[0] if len(labels) == 1 else f"{labels[0]} + {len(labels) - 1} more" for labels in steps]


def _areas(curves: DeletionInsertion) -> list[str]:
    lines = []
    pairs = zip(("deletion", "insertion"), (curves.deletion_area, curves.insertion_area), strict=True)
    for (what, area), random in zip(pairs, curves.random_areas, strict=True):
        mean, spread = with_error(random.mean().item(), random.std().item())
        better = "larger" if what == "deletion" else "smaller"
        others = f"random orders {mean}, standard deviation {spread}"
        lines.append(f"mean change in {what} {value_with_error(*area)}; {others} ({better} is better)")
    return lines


def _draw(curves: DeletionInsertion, figure: Any) -> Figure:
    if figure is None:
        figure = new_figure(WIDTH, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    moved, original = curves.moved.numpy(), curves.deletion[0]
    panels = (
        ("Deletion", curves.deletion, moved, "at their baselines"),
        ("Insertion", curves.insertion, moved[-1] - moved, "at their own values"),
    )
    for ax, (title, curve, random_moved, where) in zip(axes, panels, strict=True):
        for index, random in enumerate((curves.random - original).mean(2)):
            label = None if index else "random orders"
            ax.plot(random_moved, random, color="0.8", linewidth=0.8, label=label)
        means, errors = zip(*means_and_errors(curve - original), strict=True)
        ax.errorbar(
            moved, means, errors, color=RAISES, marker="o", markersize=3, capsize=2, label=curves.method
        )
        ax.set_xlabel(f"parameters {where}", fontsize=TEXT)
        style_axes(ax, title)
    name = shorten([curves.metric], _NAME_WIDTH)[0]
    axes[0].set_ylabel(f"change of {name}\nfrom the original scene", fontsize=TEXT, parse_math=False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=SMALL, frameon=False)
    verdict = textwrap.fill(curves.verdict, _NOTE_WIDTH)
    figure.supxlabel(verdict, x=0.02, ha="left", fontsize=SMALL, alpha=0.75, parse_math=False)
    return figure_of(axes[0])
