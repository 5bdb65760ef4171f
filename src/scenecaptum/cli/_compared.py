"""What ``compare`` found, as text and as plain values."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from .. import metrics
from ..attr import Definition, Explanation, SceneAttribution, are_far_apart, lacks_much
from ..explanation import TOO_LOW
from ..report import Table, different_values
from ..scene import pose_component, with_unit
from ..visualization import (
    advised,
    format_with_error,
    grid,
    metric_name,
    metric_unit,
    noise_notes,
    rounded,
    signed_roughly,
    signed_with_error,
    terminal_width,
    unit_of_change,
    wrapped_lines,
)
from ._compared_effects import (
    SIGNIFICANT,
    compared_effects,
    effect_table,
    not_compared,
    own_ranges,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Settings on which a value depends, by their key in ``info``, and their names.
SETTINGS = {"resolution": "resolution", "sensor": "camera", "max_depth": "max depth"}
ROWS = 10
WIDTH = 100  # of sentences, without a terminal
SAVED = (
    "Both values are relaxed near the threshold, which only serves the derivatives. The change by the definition "
    "was not computed."
)
COMPARE_SCENES = "Compare the scenes, not saved results, to get the change by the definition."
RELAXED = "The effects are those of the relaxed metric, which only serves the derivatives"
FAR_APART = (
    "The main source is so close to the threshold that both changes depend on it more than on the scene"
)
SAVED_LACK = (
    "caution: both ratings are too low because of the edges of lamps, by different amounts; the change lacks the "
    "difference"
)
OPPOSITE = "caution: the direction of this change depends on the threshold"


@dataclass(frozen=True)
class Side:
    """What belongs to one of the two results: its plan, its value by the definition, and its premises.

    ``on_page`` has the premises of which the terminal was warned before, and ``missing`` is what a glare rating
    lacks of lamps that cover pixels in part. A saved result has none of these.
    """

    plan: Figure | None = None
    definition: Definition | None = None
    premises: Sequence[str] = ()
    on_page: Sequence[str] = ()
    missing: float = 0.0
    is_saved: bool = False


@dataclass(frozen=True)
class Compared:
    """Two results of one metric, their titles, and the change of the metric with its standard error.

    ``measured`` says how, where the change is not the difference of the two values. Of metrics of daylight, also
    the change by the definition and its error. ``sides`` have what belongs to each result.
    """

    before: SceneAttribution
    after: SceneAttribution
    titles: Sequence[str]
    change: float
    error: float | None
    sides: Sequence[Side]
    measured: str = ""
    by_definition: tuple[float, float | None] | None = None

    def notes(self) -> list[str]:
        """Return what belongs to the change: how it was measured, that of the relaxed metric, and cautions."""
        return [
            *filter(
                None,
                (self.measured, self.relaxed(), self.opposite(), self.lacking(), self.different_settings()),
            ),
            *own_ranges(self.before, self.after),
            *not_compared(self.before, self.after, self.titles),
        ]

    def opposite(self) -> str:
        """Return a caution if the relaxed metric rises and the value by the definition falls, or the reverse."""
        if self.by_definition is None:
            return ""
        changes = (self.by_definition, (self.change, self.error))
        is_clear = all(abs(change) > SIGNIFICANT * (error or 0.0) for change, error in changes)
        return OPPOSITE if is_clear and self.by_definition[0] * self.change < 0 else ""

    def lacking(self) -> str:
        """Return a caution if the change lacks much at the edges of lamps, with about what it is with them.

        What a saved result lacks is known from its cautions only.
        """
        if not any(side.is_saved for side in self.sides):
            first, second = (side.missing for side in self.sides)
            change, error = self.by_definition or (self.change, self.error)
            if not lacks_much(second - first, change, error):
                return ""
            lacks = [
                f"{title}: by about {rounded(side.missing, 2)}"
                for side, title in zip(self.sides, self.titles, strict=True)
            ]
            return (
                f"caution: the edges of lamps lower the ratings ({'; '.join(lacks)}): without that, the change is "
                f"about {signed_roughly(change + second - first)}"
            )
        of_first, of_second = (
            [text for text in (*noise_notes(one), *side.premises) if TOO_LOW in text]
            for one, side in zip((self.before, self.after), self.sides, strict=True)
        )
        return SAVED_LACK if of_first != of_second else ""

    def different_settings(self) -> str:
        """Return a caution that names the settings by which the two results differ; empty if there are none."""
        changed = different_values(self.before, self.after)
        # The camera that a design moves is listed as what it sets.
        is_moved = any(name.startswith("camera.") and pose_component(name) for name in changed)
        different = [
            f"{name} {' against '.join(values)}"
            for key, name in SETTINGS.items()
            if not (key == "sensor" and is_moved)
            and all(values := _different_settings(self.before, self.after, key))
        ]
        if not different:
            return ""
        return f"caution: made with different settings, which are part of the change: {'; '.join(different)}"

    def premises(self) -> list[str]:
        """Return cautions of both results, and what they were computed for.

        What holds for one of them alone begins with its title.
        """
        first, second = (
            [*noise_notes(one), *side.premises]
            for one, side in zip((self.before, self.after), self.sides, strict=True)
        )
        return [
            text if text in first and text in second else f"{title}: {text}"
            for title, own, others in zip(self.titles, (first, second), ((), first), strict=True)
            for text in own
            if text not in others
        ]

    def relaxed(self) -> str:
        """Return the change of the relaxed metric in a sentence; empty if the metric is not relaxed."""
        if self.by_definition is None:
            return SAVED if self.are_relaxed_ratings() else ""
        unit = unit_of_change(metric_unit(self.before))
        change = f"{signed_with_error(self.change, self.error)} {unit}".rstrip()
        exact, exact_error = self.by_definition
        stated = f"{RELAXED}: it changes by {change}."
        if not (_is_glare_rating(self.before) and are_far_apart(self.change, exact, self.error, exact_error)):
            return stated
        return advised(f"{stated} {FAR_APART}", "compare with --threshold-factor 5", ": ")

    def are_relaxed_ratings(self) -> bool:
        """Whether the two values are relaxed ratings of glare, as one that was saved is."""
        return any(side.is_saved for side in self.sides) and _is_glare_rating(self.before)

    def effects(self) -> Table | None:
        """Return the effects of both results beside each other; None if they share no parameter."""
        return effect_table(self.before, self.after, self.titles, relaxed=self.by_definition is not None)

    def shown(self) -> list[Explanation]:
        """Return both results for the page, with what belongs to their values; a relaxed rating has no class."""
        results = [self.before, self.after]
        if self.are_relaxed_ratings():
            results = [dataclasses.replace(one, info={**one.info, "verdict": ""}) for one in results]
        return [
            Explanation(one, definition=side.definition, premises=(*side.premises, *side.on_page), count=0)
            for one, side in zip(results, self.sides, strict=True)
        ]


def lines(found: Compared) -> list[str]:
    """Return the comparison as text: the metric, the values that differ, and the effects."""
    before, after = found.before, found.after
    suffix = f" {unit_of_change(metric_unit(before))}".rstrip()
    text = [
        *(line for text in _value_lines(found) for line in wrapped_lines(text, _width(), indent=4)),
        f"change: {signed_with_error(*(found.by_definition or (found.change, found.error)))}{suffix}",
        *(line for note in found.notes() for line in _note(note)),
        *(_note(COMPARE_SCENES) if SAVED in found.notes() else []),
        *(line for text in found.premises() for line in wrapped_lines(text, _width(), indent=4)),
    ]
    moved = [
        (
            with_unit(before.labels.get(name, name), name),
            *(_values(one.parameter_values[name]) for one in (before, after)),
        )
        for name in different_values(before, after)
    ]
    if moved:
        text += ["", *grid(("parameter", *found.titles), moved[:ROWS])]
    if (table := found.effects()) is None:
        return text
    head = ["", *wrapped_lines(table.caption, _width(), indent=4)]
    return [
        *text,
        *head,
        *grid(table.columns, table.rows),
        *(line for note in table.notes for line in _note(note)),
    ]


def _value_lines(found: Compared) -> list[str]:
    """Return both values, each with its title and its class, which a relaxed rating has not."""
    lines = []
    for title, shown, side in zip(found.titles, found.shown(), found.sides, strict=True):
        value = f"{title}: {_value(shown, side)}{', relaxed' if found.are_relaxed_ratings() else ''}"
        lines.append(": ".join(filter(None, [value, shown.rating()])))
    return lines


def _value(shown: Explanation, side: Side) -> str:
    """Return the metric and its value; by the definition, with the relaxed one behind it, if there are two."""
    headline, attribution = shown.headline(), shown.attribution
    if side.definition is None:
        return headline
    relaxed = format_with_error(attribution.metric_value, attribution.metric_standard_error)
    relaxed = f"{relaxed} {metric_unit(attribution)}".rstrip()
    return f"{headline} by the definition (relaxed {relaxed})"


def _is_glare_rating(attribution: SceneAttribution) -> bool:
    """Whether a result is of a rating of glare, also if it was saved."""
    rating = getattr(metrics, str(attribution.info.get("metric")), None)
    return isinstance(rating, type) and issubclass(rating, metrics.GlareRating)


def _different_settings(before: SceneAttribution, after: SceneAttribution, key: str) -> list[str]:
    """Return a setting of two results in words, what differs of it; empty where it is equal or not known."""
    values = [_setting(one, key) for one in (before, after)]
    if not all(values):
        return ["", ""]
    parts, others = (value.split(", ") for value in values)
    different = [
        ", ".join(part for part in own if part not in rest)
        for own, rest in ((parts, others), (others, parts))
    ]
    return different if all(different) or parts == others else values


def _setting(attribution: SceneAttribution, key: str) -> str:
    """Return a setting of a result in words; empty if it is not known."""
    value = attribution.info.get(key)
    if key == "resolution" and value is not None:
        return "×".join(map(str, value))
    return "no limit" if value == -1 else str("" if value is None else value)


def _note(text: str) -> list[str]:
    """Return a sentence as indented lines."""
    return wrapped_lines(f"  {text}", _width(), indent=2) if text else []


def _width() -> int:
    return max(terminal_width() or WIDTH, 40)


def numbers(found: Compared) -> dict[str, Any]:
    """Return the comparison as plain values."""
    before, after = found.before, found.after
    return {
        "metric": metric_name(before),
        "unit": metric_unit(before),
        "results": [
            {
                "title": title,
                "value": one.metric_value,
                "standard_error": one.metric_standard_error,
                "definition": None if side.definition is None else vars(side.definition),
            }
            for title, one, side in zip(found.titles, (before, after), found.sides, strict=True)
        ],
        "change": {
            "value": found.change,
            "standard_error": found.error,
            "definition": None
            if found.by_definition is None
            else dict(zip(("value", "error"), found.by_definition, strict=True)),
        },
        "values": {
            name: [one.parameter_values[name].tolist() for one in (before, after)]
            for name in different_values(before, after)
        },
        "notes": found.notes(),
        "effects": [
            {
                "name": one.name,
                "label": one.label,
                "before": one.before,
                "after": one.after,
                "change": one.change,
                "standard_error": one.error,
                "is_clear": one.is_clear,
            }
            for one in compared_effects(before, after)
        ],
    }


def _values(value: torch.Tensor) -> str:
    return " ".join(rounded(number, 4) for number in value.flatten().tolist())
