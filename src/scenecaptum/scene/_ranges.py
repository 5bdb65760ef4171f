"""The interval of each parameter over which effects are compared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ._parameter_table import SceneParameters
from ._selection import is_of_kind


def choose_ranges(
    parameters: SceneParameters, names: Sequence[str], ranges: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return the range of each named parameter: that of ``ranges``, by name, glob or kind, or its own."""
    chosen = {name: (parameters[name].range.low, parameters[name].range.high) for name in names}
    unmatched = dict.fromkeys(ranges)
    # Kinds first, so that globs and then names override them.
    for matches in (
        lambda name, key: is_of_kind(parameters[name], key),
        fnmatchcase,
        lambda name, key: name == key,
    ):
        for key, interval in ranges.items():
            for name in names:
                if matches(name, key):
                    chosen[name] = _checked(key, interval)
                    unmatched.pop(key, None)
    for key in unmatched:
        raise SceneCaptumError(
            f"ranges names {key!r}, which no input matches.{near_misses(key, names, instead=INPUT_NAMES)}"
        )
    return chosen


def _checked(key: str, interval: Any) -> tuple[float, float]:
    try:
        low, high = map(float, interval)
    except (TypeError, ValueError):
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        raise SceneCaptumError(
            f"ranges[{key!r}] must be a pair of numbers (low, high) with low < high, not {interval!r}."
        )
    return low, high
