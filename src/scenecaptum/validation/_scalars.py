"""Parameters as single numbers within intervals, which is what global sensitivity analysis takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import numpy as np
import torch

from .._reflection import OPEN_MARGIN
from ..attr._baselines import table_of
from ..attr._gradients import Point
from ..errors import SceneCaptumError, near_misses

Values: TypeAlias = "Mapping[str, torch.Tensor]"
Intervals: TypeAlias = "Mapping[str, tuple[float, float]] | None"


@dataclass(frozen=True)
class Scalar:
    """A parameter that one number moves: the largest of its elements, to which all others keep their ratio.

    A colour is thus varied from dark to bright and keeps its hue, and a texture its pattern. Were each channel
    varied by itself, the renders that sampling takes would be three times as many, to rank channels of which
    nobody asks.

    Attributes
    ----------
    low, high
        The interval, in the parameter's unit.
    pattern
        What the number is multiplied by, of the parameter's shape.
    """

    name: str
    label: str
    low: float
    high: float
    pattern: torch.Tensor

    @property
    def length(self) -> float:
        """How long the interval is."""
        return self.high - self.low

    def at(self, place: float) -> torch.Tensor:
        """Return the parameter at a place between 0, the low end of its interval, and 1."""
        return self.pattern * (self.low + place * self.length)


def find_scalars(
    renderer: Any, values: Values, parameters: Sequence[str] | None, bounds: Intervals
) -> list[Scalar]:
    """Return the parameters that names or globs choose, all by default, with their intervals.

    Raises
    ------
    SceneCaptumError
        Where a name, glob or interval does not fit, or the renderer tells no bounds.
    """
    given = dict(bounds or {})
    for key in (*(parameters or ()), *given):
        if not any(fnmatchcase(name, key) for name in values):
            raise SceneCaptumError(
                f"{key!r} matches none of the {len(values)} inputs.{near_misses(key, values)}"
            )
    chosen = [n for n in values if parameters is None or any(fnmatchcase(n, key) for key in parameters)]
    return [_scalar(renderer, name, values[name], _given(name, given)) for name in chosen]


def point_at(scalars: Sequence[Scalar], values: Values, places: Sequence[float] | np.ndarray) -> Point:
    """Return the scene at these places, with factors that make gradients those per length of the intervals.

    Summed over its elements, a gradient times its factor is the derivative with respect to the place.
    """
    moved = {one.name: one.at(float(place)) for one, place in zip(scalars, places, strict=True)}
    return Point({**values, **moved}, factors=factors_of(scalars))


def factors_of(scalars: Sequence[Scalar]) -> dict[str, torch.Tensor]:
    """Return what turns a gradient into the derivative with respect to the place, once it is summed."""
    return {one.name: one.pattern * one.length for one in scalars}


def _given(name: str, bounds: Mapping[str, tuple[float, float]]) -> tuple[float, float] | None:
    if name in bounds:
        return bounds[name]
    return next((interval for key, interval in bounds.items() if fnmatchcase(name, key)), None)


def _scalar(renderer: Any, name: str, value: torch.Tensor, given: tuple[float, float] | None) -> Scalar:
    largest = value.abs().max().item()
    pattern = value / largest if value.ndim and largest else torch.ones_like(value)
    number = largest if value.ndim else value.item()
    low, high = _physical(renderer, name, pattern)
    if given is None:
        low, high = _stand_in(low, high, number)
    else:
        low, high = _checked(name, given, low, high)
    return Scalar(name, getattr(renderer, "labels", {}).get(name, name), low, high, pattern)


def _physical(renderer: Any, name: str, pattern: torch.Tensor) -> tuple[float, float]:
    """Return the interval in which every element of the parameter is inside its physical bounds."""
    bounds = getattr(renderer, "bounds", None)
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


def _stand_in(low: float, high: float, number: float) -> tuple[float, float]:
    """Return a finite interval: half the value to one and a half of it where the physical one is not.

    It is as long as ``ranges`` takes it to be.
    """
    if math.isfinite(high - low):
        return low, high
    length = abs(number) or 1.0
    start = min(max(low, number - length / 2), high - length)
    return start, start + length


def _checked(name: str, given: Any, low: float, high: float) -> tuple[float, float]:
    try:
        first, last = map(float, given)
    except (TypeError, ValueError):
        raise SceneCaptumError(f"bounds[{name!r}] must be (low, high), two numbers, not {given!r}.") from None
    if not (math.isfinite(last - first) and low <= first < last <= high):
        raise SceneCaptumError(
            f"bounds[{name!r}] is ({first:g}, {last:g}); expected is a low and a higher number from {low:g} to "
            f"{high:g}, the values that the parameter's largest element can have."
        )
    return first, last
