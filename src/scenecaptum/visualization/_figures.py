"""The ranking as bars, and the saliency map beside the render."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ._numbers import shorten, with_error
from ._tonemap import display_image
from ._words import (
    caution_groups,
    count_words,
    method_name,
    metric_line,
    metric_name,
    quantity,
    sampling_words,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..attr import Ranked, SceneAttribution

# Okabe and Ito's blue and vermillion, which colour-blind readers tell apart, on white and on black.
RAISES, LOWERS, UNCLEAR = "#0072B2", "#D55E00", "#8C8C8C"
_MEANINGS = {
    RAISES: "raising it raises the metric",
    LOWERS: "raising it lowers the metric",
    UNCLEAR: "channels disagree, or sign lost in the noise",
}
_SIGNS = {RAISES: "+", LOWERS: "−", UNCLEAR: "±"}
_HATCH = "////"

_NAME_WIDTH = 36
_NOTE_WIDTH = 90


def plot_bars(attribution: SceneAttribution, top: int | None = 15, ax: Axes | None = None) -> Figure:
    """Draw the ranking as horizontal bars of saliency with their standard errors, the most salient on top.

    A bar's colour, and the sign at its end, say whether raising the parameter raises or lowers the metric. It
    is neutral where the channels of a colour disagree, or where no channel is two standard errors from zero.

    Parameters
    ----------
    attribution
        What to draw.
    top
        How many parameters; None draws all.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if top is not None and top < 1:
        raise SceneCaptumError(f"top must be at least 1, or None for all parameters, not {top!r}.")
    rows = attribution.ranking(top)
    if ax is None:
        ax = _figure(8.5, 2.4 + 0.29 * len(rows)).add_subplot()
    colours = [_colour(row) for row in rows]
    cautions = caution_groups(attribution, (row.name for row in rows))
    doubtful = [any(row.name in names for names in cautions.values()) for row in rows]

    _draw_bars(ax, rows, colours, doubtful)
    _label_bars(ax, attribution, rows, doubtful)
    _head(ax, attribution, colours, any(doubtful))
    _annotate(ax, [*_remarks(attribution, len(rows)), *_caution_remarks(attribution, cautions)])
    part: Any = ax.figure  # of a figure, where the axes are those of a subfigure
    return part.figure  # type: ignore[no-any-return]


def plot_heatmap(attribution: SceneAttribution) -> Figure:
    """Draw the render and, beside it and of the same size, the saliency of what each pixel shows.

    Raises
    ------
    SceneCaptumError
        Where the attribution does not know what its pixels show, or has no picture.
    """
    from matplotlib.colors import PowerNorm

    heat = attribution.heatmap()
    if attribution.image is None:
        raise SceneCaptumError("This attribution has no picture to set beside its heatmap.")
    render = display_image(attribution.image).cpu()

    height, width = heat.shape
    figure, left, right, bar = _panels(attribution, height, width)
    left.imshow(render.numpy())
    left.set_title("render", fontsize=10)
    right.set_title("saliency relative to the strongest (√ scale)", fontsize=10)
    # Saliencies spread over orders of magnitude: on a linear scale all but a lamp or two would be black.
    mapped = right.imshow(heat.cpu().numpy(), cmap="inferno", norm=PowerNorm(0.5, 0, 1))
    ticks = [0, 0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1]
    figure.colorbar(mapped, cax=bar, ticks=ticks, format="%g")
    bar.tick_params(labelsize=8)
    return figure


def _figure(width: float, height: float, **options: Any) -> Figure:
    """Return a figure that pyplot does not know of and notebooks show all the same."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", **options})
    FigureCanvasAgg(figure)
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _colour(row: Ranked) -> str:
    errors = row.total_error or (0.0,) * len(row.total)
    signs = {value > 0 for value, error in zip(row.total, errors, strict=True) if abs(value) > 2 * error}
    return UNCLEAR if len(signs) != 1 else RAISES if signs.pop() else LOWERS


def _draw_bars(ax: Axes, rows: Sequence[Ranked], colours: Sequence[str], doubtful: Sequence[bool]) -> None:
    places = range(len(rows))
    errors = [row.saliency_error for row in rows]
    bars = ax.barh(places, [row.saliency for row in rows], height=0.7, color=colours)
    for bar, doubt in zip(bars, doubtful, strict=True):
        if doubt:
            bar.set(hatch=_HATCH, edgecolor="white", linewidth=0)
    known = [error for error in errors if error is not None]
    if known:
        ends = [row.saliency for row in rows]
        ink = ax.xaxis.label.get_color()
        ax.errorbar(ends, places, xerr=known, fmt="none", ecolor=ink, elinewidth=1.2, capsize=3)
    for place, row, error, colour in zip(places, rows, errors, colours, strict=True):
        ax.annotate(
            _SIGNS[colour] if row.saliency else "0",
            (row.saliency + (error or 0.0), place),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            color=colour,
            fontweight="bold",
        )


def _label_bars(
    ax: Axes, attribution: SceneAttribution, rows: Sequence[Ranked], doubtful: Sequence[bool]
) -> None:
    names = shorten([row.label for row in rows], _NAME_WIDTH)
    marked = [f"! {name}" if doubt else name for name, doubt in zip(names, doubtful, strict=True)]
    ax.set_yticks(range(len(rows)), marked)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)  # a scene may well have a $ in its names
    ax.invert_yaxis()
    ax.margins(x=0.08)
    ax.set_xlim(left=0)
    gradient = quantity(attribution) == "gradient per unit"
    measure = "per unit of the parameter" if gradient else f"({quantity(attribution)})"
    ax.set_xlabel(f"saliency: change of {metric_name(attribution)} {measure}", parse_math=False)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)


def _head(ax: Axes, attribution: SceneAttribution, colours: Iterable[str], doubtful: bool) -> None:
    """Write the title, and below it, above the bars and out of their way, the legend."""
    from matplotlib.patches import Patch

    present = set(colours)
    entries = [Patch(color=colour, label=text) for colour, text in _MEANINGS.items() if colour in present]
    if doubtful:
        entries.append(
            Patch(facecolor=UNCLEAR, edgecolor="white", hatch=_HATCH, label="! known to be off: see below")
        )
    ax.legend(
        handles=entries,
        loc="lower left",
        bbox_to_anchor=(0, 1),
        borderaxespad=0.2,
        borderpad=0,
        fontsize=9,
        frameon=False,
    )
    above = 10 + 13.5 * len(entries)
    ax.set_title(_title(attribution, 56), loc="left", fontsize=11, pad=above, parse_math=False)


def _title(attribution: SceneAttribution, width: int) -> str:
    value, method = metric_line(attribution), method_name(attribution)
    return f"{value}   ({method})" if len(value) + len(method) + 5 <= width else f"{value}\n({method})"


def _remarks(attribution: SceneAttribution, shown: int) -> list[str]:
    words = ", ".join(sampling_words(attribution))
    hidden = len(attribution) - shown
    more = [f"{count_words(hidden, 'less salient parameter')} not shown"] if hidden > 0 else []
    bars = ["whiskers: ± 1 standard error"] if attribution.covariance is not None else []
    return [" · ".join(part for part in (words, *bars, *more) if part)]


def _caution_remarks(attribution: SceneAttribution, cautions: dict[str, list[str]]) -> list[str]:
    labels = attribution.labels
    return [
        f"! {text} ({', '.join(labels.get(name, name) for name in names)})"
        for text, names in cautions.items()
    ]


def _annotate(ax: Axes, lines: Sequence[str]) -> None:
    """Write small print below the axis label."""
    wrapped = [part for line in lines for part in textwrap.wrap(line, _NOTE_WIDTH, subsequent_indent="    ")]
    ax.annotate(
        "\n".join(wrapped),
        (0, 0),
        xycoords=("axes fraction", "axes fraction"),
        xytext=(0, -42),
        textcoords="offset points",
        va="top",
        fontsize=8,
        alpha=0.75,
        parse_math=False,
    )


def _panels(attribution: SceneAttribution, height: int, width: int) -> tuple[Figure, Axes, Axes, Axes]:
    """Place two pictures of one size and a colour bar as tall as they are; lengths are in inches."""
    scale = min(4.8 / width, 4.0 / height)
    w, h = width * scale, height * scale
    margin, gap, bar, ticks = 0.15, 0.12, 0.14, 0.45
    across = 2 * margin + 2 * w + 2 * gap + bar + ticks
    title = _title(attribution, int(across * 11))
    caption = textwrap.wrap(_caption(attribution), int(across * 13))
    bottom, top = 0.12 + 0.18 * len(caption), 0.48 + 0.2 * len(title.splitlines())
    down = bottom + h + top
    figure = _figure(across, down, layout="none")
    figure.text(margin / across, 1 - 0.12 / down, title, va="top", fontsize=11, parse_math=False)
    small: dict[str, Any] = {"va": "bottom", "fontsize": 9, "parse_math": False}
    figure.text(margin / across, 0.08 / down, "\n".join(caption), **small)

    def place(x: float, extent: float) -> Axes:
        return figure.add_axes((x / across, bottom / down, extent / across, h / down))

    left, right = place(margin, w), place(margin + w + gap, w)
    for axes in (left, right):
        axes.set_axis_off()
    return figure, left, right, place(margin + 2 * w + 2 * gap, bar)


def _caption(attribution: SceneAttribution) -> str:
    """Name the strongest parameter that no pixel shows, if it is one of the three most salient."""
    surfaces = attribution.surfaces
    if surfaces is None:
        return ""
    seen = {name for index in set(surfaces.object_index.tolist()) for name in surfaces.parameters[index]}
    for row in attribution.ranking(3):
        if row.name not in seen and row.saliency > 0:
            saliency = " ± ".join(filter(None, with_error(row.saliency, row.saliency_error)))
            return f"not in the picture: {row.label}, #{row.rank} with a saliency of {saliency}"
    return ""
