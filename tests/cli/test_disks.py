"""The files of ``scenecaptum attribute`` on full disks and in folders that cannot be written."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import results
from disks import check_full_disk, check_unwritable_folder

from scenecaptum.cli import _attribute, _files


def write(path: Path) -> None:
    """Write one of the files."""
    content = partial(_attribute._write_file, results.make(metric_bias=0.0))
    _files.write_each(path.parent, [path.name], content)


@pytest.mark.parametrize("name", _attribute.CONTENTS)
def test_full_disk(name: str, tmp_path: Path, mi: Any) -> None:
    check_full_disk(write, tmp_path / name)


@pytest.mark.parametrize("name", _attribute.CONTENTS)
def test_folders_that_cannot_be_written(name: str, tmp_path: Path, mi: Any) -> None:
    check_unwritable_folder(write, name, tmp_path)
