"""What belongs to the value of a cell: whether it is relaxed, and what it takes for granted of the scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch

from ..daylight import DaylightMetric
from ..estimation import TargetedMetric
from ..explanation import (
    FACTOR,
    has_absolute_threshold,
    near_threshold_note,
    photometric_premises,
    relative_rating,
    states_definition,
)
from ..metrics import GlareRating
from ..rendering import SceneRenderer
from ..visualization import group_by_text, pluralize
from ._cell_effects import CellResults
from ._recipe import Cell

RELAXED = (
    "this rating is relaxed near the threshold, and has no class here: explain and compare state the value by "
    "the definition"
)
RELAXED_DAYLIGHT = (
    "this value is relaxed, and has no class here: the command daylight states the value by the definition"
)
IN_TABLE = f"the table of cells has the rating with a threshold of {FACTOR:g} times the mean luminance, too"
MOST_NOTES = 8  # of a study: some have a number of their own in each cell


def described(
    metric: TargetedMetric,
    image: torch.Tensor,
    shown: torch.Tensor,
    value: float,
    info: Mapping[str, Any],
    renderer: SceneRenderer,
) -> dict[str, Any]:
    """Return measure, verdict and notes of a cell; ``info`` has what the metric says of the value itself.

    ``shown`` is the picture that is rated, if the image is denoised for that.

    A relaxed metric is called so, a glare rating only with its main source near the threshold. It has no class:
    that of the value by the definition may be another one. The rating by the other threshold is a number of its
    own, too, for tables.
    """
    measure, verdict = info["measure"], info["verdict"] or ""
    notes = photometric_premises(metric.metric, image, value, shown, renderer)
    if states_definition(metric, shown):
        measure, verdict = {**measure, "name": f"{measure['name']}, relaxed"}, ""
        notes = (RELAXED if isinstance(metric.metric, GlareRating) else RELAXED_DAYLIGHT, *notes)
    if isinstance(metric.metric, DaylightMetric):
        weather, caution = metric.metric.sky.weather, getattr(metric.metric, "caution", None)
        of_sky = None if weather is None else f"weather: {weather.place}"
        notes = (*notes, *(note for note in (caution, of_sky) if note))
    said = {"measure": measure, "verdict": verdict, "notes": list(notes)}
    if not has_absolute_threshold(metric.metric):
        return said
    near = near_threshold_note(metric.metric, shown)
    return {**said, "relative_rating": relative_rating(metric.metric, shown), "threshold_note": near}


def notes_of(result: CellResults, cells: Iterable[Cell]) -> list[str]:
    """Return the notes on the values of some cells, each with the cells that it is of."""
    pairs = [(str(cell), note) for cell in cells for note in _notes(result.numbers(cell))]
    grouped = group_by_text(pairs)
    lines = [f"{note} ({_which(names)})" for note, names in grouped.items()]
    more = len(lines) - MOST_NOTES
    return lines if more <= 0 else [*lines[:MOST_NOTES], f"{pluralize(more, 'more note')} on single cells"]


def _notes(numbers: Mapping[str, Any]) -> list[str]:
    """Return the notes of a cell, with the rating by the other threshold left to the table."""
    notes, near = numbers.get("notes", []), numbers.get("threshold_note")
    return [f"{near}; {IN_TABLE}" if near and note.startswith(near) else note for note in notes]


def _which(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {pluralize(len(names) - 1, 'more cell')}"
