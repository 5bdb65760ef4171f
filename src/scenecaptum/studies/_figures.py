"""Figures of a study: an effect by room, the stability of rankings, and the maps of rooms and cameras."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..attr import SceneAttribution
from ..errors import SceneCaptumError
from ..projection import DEFAULT_NORM, heatmap, objects_of_unclear_sign, shared_maximum
from ..ranks import kendall_tau
from ..visualization import (
    DEFAULT_TOP,
    LOWERS,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    add_footnotes,
    axes_or_new,
    characters_per_line,
    draw_colorbar,
    draw_overlay,
    figure_of,
    first,
    format_with_error,
    metric_name,
    metric_unit,
    name_rows,
    new_figure,
    pack,
    pluralize,
    rounded,
    shorten,
    sign_labels,
    signed_with_error,
    style_axes,
    unit_of_change,
    wrapped_lines,
    write_at,
    write_header,
)
from ._cell_effects import KIND, CellResults, Group, cell_effects, selected_cells
from ._random_effects import RoomEffect
from ._recipe import Cell, camera_name
from ._summary import GroupEffect, Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

MIN_GROUPS = 3  # of a ranking that is compared
MAX_PAIRS = 2000  # of cells, for each source of variation
_COLORBAR = 0.14  # width in inches
_NAME_WIDTH = 28
_BELOW = 0.3  # a dot: where the marks of its cameras are, in rows
_COLORS = {1: RAISES, -1: LOWERS, 0: UNCLEAR}
_MEANS = ("mean of all rooms", "a new room")
_SOURCES = {
    "seed": "seeds",
    "camera": "cameras",
    "scene": "rooms",
    "metric": "metrics",
    "design": "designs",
    "method": "methods",
}


def plot_effect_by_room(
    summary: Summary,
    group: str | None = None,
    top: int | None = DEFAULT_TOP,
    *,
    ax: Axes | None = None,
    metric: str | None = None,
    design: str | None = None,
    method: str | None = None,
) -> Figure:
    """Plot the effect of a group of parameters in each room, the largest on top, and below them the mean.

    A dot is the mean over the cameras of a room, with its 95 % interval from the noise of the renders; it is grey
    if this includes 0. Small marks below it are its cameras. The diamond is the interval of the mean of all rooms,
    and the line below it that of the effect in a new room, as in `GroupEffect`.

    Parameters
    ----------
    summary
        What ``StudyResult.summary`` returns.
    group
        Name of the group; by default the one with the largest mean effect.
    top
        Number of rooms, those with the largest effects; None for all.
    ax
        Axes to draw into; by default those of a new figure.
    metric, design, method
        Names in the study; needed if the summary has several.

    Raises
    ------
    SceneCaptumError
        If the summary has no such row, or several.
    """
    row = summary.row(group, metric=metric, design=design, method=method)
    rooms = first(sorted(row.rooms, key=lambda room: -abs(room.effect)), top)
    rooms = sorted(rooms, key=lambda room: -room.effect)
    title = wrapped_lines(_finding(row), characters_per_line(0.68 * WIDTH, TITLE))
    label = wrapped_lines(row.quantity.label, characters_per_line(0.6 * WIDTH, TEXT))
    means = _MEANS[: 2 if row.new_low is not None else 1 if row.low is not None else 0]
    height = 1.25 + 0.17 * (len(title) + len(label)) + 0.22 * max(len(rooms) + len(means), 2)
    ax = axes_or_new(ax, WIDTH, height)
    style_axes(ax, x="\n".join(label))
    for place, room in enumerate(rooms):
        _draw_room(ax, room, place)
    name_rows(ax, [*shorten([room.room for room in rooms], _NAME_WIDTH), *means])
    _draw_means(ax, row, len(rooms), means)
    ax.axvline(0, color=UNCLEAR, linewidth=0.8, zorder=0)
    ax.margins(x=0.05)
    write_header(ax, "\n".join(title), handles=_legend(row, rooms), columns=2)
    hidden = len(row.rooms) - len(rooms)
    notes = [
        _intervals(rooms, means),
        f"{pluralize(hidden, 'room')} with smaller effects not shown" if hidden else "",
        *row.unknowns,
    ]
    lines = [line for note in filter(None, notes) for line in wrapped_lines(note, 90)]
    if lines:
        add_footnotes(ax, lines, below=24 + 1.25 * TEXT * len(label))
    return figure_of(ax)


def _finding(row: GroupEffect) -> str:
    """Return what the figure shows, as a sentence."""
    count = len(row.rooms)
    mean = (
        f"{signed_with_error(row.mean, row.error or row.rooms[0].error)} {unit_of_change(row.unit)}".strip()
    )
    name = shorten([row.label], _NAME_WIDTH)[0]
    if count == 1:
        return f"{name}: {mean} in the only room"
    signs = {"positive": row.raises, "negative": row.lowers}
    parts = [f"{sign} in {rooms}" for sign, rooms in signs.items() if rooms]
    of_none = (
        "no clear sign in any" if any(room.effect or room.error for room in row.rooms) else "exactly 0 in all"
    )
    return f"{name}: {' and '.join(parts) or of_none} of {count} rooms, mean {mean}"


def _intervals(rooms: Sequence[RoomEffect], means: Sequence[str]) -> str:
    """Return what the bars of the rooms and the marks below them are; empty if there are none."""
    drawn = ["bar: {}of the noise"] if any(room.low is not None for room in rooms) else []
    drawn += ["diamond: {}of the mean", "line: {}of a new room"][: len(means)]
    # What they have in common is said of the first.
    return "; ".join(text.format("" if place else "95 % interval ") for place, text in enumerate(drawn))


def _draw_room(ax: Axes, room: RoomEffect, place: int) -> None:
    color = _COLORS[room.sign]
    if len(room.cameras) > 1:
        # Behind the dot, those of like effects could not be seen.
        below = [place + _BELOW] * len(room.cameras)
        ax.plot([*room.cameras.values()], below, "|", color=color, markersize=4.5, alpha=0.7)
    if room.low is not None and room.high is not None:
        ax.plot([room.low, room.high], [place, place], color=color, linewidth=1.4, solid_capstyle="butt")
    ax.plot([room.effect], [place], "o", color=color, markersize=4.5)


def _draw_means(ax: Axes, row: GroupEffect, below: int, means: Sequence[str]) -> None:
    """Draw the mean as a diamond as wide as its interval, and the interval of a new room as a line."""
    ink = ax.xaxis.label.get_color()
    if row.low is not None and row.high is not None:
        corners = [(row.low, below), (row.mean, below - 0.26), (row.high, below), (row.mean, below + 0.26)]
        ax.fill(*zip(*corners, strict=True), color=ink, linewidth=0)
        ax.axhline(below - 0.5, color=UNCLEAR, linewidth=0.6)
    if row.new_low is not None and row.new_high is not None:
        ax.plot([row.new_low, row.new_high], [below + 1] * 2, color=ink, linewidth=1.0)


def _legend(row: GroupEffect, rooms: Sequence[RoomEffect]) -> list[Any]:
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"linewidth": 1.4, "marker": "o", "markersize": 4.5}
    signs = row.quantity.signs or ("positive", "negative")
    meanings = {1: signs[0], -1: signs[1], 0: "sign lost in the noise"}
    present = {room.sign for room in rooms if room.sign or room.is_unclear}
    entries = [
        Line2D([], [], color=_COLORS[s], label=text, **style) for s, text in meanings.items() if s in present
    ]
    if any(len(room.cameras) > 1 for room in rooms):
        entries.append(
            Line2D([], [], color=UNCLEAR, marker="|", linestyle="none", label="cameras of the room")
        )
    return entries


def plot_rank_stability(
    result: CellResults,
    group: Group = KIND,
    *,
    ax: Axes | None = None,
    metric: str | None = None,
    design: str | None = None,
    method: str | None = None,
) -> Figure:
    """Plot how alike pairs of cells rank the groups of parameters, by what the two cells differ in.

    Each dot is Kendall's τ of two cells that differ in their seed only, in their camera only, in their room only,
    and so on: 1 for the same order of the magnitudes of the effects, 0 for unrelated orders, −1 for the reverse.
    Bars are means. Cells that differ in their seed show what the noise alone does.

    Parameters
    ----------
    result
        The study.
    group
        As for ``StudyResult.summary``. Two cells are compared by the groups that both have, at least three.
    ax
        Axes to draw into; by default those of a new figure.
    metric, design, method
        Names of the study, to compare only their cells.

    Raises
    ------
    SceneCaptumError
        If no two cells that differ in one thing share three groups, or a name or a pattern is unknown.

    References
    ----------
    Kendall, "The treatment of ties in ranking problems", Biometrika 33, 1945 (τ-b).
    """
    cells = selected_cells(result, metric=metric, design=design, method=method)
    effects: dict[Cell, dict[str, float]] = {}
    for one in cell_effects(result, cells, group):
        effects.setdefault(one.cell, {})[one.group] = abs(one.effect)
    ranked = "parameters" if group is None else "groups"
    taus, notes = _taus(effects, ranked)
    if not taus:
        advice = "" if group is None else " Use other groups, such as group=None for each parameter."
        raise SceneCaptumError(
            "The stability of a ranking needs two cells that differ in one thing only, such as their seed, and "
            f"have at least {MIN_GROUPS} {ranked} in common whose effects are not all equal.{advice}"
        )
    means = {source: sum(values) / len(values) for source, values in taus.items()}
    title = wrapped_lines(_stability_finding(means, ranked), characters_per_line(0.75 * WIDTH, TITLE))
    ax = axes_or_new(ax, WIDTH, 1.2 + 0.17 * len(title) + 0.42 * len(taus) + 0.15 * len(notes))
    style_axes(
        ax, "\n".join(title), x="Kendall's τ of two rankings: 1 the same order, 0 unrelated, −1 reversed"
    )
    for place, (source, values) in enumerate(taus.items()):
        heights = [place + 0.28 * (2 * ((k * 0.618) % 1) - 1) for k in range(len(values))]
        ax.plot(
            values,
            heights,
            "o",
            color=RAISES,
            alpha=max(0.15, min(0.7, 40 / len(values))),
            markersize=4,
            mew=0,
        )
        ax.plot([means[source]] * 2, [place - 0.36, place + 0.36], color=LOWERS, linewidth=2.2)
    name_rows(ax, [f"between {_SOURCES[s]}: {pluralize(len(v), 'pair')}" for s, v in taus.items()])
    ax.set_xlim(-1.05, 1.05)
    ax.axvline(0, color=UNCLEAR, linewidth=0.8, zorder=0)
    width = characters_per_line(0.72 * WIDTH, SMALL)
    lines = [part for line in pack(["bars: means", *notes], width) for part in wrapped_lines(line, width)]
    add_footnotes(ax, lines, below=34)
    return figure_of(ax)


def _taus(
    effects: Mapping[Cell, Mapping[str, float]], ranked: str
) -> tuple[dict[str, list[float]], list[str]]:
    """Return Kendall's τ of the pairs by their source of variation, and what was left out."""
    taus: dict[str, list[float]] = {}
    sampled, left_out = [], []
    for source, plural in _SOURCES.items():
        pairs = _pairs([*effects], source)
        if len(pairs) > MAX_PAIRS:
            sampled.append(f"drawn at random: {MAX_PAIRS} of {len(pairs)} pairs of {plural}")
            pairs = random.Random(0).sample(pairs, MAX_PAIRS)
        found = [_tau(effects[a], effects[b]) for a, b in pairs]
        kept = [tau for tau in found if not math.isnan(tau)]
        if kept:
            taus[source] = kept
        if len(kept) < len(found):
            left_out.append(f"{pluralize(len(found) - len(kept), 'pair')} of {plural}")
    reason = f"with fewer than {MIN_GROUPS} {ranked} in common, or with all effects equal"
    return taus, [*sampled, *([f"left out: {', '.join(left_out)} {reason}"] if left_out else [])]


def _pairs(cells: Sequence[Cell], source: str) -> list[tuple[Cell, Cell]]:
    """Return the pairs of cells that differ in nothing but the source."""
    alike: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        others = tuple(value for name, value in cell._asdict().items() if name != source)
        alike.setdefault(others, []).append(cell)
    return [pair for group in alike.values() for pair in itertools.combinations(group, 2)]


def _tau(a: Mapping[str, float], b: Mapping[str, float]) -> float:
    """Return Kendall's τ over common groups; NaN if these are too few, or tied in one of the cells."""
    common = [name for name in a if name in b]
    if len(common) < MIN_GROUPS:
        return math.nan
    return kendall_tau([a[name] for name in common], [b[name] for name in common])


def _stability_finding(means: Mapping[str, float], ranked: str) -> str:
    written = {
        _SOURCES[source]: rounded(means[source], 2) for source in sorted(means, key=lambda one: means[one])
    }
    if len(set(written.values())) == 1:
        return f"Rankings of the {ranked} between {', '.join(written)}: mean τ {max(written.values())}"
    (worst, low), *_, (best, high) = written.items()
    return (
        f"Rankings of the {ranked} differ most between {worst} (mean τ {low}), least between {best} ({high})"
    )


def plot_gallery(
    result: CellResults,
    top: int | None = DEFAULT_TOP,
    *,
    figure: Figure | SubFigure | None = None,
    metric: str | None = None,
    design: str | None = None,
    method: str | None = None,
    shared: bool = False,
) -> Figure:
    """Plot the render and the signed map of each room and camera, of the first seed, with the metric's value.

    Blue is where raising parameters raises the metric, orange where it lowers it.

    Parameters
    ----------
    result
        The study.
    top
        Number of rooms, the first of the study; None for all.
    figure
        Figure or subfigure to draw into; by default a new one.
    metric, design, method
        Names of the study; by default the first of each.
    shared
        Use one scale for all maps, relative to the largest object of any. By default each has its own.

    Raises
    ------
    SceneCaptumError
        If a name is unknown, or no cell has a picture, as with sensor grids.
    """
    cells = selected_cells(result, metric=metric, design=design, method=method)
    of_question = [cell for cell in cells if cell[2:5] == cells[0][2:5]]
    names = list(dict.fromkeys(cell.scene for cell in of_question))
    shown = first(names, top)
    cameras = list(dict.fromkeys(cell.camera for cell in of_question))
    places: dict[tuple[str, str], SceneAttribution] = {}
    for cell in of_question:
        if cell.scene in shown and cell[:2] not in places:
            attribution = result.attribution(cell)
            if attribution.surfaces is not None and attribution.image is not None:
                places[cell[:2]] = attribution
    if not places:
        raise SceneCaptumError(
            "No cell of the study has a picture with a map of its objects, which a gallery needs."
        )
    maximum = shared_maximum(places.values()) or None if shared else None
    return _draw_gallery(places, (shown, cameras), figure, maximum, len(names) - len(shown))


def _draw_gallery(
    places: Mapping[tuple[str, str], SceneAttribution],
    names: tuple[Sequence[str], Sequence[str]],
    figure: Figure | SubFigure | None,
    maximum: float | None,
    hidden: int,
) -> Figure:
    """Draw the maps; ``names`` are those of the rooms and of the cameras."""
    rooms, cameras = names
    some = next(iter(places.values()))
    ratio = max(one.image.shape[0] / one.image.shape[1] for one in places.values() if one.image is not None)
    grid = _gallery_rows(rooms, cameras)
    columns = len(grid[0])
    width = min(2.6, max(1.5, (WIDTH - 1.0) / columns))
    above = 0.2 if len(cameras) > 1 else 0.35  # each map, in inches
    part: Any = figure or new_figure(width * columns + 1.0, (width * ratio + above) * len(grid) + 0.9)
    axes = part.subplots(len(grid), columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    mapped: Any = None
    for row, names_of_row in enumerate(grid):
        for column, (room, camera) in enumerate(names_of_row):
            attribution, ax = places.get((room, camera)), axes[row, column]
            if attribution is None:
                style: dict[str, Any] = {"ha": "center", "va": "center", "transform": ax.transAxes}
                ax.text(0.5, 0.5, "no picture", fontsize=SMALL, **style)
            else:
                colours = heatmap(attribution, signed=True, maximum=maximum)
                mapped = draw_overlay(ax, attribution, colours, signed=True)
            value = "" if attribution is None else _value(attribution)
            if len(cameras) == 1:
                value = f"{shorten([room], max(10, characters_per_line(width, SMALL)))[0]}\n{value}"
            elif row == 0:
                value = f"{_camera_name(camera)}\n{value}"
            ax.set_title(value, fontsize=SMALL, parse_math=False)
            if column == 0 and len(cameras) > 1:
                name = shorten([room], max(10, characters_per_line(width * ratio, SMALL)))[0]
                style = {"xycoords": "axes fraction", "rotation": 90, "ha": "right", "va": "center"}
                write_at(ax, name, (0, 0.5), (-5, 0), fontsize=SMALL, **style)
    inches = part.bbox.size / figure_of(part).dpi
    aspect = inches[1] / _COLORBAR
    bar = draw_colorbar(
        mapped, True, DEFAULT_NORM, ax=list(axes.flat), aspect=aspect, pad=0.02, fraction=0.05
    )
    bar.set_label(f"relative to the largest {'of all' if maximum else 'in each'}", fontsize=SMALL)
    raises, lowers = sign_labels(some) or ("positive", "negative")
    title = f"Effects of the objects in each pixel on {metric_name(some)}; blue: {raises}, orange: {lowers}"
    if any(map(objects_of_unclear_sign, places.values())):
        title += "; no colour: sign lost in the noise"
    more = [f"{pluralize(hidden, 'more room')} not shown"] if hidden else []
    lines = [*wrapped_lines(title, characters_per_line(inches[0] - 0.3, TITLE)), *more]
    part.suptitle("\n".join(lines), fontsize=TITLE, x=0.02, ha="left", parse_math=False)
    return figure_of(part)


def _gallery_rows(rooms: Sequence[str], cameras: Sequence[str]) -> list[list[tuple[str, str]]]:
    """Return room and camera of each map: a row for each room, or rooms side by side if there is one camera."""
    if len(cameras) > 1:
        return [[(room, camera) for camera in cameras] for room in rooms]
    columns = 2 if len(rooms) == 4 else min(len(rooms), 3)
    return [[(room, cameras[0]) for room in rooms[at : at + columns]] for at in range(0, len(rooms), columns)]


def _camera_name(camera: str) -> str:
    """Return the name above a column."""
    return shorten([camera_name(camera)], 24)[0]


def _value(attribution: SceneAttribution) -> str:
    value = format_with_error(attribution.metric_value, attribution.metric_standard_error)
    return f"{value} {metric_unit(attribution)}".strip()
