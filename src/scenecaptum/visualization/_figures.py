"""What all figures share: creation, colours, titles and footnotes."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ._text import METRIC_WIDTH, method_name, metric_line, sign_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..protocols import Attribution, RankedParameter

# Okabe and Ito's blue and vermillion: safe for colour-blind readers, on white and on black.
RAISES, LOWERS, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
SIGNS = {RAISES: "+", LOWERS: "−", UNCLEAR: "±"}

WIDTH = 7.2  # text width of a page in inches
TITLE, TEXT, SMALL = 10.0, 8.5, 7.5  # font sizes in points
_DOTS_PER_INCH = 150
_CHARACTER_WIDTH = 0.58  # mean width of a character relative to the font size


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure that is not managed by pyplot and that notebooks display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", "dpi": _DOTS_PER_INCH, **options})
    FigureCanvasAgg(figure)
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]
    return figure


def figure_of(ax: Axes) -> Figure:
    """Return the figure of axes, also of axes in a subfigure."""
    part: Any = ax.figure
    return part.figure  # type: ignore[no-any-return]


def color_of(row: RankedParameter, attribution: Attribution) -> str:
    """Return the colour of a row's sign: neutral if channels disagree or none is two standard errors from zero."""
    errors = row.total_error or (0.0,) * len(row.total)
    signs = {value > 0 for value, error in zip(row.total, errors, strict=True) if abs(value) > 2 * error}
    if len(signs) != 1 or sign_labels(attribution) is None:
        return UNCLEAR
    return RAISES if signs.pop() else LOWERS


def characters_per_line(inches: float, size: float) -> int:
    """Return how many characters of a font size fit into a width."""
    return max(int(inches * 72 / (_CHARACTER_WIDTH * size)), 12)


def figure_title(attribution: Attribution, width: int) -> str:
    """Return the metric's value and the method, in lines of at most ``width`` characters."""
    value, method = metric_line(attribution, METRIC_WIDTH), method_name(attribution)
    if len(value) + len(method) + 5 <= width:
        return f"{value}   ({method})"
    return "\n".join(textwrap.wrap(value, width) + textwrap.wrap(f"({method})", width))


def add_footnotes(ax: Axes, lines: Sequence[str], *, below: float) -> None:
    """Write lines ``below`` points below the axes."""
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
