"""The effects of two results side by side: which are shown, and which a render contradicts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import torch

from ..attr import SceneAttribution, have_same_baselines, lights_switched, with_different_ranges
from ..report import Table, different_values
from ..visualization import (
    Format,
    axis_label,
    caution_groups,
    caution_marks,
    first_few,
    jump_notes,
    light_notes,
    metric_unit,
    pluralize,
    prefixed,
    range_marked,
    range_notes,
    rounded,
    rounded_up,
    signed_with_error,
    unit_of_change,
)

ROWS = 10
LEADING = 5  # effects of each result that are shown whether they change or not
SMALL = 0.01  # of the largest change of an effect: smaller ones are shown of leading effects only
SIGNIFICANT = 2.0  # standard errors
ROUNDING = 1e-5  # of both effects: a difference in single precision below this is not a change
MANY_TIMES = 2.0  # a change to first order and the rendered one that differ by more contradict each other
NOISE = "◆"  # as in reports


class ComparedEffect(NamedTuple):
    """The effect of a parameter in both designs, its change, and the error of that."""

    name: str
    label: str
    before: float
    after: float
    change: float
    error: float | None

    @property
    def size(self) -> float:
        """The larger of both effects, without its sign."""
        return max(abs(self.before), abs(self.after))

    @property
    def is_clear(self) -> bool:
        """Whether the change is clear of the noise."""
        return abs(self.change) > max(SIGNIFICANT * (self.error or 0.0), ROUNDING * self.size)

    @property
    def is_equal(self) -> bool:
        """Whether both effects are equal up to rounding, and so are their replicates."""
        return max(abs(self.change), self.error or 0.0) <= ROUNDING * self.size

    def numbers(self) -> tuple[str, str, str]:
        """Return both effects and the change in one notation, with the digits that the error supports."""
        if self.is_equal:
            return rounded(self.before), rounded(self.after), "0"
        style = Format.of(max(self.size, abs(self.change)), self.error)
        change = [style.write_signed(self.change), *([style.write_error(self.error)] if self.error else [])]
        return style.write(self.before), style.write(self.after), " ± ".join(change)


def compared_effects(before: SceneAttribution, after: SceneAttribution) -> list[ComparedEffect]:
    """Return the effects of the parameters that both results have, each over its own range, the largest first.

    That of a light is from off to its value, so a light that is off in a result has no effect there.
    """
    before, after = _of_common_parameters(before, after)
    if not before:  # such as groups in one and parameters in the other: of another quantity, too
        return []
    own, others = ({row.name: row for row in one.ranking()} for one in (before, after))
    dark = [one.lights_off() for one in (before, after)]
    found = []
    for changed in (after - before).ranking():
        name, change, error = changed.name, changed.effect, changed.effect_error
        if name not in own or name not in others:
            continue  # a pose that has no derivative in one of both
        if name in dark[0] & dark[1]:
            # The difference is that of switching it on, in one design and in the other.
            change, error = 0.0, None
        first, second = own[name], others[name]
        if name in after.vectors:
            # Each effect is in a direction of its own.
            change, errors = second.effect - first.effect, (first.effect_error, second.effect_error)
            error = None if None in errors else math.hypot(*(one or 0.0 for one in errors))
        old, new = (
            0.0 if name in off else row.effect for row, off in zip((first, second), dark, strict=True)
        )
        found.append(ComparedEffect(name, second.label, old, new, change, error))
    return sorted(found, key=lambda one: -one.size)


def effect_table(
    before: SceneAttribution, after: SceneAttribution, titles: Sequence[str], *, relaxed: bool
) -> Table | None:
    """Return the table of the effects that both results have; None if there are none."""
    found = compared_effects(before, after)
    if not found:
        return None
    before, after = _without_switched(before, after)
    moved = different_values(before, after)
    off = before.lights_off() & after.lights_off()
    shown = _shown([one for one in found if one.name not in off], moved)
    names = [one.name for one in shown]
    cautions = _of_both(titles, *(caution_groups(one, names) for one in (before, after)))
    notes = _of_both(titles, *(range_notes(one, among=names) for one in (before, after)))
    marks = _marks(cautions, range_marked(notes))
    is_noisy = {one.name for one in shown if one.error and not (one.is_clear or one.is_equal)}
    rows = []
    for one in shown:
        first, second, change = one.numbers()
        label = f"{one.label} {marks[one.name]}" if one.name in marks else one.label
        rows.append((label, first, second, f"{change} {NOISE}" if one.name in is_noisy else change))
    unit = f" {unit_of_change(metric_unit(after))}".rstrip()
    below = [f"{mark} {text}" for text, mark in caution_marks(cautions).items()]
    below += [prefixed("~ ", note) for note in notes]
    of_lights = (
        light_notes(one, [row for row in one.ranking() if row.name in names]) for one in (before, after)
    )
    below += _of_both(titles, *({note: [] for note in found_notes} for found_notes in of_lights))
    below += [f"{NOISE} change within the noise"] if is_noisy else []
    if not have_same_baselines(before.info, after.info):
        baselines = (one.info.get("compared_with") or "none" for one in (before, after))
        stated = (f"{title}: {baseline}" for title, baseline in zip(titles, baselines, strict=True))
        below.append(f"compared with different baselines; {'; '.join(stated)}")
    return Table(
        f"effect: {axis_label(after, width=None, is_relaxed=relaxed)}",
        ("effect of", *titles, f"change{unit}"),
        rows,
        [*below, *_left_out([one for one in found if one not in shown], off)],
    )


def not_compared(before: SceneAttribution, after: SceneAttribution, titles: Sequence[str]) -> list[str]:
    """Return sentences for the parameters that one of the results has alone, other sizes, and poses that jump."""
    sentences = []
    for one, other, title in ((before, after, titles[0]), (after, before, titles[1])):
        if alone := [name for name in one if name not in other]:
            sentences.append(f"{_named(one, alone)} {_is(alone)} in {title} only")
    sizes = [name for name in before if name in after and before[name].shape != after[name].shape]
    if sizes:
        sentences.append(
            f"{_named(before, sizes)} {_is(sizes)} of another size in {titles[1]}, and not compared"
        )
    jumps = _of_both(
        titles, *({note.lstrip("– "): [] for note in jump_notes(one)} for one in (before, after))
    )
    return [*sentences, *jumps]


def own_ranges(before: SceneAttribution, after: SceneAttribution) -> list[str]:
    """Return sentences for the effects over different ranges in both, and for lights that are off in both."""
    names, sentences = with_different_ranges(before, after), []
    if names:
        zero = ", so 0 where it is off" if lights_switched(before, after) else ""
        sentences.append(
            f"The effect{'s' * (len(names) > 1)} of {_named(before, names)} {_is(names)} over different ranges, "
            f"each that of its own result: for a light from off to its value{zero}."
        )
    if off := [name for name in before if name in before.lights_off() & after.lights_off()]:
        one = ("its effect, from off to its value, is", "its effect if it is switched on")
        several = ("their effects, from off to their values, are", "their effects if they are switched on")
        here, alone = one if len(off) == 1 else several
        sentences.append(
            f"{_named(before, off)} {_is(off)} off in both, so in the comparison {here} 0. Each result's own "
            f"table has {alone}."
        )
    return sentences


def with_contradictions(
    before: SceneAttribution, after: SceneAttribution, rendered: tuple[float, float]
) -> tuple[SceneAttribution, SceneAttribution]:
    """Return both results with a note on the parameters that were set, where the rendered change contradicts them.

    It does if the change to first order, from the derivatives of a result, is of the other sign, or larger or
    smaller by a factor of 2. ``rendered`` is the change of the metric and its standard error.
    """
    names = different_values(before, after)
    (change, error), unit = rendered, f" {unit_of_change(metric_unit(after))}".rstrip()
    found = []
    for one in (before, after):
        predicted = _first_order_change(one, names, before, after)
        if predicted is None or not _contradicts(*predicted, change, error):
            found.append(one)
            continue
        note = (
            f"{_named(one, names)}: the derivatives at this design predict a change of "
            f"{signed_with_error(*predicted)}{unit} from the first design to the second, and rendered it is "
            f"{signed_with_error(change, error)}{unit}: the effect does not hold over the range"
        )
        found.append(dataclasses.replace(one, info={**one.info, "contradicted": {note: names}}))
    first, second = found
    return first, second


def _first_order_change(
    one: SceneAttribution, names: Sequence[str], before: SceneAttribution, after: SceneAttribution
) -> tuple[float, float] | None:
    """Return the change of the metric by the derivatives of a result, and its error; None if it is not known.

    Of a texture only the mean is known.
    """
    known = one.covariance is not None and all(name in one and one[name].ndim < 2 for name in names)
    if not names or not known or set(names) & set(one.info.get("jumps") or ()):
        return None
    totals = {row.name: row.total for row in one.ranking()}
    change, variance = 0.0, 0.0
    for name in names:
        first, second = (side.parameter_values[name].reshape(-1).double() for side in (before, after))
        step = second - first
        kept = one.info.get("kept_directions", {}).get(name) or [1] * len(step)
        if any(length for length, is_kept in zip(step.tolist(), kept, strict=True) if not is_kept):
            return None
        change += float(torch.tensor(totals[name], dtype=torch.float64) @ step)
        assert one.covariance is not None
        variance += float(step @ one.covariance[name].double() @ step)
    return change, math.sqrt(max(variance, 0.0))


def _contradicts(predicted: float, predicted_error: float, change: float, error: float) -> bool:
    """Whether two changes differ in sign, or by more than a factor of 2, clear of the errors of both."""
    sizes = [(abs(predicted), SIGNIFICANT * predicted_error), (abs(change), SIGNIFICANT * error)]
    is_opposite = predicted * change < 0 and all(size > noise for size, noise in sizes)
    return is_opposite or any(
        size - noise > MANY_TIMES * (other + other_noise)
        for (size, noise), (other, other_noise) in (sizes, sizes[::-1])
    )


def _shown(found: Sequence[ComparedEffect], moved: Sequence[str]) -> list[ComparedEffect]:
    """Return what was set, the leading effects of both results, and the largest of the other clear changes.

    What was set comes first, and then the largest clear change.
    """
    leading = [
        one.name
        for effect in (lambda one: -abs(one.before), lambda one: -abs(one.after))
        for one in sorted(found, key=effect)[:LEADING]
        if one.size
    ]
    clear = sorted((one for one in found if one.is_clear), key=lambda one: -abs(one.change))
    large = [one.name for one in clear if abs(one.change) >= SMALL * abs(clear[0].change)]
    listed = {one.name: one for one in found}
    names = [name for name in dict.fromkeys([*moved, *leading, *large]) if name in listed]
    rows = [listed[name] for name in names[:ROWS]]
    return sorted(
        rows,
        key=lambda one: (
            one.name not in moved,
            not one.is_clear,
            -abs(one.change) if one.is_clear else -one.size,
        ),
    )


def _left_out(every: Sequence[ComparedEffect], off: Collection[str] = ()) -> list[str]:
    """Return a line that counts the effects that are not shown, and says why, and those of lights that are off."""
    hidden = [one for one in every if one.name not in off]
    clear = [abs(one.change) for one in hidden if one.is_clear]
    equal = sum(one.is_equal for one in hidden)
    reasons = {
        "no change": equal,
        "a change within the noise": len(hidden) - equal - len(clear),
        f"a change of at most {rounded_up(max(clear, default=0.0), 2)}": len(clear),
    }
    parts = [f"{count} with {reason}" for reason, count in reasons.items() if count]
    if len(hidden) < len(every):
        parts.append(f"{len(every) - len(hidden)} of lights that are off")
    if not parts:
        return []
    which = f", {', '.join(parts)}" if len(parts) > 1 else parts[0].removeprefix(f"{len(every)}")
    return [f"not shown: {pluralize(len(every), 'effect')}{which}"]


def _marks(cautions: Mapping[str, Sequence[str]], noted: Collection[str]) -> dict[str, str]:
    """Return the marks of the parameters that have any: those of their cautions, and ``~``."""
    marks: dict[str, str] = {}
    for text, mark in caution_marks(cautions).items():
        marks |= {name: f"{marks.get(name, '')}{mark}" for name in cautions[text]}
    return marks | {name: f"{marks.get(name, '')}~" for name in noted}


def _of_both(
    titles: Sequence[str], first: Mapping[str, list[str]], second: Mapping[str, list[str]]
) -> dict[str, list[str]]:
    """Return the notes of both results, with their parameters; those of one alone begin with its title."""
    found: dict[str, list[str]] = {}
    for title, notes in zip(titles, (first, second), strict=True):
        for text, names in notes.items():
            note = text if text in first and text in second else prefixed(f"{title}: ", text)
            found[note] = list(dict.fromkeys([*found.get(note, []), *names]))
    return found


def _named(one: SceneAttribution, names: Sequence[str]) -> str:
    """Return the labels of the first few parameters, and how many more there are."""
    # A label may have a comma or a colon.
    return first_few([one.labels.get(name, name) for name in names], "; ")


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _without_switched(
    before: SceneAttribution, after: SceneAttribution
) -> tuple[SceneAttribution, SceneAttribution]:
    """Return both results without their notes on the lights that were switched: what these contribute is shown."""
    switched = lights_switched(before, after)
    first, second = (
        dataclasses.replace(one, info={**one.info, "lights_off": sorted(one.lights_off() - switched)})
        for one in (before, after)
    )
    return first, second


def _of_common_parameters(
    before: SceneAttribution, after: SceneAttribution
) -> tuple[SceneAttribution, SceneAttribution]:
    """Return both results with the parameters that they share."""
    names = [name for name in before if name in after and before[name].shape == after[name].shape]
    first, second = (
        dataclasses.replace(one, attributions={name: one[name] for name in names}) for one in (before, after)
    )
    return first, second
