"""Ctrl-C: the process ends within seconds, also while a kernel runs."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

INTERRUPTED = 130  # exit status
PATIENCE = 2.0  # seconds for the running kernel


@contextlib.contextmanager
def prompt_exit(say: Callable[[], None]) -> Iterator[None]:
    """End the process if Ctrl-C has no effect for 2 seconds, after ``say()``.

    Python raises ``KeyboardInterrupt`` only after the running kernel, which may take half a minute.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals arrive in the main thread only
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    noticed = threading.Event()

    def notice(number: int, frame: FrameType | None) -> None:
        noticed.set()
        signal.default_int_handler(number, frame)

    def watch() -> None:
        if os.read(reader, 1) and not noticed.wait(PATIENCE):
            say()
            leave(INTERRUPTED)

    handler, wakeup = signal.signal(signal.SIGINT, notice), signal.set_wakeup_fd(writer)
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGINT, handler)
        os.close(writer)  # ends the thread


def leave(status: int) -> None:
    """End the process without waiting for kernels that still run."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
