"""The output folder of a command, and the files that it writes there."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ..errors import SceneCaptumError
from ..files import atomic_write, write_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 150
Result = TypeVar("Result")


@dataclass(frozen=True)
class OutputFormat(Generic[Result]):
    """A file that a command writes."""

    file: str
    description: str  # of its content, in one line
    write: Callable[[Result, Path], None]
    by_default: bool = True  # unless other formats are selected
    of_a_view: bool = False  # whether it shows the objects of a picture


def figure_writer(draw: Callable[[Result], Figure]) -> Callable[[Result, Path], None]:
    """Return a function that writes the figure of a result to a path."""
    return lambda result, path: draw(result).savefig(path, dpi=_DPI)


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


def write_files(result: Result, folder: Path, formats: Iterable[OutputFormat[Result]]) -> None:
    """Write a result in each format, each file atomically."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder, error) from error
    for one in formats:
        with atomic_write(folder / one.file) as partial:
            one.write(result, partial)


def print_files(folder: Path, formats: Iterable[OutputFormat[Any]]) -> None:
    """Print the paths of the files, and what each contains."""
    print()
    for one in formats:
        print(f"{folder / one.file}  {one.description}")
