"""``Explanation``: what a result says, in sentences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from ..estimation import TOO_NOISY
from ..metrics import NO_SOURCE
from ..protocols import Attribution
from ..visualization import (
    advised,
    axis_label,
    first_few,
    format_with_error,
    metric_name,
    metric_symbol,
    metric_unit,
    noise_notes,
    plain_number,
    pluralize,
    rounded,
    signed_roughly,
    terminal_width,
    verdict,
    with_error,
    wrap,
)
from ._effect_sentences import EffectSentences
from ._findings import Change, Definition, Row, Source, are_far_apart, is_clear, lacks_much
from ._wording import change_in_words, percent, rating_in_words, row_name, signed, step

MOST = 0.8  # of the effect of more light: the fewest rows with as much decide
SMALL_REST = 0.001  # of the whole: a smaller rest is not stated
FEW_POINTS = 20  # of a grid: one point is more than 5 % of them
BIASED = "derivative known to be biased"
MOST_NAMED = 3  # of the sources that may be large
DEFAULT_EFFECTS = 5
OTHER_THRESHOLD = "a threshold of 5 times the mean luminance (threshold_factor=5, --threshold-factor 5)"
GLARE_SOURCES = "Where the glare comes from"
PICTURE_SOURCES = "What it sees in the picture: shares of the sum of |gradient × value| over the pixels"
FOUR_DIGITS = 5e-4  # of a value
OF_THRESHOLD = 0.5  # of a change: it is mostly that of the threshold
_PLAIN_WIDTH = 100  # of the lines, without a terminal


@dataclass(frozen=True, repr=False)
class Explanation:
    """What a metric says of a scene, what causes it, and what would change it; prints as text.

    Attributes
    ----------
    attribution
        The result that is explained.
    sources
        The objects of the picture that the metric depends on, the largest share first.
    changes
        Single changes, the largest effect first.
    goal
        The outcome of an optimization towards a goal, if there is one.
    count
        The number of effects that are stated; with 0, nothing is said of those in the noise either.
    rows
        The rows of points of a metric of daylight.
    definition
        The value by the published definition, if the attribution is that of a relaxed one.
    premises
        What it was computed for, such as the weather.
    picture
        The picture, or what a sensor grid measures, of which ``value`` and the values of ``rows`` are; None if it
        is ``attribution.image``.
    no_changes
        Why there are no ``changes``, if some were asked for.
    not_in_sources
        What causes glare of which the picture lacks a part, so that ``sources`` lack it, too.
    """

    attribution: Attribution
    sources: tuple[Source, ...] = ()
    changes: tuple[Change, ...] = ()
    goal: Any = None
    count: int = DEFAULT_EFFECTS
    rows: tuple[Row, ...] = ()
    definition: Definition | None = None
    premises: tuple[str, ...] = ()
    picture: torch.Tensor | None = None
    no_changes: str = ""
    not_in_sources: tuple[str, ...] = ()

    def sections(self) -> list[tuple[str, list[str]]]:
        """Return the headings and the lines below them; a section without a number that is clear is left out."""
        # That counts sources below a threshold, too.
        of_glare = f"{GLARE_SOURCES}: shares of the relaxed rating" if self.definition else GLARE_SOURCES
        is_glare = any(one.luminance is not None for one in self.sources) or bool(self.not_in_sources)
        depends_on = axis_label(self.attribution, width=None, is_relaxed=self.definition is not None)
        unclear = tuple(
            f"{self._change_line(one)}: within its noise{self._with_edges(one)}"
            for one in self.changes
            if not one.is_clear
        )
        effects = EffectSentences(self.attribution, self.changes, self.count, self._saturated(), unclear)
        sections = [
            (
                ": ".join(filter(None, [self.headline(), self.rating()])),
                self.notes(),
            ),
            (
                of_glare if is_glare else PICTURE_SOURCES,
                self._source_lines(),
            ),
            (
                f"What it depends on: {depends_on}",
                effects.lines(),
            ),
            ("What would change it", self._change_lines()),
            ("Which points decide", self._row_lines()),
            (
                self._goal_heading(),
                self._goal_lines(),
            ),
            ("Too noisy to say", effects.unclear_lines()),
        ]
        return [section for index, section in enumerate(sections) if index == 0 or section[1]]

    def text(self, width: int | None = None) -> str:
        """Return the sentences for a terminal, in lines of at most ``width`` characters."""
        limit = width or terminal_width() or _PLAIN_WIDTH
        parts = []
        for heading, lines in self.sections():
            listed = [f"  {wrap(line, limit - 2)}" for line in lines]
            parts.append("\n".join([wrap(heading, limit), *listed]))
        return "\n\n".join(parts)

    def markdown(self) -> str:
        """Return the sentences in Markdown."""
        (first, notes), *rest = self.sections()
        parts = [f"**{first}**", *notes]
        for heading, lines in rest:
            parts.append("\n".join([f"### {heading}", "", *(f"- {line}" for line in lines)]))
        return "\n\n".join(parts) + "\n"

    def __str__(self) -> str:
        """Return the sentences for a terminal."""
        return self.text()

    __repr__ = __str__

    def headline(self) -> str:
        """Return the value of the metric: by its definition, if the attribution is that of a relaxed one.

        With the rating of a picture stands the resolution, on which it depends.
        """
        value = f"{self._in_unit(self.value())}{self._pixels()}"
        if self._is_of_equal_counts():
            assert self.definition is not None
            assert self.definition.step is not None
            value += f" ± less than one point ({self._in_unit(self._plain(self.definition.step))})"
        return f"{metric_name(self.attribution)} = {value}"

    def notes(self) -> list[str]:
        """Return what belongs to the value: cautions, its definition, which value to quote, and the premises."""
        return [*noise_notes(self.attribution), *self.value_notes()]

    def value_notes(self) -> list[str]:
        """Return the notes without those on noise, which a table has below its title."""
        definition = (self.attribution.info.get("measure") or {}).get("definition")
        return [
            *([f"{metric_symbol(self.attribution)}: {definition}"] if definition else []),
            *([] if self.definition is None else [self._which_to_quote()]),
            *self.premises,
            *self._error_notes(),
        ]

    def _error_notes(self) -> list[str]:
        """Say what the error of a rating of 0 is, where the picture has no glare source."""
        value, error = self.attribution.metric_value, self.attribution.metric_standard_error
        if value or not error or self.definition is not None or verdict(self.attribution) != NO_SOURCE:
            return []
        _, written = with_error(value, error)
        return [f"the error of {written} is noise: in single replicates a pixel is bright enough to count"]

    def rating(self) -> str:
        """Return what the value means, by which source, and whether that is in doubt; empty without classes."""
        value, error = self.attribution.metric_value, self.attribution.metric_standard_error
        return rating_in_words(self.attribution.info, value, error, self.definition)

    def _relaxed(self) -> str:
        value, error = self.attribution.metric_value, self.attribution.metric_standard_error
        return self._in_unit(self._with_error(value, error))

    def _which_to_quote(self) -> str:
        assert self.definition is not None
        points, one, steps, finer = self.definition.points, self.definition.step, "", ""
        if one is not None:
            finer = "choose a finer spacing" if points is not None and points < FEW_POINTS else ""
            steps = f" (in steps of {self._in_unit(self._plain(one))}, one point)"
        value, what = self._in_unit(self.value()), f"the value by the definition{steps}"
        caution = (self.attribution.info.get("picture") or {}).get("caution") or ""
        stated = f"{value} is {what}" if TOO_NOISY in caution else f"quote {value}, {what}"
        return advised(f"{stated}; the relaxed value {self._relaxed()} only serves the derivatives", finer)

    def value(self) -> str:
        """Return the value of the headline, without its unit, such as ``'24.78 ± 0.01'``."""
        if self._is_of_equal_counts():
            assert self.definition is not None
            return self._plain(self.definition.value)
        if self.definition is not None:
            return self._with_error(self.definition.value, self.definition.error)
        value, error = self.attribution.metric_value, self.attribution.metric_standard_error
        return format_with_error(value, error)

    def _is_of_equal_counts(self) -> bool:
        """Whether all replicates count the same points: the share has an error, but one below a point."""
        return self.definition is not None and bool(self.definition.step) and self.definition.error == 0

    def _pixels(self) -> str:
        """Return ``" at 160×90 pixels"`` for a rating of a picture; empty for other metrics, and of a grid."""
        surfaces, measure = self.attribution.surfaces, self.attribution.info.get("measure") or {}
        if surfaces is None or not measure.get("limits"):
            return ""
        height, width = surfaces.shape
        return f" at {width}×{height} pixels"

    def _source_lines(self) -> list[str]:
        """Return each source with a clear share, the uncertain ones with a larger share, and the rest.

        None that is larger than one that is named is part of the rest.
        """
        clear = [source for source in self.sources if is_clear(source.share, source.share_error)]
        if clear:
            smallest = min(source.share for source in clear)
            stated = [source for source in self.sources if source in clear or source.share > smallest]
        else:
            stated = list(self.sources[:MOST_NAMED])
        lines = [
            f"{source.name}, {source.place}: {percent(source.share, source.share_error)}"
            + ("" if source.luminance is None else f" of it, at {rounded(source.luminance)} cd/m²")
            + ("" if source in clear else " (uncertain)")
            for source in stated
        ]
        if lines and (rest := 1 - sum(source.share for source in stated)) > SMALL_REST:
            lines.append(f"the rest: {100 * rest:.1f} %")
        if self.not_in_sources:
            them = "it" if len(self.not_in_sources) == 1 else "them"
            lines.append(
                advised(
                    f"the picture lacks light of {first_few(self.not_in_sources)}: few samples meet {them}",
                    "use a higher resolution and more samples",
                )
            )
        return lines

    def _change_lines(self) -> list[str]:
        if self.no_changes:
            return [self.no_changes]
        lines = [
            f"{self._change_line(change)}{self._with_edges(change)}{self._with_other_threshold(change)}"
            for change in self.changes
            if change.is_clear
        ]
        return [*self._change_legend(), *lines] if lines else []

    def _row_lines(self) -> list[str]:
        """Return the rows that make up most of the effect of more light, then each row."""
        clear = [row for row in self.rows if is_clear(row.effect, row.effect_error)]
        if not clear:
            return ["none: more light at one row of points would change nothing"] if self.rows else []
        total, deciding = sum(abs(row.effect) for row in clear), list[Row]()
        for row in sorted(clear, key=lambda row: -abs(row.effect)):
            if sum(abs(one.effect) for one in deciding) < MOST * total:
                deciding.append(row)
        share = (
            f"{100 * sum(abs(one.effect) for one in deciding) / total:.0f} % of the effect of 10 % more light"
        )
        *names, last = [row_name(row) for row in self.rows if row in deciding]
        if 2 * len(deciding) > len(self.rows) > 1:
            rows = "rows" if self.rows[0].side == "top" else "columns"
            finding = f"most of them: {len(deciding)} of {len(self.rows)} {rows} have {share}"
        else:
            named = " and ".join(filter(None, [", ".join(names), last]))
            finding = f"{named} {'decide' if names else 'decides'}: {share}"
        return [
            finding,
            self._row_legend(),
            *(self._row_line(row) for row in self.rows),
        ]

    def _change_legend(self) -> list[str]:
        """Say which of the values of a change is by the definition, and why the relaxed ones stand beside it."""
        if self.definition is None:
            return []
        exact = f"{metric_symbol(self.attribution)} by the definition, before → after, jumps"
        relaxed = "the relaxed change, in parentheses,"
        if self.definition.step:
            return [f"{exact} by whole points; {relaxed} does not: compare changes by it"]
        clear = [change for change in self.changes if change.is_clear]
        if not any(self._is_far_from_relaxed(one) or self._with_other_threshold(one) for one in clear):
            return [f"{exact} at the threshold; {relaxed} does not: compare changes by it"]
        # Both fade with the brightest pixel, the relaxed rating as a whole.
        return [
            advised(
                f"{exact} where the main source passes the threshold, and {relaxed} falls steeply near it: where "
                "they, or the change with another threshold, are far apart, neither says much",
                f"compare with {OTHER_THRESHOLD}",
            )
        ]

    def _is_far_from_relaxed(self, change: Change) -> bool:
        if change.exact is None or change.measured is None:
            return False
        by, error = self._rendered_change(change)
        if lacks_much(change.missing, by, error):  # without the edges of lamps it is closer to the truth
            by += change.missing
        return are_far_apart(by, change.measured, error, change.measured_error)

    def _row_legend(self) -> str:
        """Say what stands behind each row of points, and how the rows are counted on the plan."""
        first, symbol = self.rows[0], metric_symbol(self.attribution)
        rows, towards = ("rows", "up") if first.side == "top" else ("columns", "to the right")
        there = "" if first.value is None else f"{symbol} there, and "
        relaxed = ", relaxed" if self.definition else ""
        return (
            f"below, {there}how 10 % more light there changes {symbol} of all points{relaxed}; {rows} are counted "
            f"from the {first.side} of the plan, where {first.towards} points {towards}"
        )

    def _row_line(self, row: Row) -> str:
        effect = change_in_words(self.attribution, row.effect, row.effect_error)
        there = "" if row.value is None else f"{self._in_unit(self._plain(row.value))}; "
        return f"{row_name(row)}, {pluralize(row.count, 'point')}: {there}{effect} for all points"

    def _change_line(self, change: Change) -> str:
        predicted = signed(change.predicted, change.predicted_error)
        what = f"{step(change)}: {metric_symbol(self.attribution)}"
        if change.measured is None:
            effect = change_in_words(self.attribution, change.predicted, change.predicted_error)
            return f"{what} {effect}, predicted"
        value = self.attribution.metric_value
        if self.definition is not None and change.exact is not None:
            numbers = (self.definition.value, change.exact)
            if change.exact_error and self.definition.step is None:
                # The change is known more precisely than the value, but more than four digits say nothing.
                precision = max(change.exact_error, FOUR_DIGITS * abs(self.definition.value))
                before, after = (with_error(number, precision, digits=1)[0] for number in numbers)
            else:
                before, after = (self._plain(number) for number in numbers)
            relaxed = "relaxed: "
        else:
            # No rating of a scene is negative, but its value and the measured change are of other renders.
            rated = bool((self.attribution.info.get("measure") or {}).get("limits"))
            changed = max(0.0, value + change.measured) if rated else value + change.measured
            before, after = (with_error(number, change.measured, digits=2)[0] for number in (value, changed))
            relaxed = ""
        by = self._exact_difference(change)
        measured = signed(change.measured, change.measured_error)
        is_biased = change.name in (self.attribution.info.get("cautions") or {})
        bent = "" if change.is_linear else f", {BIASED if is_biased else 'not linear'}"
        if not bent and change.is_clear and change.measured * change.predicted < 0:
            bent = ", with the other sign"
        effects = f"({relaxed}{measured} rendered, {predicted} predicted{bent})"
        return f"{what} {before} → {self._in_unit(after)}{by} {effects}"

    def _with_edges(self, change: Change) -> str:
        """Return the change of a glare rating with what it lacks at the edges of lamps, if that is much."""
        by, error = self._rendered_change(change)
        if not lacks_much(change.missing, by, error):
            return ""
        return f"; corrected for the edges of lamps, by about {signed_roughly(by + change.missing)}"

    def _with_other_threshold(self, change: Change) -> str:
        """Return the change by the other usual threshold, where a source that passes the absolute one makes it."""
        if change.relative is None:
            return ""
        by, error = self._rendered_change(change)
        apart = abs(by - change.relative)
        if apart <= OF_THRESHOLD * abs(by) or not is_clear(apart, error or 0.0):
            return ""
        return f"; with a threshold of 5 times the mean luminance, by about {signed_roughly(change.relative)}"

    def _exact_difference(self, change: Change) -> str:
        """Return ``", by +8.0 ± 2.1 percentage points"``, by the definition; empty without a known error."""
        if change.exact is None or not change.exact_error:
            return ""
        by, error = self._rendered_change(change)
        return f", by {change_in_words(self.attribution, by, error)}"

    def _rendered_change(self, change: Change) -> tuple[float, float | None]:
        """Return by how much the rendered metric changes, and its error: by the definition, if there is one."""
        if self.definition is None or change.exact is None:
            return change.measured or 0.0, change.measured_error
        return change.exact - self.definition.value, change.exact_error

    def _goal_heading(self) -> str:
        if self.goal is None or self.goal.was_below:
            return "The goal"
        return f"What {'reaches' if self.goal.reached else 'was tried to reach'} the goal"

    def _goal_lines(self) -> list[str]:
        if self.goal is None:
            return []
        return [
            *(f"{step(one)}, {one.extent}" for one in self.goal.moved),
            f"{self.goal.outcome}, in other renders" if self.goal.moved else self.goal.outcome,
            *([self.goal.note] if self.goal.note else []),
        ]

    def _with_error(self, value: float, error: float | None) -> str:
        """Return a number with its error, also one of 0: a share of hours may be the same in all replicates."""
        if error:
            return format_with_error(value, error)
        return f"{self._plain(value)}{'' if error is None else ' ± 0'}"

    def _plain(self, number: float) -> str:
        """Return a number without an error."""
        return plain_number(number, metric_unit(self.attribution))

    def _in_unit(self, number: str) -> str:
        return f"{number} {metric_unit(self.attribution)}".rstrip()

    def _saturated(self) -> str:
        """Say that a share of points cannot rise or fall, if it is all or none of them; else nothing."""
        if self.definition is None:
            return ""
        lower = (self.attribution.info.get("measure") or {}).get("better") == "lower"
        if self.definition.counts_none:
            return "no point counts" if lower else "no point passes"
        if self.definition.counts_all:
            return "every point counts" if lower else "every point passes: nothing limits it"
        return ""
