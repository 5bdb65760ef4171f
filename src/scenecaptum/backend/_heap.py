"""The heap of the C library."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any


def trim_heap() -> None:
    """Return freed memory to the system, where the C library has a function for it (glibc on Linux).

    glibc keeps freed blocks of up to 32 MiB. Small objects that live on between them stop it from joining the
    blocks, so that a long series of large temporary arrays takes ever more memory.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _malloc_trim() -> Any:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
