"""Bar chart of a ranking."""

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
    add_footnotes,
    characters_per_line,
    color_of,
    figure_of,
    figure_title,
    new_figure,
)
from ._numbers import shorten
from ._text import (
    axis_label,
    caution_groups,
    convergence_notes,
    pack,
    pluralize,
    sampling_notes,
    scene_cautions,
    sign_labels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..protocols import Attribution, RankedParameter

_HATCH = "////"
_NAME_WIDTH = 36
_MAX_NAMES = 6


def plot_bars(attribution: Attribution, top: int | None = 15, ax: Axes | None = None) -> Figure:
    """Plot the ranking as horizontal bars of saliency with standard errors, the most salient on top.

    The colour of a bar and the sign at its end show whether raising the parameter raises or lowers the metric or,
    for contributions, whether the parameter adds to the metric or takes from it. Bars are neutral if the channels
    of a colour disagree, or if no channel is two standard errors from zero.

    Parameters
    ----------
    attribution
        The result to plot.
    top
        Number of parameters; None for all.
    ax
        Axes to draw into; by default those of a new figure.
    """
    rows = top_rows(attribution, top)
    cautions = caution_groups(attribution, (row.name for row in rows))
    inaccurate = [any(row.name in names for names in cautions.values()) for row in rows]
    legend = bar_legend(attribution, rows, any(inaccurate))
    # Up to a third of the width is for the names.
    width = 0.67 * WIDTH if ax is None else 0.85 * ax.get_position().width * figure_of(ax).get_figwidth()
    title = figure_title(attribution, characters_per_line(0.88 * width, TITLE))
    axis = textwrap.wrap(axis_label(attribution), characters_per_line(width, TEXT))
    footnotes = _footnotes(attribution, rows, cautions, characters_per_line(width, SMALL))
    if ax is None:
        points = TITLE * len(title.splitlines()) + TEXT * (len(legend) + len(axis)) + SMALL * len(footnotes)
        ax = new_figure(WIDTH, 0.7 + 1.4 * points / 72 + 0.21 * max(len(rows), 2)).add_subplot()

    draw_bars(ax, attribution, rows, inaccurate, name_width=_NAME_WIDTH)
    ax.set_xlabel("\n".join(axis), fontsize=TEXT, parse_math=False)
    _write_header(ax, title, legend)
    add_footnotes(ax, footnotes, below=24 + 1.25 * TEXT * len(axis))
    return figure_of(ax)


def top_rows(attribution: Attribution, top: int | None) -> Sequence[RankedParameter]:
    """Return the ``top`` rows of a ranking, or all for None."""
    if top is not None and top < 1:
        raise SceneCaptumError(f"top must be at least 1, or None for all parameters, not {top!r}.")
    return attribution.ranking(top)


def draw_bars(
    ax: Axes,
    attribution: Attribution,
    rows: Sequence[RankedParameter],
    inaccurate: Sequence[bool],
    *,
    name_width: int,
) -> None:
    """Draw the bars, error bars and signs, and write the names."""
    positions = range(len(rows))
    colors = [color_of(row, attribution) for row in rows]
    lengths, errors = [row.saliency for row in rows], [row.saliency_error for row in rows]
    bars = ax.barh(positions, lengths, height=0.7, color=colors)
    for bar, hatched in zip(bars, inaccurate, strict=True):
        if hatched:
            bar.set(hatch=_HATCH, edgecolor="white", linewidth=0)
    known = [error for error in errors if error is not None]
    if known:
        text_color = ax.xaxis.label.get_color()
        ax.errorbar(
            lengths, positions, xerr=known, fmt="none", ecolor=text_color, elinewidth=1.0, capsize=2.5
        )
    if sign_labels(attribution) is not None:
        ends = [length + (error or 0.0) for length, error in zip(lengths, errors, strict=True)]
        signs = [SIGNS[color] if row.saliency else "0" for color, row in zip(colors, rows, strict=True)]
        _write_signs(ax, ends, signs)
    _write_names(ax, rows, inaccurate, name_width)


def _write_signs(ax: Axes, ends: Sequence[float], signs: Sequence[str]) -> None:
    colors = {sign: color for color, sign in SIGNS.items()}
    for position, (end, sign) in enumerate(zip(ends, signs, strict=True)):
        ax.annotate(
            sign,
            (end, position),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=colors.get(sign, UNCLEAR),
            fontsize=TEXT,
            fontweight="bold",
        )


def _write_names(ax: Axes, rows: Sequence[RankedParameter], inaccurate: Sequence[bool], width: int) -> None:
    names = shorten([row.label for row in rows], width)
    marked = [f"! {name}" if mark else name for name, mark in zip(names, inaccurate, strict=True)]
    ax.set_yticks(range(len(rows)), marked, fontsize=TEXT)
    for label in ax.get_yticklabels():
        label.set_parse_math(False)  # names may contain $
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.margins(x=0.08)
    ax.set_xlim(left=0, right=None if any(row.saliency for row in rows) else 1)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.tick_params(axis="x", labelsize=TEXT)


def bar_legend(attribution: Attribution, rows: Iterable[RankedParameter], has_inaccurate: bool) -> list[Any]:
    """Return legend entries for the colours of these rows' bars; bars of length 0 have none."""
    from matplotlib.patches import Patch

    labels = sign_labels(attribution)
    present = {color_of(row, attribution) for row in rows if row.saliency}
    meanings = {UNCLEAR: "never negative: it has no sign"}
    if labels is not None:
        meanings = {
            RAISES: labels[0],
            LOWERS: labels[1],
            UNCLEAR: "channels disagree, or sign lost in the noise",
        }
    entries = [Patch(color=color, label=text) for color, text in meanings.items() if color in present]
    if has_inaccurate:
        entries.append(
            Patch(facecolor=UNCLEAR, edgecolor="white", hatch=_HATCH, label="! known to be inaccurate")
        )
    return entries


def _write_header(ax: Axes, title: str, legend: Sequence[Any]) -> None:
    """Write the title and, between it and the bars, the legend."""
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
    padding = 8 + 1.45 * TEXT * len(legend)
    ax.set_title(title, loc="left", fontsize=TITLE, pad=padding, parse_math=False)


def _footnotes(
    attribution: Attribution,
    rows: Sequence[RankedParameter],
    cautions: Mapping[str, Sequence[str]],
    width: int,
) -> list[str]:
    """Return the footnotes in lines of at most ``width`` characters."""
    lines = pack(_notes(attribution, rows), width)
    for text, names in cautions.items():
        labels = shorten([attribution.labels.get(name, name) for name in names[:_MAX_NAMES]], _NAME_WIDTH)
        more = [f"{len(names) - _MAX_NAMES} more"] if len(names) > _MAX_NAMES else []
        lines.append(f"! {text} ({', '.join([*labels, *more])})")
    lines += [f"! {text}" for text in scene_cautions(attribution)]
    return [part for line in lines for part in textwrap.wrap(line, width, subsequent_indent="    ")]


def _notes(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[str]:
    hidden = len(attribution) - len(rows)
    parts = [
        *sampling_notes(attribution),
        *convergence_notes(attribution),
        "error bars: ± 1 standard error" if attribution.covariance is not None else "",
        "a colour's bar: ℓ2 norm over R, G, B" if any(len(row.total) == 3 for row in rows) else "",
        "" if any(row.saliency for row in rows) else "all saliencies are 0",
        f"{pluralize(hidden, 'less salient parameter')} not shown" if hidden > 0 else "",
    ]
    return [part for part in parts if part]
