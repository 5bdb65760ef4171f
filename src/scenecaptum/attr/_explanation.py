"""``Explanation``: what a result says, in sentences."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from ..protocols import Attribution
from ..visualization import (
    axis_label,
    format_with_error,
    grid,
    metric_line,
    metric_unit,
    noise_notes,
    pluralize,
    signed_with_error,
    terminal_width,
    verdict,
    wrap,
)

SIGNIFICANT = 2.0  # standard errors below which an effect is not stated
DEFAULT_EFFECTS = 5
_PLAIN_WIDTH = 100  # of the lines, without a terminal


@dataclass(frozen=True)
class Source:
    """A glare source.

    Attributes
    ----------
    name
        The object that it lies on.
    place
        Where in the picture: ``"top left"``.
    share
        Of the sum over all sources, from 0 to 1.
    luminance
        In cd/m².
    """

    name: str
    place: str
    share: float
    luminance: float


@dataclass(frozen=True)
class Change:
    """A change of one parameter, and its effect on the metric.

    Attributes
    ----------
    name, label
        The parameter's name in the scene, and a readable label.
    before, after
        Its values.
    predicted, predicted_error
        The effect to first order, from the gradient, and its standard error.
    measured, measured_error
        The effect of rendering the changed scene, with the same random numbers, and its standard error; None if it
        was not rendered.
    """

    name: str
    label: str
    before: torch.Tensor
    after: torch.Tensor
    predicted: float
    predicted_error: float
    measured: float | None = None
    measured_error: float | None = None

    @property
    def is_clear(self) -> bool:
        """Whether its effect is clear of the noise, as predicted and as rendered."""
        if abs(self.predicted) <= SIGNIFICANT * self.predicted_error:
            return False
        return self.measured is None or abs(self.measured) > SIGNIFICANT * (self.measured_error or 0.0)


@dataclass(frozen=True, repr=False)
class Explanation:
    """What a metric says of a scene, what causes it, and what would change it; prints as text.

    Attributes
    ----------
    attribution
        The result that is explained.
    sources
        The glare sources, for a glare rating.
    changes
        Single changes, the largest effect first.
    goal
        The outcome of an optimization towards a goal, if there is one.
    count
        The number of effects that are stated.
    """

    attribution: Attribution
    sources: tuple[Source, ...] = ()
    changes: tuple[Change, ...] = ()
    goal: Any = None
    count: int = DEFAULT_EFFECTS

    def sections(self) -> list[tuple[str, list[str]]]:
        """Return the headings and the lines below them; a section without a number that is clear is left out."""
        sections = [
            (self._verdict(), [f"caution: {note}" for note in noise_notes(self.attribution)]),
            ("Glare comes from", self._source_lines()),
            (f"What matters most: {axis_label(self.attribution)}", self._effect_lines()),
            ("What would change it", self._change_lines()),
            ("To reach the goal", [] if self.goal is None else str(self.goal).splitlines()),
            ("What could not be told", self._unclear_lines()),
        ]
        return [section for index, section in enumerate(sections) if index == 0 or section[1]]

    def text(self, width: int | None = None) -> str:
        """Return the sentences for a terminal, in lines of at most ``width`` characters."""
        limit = width or terminal_width() or _PLAIN_WIDTH
        parts = []
        for heading, lines in self.sections():
            parts.append("\n".join([wrap(heading, limit), *(f"  {line}" for line in lines)]))
        return "\n\n".join(parts)

    def markdown(self) -> str:
        """Return the sentences in Markdown."""
        (first, notes), *rest = self.sections()
        parts = [f"**{first}**", *notes]
        for heading, lines in rest:
            parts.append("\n".join([f"### {heading}", "", "```text", *lines, "```"]))
        return "\n\n".join(parts) + "\n"

    def __str__(self) -> str:
        """Return the sentences for a terminal."""
        return self.text()

    __repr__ = __str__

    def _verdict(self) -> str:
        means = verdict(self.attribution)
        source = (self.attribution.info.get("measure") or {}).get("source")
        line = metric_line(self.attribution)
        return f"{line}: {means}{f' ({source})' if source else ''}" if means else line

    def _source_lines(self) -> list[str]:
        rows = [
            (source.name, f"{100 * source.share:.0f} %", source.place, f"{source.luminance:.3g} cd/m²")
            for source in self.sources
        ]
        return grid(("object", "share", "in the picture", "luminance"), rows) if rows else []

    def _effect_lines(self) -> list[str]:
        unit = metric_unit(self.attribution)
        rows = [
            (row.label, f"{signed_with_error(row.effect, row.effect_error)}{f' {unit}' if unit else ''}")
            for row in self.attribution.ranking()
            if abs(row.effect) > SIGNIFICANT * (row.effect_error or 0.0)
        ]
        return grid(("parameter", "effect"), rows[: self.count]) if rows else []

    def _change_lines(self) -> list[str]:
        rows = [
            (
                change.label,
                f"{_format(change.before)} → {_format(change.after)}",
                signed_with_error(change.predicted, change.predicted_error),
                "" if change.measured is None else signed_with_error(change.measured, change.measured_error),
            )
            for change in self.changes
            if change.is_clear
        ]
        return grid(("parameter", "from → to", "predicted", "rendered again"), rows) if rows else []

    def _unclear_lines(self) -> list[str]:
        """Return how many effects are in the noise, and the samples that would resolve them."""
        rows = self.attribution.ranking()
        if self.attribution.covariance is None:
            return ["which effects are due to noise: there are no error bars"]
        unclear = [row for row in rows if 0 < abs(row.effect) <= SIGNIFICANT * (row.effect_error or 0.0)]
        clear = [row for row in rows if abs(row.effect) > SIGNIFICANT * (row.effect_error or 0.0)]
        if not unclear or not clear:
            return []
        smallest = min(abs(row.effect) for row in clear[: self.count])
        # An effect as large as the smallest that is stated may hide in the error of another.
        hiding = [row for row in unclear if SIGNIFICANT * (row.effect_error or 0.0) > smallest]
        if not hiding:
            return []
        largest = max(row.effect_error or 0.0 for row in hiding)
        factor = math.ceil((SIGNIFICANT * largest / smallest) ** 2)
        return [
            f"{pluralize(len(hiding), 'parameter')} may have an effect of {format_with_error(smallest, None)} or "
            f"more within their errors; {factor} times the samples would tell"
        ]


def _format(value: torch.Tensor) -> str:
    """Return a scalar, a colour by channel or as one number if it is grey, or the mean of a texture."""
    channels = value.reshape(-1, value.shape[-1]).mean(0) if value.ndim > 1 else value.reshape(-1)
    numbers = [f"{number:.3g}" for number in channels.tolist()]
    return numbers[0] if len(set(numbers)) == 1 else f"({', '.join(numbers)})"
