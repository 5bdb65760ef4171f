"""Full disks and folders that cannot be written: every writer gives one clear error and leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from scenecaptum import SceneCaptumError


@contextlib.contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Let no file grow beyond a size: a write fails there, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def check_full_disk(write: Callable[[Path], None], path: Path) -> None:
    """Check that a write without enough space raises and keeps the previous file."""
    write(path)
    size = path.stat().st_size
    path.write_text("previous content")
    for limit in (0, size // 2):
        with file_size_limit(limit), pytest.raises(SceneCaptumError, match="cannot be written") as caught:
            write(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert path.read_text() == "previous content"
        assert os.listdir(path.parent) == [path.name]
    write(path)
    assert path.stat().st_size == pytest.approx(size, rel=0.01)  # it contains the elapsed seconds


def check_unwritable_folder(write: Callable[[Path], None], name: str, tmp_path: Path) -> None:
    """Check that writing into a file, or where not even root may write, raises and changes nothing."""
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", Path("/proc")):
        with pytest.raises(SceneCaptumError, match="cannot be written"):
            write(folder / name)
    assert (tmp_path / "file").read_text() == "mine"
    assert os.listdir(tmp_path) == ["file"]
