"""``scenecaptum study`` on a Dask scheduler; the other options are in test_options.py."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from scenecaptum import cli
from scenecaptum.cli._attribute import EXPLAIN


@pytest.fixture
def own_threads(mi: Any) -> Iterator[None]:
    """Give the tests that follow their threads back: a worker in this process sets their number."""
    import drjit as dr

    before = torch.get_num_threads(), dr.thread_count()
    yield
    torch.set_num_threads(before[0])
    dr.set_thread_count(before[1])


def test_the_command_computes_on_dask(
    own_threads: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    file, quiet = tmp_path / "rooms.json", {"dashboard_address": None, "silence_logs": "CRITICAL"}
    file.write_text(
        json.dumps({"scenes": ["cornell-box"], "methods": ["value"], "resolution": [8, 8], "spp": 4})
    )
    command = ["study", str(file), "--out", str(tmp_path / "out"), "--threads", "2", "--no-progress"]
    # In this process, which starts faster; long tests have others.
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **quiet) as cluster:
        assert cli.main([*command, "--dask", cluster.scheduler_address]) == 0
        assert "1 cell finished" in capsys.readouterr().out
        assert cli.main([*command, "--dask", cluster.scheduler_address, "--workers", "2"]) == 2
        assert "--workers has no effect with --dask" in capsys.readouterr().err
    monkeypatch.setattr("scenecaptum.cli._study.PATIENCE", "1s")
    assert cli.main([*command, "--dask", "tcp://127.0.0.1:1"]) == 2
    assert "There is no Dask scheduler at tcp://127.0.0.1:1" in capsys.readouterr().err


def test_the_terminal_shows_the_summary_or_what_it_needs(
    own_threads: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "rooms.json"
    small = {"inputs": "emitters", "resolution": [8, 8], "spp": 8, "max_depth": 2}
    file.write_text(json.dumps({"scenes": {"one": "cornell-box", "two": "cornell-box"}, **small}))
    command = ["study", str(file), "--out", str(tmp_path / "out"), "--no-progress"]
    assert cli.main([*command, "--workers", "1"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"\ngroup +mean effect .*\nemitters +\+", text)
    assert text.count("valid if the scene's lights are in") == 1
    monkeypatch.setitem(sys.modules, "statsmodels.stats.meta_analysis", None)
    assert cli.main([*command, "--workers", "1"]) == 0
    assert "no summary: Summaries of a study need statsmodels: pip install" in capsys.readouterr().out


def test_of_relaxed_values_the_terminal_says_what_to_run_and_the_page_does_not(
    own_threads: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sky just above the threshold of 2000 cd/m² counts in part in the relaxed rating."""
    file, out = tmp_path / "rooms.json", tmp_path / "out"
    small = {"inputs": "emitters", "methods": ["value"], "resolution": [32, 18], "spp": 16, "max_depth": 3}
    dim = {"dim": {"sky.emitter.radiance.value*": 0.7}}
    file.write_text(json.dumps({"scenes": ["office"], "metrics": ["ugr"], "designs": dim, **small}))
    assert cli.main(["study", str(file), "--out", str(out), "--no-progress", "--report"]) == 0
    assert EXPLAIN in capsys.readouterr().out
    page = (out / "report" / "index.html").read_text(encoding="utf-8")
    assert "the value by the definition was not computed" in page
    assert "explain" not in page
