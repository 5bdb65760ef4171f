"""The ranking as bars."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ._figures import (
    LOWERS,
    RAISES,
    SIGNS,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    colour_of,
    figure_of,
    letters,
    new_figure,
    small_print,
    title_of,
)
from ._numbers import shorten
from ._words import (
    axis_words,
    caution_groups,
    convergence_words,
    count_words,
    pack,
    sampling_words,
    scene_cautions,
    sign_words,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..attr import Ranked, SceneAttribution

_HATCH = "////"
_NAME_WIDTH = 36
_MOST_NAMED = 6


def plot_bars(attribution: SceneAttribution, top: int | None = 15, ax: Axes | None = None) -> Figure:
    """Draw the ranking as horizontal bars of saliency with their standard errors, the most salient on top.

    A bar's colour, and the sign at its end, say whether raising the parameter raises or lowers the metric, or
    where the attributions are contributions, whether it adds to the metric or takes from it. It is neutral where
    the channels of a colour disagree, or where no channel is two standard errors from zero.

    Parameters
    ----------
    attribution
        What to draw.
    top
        How many parameters; None draws all.
    ax
        Axes to draw into; by default those of a new figure.
    """
    rows = top_rows(attribution, top)
    cautions = caution_groups(attribution, (row.name for row in rows))
    doubtful = [any(row.name in names for names in cautions.values()) for row in rows]
    legend = bar_legend(attribution, rows, any(doubtful))
    # Names take up to a third of the width.
    room = 0.67 * WIDTH if ax is None else 0.85 * ax.get_position().width * figure_of(ax).get_figwidth()
    title = title_of(attribution, letters(0.88 * room, TITLE))
    axis = textwrap.wrap(axis_words(attribution), letters(room, TEXT))
    small = _wrap(attribution, rows, cautions, letters(room, SMALL))
    if ax is None:
        points = TITLE * len(title.splitlines()) + TEXT * (len(legend) + len(axis)) + SMALL * len(small)
        ax = new_figure(WIDTH, 0.7 + 1.4 * points / 72 + 0.21 * max(len(rows), 2)).add_subplot()

    draw_bars(ax, attribution, rows, doubtful, name_width=_NAME_WIDTH)
    ax.set_xlabel("\n".join(axis), fontsize=TEXT, parse_math=False)
    _head(ax, title, legend)
    small_print(ax, small, below=24 + 1.25 * TEXT * len(axis))
    return figure_of(ax)


def top_rows(attribution: SceneAttribution, top: int | None) -> list[Ranked]:
    """Return the first rows of a ranking, at least one where there are any."""
    if top is not None and top < 1:
        raise SceneCaptumError(f"top must be at least 1, or None for all parameters, not {top!r}.")
    return attribution.ranking(top)


def draw_bars(
    ax: Axes,
    attribution: SceneAttribution,
    rows: Sequence[Ranked],
    doubtful: Sequence[bool],
    *,
    name_width: int,
) -> None:
    """Draw bars, whiskers and signs, and write the names beside them."""
    places = range(len(rows))
    colours = [colour_of(row, attribution) for row in rows]
    lengths, errors = [row.saliency for row in rows], [row.saliency_error for row in rows]
    bars = ax.barh(places, lengths, height=0.7, color=colours)
    for bar, doubt in zip(bars, doubtful, strict=True):
        if doubt:
            bar.set(hatch=_HATCH, edgecolor="white", linewidth=0)
    known = [error for error in errors if error is not None]
    if known:
        ink = ax.xaxis.label.get_color()
        ax.errorbar(lengths, places, xerr=known, fmt="none", ecolor=ink, elinewidth=1.0, capsize=2.5)
    if sign_words(attribution) is not None:
        ends = [length + (error or 0.0) for length, error in zip(lengths, errors, strict=True)]
        _write_signs(
            ax, ends, [SIGNS[c] if row.saliency else "0" for c, row in zip(colours, rows, strict=True)]
        )
    _write_names(ax, rows, doubtful, name_width)


def _write_signs(ax: Axes, ends: Sequence[float], signs: Sequence[str]) -> None:
    ink = {sign: colour for colour, sign in SIGNS.items()}
    for place, (end, sign) in enumerate(zip(ends, signs, strict=True)):
        ax.annotate(
            sign,
            (end, place),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=ink.get(sign, UNCLEAR),
            fontsize=TEXT,
            fontweight="bold",
        )


def _write_names(ax: Axes, rows: Sequence[Ranked], doubtful: Sequence[bool], width: int) -> None:
    names = shorten([row.label for row in rows], width)
    marked = [f"! {name}" if doubt else name for name, doubt in zip(names, doubtful, strict=True)]
    ax.set_yticks(range(len(rows)), marked, fontsize=TEXT)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)  # a scene may well have a $ in its names
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.margins(x=0.08)
    ax.set_xlim(left=0, right=None if any(row.saliency for row in rows) else 1)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=TEXT)


def bar_legend(attribution: SceneAttribution, rows: Iterable[Ranked], doubtful: bool) -> list[Any]:
    """Return legend entries for the colours that the bars of these rows have; a bar of length 0 shows none."""
    from matplotlib.patches import Patch

    words = sign_words(attribution)
    present = {colour_of(row, attribution) for row in rows if row.saliency}
    meanings = {UNCLEAR: "never negative: it has no sign"}
    if words is not None:
        meanings = {
            RAISES: words[0],
            LOWERS: words[1],
            UNCLEAR: "channels disagree, or sign lost in the noise",
        }
    entries = [Patch(color=colour, label=text) for colour, text in meanings.items() if colour in present]
    if doubtful:
        entries.append(Patch(facecolor=UNCLEAR, edgecolor="white", hatch=_HATCH, label="! known to be off"))
    return entries


def _head(ax: Axes, title: str, legend: Sequence[Any]) -> None:
    """Write the title, and below it, above the bars and out of their way, the legend."""
    if legend:
        ax.legend(
            handles=legend,
            loc="lower left",
            bbox_to_anchor=(0, 1),
            borderaxespad=0.2,
            borderpad=0,
            fontsize=TEXT,
            frameon=False,
        )
    above = 8 + 1.45 * TEXT * len(legend)
    ax.set_title(title, loc="left", fontsize=TITLE, pad=above, parse_math=False)


def _wrap(
    attribution: SceneAttribution, rows: Sequence[Ranked], cautions: Mapping[str, Sequence[str]], width: int
) -> list[str]:
    """Write the small print in lines of so many letters."""
    lines = pack(_remarks(attribution, rows), width)
    for text, names in cautions.items():
        labels = shorten([attribution.labels.get(name, name) for name in names[:_MOST_NAMED]], _NAME_WIDTH)
        more = [f"{len(names) - _MOST_NAMED} more"] if len(names) > _MOST_NAMED else []
        lines.append(f"! {text} ({', '.join([*labels, *more])})")
    lines += [f"! {text}" for text in scene_cautions(attribution)]
    return [part for line in lines for part in textwrap.wrap(line, width, subsequent_indent="    ")]


def _remarks(attribution: SceneAttribution, rows: Sequence[Ranked]) -> list[str]:
    hidden = len(attribution) - len(rows)
    parts = [
        *sampling_words(attribution),
        *convergence_words(attribution),
        "whiskers: ± 1 standard error" if attribution.covariance is not None else "",
        "a colour's bar: ℓ2 norm over R, G, B" if any(len(row.total) == 3 for row in rows) else "",
        "" if any(row.saliency for row in rows) else "all saliencies are 0",
        f"{count_words(hidden, 'less salient parameter')} not shown" if hidden > 0 else "",
    ]
    return [part for part in parts if part]
