"""Bar chart of a ranking."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..protocols import Attribution, RankedParameter, Scale
from ._effect_notes import light_notes, range_marked, range_notes
from ._figures import (
    DEFAULT_TOP,
    LEAST_BARS,
    LOWERS,
    NO_CAPTIONS,
    RAISES,
    SIGNS,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    Room,
    add_footnotes,
    characters_per_line,
    check_height,
    check_width,
    color_of,
    column_of,
    figure_of,
    figure_title,
    first,
    legend_lines,
    name_rows,
    new_figure,
    style_axes,
    warn_if_cramped,
    width_of,
    write_at,
    write_header,
    write_legend_below,
)
from ._layout import wrapped_lines
from ._notes import (
    baseline_notes,
    caution_groups,
    convergence_notes,
    jump_notes,
    marked_doubts,
    note_of_none,
    sampling_notes,
    scene_cautions,
    unit_notes,
    untrusted_groups,
)
from ._numbers import shorten, signed_with_error
from ._text import axis_label, method_name, pack, pluralize, sign_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HATCH = "////"
_NAME_WIDTH = 36
_MAX_NAMES = 6
_LONGEST = 80  # characters of a line of the legend
_LEGEND_PATCH = 0.4  # inches, before the text of each entry
_BAR, _LEAST_BAR = 0.21, 0.13  # inches of each bar: by default, and at least
_SIGN = 0.2  # inches, beside the end of a bar
_BESIDE = 0.2  # inches: the margins of the figure, and between the names and the axes


def plot_bars(
    attribution: Attribution,
    top: int | None = DEFAULT_TOP,
    *,
    ax: Axes | None = None,
    scale: Scale | None = None,
    figsize: tuple[float, float] | None = None,
    captions: bool = True,
) -> Figure:
    """Plot the ranking as horizontal bars of effects with standard errors, the largest on top.

    The side and the colour of a bar show whether raising the parameter raises or lowers the metric or, for
    contributions, whether the parameter adds to the metric or takes from it. Bars are grey if the effect is less
    than two standard errors from zero, or if its errors have fewer than 7 degrees of freedom and its interval at
    95 % (Student's t) contains 0: 8 replicates of a gradient have 7, those of several points may have fewer.
    Gradients per unit, whose channels have no common sign, are shown by their norm. What
    ranks last has its number in place of a bar.

    Parameters
    ----------
    attribution
        The result to plot.
    top
        Number of parameters; None for all.
    scale
        ``"range"`` (the default where ranges are known), ``"unit"`` or ``"value"``, as for ``ranking``.
    ax
        Axes to draw into; by default those of a new figure. A warning says if they are too low for the
        bars, or if texts end outside the figure.
    figsize
        Width and height of the new figure in inches; by default as high as the rows need.
    captions
        Write the finding and the value above the bars, and the notes below them. False leaves this to the text
        around the figure, and takes less room; the legend is below the axes, so that you can give them a title.

    Raises
    ------
    SceneCaptumError
        If the figure would be narrower than 4.5 inches, or too low for its texts and bars.
    """
    if figsize is not None:
        check_width(figsize)
    rows = first(attribution.ranking(scale=scale), top)
    cautions = caution_groups(attribution, (row.name for row in rows))
    # What the names leave is for the texts, at least three fifths: a name may be wider than its share.
    if ax is None:
        full = WIDTH if figsize is None else figsize[0]
        name_width = _NAME_WIDTH
    else:
        left, right = column_of(ax)
        full = (right - left) / figure_of(ax).dpi
        name_width = min(_NAME_WIDTH, characters_per_line(0.4 * full, TEXT))
    names = bar_names(attribution, rows, scale, name_width)
    width = max(0.6 * full, full - _BESIDE - width_of(names, TEXT))
    longest = _LONGEST if ax is None else characters_per_line(width - _LEGEND_PATCH, TEXT)
    legend = bar_legend(attribution, rows, scale, longest)
    title = figure_title(attribution, characters_per_line(0.88 * width, TITLE), scale) if captions else ""
    axis = wrapped_lines(axis_label(attribution, scale), characters_per_line(width, TEXT))
    footnotes = []
    if captions:
        footnotes = _footnotes(attribution, rows, scale, cautions, characters_per_line(width, SMALL))
    own = ax is None
    if ax is None:
        points = TITLE * len(title.splitlines()) + TEXT * (legend_lines(legend) + len(axis))
        points += SMALL * len(footnotes)
        height = 0.7 + 1.4 * points / 72 + _BAR * max(len(rows), 2)
        ax = new_figure(*(figsize or (WIDTH, height))).add_subplot()

    style_axes(ax, x="\n".join(axis))
    draw_bars(ax, attribution, rows, scale=scale, name_width=name_width)
    below = 24 + 1.25 * TEXT * len(axis)
    if captions:
        write_header(ax, title, handles=legend, size=TEXT)
        add_footnotes(ax, footnotes, below=below)
    else:
        write_legend_below(ax, legend, below=below, size=TEXT)
    if not own:
        options = [NO_CAPTIONS, "a smaller top="] if captions else ["a smaller top="]
        warn_if_cramped(ax, Room(_LEAST_BAR * len(rows), LEAST_BARS, options))
    elif figsize is not None:
        check_height(ax, _LEAST_BAR * len(rows))
    return figure_of(ax)


def draw_bars(
    ax: Axes,
    attribution: Attribution,
    rows: Sequence[RankedParameter],
    *,
    scale: Scale | None,
    name_width: int,
    size: float = TEXT,
) -> None:
    """Draw the bars, error bars and signs, and write the names."""
    signed = _is_signed(attribution, scale)
    positions = range(len(rows))
    colors = [color_of(row, attribution, scale) for row in rows]
    inaccurate = _inaccurate(attribution, rows)
    last = attribution.ranked_last(scale)
    lengths = [0.0 if row.name in last else row.effect if signed else row.saliency for row in rows]
    errors = [0.0 if row.name in last and row.saliency_error else row.saliency_error for row in rows]
    bars = ax.barh(positions, lengths, height=0.7, color=colors)
    for bar, hatched in zip(bars, inaccurate, strict=True):
        if hatched:
            bar.set(hatch=_HATCH, edgecolor="white", linewidth=0)
    known = [error for error in errors if error is not None]
    if known:
        style: dict[str, Any] = {"fmt": "none", "elinewidth": 1.0, "capsize": 2.5}
        ax.errorbar(lengths, positions, xerr=known, ecolor=ax.xaxis.label.get_color(), **style)
    if sign_labels(attribution) is not None:
        for position, (row, color) in enumerate(zip(rows, colors, strict=True)):
            if row.name in last:
                written = signed_with_error(row.effect, row.effect_error)
                write_at(ax, written, (0, position), (4, 0), va="center", color=UNCLEAR, fontsize=SMALL)
                continue
            side = -1 if signed and row.effect < 0 else 1
            end = side * (row.saliency + (row.saliency_error or 0.0))
            sign, ink = (SIGNS[color], color) if row.saliency else ("0", UNCLEAR)
            style = {"va": "center", "ha": "left" if side > 0 else "right", "fontweight": "bold"}
            write_at(ax, sign, (end, position), (4 * side, 0), color=ink, **style)
    name_rows(ax, bar_names(attribution, rows, scale, name_width), size)
    # A layout may leave half of the width.
    ax.margins(x=max(0.08, 2 * _SIGN * figure_of(ax).dpi / ax.bbox.width))
    if not any(length < 0 for length in lengths):
        ax.set_xlim(left=0, right=None if any(lengths) else 1)
    else:
        ax.axvline(0, color=UNCLEAR, linewidth=0.8)


def bar_names(
    attribution: Attribution, rows: Sequence[RankedParameter], scale: Scale | None, width: int
) -> list[str]:
    """Return what is written beside the bars: names of at most ``width`` characters, after their marks."""
    noted = range_marked(bar_notes(attribution, rows, scale))
    doubted = _doubted(attribution)
    marks = [
        f"{'!' if hatched else ''}{'?' if row.name in doubted else ''}{'~' if row.name in noted else ''}"
        for row, hatched in zip(rows, _inaccurate(attribution, rows), strict=True)
    ]
    names = shorten([row.label for row in rows], width)
    return [f"{mark} {name}".lstrip() for mark, name in zip(marks, names, strict=True)]


def _is_signed(attribution: Attribution, scale: Scale | None) -> bool:
    """Whether bars show signed effects, not norms."""
    return attribution.kind.has_sign and not attribution.ranks_by_norm(scale)


def _inaccurate(attribution: Attribution, rows: Iterable[RankedParameter]) -> list[bool]:
    """Return whether the derivative of each row is known to be inaccurate."""
    cautions = attribution.info.get("cautions") or {}
    return [row.name in cautions for row in rows]


def bar_legend(
    attribution: Attribution, rows: Sequence[RankedParameter], scale: Scale | None, width: int = _LONGEST
) -> list[Any]:
    """Return legend entries for the colours of these rows' bars; bars of length 0 have none.

    Their texts have lines of at most ``width`` characters.
    """
    from matplotlib.patches import Patch

    labels, signed = sign_labels(attribution), _is_signed(attribution, scale)
    last = attribution.ranked_last(scale)
    present = {color_of(row, attribution, scale) for row in rows if row.saliency and row.name not in last}
    meanings = {UNCLEAR: "a square or variance: it has no sign"}
    if labels is not None:
        meanings = {
            RAISES: labels[0],
            LOWERS: labels[1],
            UNCLEAR: "sign lost in the noise" if signed else "channels disagree, or sign lost in the noise",
        }
    entries = [Patch(color=color, label=text) for color, text in meanings.items() if color in present]
    if any(_inaccurate(attribution, rows)):
        entries.append(
            Patch(facecolor=UNCLEAR, edgecolor="white", hatch=_HATCH, label="! known to be inaccurate")
        )
    for entry in entries:
        entry.set_label("\n".join(wrapped_lines(str(entry.get_label()), width)))
    return entries


def bar_notes(
    attribution: Attribution, rows: Iterable[RankedParameter], scale: Scale | None
) -> dict[str, list[str]]:
    """Return what the mark ``~`` means, with the rows that have it."""
    return range_notes(
        attribution, scale, among=[*(row.name for row in rows), *attribution.ranked_last(scale)]
    )


def bar_doubts(attribution: Attribution, rows: Iterable[RankedParameter]) -> list[str]:
    """Return the notes on error bars of these rows that are unreliable."""
    shown = [row.name for row in rows]
    doubts = {why: names for why, names in untrusted_groups(attribution).items() if {*shown} & {*names}}
    return marked_doubts(doubts, attribution.labels, shown, len(attribution), "? ")


def _doubted(attribution: Attribution) -> set[str]:
    """Return the rows with the mark ``?``: as in the table, none if all parameters would have it."""
    groups = untrusted_groups(attribution).values()
    return {name for names in groups if len(names) < len(attribution) for name in names}


def _footnotes(
    attribution: Attribution,
    rows: Sequence[RankedParameter],
    scale: Scale | None,
    cautions: Mapping[str, Sequence[str]],
    width: int,
) -> list[str]:
    """Return the footnotes in lines of at most ``width`` characters."""
    last, shown = attribution.ranked_last(scale), {row.name for row in rows}
    hidden = sum(row.name not in shown | last for row in attribution.ranking(scale=scale))
    notes = [
        method_name(attribution),
        *sampling_notes(attribution),
        *convergence_notes(attribution),
        *unit_notes(attribution, rows, scale),
        "error bars: ± 1 standard error" if attribution.covariance is not None else "",
        "" if any(row.saliency for row in rows) else note_of_none(attribution),
        f"{pluralize(hidden, 'parameter')} with smaller effects not shown" if hidden > 0 else "",
        *bar_doubts(attribution, rows),
    ]
    lines = [*pack([note for note in notes if note], width), *baseline_notes(attribution)]
    lines += light_notes(attribution, rows, scale)
    for text, names in cautions.items():
        labels = shorten([attribution.labels.get(name, name) for name in names[:_MAX_NAMES]], _NAME_WIDTH)
        more = [f"{len(names) - _MAX_NAMES} more"] if len(names) > _MAX_NAMES else []
        lines.append(f"! {text} ({', '.join([*labels, *more])})")
    lines += jump_notes(attribution)
    lines += [f"~ {text}" for text in bar_notes(attribution, rows, scale)]
    lines += [f"! {text}" for text in scene_cautions(attribution)]
    return [part for line in lines for part in wrapped_lines(line, width, 4)]
