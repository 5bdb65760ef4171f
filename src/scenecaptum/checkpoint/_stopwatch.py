"""Times that do not depend on what a checkpoint has supplied."""

from __future__ import annotations

import time
from typing import Any

from ..protocols import Capabilities, Renderer
from ._store import Checkpoint


class Stopwatch:
    """Elapsed time, including the original render time of results that a checkpoint supplied."""

    def __init__(self, renderer: Renderer | None) -> None:
        self._checkpoint: Checkpoint | None = Capabilities(renderer).checkpoint
        self._start = self.now()
        self._counts = self._count()

    def now(self) -> float:
        """Return the current time on this clock, in seconds."""
        return time.perf_counter() + (self._checkpoint.seconds_saved if self._checkpoint else 0.0)

    @property
    def seconds(self) -> float:
        """Seconds since construction."""
        return self.now() - self._start

    @property
    def info(self) -> dict[str, Any]:
        """Entries for a result's ``info``: elapsed seconds, and use of the checkpoint since construction."""
        if self._checkpoint is None:
            return {"seconds": self.seconds}
        reused, rendered = (new - old for new, old in zip(self._count(), self._counts, strict=True))
        usage = {"folder": str(self._checkpoint.folder), "reused": reused, "passes": reused + rendered}
        return {"seconds": self.seconds, "checkpoint": usage}

    def _count(self) -> tuple[int, int]:
        return (self._checkpoint.reused, self._checkpoint.rendered) if self._checkpoint else (0, 0)
