"""Deletion and insertion curves: set parameters to their baselines, or restore them, in order of importance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..attr import Baselines, SceneAttribution
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import (
    DEFAULT_REPLICATES,
    Metric,
    Stream,
    Target,
    mean_and_error,
    random_generator,
    student_t,
)
from ..protocols import Renderer
from ..visualization import (
    LOWERS,
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
    wrapped_lines,
)
from ._faithfulness import contributions, measure_without
from ._orders import OrderCurves, Orders, area, importances, order_curves

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_NAME_WIDTH, _NOTE_WIDTH, _LEGEND_COLUMNS = 36, 110, 2
# Okabe and Ito's colours; with a marker each, since curves meet.
_COLORS = (RAISES, LOWERS, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_MARKERS = ("o", "s", "^", "D", "v", "P")


def deletion_insertion(  # noqa: PLR0913 -- the options of every check, and three of its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    baselines: Baselines = None,
    orders: Orders | None = None,
    steps: int = 12,
    random_orders: int = 10,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> DeletionInsertion:
    """Compute deletion and insertion curves of a ranking, and compare them with random and with other orders.

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
        Contributions relative to the same baselines, ranked by magnitude; integrated gradients by default. The
        scenes have the values for which they were made.
    baselines
        The values of deleted parameters, as for ``IntegratedGradientsScene``. Parameters that are already at their
        baselines are skipped.
    orders
        Other orders to compare with, by name: another attribution, or the importance of parameters or objects, as
        from ``projection.project_pixels``. Magnitudes count, and what has no number comes last. Parameters of
        equal importance move together, and the curves are linear in between.
    steps
        Maximum number of steps, each with about the same number of parameters.
    random_orders
        Number of random orders to compare with, at least 2.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``.

    Returns
    -------
    DeletionInsertion
        Both curves and those of the other orders, in the unit of the metric.

    Raises
    ------
    SceneCaptumError
        If the attribution is one of gradients or of groups, was made for other baselines or another texture than
        that of the renderer, an order contains an unknown name, or fewer than two parameters differ from their
        baselines.

    References
    ----------
    Petsiuk, Das and Saenko, "RISE: Randomized Input Sampling for Explanation of Black-box Models", BMVC 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    attribution, scenes, deleted = contributions(
        renderer, metric, attribution, target, baselines, 2, **options
    )
    names = list(deleted)
    others = {name: importances(name, given, names, renderer) for name, given in (orders or {}).items()}
    moved = np.linspace(0, len(names), min(whole_number("steps", steps), len(names)) + 1).round().astype(int)
    generator = random_generator(seed, Stream.DELETION_ORDERS)
    random_count = whole_number("random_orders", random_orders, 2)
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
        random=torch.stack([deletion(generator.permutation(names).tolist()) for _ in range(random_count)]),
        metric=metric_name(attribution),
        method=str(attribution.info["method"]),
        others={
            name: order_curves(values, torch.from_numpy(moved), without) for name, values in others.items()
        },
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
    others
        The curves of the other orders, by name.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    moved: torch.Tensor
    deletion: torch.Tensor
    insertion: torch.Tensor
    random: torch.Tensor
    metric: str
    method: str
    others: Mapping[str, OrderCurves] = field(default_factory=dict)

    @cached_property
    def _own(self) -> OrderCurves:
        return OrderCurves(self.names, self.moved, self.deletion, self.insertion)

    @property
    def deletion_area(self) -> tuple[float, float]:
        """Mean change of the metric from the original scene over the deletion curve, and its standard error.

        Larger is better: the first parameters change the metric most. If the metric falls, this is its original
        value minus the usual area under the curve; a rise counts in the same way.
        """
        return self._own.deletion_area

    @property
    def insertion_area(self) -> tuple[float, float]:
        """Mean difference of the metric from the original scene over the insertion curve, and its standard error.

        Smaller is better: the first parameters restore most of the metric.
        """
        return self._own.insertion_area

    @cached_property
    def random_areas(self) -> torch.Tensor:
        """``(2, orders)``: the deletion and insertion areas of the random orders."""
        original, remaining = self.deletion[0], self.moved[-1] - self.moved.flip(0)
        deletions = [area(curve, original, self.moved).mean() for curve in self.random]
        insertions = [area(curve.flip(0), original, remaining).mean() for curve in self.random]
        return torch.stack([torch.stack(deletions), torch.stack(insertions)])

    def lead(self, name: str) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return how much better the ranking is than another order, by deletion and by insertion.

        Each is a difference of areas, positive if the ranking is better, and its standard error. Both orders are
        rendered with the same seeds, so that the difference has less noise than the areas. The error does not
        include the noise of the attributions that made the orders.

        Parameters
        ----------
        name
            One of ``others``.

        Raises
        ------
        SceneCaptumError
            If there is no order of this name.
        """
        if name not in self.others:
            raise SceneCaptumError(
                f"{name!r} is not one of the orders {list(self.others)}.{near_misses(name, self.others)}"
            )
        deletion, insertion = self._own.areas - self.others[name].areas
        return mean_and_error(deletion), mean_and_error(-insertion)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        deletions, insertions = self.random_areas
        by_deletion = int((self.deletion_area[0] > deletions).sum())
        by_insertion = int((self.insertion_area[0] < insertions).sum())
        critical = student_t(0.95, self.deletion.shape[1] - 1)
        comparisons = []
        for name in self.others:
            deletion, insertion = (_compared(*lead, critical) for lead in self.lead(name))
            by = "both" if deletion == insertion else f"deletion and {insertion} by insertion"
            comparisons.append(f"; compared with {name}, it is {deletion} by {by}")
        return (
            f"the order of {self.method} beats {by_deletion} of {len(deletions)} random orders by deletion and "
            f"{by_insertion} by insertion{''.join(comparisons)}"
        )

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure:
        """Plot deletion and insertion side by side, over the number of moved parameters, into ``figure`` if given.

        The grey band is the range of the random orders, and the line in it their mean; error bars are standard
        errors of the change.
        """
        rows = math.ceil((2 + len(self.others)) / _LEGEND_COLUMNS)
        part: Any = figure or new_figure(WIDTH, 3.6 + 0.16 * rows)
        left, right = part.subplots(1, 2, sharey=True)
        name = shorten([self.metric], _NAME_WIDTH)[0]
        y = f"change of {name}\nfrom the original scene"
        style_axes(left, "Deletion", x="parameters at their baselines", y=y)
        style_axes(right, "Insertion", x="parameters at their own values")
        moved = self.moved.numpy()
        random = (self.random - self.deletion[0]).mean(2)
        for ax, random_moved in ((left, moved), (right, moved[-1] - moved)):
            ax.axhline(0, color="0.75", linewidth=0.8, zorder=0)
            ax.locator_params(axis="x", integer=True)
            low, high = random.amin(0), random.amax(0)
            ax.fill_between(random_moved, low, high, color="0.88", linewidth=0, label="random orders")
            ax.plot(random_moved, random.mean(0), color="0.6", linewidth=0.8)
        styles = itertools.cycle(zip(_COLORS, _MARKERS, strict=True))
        # The ranking on top, but first in the legend.
        for order, (label, curves) in enumerate({self.method: self._own, **self.others}.items()):
            color, marker = next(styles)
            style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 3.5, "capsize": 2}
            for ax, curve in ((left, curves.deletion), (right, curves.insertion)):
                means, errors = zip(*self._changes(curve), strict=True)
                ax.errorbar(
                    moved, means, errors, label=label, zorder=9 - min(order, 5), linewidth=1.3, **style
                )
        handles, labels = left.get_legend_handles_labels()
        legend = {"ncols": _LEGEND_COLUMNS, "fontsize": SMALL, "frameon": False}
        # Band and curves: matplotlib lists error bars after all others.
        handles, labels = [*handles[1:], handles[0]], shorten([*labels[1:], labels[0]], _NAME_WIDTH)
        part.legend(handles, labels, loc="outside upper right", **legend)
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
        verdict = wrapped_lines(self.verdict, _NOTE_WIDTH)
        return "\n".join([title, "", *lines, "", *self._table_of_areas(), "", *verdict])

    __repr__ = __str__

    def _changes(self, curve: torch.Tensor) -> list[tuple[float, float]]:
        """Return the change from the original scene at each point of a curve, and its standard error."""
        return [mean_and_error(change) for change in curve - self.deletion[0]]

    def _table_of_areas(self) -> list[str]:
        rows = [["mean size of the change", *_formatted(self._own)]]
        for name, curves in self.others.items():
            rows.append([f"of {name}", *_formatted(curves)])
            rows.append(["  lead over it", *(format_with_error(*lead) for lead in self.lead(name))])
        means, spreads = self.random_areas.mean(1).tolist(), self.random_areas.std(1).tolist()
        texts = (
            "{}, standard deviation {}".format(*with_error(*pair))
            for pair in zip(means, spreads, strict=True)
        )
        rows.append(["of random orders", *texts])
        return grid(("", "deletion (larger is better)", "insertion (smaller is better)"), rows)


def _formatted(curves: OrderCurves) -> list[str]:
    return [format_with_error(*curves.deletion_area), format_with_error(*curves.insertion_area)]


def _compared(lead: float, error: float, critical: float) -> str:
    """Return whether a lead is significant, and for whom."""
    if abs(lead) <= critical * error:
        return "equal within the errors"
    return "better" if lead > 0 else "worse"
