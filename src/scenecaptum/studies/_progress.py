"""Progress of a study: a bar on a terminal, lines in a log file."""

from __future__ import annotations

import sys
import time

from ..estimation import ProgressBar
from ..visualization import pluralize

LINES = 10  # in a log file, after the first one


class Progress(ProgressBar):
    """Counts finished cells on stderr: a bar with the time left, or lines if stderr is not a terminal.

    The lines are one at the start, and one for each tenth of the cells.
    """

    def __init__(self, total: int, *, finished: int, show: bool) -> None:
        self._total, self._finished = total, finished
        self._began = time.monotonic()
        self._logs = show and not sys.stderr.isatty()
        super().__init__(total=total, initial=finished, disable=not show or self._logs, unit="cell")
        if self._logs:
            before = f", {finished} of them finished before" if finished else ""
            self._write(f"study: {pluralize(total, 'cell')}{before}")

    def update(self, failed: int) -> None:
        """Count a cell; ``failed`` is how many have failed so far."""
        note = f"{failed} failed" if failed else ""
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update()
        tenths = [LINES * count // self._total for count in (self._finished, self._finished + 1)]
        self._finished += 1
        if self._logs and tenths[0] < tenths[1]:
            count = f"study: {self._finished} of {pluralize(self._total, 'cell')}"
            seconds = f"{time.monotonic() - self._began:.0f} s"
            self._write(", ".join(filter(None, [count, note, seconds])))

    @staticmethod
    def _write(line: str) -> None:
        print(line, file=sys.stderr, flush=True)
