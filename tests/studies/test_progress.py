"""What a study writes to stderr while it runs."""

from __future__ import annotations

import re
import sys

import pytest

from scenecaptum.studies._progress import Progress


def run(total: int, *, finished: int = 0, failing: int = 0, show: bool = True) -> None:
    with Progress(total, finished=finished, show=show) as progress:
        for count in range(finished, total):
            progress.update(min(failing, count + 1 - finished))


def written(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [re.sub(r"\d+ s$", "… s", line) for line in capsys.readouterr().err.splitlines()]


def test_a_log_file_gets_a_line_at_the_start_and_for_each_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    run(40)
    tenths = [f"study: {4 * k} of 40 cells, … s" for k in range(1, 11)]
    assert written(capsys) == ["study: 40 cells", *tenths]


def test_one_cell_is_no_plural(capsys: pytest.CaptureFixture[str]) -> None:
    run(1)
    assert written(capsys) == ["study: 1 cell", "study: 1 of 1 cell, … s"]


def test_few_cells_have_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    run(3, finished=1, failing=1)
    assert written(capsys) == [
        "study: 3 cells, 1 of them finished before",
        "study: 2 of 3 cells, 1 failed, … s",
        "study: 3 of 3 cells, 1 failed, … s",
    ]


def test_nothing_is_written_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    run(3, show=False)
    assert written(capsys) == []


def test_a_terminal_has_a_bar(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    run(3, failing=1)
    text = capsys.readouterr().err
    assert "3/3" in text
    assert "study: " not in text
