"""Exceptions raised on invalid input, and shared argument checks.

A message names the parameter or file, the expected and the actual value, and the fix.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from numbers import Real

_MOST_LISTED = 20  # names in a message
# What the same thing is called elsewhere, and here.
_SYNONYMS = {"--camera": "--sensor", "--inputs": "--kind", "lamps": "emitters", "lights": "emitters"}


class SceneCaptumError(Exception):
    """An error that the caller can fix: in a file, a name, a value, a metric or a missing library."""


class BackendError(SceneCaptumError):
    """The renderer cannot run on this machine; the message gives the command that fixes it."""


class UnknownNameError(SceneCaptumError, KeyError):
    """An unknown parameter name; also a ``KeyError``, as ``Mapping`` requires."""

    __str__ = Exception.__str__  # KeyError would quote the whole message


def near_misses(name: str, known: Iterable[str], limit: int = 3) -> str:
    """Return ``' Did you mean …?'`` for the known names closest to ``name``, or an empty string.

    Names that have ``name`` as one of their parts or words come first: ``floor`` means
    ``floor.reflectance.value``, and ``lamp`` means ``table lamp``. What has another name here comes alone.
    """
    candidates = list(known)
    if (synonym := _SYNONYMS.get(name.lower())) in candidates:
        return f" Did you mean {synonym!r}?"
    by_folded = {candidate.lower(): candidate for candidate in candidates}
    whole = [folded for folded in by_folded if name.lower() in re.split(r"[.\s]", folded)]
    close = whole + difflib.get_close_matches(name.lower(), by_folded, n=limit)
    close = list(dict.fromkeys(close))[:limit]
    return f" Did you mean {', '.join(repr(by_folded[c]) for c in close)}?" if close else ""


def listed(names: Sequence[str]) -> str:
    """Return ``': a, b, c'``, or an empty string if there are more than 20 names."""
    return f": {', '.join(names)}" if len(names) <= _MOST_LISTED else ""


def whole_number(name: str, value: int, low: int = 1, high: int | None = None) -> int:
    """Return ``value`` as an int; raise if the argument ``name`` is not an integer within the limits."""
    whole = isinstance(value, Real) and not isinstance(value, bool) and float(value).is_integer()
    if not whole or value < low or (high is not None and value > high):
        span = f"of at least {low}" if high is None else f"from {low} to {high}"
        required = f"{low}" if low == high else f"a whole number {span}"
        raise SceneCaptumError(f"{name} must be {required}, not {value!r}.")
    return int(value)


def check_seed(name: str, value: int) -> int:
    """Return a seed as an int; Mitsuba's seeds have 32 bits."""
    return whole_number(name, value, 0, 2**32 - 1)
