"""The comparison with a hand-written script: on any variant, in a table for each."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import _device
import pytest
from _device import activate_variant, device_name, memory, peak_memory
from _pages import measured, replace_rows
from overhead import HEADER, name_of

ROOT = Path(__file__).parents[2]
CPU, GPU = "overhead llvm_ad_rgb", "overhead cuda_ad_rgb"
NOT_MEASURED = "Not measured: no GPU was available."
PAGE = f"""before

<!-- {CPU} -->

| room | time |
|---|---|
| office | 1 s |
| kitchen | 2 s |

<!-- end of {CPU} -->

between

<!-- {GPU} -->

{NOT_MEASURED}

<!-- end of {GPU} -->

after
"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    return page


def run(script: str, *arguments: str, scenes: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, ROOT / "benchmarks" / script, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "SCENECAPTUM_SCENES": str(scenes)},  # none, so that rooms are bundled ones
    )


def rows(*cells: tuple[str, str]) -> list[tuple[str, str]]:
    return [("room", "time"), *cells]


def test_a_table_keeps_the_rows_of_other_rooms(page: Path) -> None:
    replace_rows(page, CPU, rows(("classroom", "3 s"), ("office", "4 s")))
    new = "| office | 4 s |\n| kitchen | 2 s |\n| classroom | 3 s |\n"
    assert page.read_text() == PAGE.replace("| office | 1 s |\n| kitchen | 2 s |\n", new)


def test_the_table_of_one_device_leaves_that_of_the_other(page: Path) -> None:
    replace_rows(page, GPU, rows(("office", "0.1 s")))
    replace_rows(page, GPU, rows(("kitchen", "0.2 s")))
    table = "| room | time |\n|---|---|\n| office | 0.1 s |\n| kitchen | 0.2 s |"
    assert page.read_text() == PAGE.replace(NOT_MEASURED, table)


def test_a_page_without_the_table_stays_as_it_is(page: Path) -> None:
    with pytest.raises(SystemExit, match="no place for a table called 'other'"):
        replace_rows(page, "other", rows())
    assert page.read_text() == PAGE


def test_the_documentation_has_a_table_for_each_device() -> None:
    text = (ROOT / "docs" / "performance.md").read_text()
    assert f"| {' | '.join(HEADER)} |" in text
    assert all(
        text.count(f"<!-- {name} -->") == 1 for name in (CPU, GPU, "rooms llvm_ad_rgb", "rooms cuda_ad_rgb")
    )


def test_rooms_are_named_after_their_folders() -> None:
    assert [name_of(scene) for scene in ("office", "/a/kitchen/scene.xml", "/a/attic.xml")] == [
        "office",
        "kitchen",
        "attic",
    ]


@pytest.mark.parametrize(
    ("variant", "reason"),
    [("llvm_ad_grey", "Unknown Mitsuba variant 'llvm_ad_grey'"), ("scalar_rgb", "cannot be differentiated")],
)
def test_a_variant_that_cannot_be_used_is_one_clear_error(
    mi: Any, capsys: pytest.CaptureFixture[str], variant: str, reason: str
) -> None:
    before = mi.variant()
    with pytest.raises(SystemExit) as end:
        activate_variant(argparse.ArgumentParser("overhead.py", usage="overhead.py"), variant)
    assert end.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "usage: overhead.py"
    assert lines[1].startswith("overhead.py: error: ")
    assert reason in lines[1]
    assert len(lines) == 2
    assert mi.variant() == before


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="resident memory is read from /proc")
def test_on_a_cpu_memory_is_that_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_device, "is_gpu", lambda: False)
    assert 0 < memory() <= peak_memory()
    assert device_name().endswith(" cores")


def test_memory_that_no_library_knows_is_not_measured(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if _device.is_gpu():
        pytest.skip("there is a GPU")
    monkeypatch.setattr(_device, "is_gpu", lambda: True)
    assert math.isnan(peak_memory())
    assert measured(peak_memory() / 2**30, "{:.2f} GiB") == "not measured"


@pytest.mark.long
def test_overhead_measures_on_the_variant_and_writes_its_table(page: Path, tmp_path: Path) -> None:
    page.write_text(PAGE.replace(CPU, "…").replace(GPU, CPU).replace("…", GPU))
    small = ("--inputs", "reflectance", "--size", "8x8", "--spp", "8", "--depth", "2", "--turns", "1")
    done = run(
        "overhead.py",
        "cornell-box",
        *small,
        "--variant",
        "llvm_ad_rgb",
        "--write",
        str(page),
        scenes=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert "cornell-box, llvm_ad_rgb: " in done.stdout
    gpu, _, cpu = page.read_text().partition("between")
    assert "| kitchen | 2 s |" in gpu
    assert "cornell-box" not in gpu
    assert NOT_MEASURED not in cpu
    assert re.search(
        r"^\| cornell-box \| \d+, reflectance \| 8×8, 8 spp, depth 2 \| \d+ cores \|", cpu, re.MULTILINE
    )


@pytest.mark.long
def test_rooms_measures_on_the_variant(tmp_path: Path) -> None:
    task = ("--task", '["attribution", "cornell-box"]')
    done = run("rooms.py", "--variant", "llvm_ad_rgb", *task, scenes=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert 0 < found["beyond"] < found["peak"]
    assert 0 < found["load"] < found["seconds"]
