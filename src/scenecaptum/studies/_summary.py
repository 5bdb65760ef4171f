"""Summaries of a study: the effects of groups of parameters over all rooms."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError, near_misses
from ..visualization import (
    Format,
    advised,
    align_decimals,
    align_with_errors,
    first_few,
    grid,
    group_by_text,
    pluralize,
    rounded,
    shorten,
    terminal_width,
    wrapped_lines,
)
from . import _extras as extras
from ._cell_effects import KIND, CellEffect, CellResults, Group, Quantity, cell_effects, selected_cells
from ._notes import count_of_cautions, notes_of
from ._random_effects import MIN_ROOMS_FOR_NEW_ROOM, Combined, Observation, combine
from ._recipe import Cell

if TYPE_CHECKING:
    import pandas

_NAME_WIDTH = 32
_NOTE_WIDTH = 100  # without a terminal
_UNKNOWN = "–"
_REMOVE_TOGETHER = (
    'groups of the method, such as {"method": "ablation", "groups": "kind"}, remove them together'
)
_FEW_EFFECTIVE_ROOMS = 2.0  # below, one room has more than half of the weight


@dataclass(frozen=True)
class GroupEffect(Combined):
    """The effect of a group of parameters over all rooms, for one metric, design and method.

    What cannot be estimated is None.

    Attributes
    ----------
    mean, error
        The mean effect over the rooms, in the metric's unit, and its standard error by Hartung, Knapp, Sidik and
        Jonkman: of the mean over all rooms of which these are a sample. Rooms that agree by chance do not make it
        smaller than their noise does: the factor q is at least 1 (Knapp and Hartung's ad hoc correction).
    low, high
        95 % confidence interval of the mean (Student's t); None for two rooms of which one has nearly all the
        weight, with less than 1.5 ``effective_rooms``.
    new_low, new_high
        95 % prediction interval: where the effect in another room would be, with the same error of the mean.
    between, within
        Standard deviation between rooms (Paule and Mandel), and between the cameras of one room, both less what
        the noise adds. Their squares are the components of variance.
    noise
        Standard error of one cell, that of its renders (root mean square); from the spread of the seeds if a
        cell has no error.
    seed_spread
        Standard deviation between seeds, about as large as ``noise`` if the errors of the cells are right.
    rooms
        A `RoomEffect` for each room that has such parameters.
    effective_rooms
        By how many rooms of equal weight the mean is decided: 1 / Σ w² for weights w that add up to 1 (Kish).
    metric, design, method, group
        Names in the study, and that of the group.
    label
        What tables call the group: of a single parameter its label, where that is the same in all rooms.
    measure, unit
        What the metric measures, and its unit.
    quantity
        What the effects are: the label of an axis, and the meanings of positive and negative effects.
    adds_losses
        Whether effects are sums of losses by ablation or occlusion, each of one part that was removed alone.
    adds_errors
        Whether errors of effects are sums of those of Shapley values, which are upper limits.
    """

    metric: str
    design: str
    method: str
    group: str
    label: str
    measure: str
    unit: str
    quantity: Quantity
    adds_losses: bool
    adds_errors: bool

    @property
    def raises(self) -> int:
        """Number of rooms in which the effect is clearly positive."""
        return sum(room.sign > 0 for room in self.rooms)

    @property
    def lowers(self) -> int:
        """Number of rooms in which the effect is clearly negative."""
        return sum(room.sign < 0 for room in self.rooms)

    @property
    def is_lopsided(self) -> bool:
        """Whether one of three or more rooms has most of the weight; the 95 % interval is then very wide."""
        return len(self.rooms) >= MIN_ROOMS_FOR_NEW_ROOM and self.effective_rooms < _FEW_EFFECTIVE_ROOMS

    @property
    def unknowns(self) -> list[str]:
        """What cannot be estimated, and why."""
        count, notes = len(self.rooms), []
        if count == 1:
            notes.append(
                "one room: neither an interval of the mean nor the variance between rooms can be estimated"
            )
        elif count < MIN_ROOMS_FOR_NEW_ROOM:
            if self.low is None:
                notes.append("one of two rooms has nearly all the weight: no interval of the mean")
            notes.append(f"{count} rooms: an interval for a new room takes {MIN_ROOMS_FOR_NEW_ROOM}")
        if self.within is None:
            notes.append(
                "one camera in each room: differences between cameras are part of those between rooms"
            )
        if self.noise is None:
            notes.append(
                "one seed and no error bars: the noise is part of the differences between rooms and cameras"
            )
        return notes


@dataclass(frozen=True, repr=False)
class Summary:
    """What ``StudyResult.summary`` returns; prints as a table.

    Attributes
    ----------
    rows
        A `GroupEffect` for each metric, design, method and group; the largest mean effect first in each.
    cells
        Number of cells that it is about.
    left_out
        Number of cells that failed or have not been computed.
    doubts
        For each effect of a cell whose error may be too small: group and cell, and the reason.
    premises
        What the values of the cells take for granted, and which of them are relaxed or in doubt.
    cautions
        How many cells have a caution, and of how many the effects do not add up; empty if there is none.
    """

    rows: tuple[GroupEffect, ...]
    cells: int
    left_out: int
    doubts: tuple[tuple[str, str], ...] = ()
    premises: tuple[str, ...] = ()
    cautions: str = ""

    def text(self) -> str:
        """Return the tables that ``print`` shows, one for each metric, design and method."""
        tables = [part for _, rows in self.by_question() for part in [*_table(rows), ""]]
        width = terminal_width() or _NOTE_WIDTH
        return "\n".join(
            [*tables, *(line for note in self.notes() for line in wrapped_lines(note, width, 2))]
        )

    def by_question(self) -> Iterator[tuple[tuple[str, str, str], list[GroupEffect]]]:
        """Yield each metric, design and method with its rows."""
        for names, rows in itertools.groupby(self.rows, key=lambda row: (row.metric, row.design, row.method)):
            yield names, list(rows)

    def row(
        self,
        group: str | None = None,
        *,
        metric: str | None = None,
        design: str | None = None,
        method: str | None = None,
    ) -> GroupEffect:
        """Return the row of a group, by default of the one with the largest mean effect.

        Parameters
        ----------
        group
            Name or label of the group.
        metric, design, method
            Names in the study; needed if the summary has several.

        Raises
        ------
        SceneCaptumError
            If there is no such row, or several metrics, designs or methods have one.
        """
        rows = list(self.rows)
        if group not in {row.group for row in rows}:
            group = next((row.group for row in rows if row.label == group), group)
        wanted = {"group": group, "metric": metric, "design": design, "method": method}
        for axis, name in wanted.items():
            known = list(dict.fromkeys(getattr(row, axis) for row in rows))
            if name is not None and name not in known:
                raise SceneCaptumError(
                    f"The summary has no {axis} {name!r}.{near_misses(name, known)} It has {', '.join(known)}."
                )
            if name is None and axis != "group" and len(known) > 1:
                raise SceneCaptumError(
                    f"The summary has several {axis}s, {', '.join(known)}: choose one with {axis}=."
                )
            rows = [row for row in rows if name is None or getattr(row, axis) == name]
        return rows[0]

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the rows as a pandas DataFrame, with NaN for what cannot be estimated.

        Raises
        ------
        SceneCaptumError
            If pandas is not installed: ``pip install 'scenecaptum[studies]'``.
        """
        names = ("metric", "design", "method", "group", "measure", "unit")
        numbers = (
            "mean",
            "error",
            "low",
            "high",
            "new_low",
            "new_high",
            "between",
            "within",
            "noise",
            "seed_spread",
        )
        rows = [
            {
                **{name: getattr(row, name) for name in (*names, *numbers)},
                "rooms": len(row.rooms),
                "raises": row.raises,
                "lowers": row.lowers,
            }
            for row in self.rows
        ]
        frame = extras.pandas().DataFrame(rows)
        return frame.astype(dict.fromkeys(numbers, float))

    def notes(self) -> list[str]:
        """Return what the columns are, and what cannot be estimated."""
        notes = [
            f"from {pluralize(self.cells, 'cell')}",
            "± one standard error; 95 % intervals of the mean, and of the effect in a new room",
            "between rooms, and between cameras of one room: standard deviations, less the noise of the cells",
            "+ and −: rooms in which the effect is clearly positive or negative",
        ]
        axes = _with_several(("metric", "design", "method"), self.rows)
        named = [(" · ".join([row.label, *(getattr(row, axis) for axis in axes)]), row) for row in self.rows]
        if added := [name for name, row in named if row.adds_losses]:
            which = _where(added, named)
            sums = f"the sum of the losses of its parameters, channels or patches, each alone{which}"
            notes.append(advised(sums, _REMOVE_TOGETHER, ": "))
        if added := [name for name, row in named if row.adds_errors]:
            notes.append(
                f"of a sum of Shapley values, the noise is an upper limit{_where(added, named)}: the sum of the "
                "errors of its members, whose covariance is not known"
            )
        unknown = group_by_text((name, note) for name, row in named for note in row.unknowns)
        for note, names in unknown.items():
            notes.append(f"{_UNKNOWN} {note}{_where(names, named)}")
        if lopsided := [name for name, row in named if row.is_lopsided]:
            most = f"one room has most of the weight{_where(lopsided, named)}"
            notes.append(advised(most, "give the noisy rooms more samples", ": "))
        for reason, names in group_by_text(self.doubts).items():
            which = first_few(names, "; ")
            notes.append(
                f"the error of {pluralize(len(names), 'effect')} may be too small ({which}): {reason}"
            )
        notes += [self.cautions] if self.cautions else []
        notes += self.premises
        if self.left_out:
            notes.append(f"{pluralize(self.left_out, 'cell')} failed or missing, and left out")
        return notes

    def __str__(self) -> str:
        return self.text()

    __repr__ = __str__


def summarize_effects(
    result: CellResults,
    group: Group = KIND,
    *,
    metric: str | None = None,
    design: str | None = None,
    method: str | None = None,
) -> Summary:
    """Return the mean effects of groups of parameters over rooms; see ``StudyResult.summary``."""
    cells = selected_cells(result, metric=metric, design=design, method=method)
    questions: dict[tuple[str, ...], list[CellEffect]] = {}
    effects = cell_effects(result, cells, group)
    for one in effects:
        questions.setdefault((one.cell.metric, one.cell.design, one.cell.method, one.group), []).append(one)
    labels = _labels(effects)
    rows = [_row(result, names, labels, effects) for names, effects in questions.items()]
    order = list(dict.fromkeys(names[:3] for names in questions))
    rows.sort(key=lambda row: (order.index((row.metric, row.design, row.method)), -abs(row.mean)))
    axes = {"scene", *_with_several(Cell._fields, [one.cell for one in effects])}
    doubts = tuple((f"{labels[one.group]} in {one.cell.on(axes)}", one.doubt) for one in effects if one.doubt)
    left_out = len(result.failures) + len(result.missing)
    premises, cautions = tuple(notes_of(result, cells)), count_of_cautions(result, cells)
    return Summary(tuple(rows), len(cells), left_out, doubts, premises, cautions)


def _labels(effects: Sequence[CellEffect]) -> dict[str, str]:
    """Return the label of each group; its name where cells differ in the label, or another group shares it."""
    pairs = {(one.group, one.label) for one in effects}
    counts = Counter(group for group, _ in pairs) + Counter(f"label {label}" for _, label in pairs)
    return {
        group: label if counts[group] == counts[f"label {label}"] == 1 else group for group, label in pairs
    }


def _where(names: Sequence[str], rows: Sequence[object]) -> str:
    """Return the first of the rows that a note is about, in parentheses; empty if it is about all."""
    return "" if len(names) == len(rows) else f" ({first_few(names)})"


def _with_several(axes: Iterable[str], things: Sequence[object]) -> list[str]:
    """Return the axes on which the cells or rows differ: a name on another one tells nothing apart."""
    return [axis for axis in axes if len({getattr(one, axis) for one in things}) > 1]


def _row(
    result: CellResults, names: tuple[str, ...], labels: Mapping[str, str], effects: Sequence[CellEffect]
) -> GroupEffect:
    metric, design, method, group = names
    numbers = result.numbers(effects[0].cell)
    combined = combine(
        [Observation(one.cell.scene, one.cell.camera, one.effect, one.error, one.degrees) for one in effects]
    )
    return GroupEffect(
        **vars(combined),
        metric=metric,
        design=design,
        method=method,
        group=group,
        label=labels[group],
        measure=numbers["measure"],
        unit=numbers["unit"],
        quantity=effects[0].quantity,
        adds_losses=any(one.adds_losses for one in effects),
        adds_errors=any(one.adds_errors for one in effects),
    )


def table_columns(rows: Sequence[GroupEffect]) -> dict[str, list[str]]:
    """Return the cells of the table by column, with the decimal points of the means aligned."""
    return {
        "group": shorten([row.label for row in rows], _NAME_WIDTH),
        "mean effect": _means(rows),
        "95 % interval": [_interval(row.low, row.high) for row in rows],
        "new room": [_interval(row.new_low, row.new_high) for row in rows],
        "between rooms": _deviations([row.between for row in rows]),
        "between cameras": _deviations([row.within for row in rows]),
        "noise": _deviations([row.noise for row in rows]),
        "+": [str(row.raises) for row in rows],
        "−": [str(row.lowers) for row in rows],
        "of": [str(len(row.rooms)) for row in rows],
    }


def heading(rows: Sequence[GroupEffect]) -> str:
    """Return what the effects of a table are, with design and method where these say something."""
    return " · ".join([rows[0].quantity.label, rows[0].metric, rows[0].design, rows[0].method])


def _table(rows: Sequence[GroupEffect]) -> list[str]:
    columns: Mapping[str, list[str]] = table_columns(rows)
    return [heading(rows), "", *grid([*columns], list(zip(*columns.values(), strict=True)))]


def _means(rows: Sequence[GroupEffect]) -> list[str]:
    """Return the means with their errors; that of a single room has the digits that its noise leaves."""
    lone = {row.group: row.rooms[0].error for row in rows if row.error is None}
    written = align_with_errors([(row.mean, row.error or lone.get(row.group)) for row in rows], signed=True)
    return [
        text.partition(" ±")[0] if row.group in lone else text
        for row, text in zip(rows, written, strict=True)
    ]


def _interval(low: float | None, high: float | None) -> str:
    """Return ``'−1.2 to +3.4'``, rounded to three digits of the larger end."""
    if low is None or high is None:
        return _UNKNOWN
    size = max(abs(low), abs(high))
    style: Any = Format.of(size, None).at_most(3, size)
    return f"{style.write_signed(low)} to {style.write_signed(high)}"


def _deviations(numbers: Sequence[float | None]) -> list[str]:
    return align_decimals([_UNKNOWN if number is None else rounded(number, 2) for number in numbers])
