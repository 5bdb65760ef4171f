"""Every attribution method has a name on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scenecaptum import cli
from scenecaptum.attr import METHODS

TINY = ["--resolution", "16x16", "--spp", "16", "--max-depth", "2", "--replicates", "2", "--no-progress"]


def test_each_method_has_one_name() -> None:
    assert len({method.create for method in METHODS.values()}) == len(METHODS)
    assert all(method.description for method in METHODS.values())


@pytest.mark.parametrize("name", METHODS)
def test_a_method_runs_by_its_name(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = "office" if name == "occlusion" else "cornell-box"
    inputs = "textures" if name == "occlusion" else "emitters"
    options = ["--method", name, "--inputs", inputs, "--format", "json", "--json", "--out", str(tmp_path)]
    assert cli.main(["attribute", scene, *TINY, *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["info"]["method"] == METHODS[name].create.__name__
    assert result["ranking"]


def test_an_option_without_effect_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--method", "shapley", "--tolerance", "0.1", "--out", str(tmp_path / "out")]
    assert cli.main(["attribute", "cornell-box", *TINY, *options]) == 2
    assert "--tolerance has no effect on --method shapley" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
