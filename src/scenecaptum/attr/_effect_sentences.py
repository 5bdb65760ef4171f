"""Which effects an explanation states, and which it leaves to more samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile

from ..protocols import Attribution, RankedParameter
from ..scene import pose_component
from ..student import all_clear_from, clear_from, rankable
from ..visualization import (
    advised,
    baseline_notes,
    caution_groups,
    caution_marks,
    convergence_notes,
    gradient_advice,
    jump_notes,
    light_notes,
    move,
    pluralize,
    prefixed,
    range_marked,
    range_notes,
    rounded,
    unit_notes,
    untrusted_groups,
)
from ._findings import SIGNIFICANT, Change
from ._wording import (
    change_in_words,
    effect_in_words,
    in_words,
    number_of_effect,
    unit_of_effect,
)

UNSURE_SIZE = "size uncertain"
MORE_SAMPLES = "use more samples"
MOST_SAMPLES = 100  # times those of a result: more are no advice
MOST_NAMED = 3  # of the effects that may be large


@dataclass(frozen=True)
class EffectSentences:
    """The sentences on the effects of a result: those that are clear of the noise, and what it hides.

    Attributes
    ----------
    attribution
        The result.
    changes
        Single changes that were rendered.
    count
        The number of effects that are stated; with 0, nothing is said.
    saturated
        Why a share of points has no effect at all, if it has none; else empty.
    unclear_changes
        Lines on the changes whose effects are within their noise.
    """

    attribution: Attribution
    changes: tuple[Change, ...]
    count: int
    saturated: str
    unclear_changes: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the effects that are clear, each with its marks, and what these mean."""
        if not self.count:
            return []
        clear, unclear = self._clear_and_unclear
        if not clear and self.saturated:
            return [self.saturated]
        stated = clear[: self.count]
        jumps = self._jump_lines([row.name for row in stated])
        if not stated:
            return jumps
        marks, legend = self._marks([row.name for row in stated])
        allowed = self._allowed_errors()
        lines = [
            f"{in_words(row.label)}: {effect_in_words(self.attribution, row)}{self._along(row.name)}"
            f"{f' {marks[row.name]}' if row.name in marks else ''}"
            f"{'' if _exceeds(row, allowed) else self._unsure(row.name)}"
            for row in stated
        ]
        above, below = self._larger_lines(unclear, abs(stated[0].effect))
        between = self._between_lines(unclear, stated)
        legend += [*self._floor_notes(stated), *unit_notes(self.attribution, stated)]
        legend += light_notes(self.attribution, stated)
        notes = [*legend, *self._contribution_notes(), *jumps]
        return [*above, *lines, *between, *below, *notes]

    def _floor_notes(self, stated: Sequence[RankedParameter]) -> list[str]:
        """Say of moves that point mostly up or down that the changes of the same objects are along the floor."""
        changed = {change.name for change in self.changes}
        return [
            f"{in_words(row.label)}: the change below is along the floor, not {self._along(row.name).split()[-1]}"
            for row in stated
            if row.name in changed and self._along(row.name).endswith((", up", ", down"))
        ]

    def _contribution_notes(self) -> list[str]:
        """Say what contributions are compared with, and if they do not add up or this is inconclusive."""
        adds_up = self.attribution.info.get("convergence") == "adds up"
        return [*([] if adds_up else convergence_notes(self.attribution)), *baseline_notes(self.attribution)]

    def _jump_lines(self, stated: Sequence[str]) -> list[str]:
        """Say which poses have no derivative, also of those that are stated in some directions, and why."""
        jumps = self.attribution.info.get("jumps", {})
        notes = [note.lstrip("– ") for note in jump_notes(self.attribution, {*jumps, *stated})]
        more = len(notes) - MOST_NAMED
        return (
            notes if more <= 0 else [*notes[:MOST_NAMED], f"{pluralize(more, 'other')} without a derivative"]
        )

    def _marks(self, names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
        """Return the marks behind the effects of some parameters, and a line on each mark."""
        notes = range_notes(self.attribution, among=[*names, *self.attribution.ranked_last()])
        doubts = {
            reason: whose
            for reason, whose in untrusted_groups(self.attribution).items()
            if {*whose} & {*names}
        }
        partial = self._partial(doubts)
        cautions = caution_groups(self.attribution, names)
        wrong = caution_marks(cautions)
        marks = {name: wrong[reason] for reason, whose in cautions.items() for name in whose}
        marks |= {name: f"{marks.get(name, '')}?" for whose in partial for name in whose}
        marks |= {name: f"{marks.get(name, '')}~" for name in range_marked(notes)}
        legend = [
            *(f"{mark} {reason}" for reason, mark in wrong.items()),
            *(
                f"? {reason}" if whose in partial else f"all parameters: {reason}"
                for reason, whose in doubts.items()
            ),
            *(prefixed("~ ", note) for note in notes),
        ]
        return marks, legend

    def _partial(self, doubts: Mapping[str, Sequence[str]]) -> list[Sequence[str]]:
        """Return whom each doubt is about, unless it is about all parameters: then none has a mark."""
        return [whose for whose in doubts.values() if len(whose) < len(self.attribution)]

    def _larger_lines(
        self, unclear: Sequence[RankedParameter], largest: float
    ) -> tuple[list[str], list[str]]:
        """Say which effects in the noise may exceed the largest that is stated: above those, or below.

        It stands above them if one is larger by its value, too, and that is the one that is named.
        """
        larger = sorted((row for row in unclear if _upper(row) > largest), key=_upper, reverse=True)
        if not larger:
            return [], []
        first = max(larger, key=lambda row: abs(row.effect))
        is_largest = abs(first.effect) > largest
        first, *others = [first, *(row for row in larger if row is not first)] if is_largest else larger
        more = f" and {pluralize(len(others), 'other')}" if others else ""
        named = f"{self._named(first)}{more}"
        if is_largest:
            return [f"which effect is largest is uncertain: {named} may exceed those below"], []
        return [], [f"also uncertain: {named} may exceed those above"]

    def _between_lines(
        self, unclear: Sequence[RankedParameter], stated: Sequence[RankedParameter]
    ) -> list[str]:
        """Name the uncertain effects with a clear sign that are larger than one of those that are stated."""
        largest, smallest = abs(stated[0].effect), abs(stated[-1].effect)
        errors = clear_from(self.attribution.info)
        rows = [row for row in unclear if smallest < abs(row.effect) and _upper(row) <= largest]
        named = [self._named(row) for row in rows if _exceeds(row, errors)]
        if not named:
            return []
        more = f" and {pluralize(len(named) - MOST_NAMED, 'other')}" if len(named) > MOST_NAMED else ""
        return [f"larger than the last of these, but uncertain: {', '.join(named[:MOST_NAMED])}{more}"]

    def _unsure(self, name: str) -> str:
        """Say that the size of an effect is uncertain; a pose has its largest effect, in any direction."""
        has_sign = self.attribution.kind.has_sign and pose_component(name) is None
        return f" (sign clear, {UNSURE_SIZE})" if has_sign else f" ({UNSURE_SIZE})"

    def _along(self, name: str) -> str:
        """Return the change of a pose that has its effect, such as ``" over ±0.05 units towards (0, −1, 0)"``.

        The scene is in the middle of the range.
        """
        component = pose_component(name)
        if component is None or self.attribution.scale_or_default() != "range":
            return ""
        half = self.attribution.weights()[name] / 2
        return f" over ±{move(component, half, self.attribution.info.get('up'))}"

    def unclear_lines(self) -> list[str]:
        """Return how many effects are in the noise, and the samples that would resolve them."""
        if not self.count:
            return []
        if self.attribution.covariance is None:
            if all(row.effect == 0 for row in self.attribution.ranking()):
                return []
            return ["which effects are due to noise: there are no error bars"]
        lines = [*self.unclear_changes]
        clear, unclear = self._clear_and_unclear
        if not clear and self.saturated:
            return lines
        if not clear:
            return [*lines, *self._unranked_lines(unclear)] if unclear else lines
        smallest = min(abs(row.effect) for row in clear[: self.count])
        hiding = sorted((row for row in unclear if _upper(row) > smallest), key=lambda row: -abs(row.effect))
        named = self._named_of(hiding, smallest)
        if hiding:
            lines.append(self._hiding_line(hiding, named, smallest))
        return [*lines, *self._lines_on_signs([row for row in unclear if row not in named], len(clear))]

    def _lines_on_signs(self, rows: Sequence[RankedParameter], count: int) -> list[str]:
        """Name the effects that are not stated although their signs are clear in the table.

        Not those whose error is itself unreliable: how many errors they are from 0 says little.
        """
        errors = clear_from(self.attribution.info)
        doubted = {name for whose in self._partial(untrusted_groups(self.attribution)) for name in whose}
        clear_rows = [row for row in rows if _exceeds(row, errors) and row.name not in doubted]
        seen = [self._named(row) for row in clear_rows]
        if not seen or count >= self.count:
            return []
        # That of a pose is its largest effect in any direction, which has no sign.
        has_sign = self.attribution.kind.has_sign and not any(pose_component(row.name) for row in clear_rows)
        clear = "clear in sign" if has_sign else "above the noise"
        more = f" and {pluralize(len(seen) - MOST_NAMED, 'other')}" if len(seen) > MOST_NAMED else ""
        line = f"how the others rank; {clear}: {', '.join(seen[:MOST_NAMED])}{more}"
        # Where the effect of a light is stated, the legend has the note.
        is_noted = light_notes(self.attribution, self._clear_and_unclear[0][: self.count])
        return [line, *([] if is_noted else light_notes(self.attribution, clear_rows[:MOST_NAMED]))]

    def _unranked_lines(self, unclear: Sequence[RankedParameter]) -> list[str]:
        """Say that no effect stands out among all of them, and which changes are clear, as rendered."""
        unranked = (
            f"which of {pluralize(len(unclear), 'parameter')} matter most: no effect is clear enough to rank"
        )
        notes: list[str] = []
        if len(unclear) == 1:
            (one,) = unclear
            effect = f"its effect of {effect_in_words(self.attribution, one)} is not clear of its noise"
            unranked = f"whether {in_words(one.label)} matters: {effect}"
            notes = [f"! {reason}" for reason in caution_groups(self.attribution, [one.name])]
        rendered = [
            (in_words(one.label), change_in_words(self.attribution, one.measured, one.measured_error))
            for one in self.changes
            if one.measured is not None and one.is_clear
        ]
        # Where an effect is stated, the legend of these has the notes on what ranks last.
        last = self.attribution.ranked_last()
        notes += [
            note for note, whose in range_notes(self.attribution, among=last).items() if last & {*whose}
        ]
        listed = ", ".join(f"{whose} ({effect})" for whose, effect in rendered)
        seen = f", but rendered changes are clear: {listed}" if rendered else ""
        advice = gradient_advice(self.attribution) or MORE_SAMPLES
        return [advised(f"{unranked}{seen}", advice), *notes]

    def _named_of(self, hiding: Sequence[RankedParameter], smallest: float) -> list[RankedParameter]:
        """Return the effects that are named, of those that may be as large as the smallest that is stated."""
        if len(hiding) == 1:
            return [*hiding]

        def says_something(row: RankedParameter) -> bool:
            return abs(row.effect) > smallest or _exceeds(row, SIGNIFICANT)

        return list(takewhile(says_something, hiding[:MOST_NAMED]))

    def _hiding_line(
        self, hiding: Sequence[RankedParameter], leading: Sequence[RankedParameter], smallest: float
    ) -> str:
        """Say which effects may be as large as the smallest that is stated, and what would tell.

        ``leading`` are the largest of them that are named.
        """
        named = [self._named(row) for row in leading]
        which = named[0] if len(hiding) == 1 else pluralize(len(hiding), "parameter")
        listed = f"; the largest: {', '.join(named)}" if len(hiding) > 1 and named else ""
        size = f"{rounded(smallest, 2)} {unit_of_effect(self.attribution)}".rstrip()
        remedy = self._remedy(hiding, leading, smallest)
        return advised(f"{which} may have an effect of {size} or more within two errors{listed}", remedy)

    def _remedy(
        self, hiding: Sequence[RankedParameter], leading: Sequence[RankedParameter], smallest: float
    ) -> str:
        """Return what would tell: the samples, but of a rough gradient what the metric advises.

        Of a picture that is too noisy the caution says how many it needs: two numbers would contradict each other.
        """
        if (self.attribution.info.get("picture") or {}).get("advice"):
            return ""
        if self.attribution.info.get("gradient_note") and gradient_advice(self.attribution):
            return gradient_advice(self.attribution)
        all_told = self._more_samples(max(row.effect_error or 0.0 for row in hiding), smallest)
        if all_told <= MOST_SAMPLES:
            return f"{all_told} times the samples would tell"
        # One with a large error does not decide for the others.
        if leading and leading[0].effect:
            first_told = self._more_samples(leading[0].effect_error or 0.0, abs(leading[0].effect))
            if first_told <= MOST_SAMPLES:
                return f"{first_told} times the samples would tell of {in_words(leading[0].label)}"
        return "this cannot be resolved with a reasonable number of samples"

    def _named(self, row: RankedParameter) -> str:
        return f"{in_words(row.label)} ({number_of_effect(self.attribution, row)})"

    def _more_samples(self, error: float, effect: float) -> int:
        """Return how many times the samples would take an effect clear of its error, at least 2."""
        return max(2, math.ceil((self._allowed_errors() * error / effect) ** 2))

    @cached_property
    def _clear_and_unclear(self) -> tuple[list[RankedParameter], list[RankedParameter]]:
        """Return the effects that are stated, and the others that are not 0.

        Also stated are effects whose sign a render of the change confirms. What a render shows clear, but with the
        other sign, is neither. Lights that rank last are left out: their effects may be far off.
        """
        ranking, last = self.attribution.ranking(), self.attribution.ranked_last()
        rows = [row for row in ranking if row.effect and row.name not in last]
        rendered = {one.name: one for one in self.changes if one.measured is not None and one.is_clear}
        confirmed = {name for name, one in rendered.items() if (one.measured or 0.0) * one.predicted > 0}
        stated = rankable(
            {row.name: abs(row.effect) for row in rows},
            {row.name: row.effect_error for row in ranking},
            self.attribution.info,
            known=confirmed,
        )
        allowed = self._allowed_errors()
        contradicted = rendered.keys() - confirmed
        stated -= {row.name for row in rows if row.name in contradicted and not _exceeds(row, allowed)}
        clear = [row for row in rows if row.name in stated]
        return clear, [row for row in rows if row.name not in {*stated, *rendered}]

    def _allowed_errors(self) -> float:
        """Return how many standard errors noise alone may reach at some effect, at 5 % for all together."""
        return all_clear_from((row.effect_error for row in self.attribution.ranking()), self.attribution.info)


def _upper(row: RankedParameter) -> float:
    """Return how large an effect may be within two standard errors."""
    return abs(row.effect) + SIGNIFICANT * (row.effect_error or 0.0)


def _exceeds(row: RankedParameter, errors: float) -> bool:
    """Whether an effect is more than a number of standard errors from 0."""
    return abs(row.effect) > errors * (row.effect_error or 0.0)
