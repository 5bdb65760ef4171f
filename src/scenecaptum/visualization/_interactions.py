"""Table and heatmap of the interactions of parameters."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

from ._figures import SMALL, TEXT, TITLE, add_footnotes, figure_of, new_figure
from ._numbers import Format, shorten

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import Interactions

_NAME_WIDTH, _COLUMN_WIDTH, _NOTE_WIDTH = 28, 16, 90
_CELL = 0.72  # inches
_WHITE_TEXT_ABOVE = 0.6  # of the largest value


def interactions_text(found: Interactions) -> str:
    """Format the upper triangle of the matrix and the verdict for a terminal."""
    names = shorten(found.labels, _NAME_WIDTH)
    cells = _cells(found)
    numbers = [str(number) for number in range(1, len(names) + 1)]
    rows = [[f"{number} {name}", *row] for number, name, row in zip(numbers, names, cells, strict=True)]
    grid = [["", *numbers], *rows]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = [
        "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip() for line in grid
    ]
    head = [f"second derivatives of {found.metric} {_unit(found)}", ""]
    return "\n".join([*head, *lines, "", _KEY, found.verdict])


_KEY = "0.0123(4) is 0.0123 ± 0.0004; ? marks values that are not significantly different from 0"


def plot_interactions(found: Interactions, ax: Axes | None = None) -> Figure:
    """Plot the matrix: red where parameters strengthen each other's effect, blue where they weaken it.

    Each cell shows its value with the error of the last digits in brackets; grey cells do not differ significantly
    from 0.

    Parameters
    ----------
    found
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    """
    count = len(found.names)
    names = shorten(found.labels, _NAME_WIDTH)
    if ax is None:
        ax = new_figure(2.6 + _CELL * max(count, 4), 1.7 + 0.55 * _CELL * max(count, 3)).add_subplot()
    matrix, significant = found.matrix, found.significant
    largest = matrix.abs().max().item() or 1.0
    # Masked elements show the grey background.
    masked = matrix.masked_fill(~significant, math.nan)
    ax.set_facecolor("0.92")
    shown = ax.imshow(masked.numpy(), cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
    for (row, column), text in _formatted(found).items():
        strong = significant[row, column] and matrix[row, column].abs() > _WHITE_TEXT_ABOVE * largest
        color = "white" if strong else "black" if significant[row, column] else "0.45"
        ax.text(column, row, text, ha="center", va="center", fontsize=SMALL, color=color)
    # Columns have numbers only: names would have to be vertical.
    ax.set_yticks(range(count), [f"{name}  {k}" for k, name in enumerate(names, 1)], fontsize=TEXT)
    ax.set_xticks(range(count), [str(k) for k in range(1, count + 1)], fontsize=TEXT)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    bar = figure_of(ax).colorbar(shown, ax=ax, aspect=18, pad=0.03)
    bar.ax.tick_params(labelsize=SMALL)
    bar.outline.set_visible(False)
    title = textwrap.wrap(
        f"Interactions: second derivatives of {found.metric} {_unit(found)}", 16 + 9 * count
    )
    ax.set_title("\n".join(title), loc="left", fontsize=TITLE, parse_math=False)
    width = int((2.6 + _CELL * max(count, 4)) * _NOTE_WIDTH / 7.2)
    note = f"{found.verdict}. Grey: not significantly different from 0."
    add_footnotes(ax, textwrap.wrap(note, width), below=22)
    return figure_of(ax)


def _unit(found: Interactions) -> str:
    return "per unit of either" if found.scale == "unit" else "over the range of either"


def _cells(found: Interactions) -> list[list[str]]:
    significant, formatted, count = found.significant, _formatted(found), len(found.names)
    return [
        [
            formatted[row, column] + ("" if significant[row, column] else "?") if column >= row else ""
            for column in range(count)
        ]
        for row in range(count)
    ]


def _formatted(found: Interactions) -> dict[tuple[int, int], str]:
    indices = range(len(found.names))
    matrix, errors = found.matrix, found.standard_error
    return {(p, q): concise(matrix[p, q].item(), errors[p, q].item()) for p in indices for q in indices}


def concise(value: float, error: float) -> str:
    """Format a value with the error of its last digits in brackets, ``'0.0123(4)'``."""
    style = Format.of(value, error)
    number, decimals = style.write(value), style.place
    if error == 0:
        return number
    head, mark, exponent = number.partition("e")
    digits = round(error * 10.0**decimals) if decimals > 0 else style._replace(exponent=0).write(error)
    return f"{head}({digits}){mark}{exponent}"
