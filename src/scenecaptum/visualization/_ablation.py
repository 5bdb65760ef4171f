"""Table and figure of the ablation test: predictions and measurements."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from ._figures import LOWERS, RAISES, SMALL, TEXT, TITLE, UNCLEAR, WIDTH, add_footnotes, figure_of, new_figure
from ._numbers import shorten, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import Ablated, AblationTest

_NAME_WIDTH, _NOTE_WIDTH = 36, 90
_OUTCOMES = {
    RAISES: "measured: as predicted",
    LOWERS: "measured: not as predicted",
    UNCLEAR: "measured: below the noise",
}


def ablation_text(test: AblationTest) -> str:
    """Format the table and the verdict for a terminal."""
    names = shorten([row.label for row in test.rows], _NAME_WIDTH)
    cells = [
        (
            name,
            _pair(row.predicted, row.predicted_error),
            _pair(row.measured, row.measured_error),
            f"{row.step:.2g}",
        )
        for name, row in zip(names, test.rows, strict=True)
    ]
    header = ("moved along its gradient", "predicted", "measured", "step")
    widths = [max(map(len, column)) for column in zip(header, *cells, strict=True)]
    lines = [
        f"{name:{widths[0]}}  {predicted:>{widths[1]}}  {measured:>{widths[2]}}  {step:>{widths[3]}}"
        for name, predicted, measured, step in (header, *cells)
    ]
    remarks = ["", *(_remark(row) for row in test.rows)]
    return "\n".join(
        [*(line + remark for line, remark in zip(lines, remarks, strict=True)), "", test.verdict]
    )


def plot_ablation(test: AblationTest, ax: Axes | None = None) -> Figure:
    """Plot the predicted and the measured slope of the metric for each parameter.

    Parameters are in order of decreasing saliency. Grey bars show the half-width of the 95 % confidence interval
    of the measurement; crosses show the slope measured with the step of the paper, 0.01 of each gradient.

    Parameters
    ----------
    test
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    """
    rows = test.rows
    if ax is None:
        ax = new_figure(WIDTH, 1.7 + 0.24 * len(rows)).add_subplot()
    ax.set_xscale("log")
    noise = [row.noise for row in rows]
    # Bars on a logarithmic axis start at its lower limit, so the limit is set first.
    lower = 0.5 * min(
        value
        for row in rows
        for value in (row.predicted, row.noise or row.predicted, abs(row.fixed or row.predicted))
    )
    ax.set_xlim(lower, 2 * max(max(row.predicted, abs(row.measured), abs(row.fixed or 0)) for row in rows))
    positions = range(len(rows))
    lengths = [max(value - lower, 0) for value in noise]
    ax.barh(positions, lengths, left=lower, height=0.7, color="0.88", label="noise")
    ax.scatter(
        [row.predicted for row in rows],
        positions,
        marker="D",
        s=34,
        facecolors="none",
        edgecolors="black",
        label="predicted: the saliency",
        zorder=3,
    )
    fixed = [(y, row) for y, row in enumerate(rows) if row.fixed]
    ax.scatter(
        [abs(row.fixed or 0) for _, row in fixed],
        [y for y, _ in fixed],
        marker="x",
        s=26,
        linewidths=1,
        color="0.45",
        label="measured with a step of 0.01 of the gradient",
        zorder=2,
    )
    for color, label in _OUTCOMES.items():
        _draw_measured(ax, [(y, row) for y, row in enumerate(rows) if _color(row) == color], color, label)
    ax.set_yticks(positions, shorten([row.label for row in rows], _NAME_WIDTH), fontsize=TEXT)
    for tick_label in ax.get_yticklabels():
        tick_label.set_parse_math(False)
    ax.invert_yaxis()
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=SMALL)
    ax.set_xlabel(
        f"change of {test.metric} per unit of a step along the gradient", fontsize=TEXT, parse_math=False
    )
    handles = ax.get_legend_handles_labels()[0]
    columns = 2
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=columns,
        fontsize=SMALL,
        frameon=False,
        borderaxespad=0.2,
    )
    padding = 8 + 12 * -(-len(handles) // columns)
    ax.set_title("Ablation test", loc="left", fontsize=TITLE, pad=padding)
    add_footnotes(ax, textwrap.wrap(test.verdict, _NOTE_WIDTH), below=34)
    return figure_of(ax)


def _draw_measured(ax: Axes, rows: list[tuple[int, Ablated]], color: str, label: str) -> None:
    if rows:
        ax.errorbar(
            [abs(row.measured) for _, row in rows],
            [y for y, _ in rows],
            xerr=[row.measured_error for _, row in rows],
            fmt="o",
            markersize=4,
            color=color,
            elinewidth=1.2,
            capsize=3,
            label=label,
            zorder=4,
        )


def _color(row: Ablated) -> str:
    if not row.above_noise:
        return UNCLEAR
    return RAISES if row.agrees else LOWERS


def _pair(value: float, error: float) -> str:
    return " ± ".join(filter(None, with_error(value, error)))


def _remark(row: Ablated) -> str:
    if not row.above_noise:
        return "  below the noise"
    return "" if row.agrees else "  not as predicted"
