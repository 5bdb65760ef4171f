"""The number of threads of this process."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from ..errors import whole_number
from ._variants import activate


def use_threads(count: int) -> None:
    """Set the number of threads that Dr.Jit and torch use in this process.

    With one thread, sums have a fixed order: the same seeds give the same bits.

    Raises
    ------
    SceneCaptumError
        If ``count`` is not a whole number of at least 1.
    """
    count = whole_number("threads", count)
    activate()
    import drjit as dr

    dr.set_thread_count(count)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)


@contextlib.contextmanager
def at_least_two_threads() -> Iterator[None]:
    """Give Dr.Jit a second thread: with a single one Mitsuba waits forever for the pixels of an EXR file."""
    import drjit as dr

    count = dr.thread_count()
    if count >= 2:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(count)
