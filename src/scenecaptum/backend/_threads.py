"""The number of threads of this process."""

from __future__ import annotations

import sys

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
