"""Tables and figures of deletion and insertion curves, infidelity and sensitivity-n."""

from __future__ import annotations

import itertools
import math
import textwrap
from typing import TYPE_CHECKING, Any

import torch

from ._figures import RAISES, SMALL, TEXT, TITLE, UNCLEAR, WIDTH, add_footnotes, figure_of, new_figure
from ._numbers import align_decimals, pad, shorten, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import DeletionInsertion, Infidelity, SensitivityN

_NAME_WIDTH, _NOTE_WIDTH = 36, 110


def deletion_text(curves: DeletionInsertion) -> str:
    """Format both curves, their areas and the verdict for a terminal."""
    names = shorten(["", *_steps(curves)], _NAME_WIDTH)
    moved = [str(count) for count in curves.moved.tolist()]
    original = curves.deletion[0]
    deletion, insertion = (
        align_decimals([_pair(*point) for point in means_and_errors(curve - original)])
        for curve in (curves.deletion, curves.insertion)
    )
    header = ("#", "moved", "deletion", "insertion")
    grid = [header, *zip(moved, names, deletion, insertion, strict=True)]
    value = _pair(*means_and_errors(original[None])[0])
    title = (
        f"{curves.metric} = {value}, and its change with the first # parameters at their baselines (deletion)\n"
        "or with all others at theirs (insertion)"
    )
    return "\n".join([title, "", *_format_columns(grid), "", *_areas(curves), curves.verdict])


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
        lines.append(f"mean change in {what} {_pair(*area)}; {others} ({better} is better)")
    return lines


def plot_deletion(curves: DeletionInsertion, figure: Any = None) -> Figure:
    """Plot deletion and insertion side by side, over the number of moved parameters.

    Grey lines are random orders; error bars are standard errors of the change.

    Parameters
    ----------
    curves
        The result to plot.
    figure
        A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.
    """
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
        _style(ax, title)
    name = shorten([curves.metric], _NAME_WIDTH)[0]
    axes[0].set_ylabel(f"change of {name}\nfrom the original scene", fontsize=TEXT, parse_math=False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=SMALL, frameon=False)
    verdict = textwrap.fill(curves.verdict, _NOTE_WIDTH)
    figure.supxlabel(verdict, x=0.02, ha="left", fontsize=SMALL, alpha=0.75, parse_math=False)
    return figure_of(axes[0])


def infidelity_text(found: Infidelity) -> str:
    """Format the infidelity for a terminal."""
    count, replicates = found.measured.shape
    root_mean_square = found.predicted.square().mean().sqrt().item()
    grid = [
        (f"infidelity of {found.method}", _pair(found.value, found.standard_error)),
        ("relative to the mean square change", _pair(found.normalized, found.normalized_error)),
        ("root mean square of the predicted changes", f"{root_mean_square:.4g}"),
    ]
    header = f"{found.metric} under {count} perturbations, each in {replicates} replicates"
    return "\n".join([header, "", *_format_columns(grid)])


def plot_infidelity(found: Infidelity, ax: Axes | None = None) -> Figure:
    """Plot the measured against the predicted change of every perturbation, with the identity line.

    Parameters
    ----------
    found
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(4.2, 4.2).add_subplot()
    means, errors = zip(*means_and_errors(found.measured), strict=True)
    predicted = found.predicted.tolist()
    ax.axline((0, 0), slope=1, color="0.75", linewidth=1, zorder=0)
    ax.errorbar(predicted, means, errors, fmt="o", markersize=3, color=RAISES, elinewidth=0.8, alpha=0.8)
    ax.set_xlabel("predicted change: perturbation × attribution", fontsize=TEXT)
    metric = shorten([found.metric], _NAME_WIDTH)[0]
    ax.set_ylabel(f"measured change of {metric}", fontsize=TEXT, parse_math=False)
    _style(ax, f"Infidelity {_pair(found.value, found.standard_error)}")
    relative = _pair(100 * found.normalized, 100 * found.normalized_error)
    note = f"relative to the mean square change: {relative} %"
    add_footnotes(ax, [note], below=34)
    return figure_of(ax)


def sensitivity_n_text(found: SensitivityN) -> str:
    """Format the correlations for a terminal."""
    rows = zip(found.sizes, found.predicted, found.correlations, found.standard_errors, strict=True)
    grid = [
        ("n", "subsets", "correlation"),
        *((str(size), str(len(sums)), _correlation(*pair)) for size, sums, *pair in rows),
    ]
    header = f"sensitivity-n of {found.method} for {found.metric}"
    return "\n".join([header, "", *_format_columns(grid)])


def plot_sensitivity_n(found: SensitivityN, ax: Axes | None = None) -> Figure:
    """Plot the correlation over the number of parameters deleted together.

    Parameters
    ----------
    found
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(4.6, 3.3).add_subplot()
    ax.axhline(1, color="0.75", linewidth=1, zorder=0)
    ax.axhline(0, color="0.75", linewidth=1, zorder=0)
    ax.errorbar(
        found.sizes,
        found.correlations,
        found.standard_errors,
        marker="o",
        markersize=4,
        capsize=3,
        color=RAISES,
        ecolor=UNCLEAR,
    )
    lowest = min((value for value in found.correlations if not math.isnan(value)), default=0.0)
    ax.set_ylim(-1.05 if lowest < 0 else -0.05, 1.08)
    ax.set_xticks(found.sizes)
    ax.set_xlabel("parameters deleted together", fontsize=TEXT)
    ax.set_ylabel("Pearson correlation of\nsums and changes", fontsize=TEXT)
    _style(ax, "Sensitivity-n")
    note = f"{found.method} for {found.metric}"
    add_footnotes(ax, textwrap.wrap(note, 60), below=34)
    return figure_of(ax)


def _style(ax: Axes, title: str) -> None:
    ax.set_title(title, loc="left", fontsize=TITLE)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)


def means_and_errors(curve: torch.Tensor) -> list[tuple[float, float]]:
    """Return the means and standard errors of ``(points, replicates)``."""
    errors = curve.std(1) / math.sqrt(curve.shape[1])
    return list(zip(curve.mean(1).tolist(), errors.tolist(), strict=True))


def _pair(value: float, error: float) -> str:
    return " ± ".join(filter(None, with_error(value, error or None)))


def _correlation(value: float, error: float) -> str:
    return "-" if math.isnan(value) else _pair(value, error)


def _format_columns(grid: Any) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    return ["  ".join(map(pad, row, widths)).rstrip() for row in grid]
