"""The words for a rating, a change, an effect and a row of points in the sentences of an explanation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..metrics import NO_SOURCE
from ..protocols import Attribution, RankedParameter
from ..scene import pose_component
from ..visualization import (
    MOVES,
    class_doubt,
    format_with_error,
    metric_unit,
    move,
    rounded,
    signed_with_error,
    unit_of_change,
)
from ._findings import Definition, Row

_MAP_NDIM = 3


def rating_in_words(
    info: Mapping[str, Any], value: float, error: float | None, definition: Definition | None
) -> str:
    """Return what a value means, by which source, and whether that is in doubt; empty without classes.

    ``info`` is what ``TargetedMetric.describe`` says at this value. With a ``definition``, its value is rated.
    """
    numbers = [(value, error or 0.0)]
    measure, means = info.get("measure") or {}, str(info.get("verdict") or "")
    if definition is not None:
        # Only where the error of the quoted value is not known does the relaxed one say how sure it is.
        relaxed = [] if definition.error else numbers
        numbers = [*relaxed, (definition.value, definition.error or 0.0)]
        means = definition.verdict
    is_relaxed = definition is None and info.get("relaxed")
    is_class = bool(means) and means != NO_SOURCE and not is_relaxed
    doubt = class_doubt(info, numbers) if is_class else ""
    source = f" ({measure['source']})" if measure.get("source") and is_class else ""
    return "; ".join(filter(None, [f"{means}{source}", doubt]))


def row_name(row: Row) -> str:
    """Return ``"row 3 (y = 5 m)"``."""
    return f"{'row' if row.side == 'top' else 'column'} {row.number} ({row.name})"


def step(change: Any) -> str:
    """Return ``"desk base color 0.2 → 0.3"``, or ``"desk 0.05 towards (0, −1, 0)"`` for a pose.

    A map whose texels are all multiplied alike is ``"environment map × 1.25"``.
    """
    component = pose_component(change.name)
    if component in MOVES:
        return f"{change.label.rsplit(': ', 1)[0]} {move(component, change.after - change.before)}"
    factor = _factor(change.before, change.after)
    if factor is not None:
        return f"{in_words(change.label)} × {rounded(factor)}"
    return f"{in_words(change.label)} {value_in_words(change.before)} → {value_in_words(change.after)}"


def _factor(before: torch.Tensor, after: torch.Tensor) -> float | None:
    """Return by what all texels of a map are multiplied; None if they are not, or it is no map."""
    old, new = before.double(), after.double()
    if before.ndim < _MAP_NDIM or not bool(old.any()):
        return None
    factor = ((old * new).sum() / old.square().sum()).item()
    return factor if torch.allclose(new, factor * old, rtol=1e-4) else None


def in_words(label: str) -> str:
    """Return ``"desk base color"`` for the label ``"desk: base color"``."""
    return " ".join(label.rsplit(": ", 1))


def percent(share: float, error: float) -> str:
    """Return a share and its error in percent."""
    return f"{format_with_error(100 * share, 100 * error)} %"


def signed(effect: float, error: float | None) -> str:
    """Return an effect with its sign and its error."""
    return signed_with_error(effect, error)


def change_in_words(attribution: Attribution, change: float, error: float | None) -> str:
    """Return a change of the metric with its sign and its unit."""
    return f"{signed(change, error)} {_unit_of_change(attribution)}".rstrip()


def effect_in_words(attribution: Attribution, row: RankedParameter) -> str:
    """Return an effect with its unit."""
    return f"{number_of_effect(attribution, row)} {unit_of_effect(attribution)}".rstrip()


def number_of_effect(attribution: Attribution, row: RankedParameter) -> str:
    """Return an effect without its unit; a square or a variance has no sign."""
    write = signed if attribution.kind.has_sign else format_with_error
    return write(row.effect, row.effect_error)


def unit_of_effect(attribution: Attribution) -> str:
    """Return the unit of the effects: that of the metric's changes, or its square."""
    unit = _unit_of_change(attribution)
    return unit if attribution.kind.has_sign or not unit else f"({unit})²"


def _unit_of_change(attribution: Attribution) -> str:
    return unit_of_change(metric_unit(attribution))


def value_in_words(value: torch.Tensor) -> str:
    """Return a scalar, a colour by channel or as one number if it is grey, or the mean of a texture."""
    channels = value.reshape(-1, value.shape[-1]).mean(0) if value.ndim > 1 else value.reshape(-1)
    numbers = [rounded(number, 4) for number in channels.tolist()]  # a lamp × 1.25 is 11.25, not 11.2
    return numbers[0] if len(set(numbers)) == 1 else f"({', '.join(numbers)})"
