"""Images that Mitsuba writes and reads for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scenecaptum.backend import activate, at_least_two_threads

# Tests give Dr.Jit one thread, with which Mitsuba waits forever for the pixels of an EXR file.


def write_bitmap(path: Path, texels: np.ndarray) -> None:
    """Write an array of (height, width, channels)."""
    with at_least_two_threads():
        activate().Bitmap(texels).write(str(path))


def read_bitmap(path: Path) -> Any:
    """Return a file as Mitsuba's bitmap."""
    with at_least_two_threads():
        return activate().Bitmap(str(path))
