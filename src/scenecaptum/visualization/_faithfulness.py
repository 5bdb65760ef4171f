"""Deletion and insertion curves, infidelity and sensitivity-n as tables and figures."""

from __future__ import annotations

import itertools
import math
import textwrap
from typing import TYPE_CHECKING, Any

import torch

from ._figures import RAISES, SMALL, TEXT, TITLE, UNCLEAR, WIDTH, figure_of, new_figure, small_print
from ._numbers import align_decimals, pad, shorten, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import DeletionInsertion, Infidelity, SensitivityN

_NAME_WIDTH, _NOTE_WIDTH = 36, 110


def deletion_text(curves: DeletionInsertion) -> str:
    """Write both curves for a terminal, and the areas and the verdict below them."""
    names = shorten(["", *_steps(curves)], _NAME_WIDTH)
    moved = [str(count) for count in curves.moved.tolist()]
    whole = curves.deletion[0]
    deletion, insertion = (
        align_decimals([_pair(*one) for one in points(curve - whole)])
        for curve in (curves.deletion, curves.insertion)
    )
    head = ("#", "moved", "deletion", "insertion")
    grid = [head, *zip(moved, names, deletion, insertion, strict=True)]
    value = _pair(*points(whole[None])[0])
    title = (
        f"{curves.metric} = {value}, and its change with parameters moved to their baselines (deletion)\n"
        "or from them (insertion)"
    )
    return "\n".join([title, "", *_columns(grid), "", *_areas(curves), curves.verdict])


def _steps(curves: DeletionInsertion) -> list[str]:
    """Name what moves before each point but the first."""
    ends = curves.moved.tolist()
    steps = [curves.labels[start:end] for start, end in itertools.pairwise(ends)]
    return [one[0] if len(one) == 1 else f"{one[0]} + {len(one) - 1} more" for one in steps]


def _areas(curves: DeletionInsertion) -> list[str]:
    lines = []
    pairs = zip(("deletion", "insertion"), (curves.deletion_area, curves.insertion_area), strict=True)
    for (what, area), random in zip(pairs, curves.random_areas, strict=True):
        mean, spread = with_error(random.mean().item(), random.std().item())
        better = "larger" if what == "deletion" else "smaller"
        others = f"of random orders {mean}, spread {spread}"
        lines.append(f"mean change in {what} {_pair(*area)}; {others} ({better} is better)")
    return lines


def plot_deletion(curves: DeletionInsertion, figure: Any = None) -> Figure:
    """Draw deletion and insertion side by side, over the number of parameters that have moved.

    Grey lines are random orders; bars are standard errors of the change.

    Parameters
    ----------
    curves
        What to draw.
    figure
        A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.
    """
    if figure is None:
        figure = new_figure(WIDTH, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    moved, whole = curves.moved.numpy(), curves.deletion[0]
    panels = (
        ("Deletion", curves.deletion, moved, "at their baselines"),
        ("Insertion", curves.insertion, moved[-1] - moved, "at their own values"),
    )
    for ax, (title, curve, places, where) in zip(axes, panels, strict=True):
        for number, one in enumerate((curves.random - whole).mean(2)):
            ax.plot(places, one, color="0.8", linewidth=0.8, label=None if number else "random orders")
        means, errors = zip(*points(curve - whole), strict=True)
        ax.errorbar(
            moved, means, errors, color=RAISES, marker="o", markersize=3, capsize=2, label=curves.method
        )
        ax.set_xlabel(f"parameters {where}", fontsize=TEXT)
        _tidy(ax, title)
    name = shorten([curves.metric], _NAME_WIDTH)[0]
    axes[0].set_ylabel(f"change of {name}\nfrom the whole scene", fontsize=TEXT, parse_math=False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=SMALL, frameon=False)
    verdict = textwrap.fill(curves.verdict, _NOTE_WIDTH)
    figure.supxlabel(verdict, x=0.02, ha="left", fontsize=SMALL, alpha=0.75, parse_math=False)
    return figure_of(axes[0])


def infidelity_text(found: Infidelity) -> str:
    """Write the infidelity for a terminal."""
    count, passes = found.measured.shape
    mean_square = found.predicted.square().mean().sqrt().item()
    grid = [
        (f"infidelity of {found.method}", _pair(found.value, found.standard_error)),
        ("its part of the mean square change", _pair(found.missed, found.missed_error)),
        ("root mean square of the predicted changes", f"{mean_square:.4g}"),
    ]
    head = f"{found.metric} under {count} perturbations, each in {passes} replicates"
    return "\n".join([head, "", *_columns(grid)])


def plot_infidelity(found: Infidelity, ax: Axes | None = None) -> Figure:
    """Draw the measured change over the predicted one, a dot for every perturbation, and where both agree.

    Parameters
    ----------
    found
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(4.2, 4.2).add_subplot()
    means, errors = zip(*points(found.measured), strict=True)
    predicted = found.predicted.tolist()
    ax.axline((0, 0), slope=1, color="0.75", linewidth=1, zorder=0)
    ax.errorbar(predicted, means, errors, fmt="o", markersize=3, color=RAISES, elinewidth=0.8, alpha=0.8)
    ax.set_xlabel("change predicted: perturbation × attribution", fontsize=TEXT)
    metric = shorten([found.metric], _NAME_WIDTH)[0]
    ax.set_ylabel(f"change of {metric} measured", fontsize=TEXT, parse_math=False)
    _tidy(ax, f"Infidelity {_pair(found.value, found.standard_error)}")
    note = f"{_pair(100 * found.missed, 100 * found.missed_error)} % of the mean square change are missed"
    small_print(ax, [note], below=34)
    return figure_of(ax)


def sensitivity_n_text(found: SensitivityN) -> str:
    """Write the correlations for a terminal."""
    rows = zip(found.sizes, found.predicted, found.correlations, found.standard_errors, strict=True)
    grid = [
        ("n", "subsets", "correlation"),
        *((str(size), str(len(sums)), _correlation(*pair)) for size, sums, *pair in rows),
    ]
    head = f"sensitivity-n of {found.method} for {found.metric}"
    return "\n".join([head, "", *_columns(grid)])


def plot_sensitivity_n(found: SensitivityN, ax: Axes | None = None) -> Figure:
    """Draw the correlation over how many parameters are taken away together.

    Parameters
    ----------
    found
        What to draw.
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
    least = min((one for one in found.correlations if not math.isnan(one)), default=0.0)
    ax.set_ylim(-1.05 if least < 0 else -0.05, 1.08)
    ax.set_xticks(found.sizes)
    ax.set_xlabel("parameters taken away together", fontsize=TEXT)
    ax.set_ylabel("Pearson's correlation of\nsums and changes", fontsize=TEXT)
    _tidy(ax, "Sensitivity-n")
    note = f"{found.method} for {found.metric}"
    small_print(ax, textwrap.wrap(note, 60), below=34)
    return figure_of(ax)


def _tidy(ax: Axes, title: str) -> None:
    ax.set_title(title, loc="left", fontsize=TITLE)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)


def points(curve: torch.Tensor) -> list[tuple[float, float]]:
    """Return means and standard errors of ``(points, replicates)``."""
    errors = curve.std(1) / math.sqrt(curve.shape[1])
    return list(zip(curve.mean(1).tolist(), errors.tolist(), strict=True))


def _pair(value: float, error: float) -> str:
    return " ± ".join(filter(None, with_error(value, error or None)))


def _correlation(value: float, error: float) -> str:
    return "-" if math.isnan(value) else _pair(value, error)


def _columns(grid: Any) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    return ["  ".join(map(pad, row, widths)).rstrip() for row in grid]
