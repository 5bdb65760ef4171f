"""What all figures share: creation, colours, axes, titles and footnotes."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

from ..errors import SceneCaptumError, whole_number
from ..protocols import Attribution, RankedParameter, Scale
from ..student import clear_from
from ._finding import finding
from ._layout import wrapped_lines
from ._notes import kept_channels
from ._numbers import columns, rounded
from ._text import FINDING_WIDTH, metric_line, sign_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.text import Annotation
    from matplotlib.transforms import Bbox

T = TypeVar("T")

# Okabe and Ito's blue and vermillion: safe for colour-blind readers, on white and on black.
RAISES, LOWERS, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
SIGNS = {RAISES: "+", LOWERS: "−", UNCLEAR: "±"}

WIDTH = 7.2  # text width of a page in inches
_ENOUGH = 20.0  # inches, for all texts of a figure
NO_CAPTIONS = "captions=False"  # the option of a plot that leaves the texts out
LEAST_BARS = 0.8  # width in inches of bars in the axes of a caller
LEAST_WIDTH = 4.5  # in which the texts of a figure fit
TITLE, TEXT, SMALL = 10.0, 8.5, 7.5  # font sizes in points
DEFAULT_TOP = 15  # parameters in a figure
_DOTS_PER_INCH = 150
# The ticks of each decade of a logarithmic axis over at most so many decades.
_LOG_STEPS = (
    (0.4, (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)),
    (0.8, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)),
    (1.8, (1.0, 2.0, 5.0)),
    (3.0, (1.0, 3.0)),
)
_CHARACTER_WIDTH = 0.58  # mean width of a character relative to the font size


class Room(NamedTuple):
    """The least size of axes in inches, in which their texts do not overlap, and the options that make it less."""

    height: float
    width: float
    options: Sequence[str]


_rooms: WeakKeyDictionary[Axes, Room] = WeakKeyDictionary()  # of the axes of callers


class Label(NamedTuple):
    """A text beside a place in the axes, with its possible offsets in points, the best first."""

    text: str
    at: tuple[float, float]
    offsets: Sequence[tuple[float, float]]
    style: Mapping[str, Any]


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure that is not managed by pyplot and that notebooks display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", "dpi": _DOTS_PER_INCH, **options})
    FigureCanvasAgg(figure)
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]
    return figure


def check_width(figsize: tuple[float, float]) -> None:
    """Raise if a figure is too narrow for its texts."""
    if figsize[0] < LEAST_WIDTH:
        raise SceneCaptumError(
            f"A figure of {figsize[0]:g} inches is too narrow for its texts: use at least {LEAST_WIDTH:g}, save "
            "it as PDF or SVG, and let the page scale it."
        )


def check_height(ax: Axes, least: float) -> None:
    """Raise if the texts of a figure leave less than ``least`` inches of its height to its axes."""
    figure = figure_of(ax)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + _ENOUGH)  # where texts need all of the height, the layout gives up
    figure.draw_without_rendering()
    needed = (1 - ax.get_position().height) * (height + _ENOUGH) + least
    figure.set_size_inches(width, height)
    if height < needed:
        raise SceneCaptumError(
            f"A figure of {width:g} × {height:g} inches is too low for its texts and what it shows: use at least "
            f"{math.ceil(10 * needed) / 10:g} of height, or a greater width, in which texts take fewer lines."
        )


def warn_if_cramped(ax: Axes, room: Room) -> None:
    """Warn if axes that a caller made are smaller than ``room``, or their texts end outside the figure.

    All axes of the figure that were drawn into before are looked at, too: what is drawn now makes them smaller.
    """
    figure = figure_of(ax)
    _rooms[ax] = room
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a layout that gives up: those below say what to do
        for _ in range(2):  # with many texts, a layout needs two passes
            figure.draw_without_rendering()
    rooms = {one: _rooms[one] for one in figure.axes if one in _rooms}
    options = dict.fromkeys(option for room in rooms.values() for option in room.options)
    for side in ("height", "width"):
        sizes = {one: getattr(one.bbox, side) / figure.dpi for one in rooms}
        least = min(rooms, key=lambda one: sizes[one] / getattr(rooms[one], side))
        size, needed = sizes[least], getattr(rooms[least], side)
        if size < needed:
            size, needed = math.floor(10 * size) / 10, math.ceil(10 * needed) / 10
            advice = ", or ".join(["a larger figure", *options])
            warnings.warn(
                f"Axes of this figure have a {side} of {size:g} inches, too little for what they show: it needs "
                f"{needed:g}. Use {advice}.",
                stacklevel=4,
            )
            return
    if any(map(_ends_outside, rooms)):
        has_layout = figure.get_layout_engine() is not None
        layout = [] if has_layout else ["layout='constrained', which makes room for them"]
        advice = ", or ".join([*layout, "a larger figure", *options])
        warnings.warn(f"Texts end outside this figure. Use {advice}.", stacklevel=4)


def _ends_outside(ax: Axes) -> bool:
    """Whether a text of axes ends outside their figure."""
    inside, needed = figure_of(ax).bbox, ax.get_tightbbox()
    if needed is None:
        return False
    return bool(
        min(needed.x0 - inside.x0, needed.y0 - inside.y0, inside.x1 - needed.x1, inside.y1 - needed.y1) < 0
    )


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def axes_or_new(ax: Axes | None, width: float, height: float) -> Axes:
    """Return the given axes, or those of a new figure of this size in inches."""
    return new_figure(width, height).add_subplot() if ax is None else ax


def column_of(ax: Axes) -> tuple[float, float]:
    """Return where the column of axes in their figure or subfigure begins and ends, in dots."""
    part: Any = ax.figure
    spec = ax.get_subplotspec()
    if spec is None:
        return float(ax.bbox.x0), float(ax.bbox.x1)
    outer: Any = spec.get_topmost_subplotspec()
    _, _, lefts, rights = outer.get_gridspec().get_grid_positions(part)
    # Stretched over the full width, as a layout does.
    first, width = lefts[0], rights[-1] - lefts[0]
    begin, end = lefts[outer.colspan.start] - first, rights[outer.colspan.stop - 1] - first
    x0, total = part.bbox.x0, part.bbox.width
    return x0 + begin / width * total, x0 + end / width * total


def figure_of(part: Axes | SubFigure) -> Figure:
    """Return the figure of axes or of a subfigure, also of axes in a subfigure."""
    parent: Any = part.figure
    return parent.figure  # type: ignore[no-any-return]


def first(rows: Sequence[T], top: int | None) -> Sequence[T]:
    """Return the first ``top`` rows, or all for None; raise if ``top`` is less than 1."""
    return rows if top is None else rows[: whole_number("top", top)]


def color_of(row: RankedParameter, attribution: Attribution, scale: Scale | None = None) -> str:
    """Return the colour of a row's sign: neutral if its effect is not clear of its noise.

    Per unit, it is also neutral if channels disagree.
    """
    allowed = clear_from(attribution.info)
    numbers = [(row.effect, row.effect_error or 0.0)]
    if attribution.ranks_by_norm(scale):
        numbers = [(value, error or 0.0) for value, error in kept_channels(attribution, row)]
    signs = {value > 0 for value, error in numbers if abs(value) > allowed * error}
    if len(signs) != 1 or sign_labels(attribution) is None:
        return UNCLEAR
    return RAISES if signs.pop() else LOWERS


def characters_per_line(inches: float, size: float) -> int:
    """Return how many characters of a font size fit into a width."""
    return max(int(inches * 72 / (_CHARACTER_WIDTH * size)), 12)


def width_of(texts: Iterable[str], size: float) -> float:
    """Return the width of the longest of some lines of a font size in inches."""
    return max(map(columns, texts), default=0) * _CHARACTER_WIDTH * size / 72


def figure_title(
    attribution: Attribution, width: int, scale: Scale | None = None, *, texels: bool = False
) -> str:
    """Return the finding, and below it the metric's value, in lines of at most ``width`` characters.

    ``texels`` is whether the figure shows single texels.
    """
    lines = (finding(attribution, scale, texels=texels), metric_line(attribution, FINDING_WIDTH))
    return "\n".join(part for line in lines for part in wrapped_lines(line, width))


def style_axes(ax: Axes, title: str = "", *, x: str = "", y: str = "", size: float = TITLE) -> None:
    """Write the title and the labels, and remove two sides of the frame."""
    if title:
        ax.set_title(title, loc="left", fontsize=size, parse_math=False)
    ax.set_xlabel(x, fontsize=TEXT, parse_math=False)
    ax.set_ylabel(y, fontsize=TEXT, parse_math=False)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)


def log_axis(ax: Axes, which: str, low: float, high: float, write: Callable[[float], str] = rounded) -> None:
    """Make the axis ``"x"`` or ``"y"`` logarithmic between limits, with labels that do not overlap."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    ax.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_major_locator(LogLocator(subs=log_steps(low, high)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: write(value)))
    axis.set_minor_locator(NullLocator())


def log_steps(low: float, high: float) -> tuple[float, ...]:
    """Return the ticks of each decade of a logarithmic axis, the more the fewer decades there are."""
    decades = math.log10(high / low)
    return next((steps for limit, steps in _LOG_STEPS if decades <= limit), (1.0,))


def name_rows(ax: Axes, names: Sequence[str], size: float = TEXT) -> None:
    """Write names, which may contain $, beside rows, the first on top."""
    ax.set_yticks(range(len(names)), names, fontsize=size)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)


def write_header(
    ax: Axes, title: str, *, handles: Sequence[Any] | None = None, columns: int = 1, size: float = SMALL
) -> None:
    """Write the title and, between it and the axes, a legend of ``handles``, by default of all with a label."""
    entries = ax.get_legend_handles_labels()[0] if handles is None else handles
    _write_legend(ax, entries, columns, size, loc="lower left", bbox_to_anchor=(0, 1))
    lines = -(-legend_lines(entries) // columns)
    ax.set_title(title, loc="left", fontsize=TITLE, pad=8 + 1.5 * size * lines, parse_math=False)


def write_legend_below(ax: Axes, handles: Sequence[Any], *, below: float, size: float = SMALL) -> None:
    """Write a legend ``below`` points below the axes, which leaves what is above them to a caller's title."""
    from matplotlib.transforms import ScaledTranslation

    place = ax.transAxes + ScaledTranslation(0, -below / 72, figure_of(ax).dpi_scale_trans)
    _write_legend(ax, handles, 1, size, loc="upper left", bbox_to_anchor=(0, 0), bbox_transform=place)


def _write_legend(ax: Axes, entries: Sequence[Any], columns: int, size: float, **place: Any) -> None:
    if entries:
        ax.legend(
            handles=entries,
            borderaxespad=0.2,
            borderpad=0 if columns == 1 else None,
            ncols=columns,
            columnspacing=1.2,
            handletextpad=0.5,
            fontsize=size,
            frameon=False,
            **place,
        )


def legend_lines(entries: Sequence[Any]) -> int:
    """Return the number of lines of all entries of a legend."""
    return sum(1 + str(entry.get_label()).count("\n") for entry in entries)


def write_at(
    ax: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], **style: Any
) -> Annotation:
    """Write a text some points away from a place in the axes."""
    options = {"fontsize": TEXT, "parse_math": False, **style}
    return ax.annotate(text, at, xytext=offset, textcoords="offset points", **options)


def write_clear(ax: Axes, label: Label, occupied: list[Bbox]) -> None:
    """Write a label in the axes, where it covers nothing occupied, and occupy what it takes.

    The figure must be laid out, because what is occupied is in pixels. Where no offset is free, the first is used.
    """
    texts = [_beside(ax, label, offset) for offset in label.offsets]
    boxes = [text.get_window_extent() for text in texts]
    free = (
        number
        for number, box in enumerate(boxes)
        if ax.bbox.x0 < box.x0 and box.x1 < ax.bbox.x1 and not any(box.overlaps(other) for other in occupied)
    )
    chosen = next(free, 0)
    occupied.append(boxes[chosen])
    for number, text in enumerate(texts):
        if number != chosen:
            text.remove()


def _beside(ax: Axes, label: Label, offset: tuple[float, float]) -> Annotation:
    """Write a label some points away from its place, aligned to the side on which that place is."""
    align = "right" if offset[0] < 0 else "left" if offset[0] > 0 else "center"
    return write_at(ax, label.text, label.at, offset, ha=align, **label.style)


def add_footnotes(ax: Axes, lines: Sequence[str], *, below: float) -> None:
    """Write lines ``below`` points below the axes."""
    text = "\n".join(lines)
    write_at(ax, text, (0, 0), (0, -below), xycoords="axes fraction", va="top", fontsize=SMALL, alpha=0.75)
