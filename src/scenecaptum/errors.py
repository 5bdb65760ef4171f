"""The one family of errors that scenecaptum raises on bad input.

A message names the parameter or file, what was expected, what came, and the fix.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SceneCaptumError(Exception):
    """Something the caller can put right: a file, a name, a value, a metric or a missing library."""


class BackendError(SceneCaptumError):
    """The renderer cannot run on this machine; the message gives the one command that fixes it."""


def near_misses(name: str, known: Iterable[str], limit: int = 3) -> str:
    """Return ``' Did you mean …?'`` for the known names closest to ``name``, or an empty string."""
    candidates = list(known)
    by_folded = {candidate.lower(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.lower(), by_folded, n=limit, cutoff=0.5)
    return f" Did you mean {', '.join(repr(by_folded[c]) for c in close)}?" if close else ""
