"""The ablation test as a table and a figure: prediction against measurement."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from ._figures import LOWERS, RAISES, SMALL, TEXT, TITLE, UNCLEAR, WIDTH, figure_of, new_figure, small_print
from ._numbers import shorten, with_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import Ablated, AblationTest

_NAME_WIDTH, _NOTE_WIDTH = 36, 90
_OUTCOMES = {
    RAISES: "measured: as predicted",
    LOWERS: "measured: not as predicted",
    UNCLEAR: "measured: in the noise",
}


def ablation_text(test: AblationTest) -> str:
    """Write the table for a terminal, and the verdict below it."""
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
    head = ("moved along its gradient", "predicted", "measured", "step")
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
    lines = [
        f"{name:{widths[0]}}  {predicted:>{widths[1]}}  {measured:>{widths[2]}}  {step:>{widths[3]}}"
        for name, predicted, measured, step in (head, *cells)
    ]
    remarks = ["", *(_remark(row) for row in test.rows)]
    return "\n".join(
        [*(line + remark for line, remark in zip(lines, remarks, strict=True)), "", test.verdict]
    )


def plot_ablation(test: AblationTest, ax: Axes | None = None) -> Figure:
    """Draw for each parameter how much the metric was predicted to change per unit, and how much it did.

    Parameters are in the computed order. Grey reaches up to what the noise hides, with 95 % confidence. Crosses
    are what the paper's step measures, 0.01 of the gradient for every parameter.

    Parameters
    ----------
    test
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    """
    rows = test.rows
    if ax is None:
        ax = new_figure(WIDTH, 1.7 + 0.24 * len(rows)).add_subplot()
    ax.set_xscale("log")
    noise = [row.noise for row in rows]
    # A bar on a logarithmic axis begins where the axis does, so that this is fixed before.
    least = 0.5 * min(
        value
        for row in rows
        for value in (row.predicted, row.noise or row.predicted, abs(row.fixed or row.predicted))
    )
    ax.set_xlim(least, 2 * max(max(row.predicted, abs(row.measured), abs(row.fixed or 0)) for row in rows))
    places = range(len(rows))
    ax.barh(
        places, [max(one - least, 0) for one in noise], left=least, height=0.7, color="0.88", label="noise"
    )
    ax.scatter(
        [row.predicted for row in rows],
        places,
        marker="D",
        s=34,
        facecolors="none",
        edgecolors="black",
        label="predicted: the saliency",
        zorder=3,
    )
    fixed = [(place, row) for place, row in enumerate(rows) if row.fixed]
    ax.scatter(
        [abs(row.fixed or 0) for _, row in fixed],
        [place for place, _ in fixed],
        marker="x",
        s=26,
        linewidths=1,
        color="0.45",
        label="on a step of 0.01 of the gradient",
        zorder=2,
    )
    for colour, words in _OUTCOMES.items():
        _draw_measured(ax, [(k, row) for k, row in enumerate(rows) if _colour(row) == colour], colour, words)
    ax.set_yticks(places, shorten([row.label for row in rows], _NAME_WIDTH), fontsize=TEXT)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)
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
    above = 8 + 12 * -(-len(handles) // columns)
    ax.set_title("Ablation test", loc="left", fontsize=TITLE, pad=above)
    small_print(ax, textwrap.wrap(test.verdict, _NOTE_WIDTH), below=34)
    return figure_of(ax)


def _draw_measured(ax: Axes, placed: list[tuple[int, Ablated]], colour: str, words: str) -> None:
    if placed:
        ax.errorbar(
            [abs(row.measured) for _, row in placed],
            [place for place, _ in placed],
            xerr=[row.measured_error for _, row in placed],
            fmt="o",
            markersize=4,
            color=colour,
            elinewidth=1.2,
            capsize=3,
            label=words,
            zorder=4,
        )


def _colour(row: Ablated) -> str:
    if not row.above_noise:
        return UNCLEAR
    return RAISES if row.agrees else LOWERS


def _pair(value: float, error: float) -> str:
    return " ± ".join(filter(None, with_error(value, error)))


def _remark(row: Ablated) -> str:
    if not row.above_noise:
        return "  in the noise"
    return "" if row.agrees else "  not as predicted"
