"""Names, values and labels of a result that tables, figures and the report share."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Self

from ..protocols import Attribution, ResultKind, Scale
from ._numbers import format_with_error, rounded, shorten

CAUTION = "caution: "  # the start of a note that puts a value in doubt
TEXEL_MEANING = "each texel: effect of a whole texture that acts like it"  # in a map with single texels
OF_DIFFERENCES = {ResultKind.ABLATION, ResultKind.OCCLUSION, ResultKind.SHAPLEY_VALUE}
_CLEAR = 2.0  # standard errors between a value and the limit of another class
LARGE_ERROR = 0.3  # of the norm of all effects, or of a parameter's own
FINDING_WIDTH = 60  # maximum length of a name in a figure's title
METRIC_WIDTH = FINDING_WIDTH  # and of a metric's on an axis, which keeps both classes of a difference


class Advised(str):
    """A note that ends with advice, such as what to run next; ``finding`` is what it says without it.

    Terminals, tables and figures show all of it to those who run the software; pages for others, the finding.
    """

    finding: str
    __slots__ = ("finding",)

    def __new__(cls, finding: str, advice: str, between: str = "; ") -> Self:
        """Return a note of a finding and the advice that follows it."""
        note = super().__new__(cls, f"{finding}{between}{advice}")
        note.finding = finding
        return note


def advised(finding: str, advice: str | None, between: str = "; ") -> str:
    """Return a note of a finding and its advice, if there is any."""
    return Advised(finding, advice, between) if advice else finding


def prefixed(prefix: str, note: str) -> str:
    """Return a note behind a prefix, such as a mark; its advice is still told from its finding."""
    if not isinstance(note, Advised):
        return f"{prefix}{note}"
    return Advised(f"{prefix}{note.finding}", note.removeprefix(note.finding), "")


def findings(notes: Iterable[str]) -> list[str]:
    """Return notes without their advice."""
    return [note.finding if isinstance(note, Advised) else note for note in notes]


def cautions_among(notes: Iterable[str]) -> list[str]:
    """Return those notes that put a value in doubt, without their first word and their advice."""
    return [note.removeprefix(CAUTION) for note in findings(notes) if note.startswith(CAUTION)]


def metric_line(attribution: Attribution, width: int | None = None) -> str:
    """Return ``'mean luminance = 2.337 ± 0.005 cd/m²'``, with the name shortened to ``width``.

    It says that a value is relaxed where that by the definition may differ. Of two metrics in different units it
    has no number, which would mean nothing.
    """
    if units := attribution.info.get("units"):
        first, second = (one or "a number without a unit" for one in units)
        return f"{metric_name(attribution, width)}, of different units ({first} and {second})"
    value = format_with_error(attribution.metric_value, attribution.metric_standard_error)
    unit = metric_unit(attribution)
    relaxed = ", relaxed" if attribution.info.get("relaxed") else ""
    return f"{metric_name(attribution, width)} = {value}{f' {unit}' if unit else ''}{relaxed}"


def metric_name(attribution: Attribution, width: int | None = None) -> str:
    """Return the metric's name, that of its class if it has no other, shortened to ``width``."""
    name = str(_measure(attribution).get("name") or attribution.info.get("metric", "metric"))
    return name if width is None else shorten([name], width)[0]


def metric_symbol(attribution: Attribution) -> str:
    """Return the metric's usual abbreviation, such as ``"UGR"``, or its name."""
    return str(_measure(attribution).get("symbol") or metric_name(attribution))


def attributed_name(attribution: Attribution) -> str:
    """Return the metric's name, called relaxed where the value by the definition may be another one."""
    name = metric_name(attribution)
    return f"relaxed {name}" if attribution.info.get("relaxed") else name


def metric_unit(attribution: Attribution) -> str:
    """Return the metric's unit; empty if it has none, or none is known."""
    return str(_measure(attribution).get("unit") or "")


def unit_of_change(unit: str) -> str:
    """Return the unit of a change of a value in a unit: from 50 % to 60 % are ten percentage points, not 10 %."""
    return "percentage points" if unit == "%" else unit


def verdict(attribution: Attribution) -> str:
    """Return what the metric's value means; empty if the metric does not say."""
    return str(attribution.info.get("verdict") or "")


def rating(attribution: Attribution) -> str:
    """Return what the metric's value means, and whether its error leaves this in doubt."""
    found = [(attribution.metric_value, attribution.metric_standard_error)]
    doubt = class_doubt(attribution.info, found) if verdict(attribution) else ""
    return "; ".join(filter(None, [verdict(attribution), doubt]))


def class_doubt(info: Mapping[str, Any], values: Sequence[tuple[float, float | None]]) -> str:
    """Return why values with these errors may be in another class; empty if they are clear of its limits."""
    low = min(value - _CLEAR * (error or 0.0) for value, error in values)
    high = max(value + _CLEAR * (error or 0.0) for value, error in values)
    near = [limit for limit in (info.get("measure") or {}).get("limits", ()) if low <= limit <= high]
    if len(near) > 1:
        return f"too uncertain to be sure: {rounded(low)} to {rounded(high)} within two errors"
    return f"too close to {near[0]:g} to be sure" if near else ""


def _measure(attribution: Attribution) -> Mapping[str, Any]:
    return attribution.info.get("measure") or {}


def method_name(attribution: Attribution) -> str:
    """Return the name of the attribution method; of a difference or sum, of both methods."""
    methods = [method for method, *_ in attribution.info.get("sampled") or () if method]
    return " and ".join(dict.fromkeys(methods)) or str(attribution.info.get("method", "unknown method"))


def axis_label(
    attribution: Attribution,
    scale: Scale | None = None,
    width: int | None = METRIC_WIDTH,
    *,
    metric: str | None = None,
    is_relaxed: bool = False,
) -> str:
    """Return the axis label for effects in a scale; by default ``metric`` is its name, shortened to ``width``.

    ``is_relaxed`` says that the effects are those of the relaxed metric, beside a value by the definition.
    """
    kind = attribution.kind.in_scale(attribution.scale_or_default(scale))
    if metric is None:
        metric = with_unit_of_effects(attribution, metric_name(attribution, width))
        if is_relaxed or attribution.info.get("relaxed"):
            metric = f"relaxed {metric}"
    label = kind.axis_label.format(metric)
    return f"ℓ2 norm of the {label}" if attribution.ranks_by_norm(scale) else label


def with_unit_of_effects(attribution: Attribution, metric: str) -> str:
    """Return the metric followed by its unit, or the square of it for squares and variances, in parentheses."""
    unit, square = metric_unit(attribution), "" if attribution.kind.has_sign else "²"
    return f"{metric} ({unit_of_change(unit)}){square}" if unit else metric


def sign_labels(attribution: Attribution) -> tuple[str, str] | None:
    """Return the meanings of positive and negative attributions; None if the quantity has no sign.

    A gradient describes a change of the parameter; a contribution describes its presence.
    """
    subject = "difference" if "minus" in attribution.info else "metric"
    if not attribution.kind.has_sign:
        return None
    if attribution.kind.is_contribution:
        return f"adds to the {subject}", f"takes from the {subject}"
    return f"raising it raises the {subject}", f"raising it lowers the {subject}"


def color_meanings(attribution: Attribution) -> str:
    """Return ``'blue raises the metric, orange lowers it'``; empty if the quantity has no sign."""
    if not attribution.kind.has_sign:
        return ""
    subject = "difference" if "minus" in attribution.info else "metric"
    more, less = ("adds to", "takes from") if attribution.kind.is_contribution else ("raises", "lowers")
    return f"blue {more} the {subject}, orange {less} it"


def is_of_camera(name: str) -> bool:
    """Whether a parameter belongs to the camera, which is in no picture and moves all of it."""
    return name.startswith("camera.")


def pluralize(count: int, noun: str) -> str:
    """Return ``'1 parameter'`` or ``'3 parameters'``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def count_of(names: Collection[str], shown: Collection[str]) -> str:
    """Return the number of parameters of a note, and how many of them have no row that could bear its mark."""
    return ", ".join(filter(None, [pluralize(len(names), "parameter"), hidden_of(names, shown)]))


def hidden_of(names: Collection[str], shown: Collection[str]) -> str:
    """Return how many parameters of a note have no row; empty if all have one."""
    hidden = len(set(names) - set(shown))
    if not hidden:
        return ""
    if hidden < len(names):
        return f"{hidden} of them not shown"
    return "not shown" if hidden == 1 else "none of them shown"


def pack(parts: Sequence[str], width: int) -> list[str]:
    """Join parts with dots into lines of at most ``width`` characters where possible."""
    lines = [parts[0]]
    for part in parts[1:]:
        joined = f"{lines[-1]} · {part}"
        if len(joined) <= width:
            lines[-1] = joined
        else:
            lines.append(part)
    return lines
