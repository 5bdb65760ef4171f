"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

from .errors import SceneCaptumError

_open: set[Path] = set()  # what is being written


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to, whose file takes the place of ``path`` once it is complete and on the disk.

    Where that fails (disk full, folder read-only) nothing is left behind, and what was there stays as it was. A
    path that it has yielded is taken as it is: what writes a file may be part of what writes several.

    Example
    -------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with whole_file(Path(folder, "numbers.txt")) as partial:
    ...         _ = partial.write_text("1 2 3")
    ...     os.listdir(folder)
    ['numbers.txt']

    Raises
    ------
    SceneCaptumError
        Where the file cannot be written.
    """
    if Path(path) in _open:
        yield Path(path)
        return
    try:
        # A link stays a link to what is written.
        path = Path(os.path.realpath(path))
    except ValueError as error:  # a name that no file can have
        raise cannot_write(Path(path), error) from error
    try:
        if path.exists() and not path.is_file():
            # A pipe or a device such as /dev/null is written to: root could replace it.
            yield path
            return
        # Its ending stays, by which writers choose the format.
        partial = path.with_name(f".{os.getpid()}-{threading.get_ident()}-{path.name}")
        _open.add(partial)
        try:
            yield partial
            _flush(partial)
            os.replace(partial, path)
        finally:
            _open.discard(partial)
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from error


def cannot_write(path: Path, error: Exception) -> SceneCaptumError:
    """Return the error that says why a file cannot be written."""
    reason = getattr(error, "strerror", None) or error
    return SceneCaptumError(
        f"{path} cannot be written: {reason}. Make room or choose another place; nothing was changed there."
    )


def _flush(path: Path) -> None:
    """Wait until a file is on the disk: otherwise a crash may leave an empty one under the new name."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
