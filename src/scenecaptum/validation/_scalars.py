"""Parameters as single numbers in intervals, as global sensitivity analysis needs them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import numpy as np
import torch

from ..attr import table_of
from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ..estimation import Point
from ..protocols import Capabilities, Renderer
from ..scene import OPEN_MARGIN

Values: TypeAlias = "Mapping[str, torch.Tensor]"
Intervals: TypeAlias = "Mapping[str, tuple[float, float]] | None"

INTERVAL_NOTE = (  # below the tables of all that vary a ``Scalar``
    "a colour or texture keeps its hue or pattern, and only its largest number goes through the interval,\n"
    'so no column is the "effect over the range" of other tables, where every channel goes through its range'
)


@dataclass(frozen=True)
class Scalar:
    """A parameter that is varied by one number: its largest element, with all ratios of elements kept.

    A colour is varied in brightness and keeps its hue; a texture keeps its pattern. To vary each channel
    separately would take three times as many renders.

    Attributes
    ----------
    low, high
        The interval of the number, in the parameter's unit.
    pattern
        The parameter's value for the number 1, of the parameter's shape.
    """

    name: str
    label: str
    low: float
    high: float
    pattern: torch.Tensor

    @property
    def length(self) -> float:
        """Length of the interval."""
        return self.high - self.low

    def at(self, position: float) -> torch.Tensor:
        """Return the parameter's value at a position in its interval, from 0 (``low``) to 1 (``high``)."""
        return self.pattern * (self.low + position * self.length)


def find_scalars(
    renderer: Renderer, values: Values, parameters: Sequence[str] | None, bounds: Intervals
) -> list[Scalar]:
    """Return the parameters selected by names or globs, all by default, with their intervals.

    Raises if a name or glob matches nothing, or an interval is invalid.
    """
    given = dict(bounds or {})
    for key in (*(parameters or ()), *given):
        if not any(fnmatchcase(name, key) for name in values):
            raise SceneCaptumError(
                f"{key!r} matches none of the {len(values)} inputs.{near_misses(key, values, instead=INPUT_NAMES)}"
            )
    selected = [n for n in values if parameters is None or any(fnmatchcase(n, key) for key in parameters)]
    matching = {n: given.get(n, next((given[k] for k in given if fnmatchcase(n, k)), None)) for n in selected}
    return [_scalar(renderer, name, values[name], interval) for name, interval in matching.items()]


def values_at(scalars: Sequence[Scalar], positions: Sequence[float] | np.ndarray) -> dict[str, torch.Tensor]:
    """Return the values of the parameters at positions in their intervals."""
    return {scalar.name: scalar.at(float(x)) for scalar, x in zip(scalars, positions, strict=True)}


def point_at(scalars: Sequence[Scalar], values: Values, positions: Sequence[float] | np.ndarray) -> Point:
    """Return the scene at positions in the intervals, with the factors of ``position_factors``."""
    return Point({**values, **values_at(scalars, positions)}, factors=position_factors(scalars))


def position_factors(scalars: Sequence[Scalar]) -> dict[str, torch.Tensor]:
    """Return the factors whose product with a gradient sums to the derivative with respect to the position."""
    return {scalar.name: scalar.pattern * scalar.length for scalar in scalars}


def _scalar(renderer: Renderer, name: str, value: torch.Tensor, given: tuple[float, float] | None) -> Scalar:
    largest = value.abs().max().item()
    pattern = value / largest if value.ndim and largest else torch.ones_like(value)
    number = largest if value.ndim else value.item()
    low, high = _physical_interval(renderer, name, pattern)
    if given is None:
        low, high = _default_interval(low, high, number)
    else:
        low, high = _check_interval(name, given, low, high)
    return Scalar(name, (Capabilities(renderer).labels or {}).get(name, name), low, high, pattern)


def _physical_interval(renderer: Renderer, name: str, pattern: torch.Tensor) -> tuple[float, float]:
    """Return the interval in which every element of the parameter is within its physical bounds."""
    bounds = Capabilities(renderer).bounds
    if bounds is None:
        return -math.inf, math.inf
    low, high = bounds.get(name, (-math.inf, math.inf))
    table = table_of(renderer)
    if table is not None and name in table and table[name].bounds.open_low:
        low += OPEN_MARGIN * (high - low if math.isfinite(high - low) else 1.0)
    parts = pattern[pattern != 0].double()
    lowest = torch.where(parts > 0, low / parts, high / parts).max().item()
    highest = torch.where(parts > 0, high / parts, low / parts).min().item()
    return lowest, highest


def _default_interval(low: float, high: float, number: float) -> tuple[float, float]:
    """Return the physical interval if finite, else 0.5 to 1.5 times the value, of the length from ``ranges``."""
    if math.isfinite(high - low):
        return low, high
    length = abs(number) or 1.0
    start = min(max(low, number - length / 2), high - length)
    return start, start + length


def _check_interval(name: str, given: Any, low: float, high: float) -> tuple[float, float]:
    try:
        first, last = map(float, given)
    except (TypeError, ValueError):
        raise SceneCaptumError(f"bounds[{name!r}] must be (low, high), two numbers, not {given!r}.") from None
    if not (math.isfinite(last - first) and low <= first < last <= high):
        raise SceneCaptumError(
            f"bounds[{name!r}] is ({first:g}, {last:g}), but must be a low and a higher number from {low:g} to "
            f"{high:g}, the range of the parameter's largest element."
        )
    return first, last
