"""What belongs to the value of a cell: cautions, whether it is relaxed, what it takes for granted of the scene."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from ..attr import SceneAttribution
from ..estimation import TargetedMetric
from ..explanation import (
    FACTOR,
    depth_premises,
    grid_premises,
    has_absolute_threshold,
    near_threshold_note,
    photometric_premises,
    relative_rating,
    sky_premises,
    states_definition,
)
from ..metrics import GlareRating
from ..rendering import SceneRenderer
from ..visualization import CAUTION, advised, cautions_among, convergence_notes, findings, pluralize
from ._cell_effects import CellResults
from ._recipe import Cell

NOT_COMPUTED = "the value by the definition was not computed"
RELAXED = f"this rating is relaxed near the threshold, and has no class; {NOT_COMPUTED}"
RELAXED_DAYLIGHT = f"this value is relaxed, and has no class; {NOT_COMPUTED}"
IN_TABLE = f"the table of cells has the rating with a threshold of {FACTOR:g} times the mean luminance, too"
MOST_NOTES = 8  # of a study: some have a number of their own in each cell
DOES_NOT_ADD_UP = "does not add up"
INCONCLUSIVE = "inconclusive"
UNDECIDED = f"{INCONCLUSIVE} whether the effects add up"


def described(
    metric: TargetedMetric,
    image: torch.Tensor,
    shown: torch.Tensor,
    value: float,
    error: float | None,
    info: Mapping[str, Any],
    renderer: SceneRenderer,
    *,
    values: Mapping[str, torch.Tensor] | None,
    made_up: bool,
) -> dict[str, Any]:
    """Return measure, verdict, notes and cautions of a cell; ``info`` has what is known of the value itself.

    ``shown`` is the picture that is rated, if the image is denoised for that. ``values`` are those of the design.
    ``made_up`` says that the weather of a metric of daylight is.

    A relaxed metric is called so, a glare rating only with its main source near the threshold. It has no class:
    that of the value by the definition may be another one. The rating by the other threshold is a number of its
    own, too, for tables.
    """
    measure, verdict = info["measure"], info["verdict"] or ""
    notes = photometric_premises(metric.metric, image, value, error, shown, renderer, values)
    if states_definition(metric, shown):
        measure, verdict = {**measure, "name": f"relaxed {measure['name']}"}, ""
        notes = (RELAXED if isinstance(metric.metric, GlareRating) else RELAXED_DAYLIGHT, *notes)
    notes += sky_premises(metric.metric, made_up=made_up) + grid_premises(renderer) + _depth(renderer)
    picture = info.get("picture") or {}
    if caution := picture.get("caution") or metric.caution:
        notes = (advised(f"{CAUTION}{caution}", picture.get("advice"), ": "), *notes)
    said = {"measure": measure, "verdict": verdict, **_told_apart(notes)}
    if not has_absolute_threshold(metric.metric):
        return said
    near = near_threshold_note(metric.metric, shown)
    return {**said, "relative_rating": relative_rating(metric.metric, shown), "threshold_note": near}


def _told_apart(notes: Sequence[str]) -> dict[str, Any]:
    """Return notes and cautions without advice, and of those that have any their whole text."""
    plain = findings(notes)
    return {
        "notes": plain,
        "cautions": cautions_among(notes),
        "advised": {one: str(note) for one, note in zip(plain, notes, strict=True) if one != note},
    }


def _depth(renderer: SceneRenderer) -> tuple[str, ...]:
    """Return the depth of paths to a sensor grid, which no page would say, and where it is not the scene's."""
    depth = renderer.plan.max_depth
    of_grid = (f"light is followed through {depth} segments",) if renderer.has_grid and depth > 0 else ()
    return of_grid + depth_premises(renderer)


def convergence_of(attribution: SceneAttribution) -> dict[str, str]:
    """Return whether the effects of a cell add up, and the note that says so if they do not."""
    verdict = attribution.info.get("convergence") or ""
    notes = convergence_notes(attribution) if verdict == DOES_NOT_ADD_UP else []
    return {
        "convergence": verdict,
        "convergence_note": "; ".join(findings(notes)),
        "convergence_advised": "; ".join(notes),
    }


def columns_of(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Return caution and convergence of a cell, for tables; both are empty in one of an older version."""
    return {
        "caution": "; ".join(numbers.get("cautions", [])),
        "convergence": numbers.get("convergence", ""),
    }


def mark_of(numbers: Mapping[str, Any]) -> str:
    """Return what puts a cell in doubt, in a few words; empty if nothing does."""
    words = [_head(caution) for caution in numbers.get("cautions", [])]
    if numbers.get("convergence") == DOES_NOT_ADD_UP:
        words.append("the effects do not add up")
    return "; ".join(words)


def count_of_cautions(result: CellResults, cells: Iterable[Cell]) -> str:
    """Return how many cells are in doubt; empty if none is.

    Such as ``"6 of 12 cells have a caution; 1 does not add up; 2 are inconclusive whether the effects add up"``.
    """
    all_numbers = [result.numbers(cell) for cell in cells]
    verdicts = [numbers.get("convergence") for numbers in all_numbers]
    counts = (
        (sum(bool(numbers.get("cautions")) for numbers in all_numbers), "has a caution", "have a caution"),
        (verdicts.count(DOES_NOT_ADD_UP), DOES_NOT_ADD_UP, "do not add up"),
        (verdicts.count(INCONCLUSIVE), f"is {UNDECIDED}", f"are {UNDECIDED}"),
    )
    parts = [f"{count} {{}}{one if count == 1 else several}" for count, one, several in counts if count]
    # The number of all cells is said once.
    of_all = f"of {pluralize(len(all_numbers), 'cell')} "
    return "; ".join(part.format("" if index else of_all) for index, part in enumerate(parts))


def notes_of(result: CellResults, cells: Iterable[Cell], *, with_advice: bool = True) -> list[str]:
    """Return the notes on the values of some cells, each with the cells that it is of; cautions come first.

    Cautions that differ in their numbers only are one note. Pages for others are without advice.
    """
    cells = list(cells)
    kinds: dict[str, list[tuple[str, str]]] = {}
    whole: dict[str, str] = {}
    for cell in cells:
        numbers = result.numbers(cell)
        if with_advice:
            note = numbers.get("convergence_note", "")
            whole |= {**numbers.get("advised", {}), note: numbers.get("convergence_advised", note)}
        for note in _notes(numbers):
            kinds.setdefault(_kind(note), []).append((note, str(cell)))
    ordered = sorted(kinds.values(), key=lambda pairs: not _is_doubt(pairs[0][0]))
    lines = [f"{whole.get(pairs[0][0], pairs[0][0])} ({_which(pairs, len(cells))})" for pairs in ordered]
    more = len(lines) - MOST_NOTES
    return lines if more <= 0 else [*lines[:MOST_NOTES], f"{pluralize(more, 'more note')} on single cells"]


def _notes(numbers: Mapping[str, Any]) -> list[str]:
    """Return the notes of a cell, with the rating by the other threshold left to the table."""
    notes, near = numbers.get("notes", []), numbers.get("threshold_note")
    shown = [f"{near}; {IN_TABLE}" if near and note.startswith(near) else note for note in notes]
    return [*shown, *filter(None, [numbers.get("convergence_note")])]


def _is_doubt(note: str) -> bool:
    return note.startswith((CAUTION, DOES_NOT_ADD_UP))


def _kind(note: str) -> str:
    """Return what notes have in common that are one: cautions are alike up to their numbers."""
    return CAUTION + _head(note.removeprefix(CAUTION)) if _is_doubt(note) else note


def _head(text: str) -> str:
    """Return a text up to its first colon or semicolon: the numbers of a caution come after it."""
    return re.split("[:;] ", text, maxsplit=1)[0]


def _which(pairs: Sequence[tuple[str, str]], count: int) -> str:
    """Return the cells of a note, of ``count`` in all, and whether it has other numbers in some of them."""
    (note, cell), *others = pairs
    if not others:
        return cell
    numbers = ", with numbers of their own" if any(other != note for other, _ in others) else ""
    which = "all cells" if len(pairs) == count else f"{cell} and {pluralize(len(others), 'more cell')}"
    return f"{which}{numbers}"
