"""The output folder of a command."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from ..errors import SceneCaptumError
from ..files import atomic_write, write_error


@contextlib.contextmanager
def writable(folder: Path) -> Iterator[None]:
    """Create the output folder before a long job, and remove it if nothing was written."""
    try:
        existed = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions are not enough (read-only file systems): try to write.
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:  # ValueError: a null character
        reason = getattr(error, "strerror", None) or error
        raise SceneCaptumError(
            f"The output folder {str(folder)!r} cannot be written: {reason}. Choose another with --out."
        ) from error
    try:
        yield
    finally:
        if not existed and not any(folder.iterdir()):
            folder.rmdir()


def write_each(folder: Path, names: Iterable[str], write: Callable[[str, Path], None]) -> None:
    """Write each file atomically: call ``write`` with its name and a temporary path."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder, error) from error
    for name in names:
        with atomic_write(folder / name) as partial:
            write(name, partial)
