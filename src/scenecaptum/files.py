"""Atomic file writes."""

from __future__ import annotations

import contextlib
import os
import platform
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from .errors import SceneCaptumError

_STALE_SECONDS = 3600.0  # age at which a partially written file is assumed to be abandoned
_partial_files: set[Path] = set()  # temporary paths currently being written


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path to write to; it replaces ``path`` once the file is complete and flushed to disk.

    If writing fails (disk full, read-only folder), a ``SceneCaptumError`` is raised, the temporary file is deleted
    and an existing file stays unchanged. A path that was yielded before is yielded unchanged, for nested writers.

    Example
    -------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder, "numbers.txt")) as partial:
    ...         _ = partial.write_text("1 2 3")
    ...     os.listdir(folder)
    ['numbers.txt']
    """
    if Path(path) in _partial_files:
        yield Path(path)
        return
    try:
        # Write through a symbolic link instead of replacing it.
        path = Path(os.path.realpath(path))
    except ValueError as error:  # invalid file name
        raise write_error(Path(path), error) from error
    try:
        if path.exists() and not path.is_file():
            # Write directly to a pipe or a device such as /dev/null, which root could otherwise replace.
            yield path
            return
        partial = path.with_name(
            f".{_writer()}-{path.name}"
        )  # the suffix stays: writers choose the format by it
        _partial_files.add(partial)
        try:
            yield partial
            with partial.open("rb") as file:  # otherwise a crash could leave an empty file under the new name
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            _partial_files.discard(partial)
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def remove_abandoned(folder: Path, suffix: str) -> None:
    """Delete partial files that a killed process left in a folder an hour ago or longer."""
    for partial in folder.glob(f".*{suffix}"):
        with contextlib.suppress(FileNotFoundError):  # another process may delete it first
            if time.time() - partial.stat().st_mtime > _STALE_SECONDS:
                partial.unlink()


def _writer() -> str:
    """Return a name that no other thread has, on the machines that share a folder."""
    return f"{platform.node()}-{os.getpid()}-{threading.get_ident()}"


def write_error(path: Path, error: Exception) -> SceneCaptumError:
    """Return an error with the reason why a file cannot be written."""
    if isinstance(error, FileNotFoundError):
        return SceneCaptumError(f"{path} cannot be written: create its folder {str(path.parent)!r} first.")
    if isinstance(error, IsADirectoryError):
        return SceneCaptumError(f"{path} cannot be written: it is a folder. Choose another name.")
    if isinstance(error, FileExistsError | NotADirectoryError):
        return SceneCaptumError(f"{path} cannot be written: a file is where a folder must be.")
    reason = getattr(error, "strerror", None) or error
    return SceneCaptumError(
        f"{path} cannot be written: {reason}. Free disk space or choose another path; existing files were not "
        "changed."
    )
