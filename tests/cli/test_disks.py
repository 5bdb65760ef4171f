"""The files of ``scenecaptum attribute`` on full disks and in folders that cannot be written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import results
from disks import check_full_disk, check_unwritable_folder

from scenecaptum.cli._files import write_files
from scenecaptum.cli._formats import FORMATS

NAMES = [written.file for written in FORMATS.values()]


def write(path: Path) -> None:
    """Write one of the files."""
    chosen = [written for written in FORMATS.values() if written.file == path.name]
    write_files(results.make(metric_bias=0.0), path.parent, chosen)


@pytest.mark.parametrize("name", NAMES)
def test_full_disk(name: str, tmp_path: Path, mi: Any) -> None:
    check_full_disk(write, tmp_path / name)


@pytest.mark.parametrize("name", NAMES)
def test_folders_that_cannot_be_written(name: str, tmp_path: Path, mi: Any) -> None:
    check_unwritable_folder(write, name, tmp_path)
