"""Full disks and folders that cannot be written: one clear error, nothing lost and nothing left behind."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import results
import torch
from disks import check_full_disk, check_unwritable_folder, file_size_limit
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import SceneCaptumError, projection, tradeoff
from scenecaptum.checkpoint import Checkpoint
from scenecaptum.files import atomic_write
from scenecaptum.report import write_report
from scenecaptum.visualization import save_render

PICTURE = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(shifted()))


def _tradeoff(path: Path) -> None:
    tradeoff.measure(ToyRenderer(), torch.mean, vary={"spp": [4]}, runs=2).to_csv(path)


WRITERS: dict[str, Callable[[Path], None]] = {
    "result.npz": lambda path: results.make().save(path),
    "report.html": lambda path: write_report([results.make()], path),
    "picture.png": partial(save_render, PICTURE),
    "map.npy": partial(projection.export, PICTURE),
    "map.png": partial(projection.export, PICTURE),
    "map.exr": partial(projection.export, PICTURE),
    "heatmap.exr": partial(projection.export, results.make()),
    "tradeoff.csv": _tradeoff,
}


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk(name: str, tmp_path: Path, mi: Any) -> None:
    check_full_disk(WRITERS[name], tmp_path / name)


@pytest.mark.parametrize("name", WRITERS)
def test_folders_that_cannot_be_written(name: str, tmp_path: Path, mi: Any) -> None:
    check_unwritable_folder(WRITERS[name], name, tmp_path)


def test_full_disk_under_a_checkpoint(tmp_path: Path) -> None:
    """Earlier entries stay valid."""
    kept = Checkpoint(tmp_path)
    kept.get_or_render("first", lambda: (PICTURE,))
    with file_size_limit(1000), pytest.raises(SceneCaptumError, match="cannot be written"):
        kept.get_or_render("second", lambda: (PICTURE,))
    assert len(os.listdir(tmp_path)) == 1
    again = Checkpoint(tmp_path)
    (found,) = again.get_or_render("first", lambda: ())
    assert torch.equal(found, PICTURE)
    assert (again.reused, again.rendered) == (1, 0)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no permission to mount a small file system")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_disk_of_64_kilobytes(small_disk: Path) -> None:
    path = small_disk / "map.npy"
    projection.export(PICTURE, path)
    before = path.read_bytes()
    (small_disk / "rest").write_bytes(bytes(45_000))
    with pytest.raises(SceneCaptumError, match="No space left on device"):
        projection.export(PICTURE.repeat(4, 4, 1), path)
    assert path.read_bytes() == before
    assert sorted(os.listdir(small_disk)) == ["map.npy", "rest"]


def test_devices_and_links_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("before")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with atomic_write(tmp_path / "link") as partial_file:
        partial_file.write_text("after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "after"
    with atomic_write("/dev/null") as device:
        device.write_text("gone")
    assert not Path("/dev/null").is_file()
    with (
        pytest.raises(SceneCaptumError, match="No space left on device"),
        atomic_write("/dev/full") as device,
    ):
        device.write_text("too much")


def test_an_error_while_a_file_is_written_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "a.txt") as partial_file:
        partial_file.write_text("half" * (1 // partial_file.write_text("")))
    assert os.listdir(tmp_path) == []
