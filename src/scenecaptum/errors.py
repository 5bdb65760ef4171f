"""Exceptions raised on invalid input, and shared argument checks.

A message names the parameter or file, the expected and the actual value, and the fix.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from numbers import Real

_MOST_LISTED = 20  # names in a message
_PARTS = re.compile(r"[.\s]")
_WORDS = re.compile(r"[_\s]")
_SAME_OBJECT = 0.75  # similarity of first parts; "light" and "wall_right" have 0.67
INPUT_NAMES = " All names are in the `inputs` of the renderer."  # where nothing is close to a wrong one
# What the same thing is called elsewhere, and here.
_SYNONYMS = {"--camera": "--sensor", "--inputs": "--kind", "lamps": "emitters", "lights": "emitters"}


class SceneCaptumError(Exception):
    """An error that the caller can fix: in a file, a name, a value, a metric or a missing library."""


class BackendError(SceneCaptumError):
    """The renderer cannot run on this machine; the message gives the command that fixes it."""


class UnknownNameError(SceneCaptumError, KeyError):
    """An unknown parameter name; also a ``KeyError``, as ``Mapping`` requires."""

    __str__ = Exception.__str__  # KeyError would quote the whole message


def near_misses(name: str, known: Iterable[str], limit: int = 3, *, instead: str = "") -> str:
    """Return ``' Did you mean …?'`` for the known names closest to ``name``, or an empty string.

    Where the first part of ``name`` is, exactly or closely, that of dotted names, only these are suggested:
    ``floor.albedo`` means ``floor.reflectance.value``, and not ``wall.albedo``. Names that have ``name`` as one of
    their parts or words come next: ``lamp`` means ``table lamp``. What has another name here comes alone. Names
    of other objects are followed by ``instead``.

    Parameters
    ----------
    name
        The name that is not known. It may be a glob.
    known
        The names that are.
    limit
        The most that are suggested.
    instead
        The text to return where nothing is close, or only other objects are: where the names are listed.
    """
    candidates = list(known)
    if (synonym := _SYNONYMS.get(name.lower())) in candidates:
        return f" Did you mean {synonym!r}?"
    by_folded = {candidate.lower(): candidate for candidate in candidates}
    close, behind = _of_same_object(name.lower(), by_folded), ""
    if not close:
        wrong = name.lower().replace("*", "")
        whole = [folded for folded in by_folded if wrong in _PARTS.split(folded)]
        close = whole + difflib.get_close_matches(wrong, by_folded, n=limit)
        behind = instead if "." in wrong and not whole else ""
    close = list(dict.fromkeys(close))[:limit]
    return f" Did you mean {', '.join(repr(by_folded[c]) for c in close)}?{behind}" if close else instead


def _of_same_object(wrong: str, known: Iterable[str]) -> list[str]:
    """Return the dotted names whose first part is closest to that of a wrong name, closest names first."""
    dotted = [name for name in known if "." in name]
    plain = [name for name in known if "." not in name]
    owners = list(dict.fromkeys(name.partition(".")[0] for name in dotted))
    first, _, rest = wrong.partition(".")
    own = first.replace("*", "")
    if not own:
        return []
    same = [owner for owner in owners if fnmatchcase(owner, first)]
    if not same:
        is_part = any(own in _PARTS.split(name) for name in known)
        if not rest and (is_part or difflib.get_close_matches(own, plain)):
            return []  # a later part of the names, or one of those without dots
        words = sorted(_WORDS.split(own))  # "back_wall" is "wall_back"
        same = [
            owner for owner in owners if own in _WORDS.split(owner) or words == sorted(_WORDS.split(owner))
        ]
        same = same or difflib.get_close_matches(own, owners, n=1, cutoff=_SAME_OBJECT)

    def closeness(name: str) -> float:
        return difflib.SequenceMatcher(None, wrong, name).ratio()

    return sorted((name for name in dotted if name.partition(".")[0] in same), key=closeness, reverse=True)


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


def check_callable(name: str, value: object, advice: str = "") -> None:
    """Raise if the argument ``name`` cannot be called, or is a class; the message ends with ``advice``."""
    refuse_class(name, value)
    if not callable(value):
        raise SceneCaptumError(f"{name} must be callable, not {type(value).__name__}{advice}.")


def refuse_class(name: str, value: object) -> None:
    """Raise if the argument ``name`` is a class, which can be called like its instances."""
    if isinstance(value, type):
        raise SceneCaptumError(
            f"{name} is the class {value.__name__}: write {value.__name__}(), with its arguments if it needs any."
        )


def check_seed(name: str, value: int) -> int:
    """Return a seed as an int; Mitsuba's seeds have 32 bits."""
    return whole_number(name, value, 0, 2**32 - 1)
