"""Figure of several attributions side by side: rankings and saliency maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ..projection import DEFAULT_NORM, MapNorm, heatmap, objects_of_unclear_sign, shared_maximum
from ..protocols import Attribution, RankedParameter, Scale
from ._bars import bar_doubts, bar_legend, bar_notes, draw_bars
from ._figures import (
    DEFAULT_TOP,
    LEAST_BARS,
    SMALL,
    TEXT,
    TITLE,
    Room,
    characters_per_line,
    figure_of,
    first,
    new_figure,
    style_axes,
    warn_if_cramped,
)
from ._finding import finding
from ._layout import wrap, wrapped_lines
from ._maps import draw_colorbar, draw_map
from ._notes import caution_groups, convergence_notes, doubt_notes, gradient_notes, jump_notes, noise_notes
from ._text import FINDING_WIDTH, axis_label, method_name, metric_line, metric_name, with_unit_of_effects

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_COLUMN_WIDTH, _MAX_MAP_HEIGHT = 3.6, 3.6  # inches
_NAME_WIDTH = 26
_ROW_HEIGHT, _LEAST_ROW = 0.19, 0.12  # inches: by default, and at least in a figure of a caller


def plot_specificity(
    attributions: Sequence[Attribution],
    top: int | None = DEFAULT_TOP,
    *,
    figure: Figure | SubFigure | None = None,
    shared: bool = False,
    signed: bool = False,
    scale: Scale | None = None,
    norm: MapNorm = DEFAULT_NORM,
) -> Figure:
    """Plot the ranking and, below it, the saliency map of each of several attributions.

    It shows how different metrics of one image depend on different parameters. Where the methods differ, each
    column has the name of its own.

    Parameters
    ----------
    attributions
        One per column; usually several metrics of one renderer.
    top
        Number of parameters in each ranking; None for all.
    figure
        Figure or subfigure to draw into; by default a new one.
    shared
        Use one scale for all maps, relative to the most salient object in any of them. The metrics must have the
        same unit. By default each map has its own scale.
    scale
        As for ``plot_bars``.
    signed, norm
        As for ``plot_heatmap``.

    Raises
    ------
    SceneCaptumError
        If there is no attribution, or one has no map of the surfaces in its image.
    """
    if not attributions:
        raise SceneCaptumError("plot_specificity needs at least one attribution.")
    maximum = shared_maximum(attributions, scale=scale) or None if shared else None
    heats = [heatmap(a, signed=signed, scale=scale, norm=norm, maximum=maximum) for a in attributions]
    rows = [first(attribution.ranking(scale=scale), top) for attribution in attributions]
    maps = 0.1 + min(max(_COLUMN_WIDTH * heat.shape[0] / heat.shape[1] for heat in heats), _MAX_MAP_HEIGHT)
    columns = len(attributions)
    footnotes = _footnotes(attributions, rows, scale)
    maps += 1.4 * SMALL / 72 * len(footnotes)
    heading, titles = _titles(attributions, scale)
    labels = _labels(attributions, scale, is_named=bool(heading))
    legend: dict[Any, Any] = {}
    for attribution, ranked in zip(attributions, rows, strict=True):
        legend |= {entry.get_label(): entry for entry in bar_legend(attribution, ranked, scale)}
    legend_columns = min(2, columns)
    # Each row has its height, whatever the texts around the bars need.
    small_lines = _most_lines(labels) + len(legend) / legend_columns
    lines = TITLE * len(heading) + TEXT * _most_lines(titles) + SMALL * small_lines
    bars = 0.9 + 1.4 * lines / 72 + _ROW_HEIGHT * max(map(len, rows))
    part: Any = figure or new_figure(_COLUMN_WIDTH * columns + 0.7, bars + maps)
    # Separate subfigures let the maps be as wide as bars and names together.
    upper, lower = part.subfigures(2, 1, height_ratios=[bars, maps])

    axes = upper.subplots(1, columns, squeeze=False)[0]
    for ax, attribution, ranked, label in zip(axes, attributions, rows, labels, strict=True):
        style_axes(ax)
        draw_bars(ax, attribution, ranked, scale=scale, name_width=_NAME_WIDTH, size=SMALL)
        ax.locator_params(axis="x", nbins=4)
        ax.set_xlabel(label, fontsize=SMALL, parse_math=False)
    if heading:
        upper.suptitle("\n".join(heading), fontsize=TITLE, parse_math=False)
    _draw_titles(upper, titles)
    if legend:
        style: dict[str, Any] = {"loc": "outside lower center", "ncols": legend_columns, "frameon": False}
        upper.legend(handles=list(legend.values()), fontsize=SMALL, **style)
    bar_axes, axes = axes, lower.subplots(1, columns, squeeze=False)[0]
    if footnotes:
        lower.supxlabel("\n".join(footnotes), fontsize=SMALL, x=0.02, ha="left", parse_math=False)
    mapped = [draw_map(ax, heat, signed=signed) for ax, heat in zip(axes, heats, strict=True)]
    bar = draw_colorbar(mapped[-1], signed, norm, ax=list(axes), aspect=18, pad=0.02)
    noisy = signed and any(objects_of_unclear_sign(one, scale=scale) for one in attributions)
    unclear = "; white:\nsign lost in the noise" if noisy else ""
    bar.set_label(f"relative to the largest\n{'of all' if shared else 'in each'}{unclear}", fontsize=SMALL)
    if figure is not None:
        least = Room(_LEAST_ROW * max(map(len, rows)), LEAST_BARS, ["a smaller top="])
        warn_if_cramped(bar_axes[0], least)
    return figure_of(part)


def _footnotes(
    attributions: Sequence[Attribution], rows: Sequence[Sequence[RankedParameter]], scale: Scale | None
) -> list[str]:
    """Return notes on whole results, and what the marks beside names mean, in lines as wide as the figure."""
    width = characters_per_line(0.95 * _COLUMN_WIDTH * len(attributions), SMALL)
    pairs = list(zip(attributions, rows, strict=True))
    notes = _notes_of_results(attributions)
    notes += [f"! {note}" for one, ranked in pairs for note in _cautions(one, ranked)]
    notes += [f"~ {note}" for one, ranked in pairs for note in bar_notes(one, ranked, scale)]
    notes += _doubts(attributions, rows)
    return [part for note in dict.fromkeys(notes) for part in wrapped_lines(note, width, 2)]


def _notes_of_results(attributions: Sequence[Attribution]) -> list[str]:
    """Return notes on results, and what their error bars are; what not all share begins with its column."""
    columns: dict[str, list[str]] = {}
    for name, one in zip(_column_names(attributions), attributions, strict=True):
        bars = [] if one.covariance is None else ["error bars: ± 1 standard error"]
        adds_up = one.info.get("convergence") in (None, "adds up")
        converges = [] if adds_up else convergence_notes(one)
        jumps = [note.lstrip("– ") for note in jump_notes(one)]
        for note in [*bars, *noise_notes(one), *gradient_notes(one), *converges, *jumps]:
            columns.setdefault(note, []).append(name)
    return _after_columns(columns, len(attributions))


def _doubts(attributions: Sequence[Attribution], rows: Sequence[Sequence[RankedParameter]]) -> list[str]:
    """Return what the mark ``?`` means; what not all columns share begins with its column."""
    columns: dict[str, list[str]] = {}
    for name, one, ranked in zip(_column_names(attributions), attributions, rows, strict=True):
        for doubt in bar_doubts(one, ranked):
            columns.setdefault(doubt, []).append(name)
    return _after_columns(columns, len(attributions))


def _after_columns(notes: Mapping[str, Sequence[str]], count: int) -> list[str]:
    """Return notes, each after the names of its columns unless it is about all ``count`` of them."""
    return [note if len(names) == count else f"{', '.join(names)}: {note}" for note, names in notes.items()]


def _column_names(attributions: Sequence[Attribution]) -> list[str]:
    """Return what tells the columns apart: their metrics, or else their methods, or else their numbers."""
    metrics = [metric_name(one, FINDING_WIDTH) for one in attributions]
    for names in (metrics, list(map(method_name, attributions))):
        if len(set(names)) == len(names):
            return names
    return [f"column {number}" for number in range(1, len(attributions) + 1)]


def _cautions(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[str]:
    """Return why derivatives of these rows are known to be inaccurate."""
    names = [row.name for row in rows]
    return doubt_notes(caution_groups(attribution, names), attribution.labels, names, len(attribution))


def _titles(attributions: Sequence[Attribution], scale: Scale | None) -> tuple[list[str], list[str]]:
    """Return the lines of a common heading, which names the metric if all columns share it, and their titles."""
    heading, values = "", [metric_line(one, FINDING_WIDTH) for one in attributions]
    columns = [[finding(one, scale), value] for one, value in zip(attributions, values, strict=True)]
    if len(attributions) > 1 and len(set(map(metric_name, attributions))) == 1:
        found = [finding(one, scale, metric="the metric") for one in attributions]
        if len(set(values)) == 1:
            heading, columns = values[0], [[said] for said in found]
        else:
            heading = metric_name(attributions[0], FINDING_WIDTH)
            numbers = [value.removeprefix(heading).removeprefix(" = ") for value in values]
            columns = [list(lines) for lines in zip(found, numbers, strict=True)]
    methods = list(map(method_name, attributions))
    if len(set(methods)) > 1:
        columns = [[method, *lines] for method, lines in zip(methods, columns, strict=True)]
    width = characters_per_line(0.85 * _COLUMN_WIDTH, TITLE)
    titles = ["\n".join(part for line in lines for part in wrapped_lines(line, width)) for lines in columns]
    return wrapped_lines(heading, characters_per_line(0.9 * _COLUMN_WIDTH * len(columns), TITLE)), titles


def _labels(attributions: Sequence[Attribution], scale: Scale | None, *, is_named: bool) -> list[str]:
    """Return the labels of the axes; ``is_named`` says that the heading names the metric."""
    width = characters_per_line(0.68 * _COLUMN_WIDTH, SMALL)
    metrics = [with_unit_of_effects(one, "the metric") if is_named else None for one in attributions]
    pairs = zip(attributions, metrics, strict=True)
    return [wrap(axis_label(one, scale, metric=metric), width, indent=0) for one, metric in pairs]


def _most_lines(texts: Sequence[str]) -> int:
    return max(len(text.splitlines()) for text in texts)


def _draw_titles(figure: Any, titles: Sequence[str]) -> None:
    """Write each column's title centred over bars and names; a long one would not fit over the bars alone."""
    from matplotlib.transforms import blended_transform_factory

    for index, (ax, title) in enumerate(zip(figure.axes, titles, strict=True)):
        ax.text(
            (index + 0.5) / len(titles),
            1.03,
            title,
            transform=blended_transform_factory(figure.transSubfigure, ax.transAxes),
            ha="center",
            fontsize=TEXT,
            parse_math=False,
        )
