"""The effects of groups of parameters in each cell of a study."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, Protocol, TypeAlias

from ..attr import SceneAttribution, sum_groups
from ..errors import SceneCaptumError, near_misses
from ..estimation import channel_totals
from ..protocols import ResultKind
from ..student import degrees_of_freedom
from ..visualization import axis_label, sign_labels
from ._recipe import Cell

# How parameters of different scenes are put together.
Group: TypeAlias = "str | Mapping[str, str | Iterable[str]] | None"

KIND = "kind"
MOST = 0.7  # of a standard error: half of its variance
_GROUPED = "group"  # the kind of what a method with groups= has attributed


class CellResults(Protocol):
    """What tables and figures know of a ``StudyResult``."""

    @property
    def cells(self) -> Mapping[Cell, str]:
        """The finished cells, each with the name of its file."""

    @property
    def failures(self) -> Mapping[Cell, str]:
        """The failed cells, each with its error."""

    @property
    def missing(self) -> Sequence[Cell]:
        """The cells that have not been computed."""

    def attribution(self, cell: Cell, /) -> SceneAttribution:
        """Return the attribution of a finished cell."""

    def numbers(self, cell: Cell, /) -> dict[str, Any]:
        """Return the numbers of a finished cell."""


class Quantity(NamedTuple):
    """What the effects of a cell are: the label of an axis, and the meanings of both signs if they have any."""

    label: str
    signs: tuple[str, str] | None


class CellEffect(NamedTuple):
    """The effect of a group of parameters in a cell, with its standard error, None with a single replicate.

    ``label`` is what a reader calls the group; ``doubt`` is the reason why the error may be too small, or None;
    ``adds_losses`` says that it is a sum of losses, each by the removal of one part alone, and ``adds_errors``
    that the error is a sum of errors, an upper limit.
    """

    cell: Cell
    group: str
    label: str
    effect: float
    error: float | None
    degrees: int  # of freedom of the error
    quantity: Quantity
    doubt: str | None = None
    adds_losses: bool = False
    adds_errors: bool = False


def selected_cells(
    result: CellResults, *, metric: str | None = None, design: str | None = None, method: str | None = None
) -> list[Cell]:
    """Return the finished cells that have an attribution, of the named metric, design and method or of all.

    Raises
    ------
    SceneCaptumError
        If a name is unknown, or there is no such cell.
    """
    wanted = {"metric": metric, "design": design, "method": method}
    for axis, name in wanted.items():
        known = list(dict.fromkeys(str(getattr(cell, axis)) for cell in result.cells))
        if name is not None and name not in known:
            raise SceneCaptumError(
                f"The study has no finished cell with the {axis} {name!r}.{near_misses(name, known)} It has "
                f"{', '.join(known) or 'none at all'}."
            )
    cells = [
        cell
        for cell in result.cells
        if all(name is None or getattr(cell, axis) == name for axis, name in wanted.items())
        and result.numbers(cell)["rows"]
    ]
    if not cells:
        raise SceneCaptumError(
            "The study has no finished cell with an attribution: cells of the method 'value' have a number only."
        )
    return cells


def cell_effects(result: CellResults, cells: Sequence[Cell], group: Group) -> list[CellEffect]:
    """Return the effect of each group in each cell that has some of its members.

    Parameters
    ----------
    result, cells
        The study, and those of its cells to read.
    group
        As for ``StudyResult.summary``.

    Raises
    ------
    SceneCaptumError
        If a pattern matches no parameter of any cell, or the group is none of these.
    """
    unmatched, known = _patterns(group), set[str]()
    effects: list[CellEffect] = []
    for cell in cells:
        rows = result.numbers(cell)["rows"]
        unmatched = [one for one in unmatched if not any(_matches(row, one[1]) for row in rows)]
        if unmatched:
            known |= {name for row in rows for name in (row["name"], row["label"])}
        effects += _effects_of(cell, result.attribution(cell), _members(group, rows))
    if unmatched:
        name, pattern = unmatched[0]
        raise SceneCaptumError(
            f"The group {name!r} has the pattern {pattern!r}, which matches no name and no label of a parameter "
            f"in any cell.{near_misses(pattern, sorted(known))}"
        )
    return effects


def _effects_of(
    cell: Cell, attribution: SceneAttribution, members: Mapping[str, tuple[str, ...]]
) -> Iterator[CellEffect]:
    """Yield the sum of each group's effects; its error is that of ``sum_groups``."""
    summed = sum_groups(attribution, members)
    errors, degrees = summed.effects_error(), degrees_of_freedom(attribution.info)
    quantity = Quantity(axis_label(summed), sign_labels(summed))
    doubts = _doubts(attribution, summed, members)
    for name, effect in summed.effects().items():
        error = None if errors is None else errors[name]
        label = attribution.labels.get(name, name) if members[name] == (name,) else name
        adds_losses = sum(_parts_removed(attribution, member) for member in members[name]) > 1
        adds_errors = error is not None and len(members[name]) > 1 and name not in summed.replicates
        yield CellEffect(
            cell, name, label, effect, error, degrees, quantity, doubts.get(name), adds_losses, adds_errors
        )


def _parts_removed(attribution: SceneAttribution, name: str) -> int:
    """Return how many parts of a parameter were removed one at a time: channels of a colour, patches of a texture.

    Such losses need not add up, unlike Shapley values and what is of first order.
    """
    value = attribution[name]
    if attribution.kind is ResultKind.OCCLUSION:
        patch_texels: int = attribution.info["patch_texels"][name]
        return math.ceil(value[..., 0].numel() / patch_texels)
    if attribution.kind is ResultKind.ABLATION:
        return int(channel_totals(value).count_nonzero())
    return 0


def _doubts(
    attribution: SceneAttribution, summed: SceneAttribution, members: Mapping[str, tuple[str, ...]]
) -> dict[str, str]:
    """Return the groups whose error may be too small: their own, or that of a member with most of it."""
    alone, own, of_groups = (
        attribution.untrusted_errors(),
        attribution.effects_error(),
        summed.effects_error(),
    )
    doubts = summed.untrusted_errors()
    if own is None or of_groups is None:
        return doubts
    for group, names in members.items():
        for name in names:
            if name in alone and own[name] > MOST * of_groups[group]:
                doubts.setdefault(group, alone[name])
    return doubts


def _members(group: Group, rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """Return the names of each group's members in a cell, without groups that have none there."""
    members: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if isinstance(group, Mapping):
            for name in {name: None for name, pattern in _patterns(group) if _matches(row, pattern)}:
                members[name].append(row["name"])
        elif group == KIND and row["kind"] != _GROUPED:
            members[row["kind"]].append(row["name"])
        else:
            members[row["name"]].append(row["name"])
    return {name: tuple(names) for name, names in members.items()}


def _patterns(group: Group) -> list[tuple[str, str]]:
    """Return the patterns of each group, or none for a group that is not a mapping."""
    if group is None or group == KIND:
        return []
    if not isinstance(group, Mapping) or not group:
        raise SceneCaptumError(
            f"group must be {KIND!r}, None for each parameter alone, or a mapping from a group's name to globs, "
            f"such as {{'walls': '*wall*.reflectance.*'}}; not {group!r}."
        )
    pairs = [
        (name, one)
        for name, patterns in group.items()
        for one in ([patterns] if isinstance(patterns, str) else patterns)
    ]
    if faulty := [name for name, _ in pairs if not isinstance(name, str)] or [
        name for name, one in pairs if not isinstance(one, str)
    ]:
        raise SceneCaptumError(f"The group {faulty[0]!r} must have a name, and globs that are strings.")
    if empty := [name for name in group if name not in {name for name, _ in pairs}]:
        raise SceneCaptumError(f"The group {empty[0]!r} is empty: give it a glob, or leave it out.")
    return pairs


def _matches(row: Mapping[str, Any], pattern: str) -> bool:
    return fnmatchcase(row["name"], pattern) or fnmatchcase(row["label"], pattern)
