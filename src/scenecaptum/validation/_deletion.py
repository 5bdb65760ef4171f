"""Deletion and insertion curves: set parameters to their baselines, or restore them, in order of importance."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import Baselines, SceneAttribution
from ..checkpoint import Folder, with_checkpoint
from ..errors import whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Stream, Target, mean_and_error, random_generator
from ..protocols import Renderer
from ..visualization import (
    RAISES,
    SMALL,
    WIDTH,
    align_decimals,
    figure_of,
    format_with_error,
    grid,
    metric_name,
    new_figure,
    shorten,
    style_axes,
    with_error,
    wrap,
)
from ._faithfulness import contributions, measure_without
from ._scenes import Scenes

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_NAME_WIDTH, _NOTE_WIDTH = 36, 110


def deletion_insertion(  # noqa: PLR0913 -- the options of every check, and three of its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    baselines: Baselines = None,
    steps: int = 12,
    random_orders: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> DeletionInsertion:
    """Compute deletion and insertion curves of a ranking and compare them with random orders.

    Deletion starts from the original scene and sets parameters to their baselines; insertion starts with all
    parameters at their baselines and restores them. Both begin with the most important parameter. All scenes are
    rendered with common random numbers.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=16)
    >>> curves = deletion_insertion(renderer, metrics.MeanLuminance(), random_orders=2, steps=4)
    >>> curves.deletion.shape  # 5 points in 8 replicates
    torch.Size([5, 8])

    Parameters
    ----------
    renderer, metric, target
        As for ``IntegratedGradientsScene``.
    attribution
        Contributions relative to the same baselines, ranked by magnitude; integrated gradients by default.
    baselines
        The values of deleted parameters, as for ``IntegratedGradientsScene``. Parameters that are already at their
        baselines are skipped.
    steps
        Maximum number of steps, each with about the same number of parameters.
    random_orders
        Number of random orders to compare with, at least 2.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``.

    Returns
    -------
    DeletionInsertion
        Both curves and those of the random orders, in the unit of the metric.

    Raises
    ------
    SceneCaptumError
        If the attribution is one of gradients or of groups, or fewer than two parameters differ from their
        baselines.

    References
    ----------
    Petsiuk, Das and Saenko, "RISE: Randomized Input Sampling for Explanation of Black-box Models", BMVC 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    scenes = Scenes(renderer, metric, target, **options)
    attribution, deleted = contributions(scenes, metric, attribution, target, baselines, 2, **options)
    names = list(deleted)
    moved = np.linspace(0, len(names), min(whole_number("steps", steps), len(names)) + 1).round().astype(int)
    generator = random_generator(seed, Stream.DELETION_ORDERS)
    orders = whole_number("random_orders", random_orders, 2)
    known = {frozenset[str](): scenes.unmodified}

    def without(subset: Sequence[str]) -> torch.Tensor:
        key = frozenset(subset)
        if key not in known:
            known[key] = measure_without(scenes, deleted, subset)
        return known[key]

    def deletion(order: Sequence[str]) -> torch.Tensor:
        return torch.stack([without(order[:count]) for count in moved])

    return DeletionInsertion(
        names=tuple(names),
        labels=tuple(attribution.labels.get(name, name) for name in names),
        moved=torch.from_numpy(moved),
        deletion=deletion(names),
        insertion=torch.stack([without(names[count:]) for count in moved]),
        random=torch.stack([deletion(generator.permutation(names).tolist()) for _ in range(orders)]),
        metric=metric_name(attribution),
        method=str(attribution.info["method"]),
    )


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

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot deletion and insertion side by side, over the number of moved parameters, into ``figure`` if given.

        Grey lines are random orders; error bars are standard errors of the change.
        """
        part: Any = figure or new_figure(WIDTH, 3.6)
        left, right = part.subplots(1, 2, sharey=True)
        name = shorten([self.metric], _NAME_WIDTH)[0]
        y = f"change of {name}\nfrom the original scene"
        style_axes(left, "Deletion", x="parameters at their baselines", y=y)
        style_axes(right, "Insertion", x="parameters at their own values")
        moved = self.moved.numpy()
        style: dict[str, Any] = {"marker": "o", "markersize": 3, "capsize": 2, "label": self.method}
        panels = ((left, self.deletion, moved), (right, self.insertion, moved[-1] - moved))
        for ax, curve, random_moved in panels:
            for index, random in enumerate((self.random - self.deletion[0]).mean(2)):
                label = None if index else "random orders"
                ax.plot(random_moved, random, color="0.8", linewidth=0.8, label=label)
            means, errors = zip(*self._changes(curve), strict=True)
            ax.errorbar(moved, means, errors, color=RAISES, **style)
        handles, labels = left.get_legend_handles_labels()
        part.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=SMALL, frameon=False)
        verdict = wrap(self.verdict, _NOTE_WIDTH, indent=0)
        part.supxlabel(verdict, x=0.02, ha="left", fontsize=SMALL, alpha=0.75, parse_math=False)
        return figure_of(part)

    def __str__(self) -> str:
        moved = [str(count) for count in self.moved.tolist()]
        steps = (self.labels[start:end] for start, end in itertools.pairwise(self.moved.tolist()))
        more = (f"{first} + {len(others)} more" if others else first for first, *others in steps)
        names = shorten(["", *more], _NAME_WIDTH)
        deletion, insertion = (
            align_decimals([format_with_error(*point) for point in self._changes(curve)])
            for curve in (self.deletion, self.insertion)
        )
        rows = list(zip(moved, names, deletion, insertion, strict=True))
        value = format_with_error(*mean_and_error(self.deletion[0]))
        title = (
            f"{self.metric} = {value}, and its change with the first # parameters at their baselines (deletion)\n"
            "or with all others at theirs (insertion)"
        )
        lines = grid(("#", "moved", "deletion", "insertion"), rows)
        return "\n".join([title, "", *lines, "", *_areas(self), self.verdict])

    __repr__ = __str__

    def _changes(self, curve: torch.Tensor) -> list[tuple[float, float]]:
        """Return the change from the original scene at each point of a curve, and its standard error."""
        return [mean_and_error(change) for change in curve - self.deletion[0]]


def _areas(curves: DeletionInsertion) -> list[str]:
    lines = []
    pairs = zip(("deletion", "insertion"), (curves.deletion_area, curves.insertion_area), strict=True)
    for (what, area), random in zip(pairs, curves.random_areas, strict=True):
        mean, spread = with_error(random.mean().item(), random.std().item())
        better = "larger" if what == "deletion" else "smaller"
        others = f"random orders {mean}, standard deviation {spread}"
        lines.append(f"mean change in {what} {format_with_error(*area)}; {others} ({better} is better)")
    return lines
