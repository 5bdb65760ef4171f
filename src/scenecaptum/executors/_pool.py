"""Worker processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor

from tqdm import tqdm

from ..errors import whole_number


def process_pool(workers: int | None = None) -> ProcessPoolExecutor:
    """Return a pool of worker processes, which end with this process.

    They are started anew (``spawn``) rather than forked: a fork of a process that has rendered would hang. A
    script that uses them needs ``if __name__ == "__main__":`` around what it does.

    Example
    -------
    >>> with process_pool(1) as pool:
    ...     pool.submit(abs, -1).result()
    1

    Parameters
    ----------
    workers
        Number of processes; by default one for each core of this machine.

    Raises
    ------
    SceneCaptumError
        If ``workers`` is not a whole number of at least 1.
    """
    count = _cores() if workers is None else whole_number("workers", workers)
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_start_worker)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def _start_worker() -> None:
    """Let the parent handle Ctrl-C, and end when it ends: a worker would wait for its next task for ever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Its default lock is shared between processes, and Python warns if a worker is killed that has one.
    tqdm.set_lock(threading.RLock())
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


class Workers:
    """A pool of worker processes that can be started again if one of them has died.

    Use it as a context; an exception ends the processes without waiting for their tasks.
    """

    def __init__(self, count: int | None) -> None:
        self.count = _cores() if count is None else whole_number("workers", count)
        self._others = set(multiprocessing.active_children())
        self.pool = process_pool(self.count)

    def restart(self) -> None:
        """Replace the pool by a new one; tasks of the old one are lost."""
        self._end()
        self.pool = process_pool(self.count)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None:
            self.pool.shutdown()
        else:
            self._end()

    def _end(self) -> None:
        processes = set(multiprocessing.active_children()) - self._others
        self.pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        for process in processes:
            process.join()
        self.pool.shutdown()
