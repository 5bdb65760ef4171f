"""The folder that a command writes to."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from .._writing import cannot_write, whole_file
from ..errors import SceneCaptumError


@contextlib.contextmanager
def writable(folder: Path) -> Iterator[None]:
    """Make the output folder before hours of rendering, and leave none behind where nothing was written."""
    try:
        existed = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions do not tell the whole story (a read-only file system): only writing does.
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
    """Let each file be written by its name to a path beside it, so that none is ever half-written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    for name in names:
        with whole_file(folder / name) as partial:
            write(name, partial)
