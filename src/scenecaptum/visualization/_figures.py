"""What all figures share: how they are made, their colours, their titles and their small print."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ._words import METRIC_WIDTH, method_name, metric_line, sign_words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..attr import Ranked, SceneAttribution

# Okabe and Ito's blue and vermillion, which colour-blind readers tell apart, on white and on black.
RAISES, LOWERS, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
SIGNS = {RAISES: "+", LOWERS: "−", UNCLEAR: "±"}

# The width of a page's text in inches, at which a figure keeps its letters readable.
WIDTH = 7.2
TITLE, TEXT, SMALL = 10.0, 8.5, 7.5  # sizes of letters in points
_DOTS_PER_INCH = 150
_LETTER = 0.58  # width of a letter relative to its size, on average


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure that pyplot does not know of and notebooks show all the same."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", "dpi": _DOTS_PER_INCH, **options})
    FigureCanvasAgg(figure)
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]
    return figure


def figure_of(ax: Axes) -> Figure:
    """Return the figure that axes are in, also where they are those of a subfigure."""
    part: Any = ax.figure
    return part.figure  # type: ignore[no-any-return]


def colour_of(row: Ranked, attribution: SceneAttribution) -> str:
    """Tell the colour of a row's sign: neutral where channels disagree, or none is two errors from zero."""
    errors = row.total_error or (0.0,) * len(row.total)
    signs = {value > 0 for value, error in zip(row.total, errors, strict=True) if abs(value) > 2 * error}
    if len(signs) != 1 or sign_words(attribution) is None:
        return UNCLEAR
    return RAISES if signs.pop() else LOWERS


def letters(inches: float, size: float) -> int:
    """Return how many letters of a size in points fit in a width."""
    return max(int(inches * 72 / (_LETTER * size)), 12)


def title_of(attribution: SceneAttribution, width: int) -> str:
    """Write the metric's value and the method, on one line of so many letters or on several."""
    value, method = metric_line(attribution, METRIC_WIDTH), method_name(attribution)
    if len(value) + len(method) + 5 <= width:
        return f"{value}   ({method})"
    return "\n".join(textwrap.wrap(value, width) + textwrap.wrap(f"({method})", width))


def small_print(ax: Axes, lines: Sequence[str], *, below: float) -> None:
    """Write lines so many points below the axes."""
    ax.annotate(
        "\n".join(lines),
        (0, 0),
        xycoords=("axes fraction", "axes fraction"),
        xytext=(0, -below),
        textcoords="offset points",
        va="top",
        fontsize=SMALL,
        alpha=0.75,
        parse_math=False,
    )


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
