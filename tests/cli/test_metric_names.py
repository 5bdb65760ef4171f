"""The registry of metrics: every name works on the command line, and the documentation has the same names."""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from scenecaptum import Camera, cli, metrics
from scenecaptum.metrics import NamedMetric

TABLE = Path(__file__).parents[2] / "docs" / "metrics.md"
TINY = ["cornell-box", "--spp", "16", "--max-depth", "3", "--inputs", "emitters"]
VIEW, POINTS = ["--resolution", "16x16"], ["--sensor", "grid"]
QUIET = ["--replicates", "2", "--denoise", "off", "--json", "--no-progress"]


def run(name: str, out: Path, *options: str) -> int:
    sensor = POINTS if name in metrics.BY_NAME and "grid" in metrics.BY_NAME[name].parameters else VIEW
    return cli.main(["attribute", *TINY, *sensor, *QUIET, "--metric", name, *options, "--out", str(out)])


def create(name: str) -> Any:
    metric = metrics.BY_NAME[name]
    return metric.create(
        **({"camera": Camera.perspective(8, 8, 60)} if "camera" in metric.parameters else {})
    )


@pytest.mark.parametrize("name", metrics.BY_NAME)
def test_every_name_gives_an_attribution(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--target", "1"] if create(name)(torch.rand(8, 8, 3)).ndim else []
    assert run(name, tmp_path, *options) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["metric"]["name"].startswith(type(create(name)).__name__)
    assert [row["name"] for row in numbers["ranking"]] == ["light.emitter.radiance.value"]


def test_the_table_of_metrics_has_the_names_and_classes_of_the_registry() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (?:`([\w-]+)`|–) \|", TABLE.read_text(), re.MULTILINE)
    named = {name: owner for owner, name in rows if name}
    assert named == {name: type(create(name)).__name__ for name in metrics.BY_NAME}
    classes = {name for name, thing in vars(metrics).items() if inspect.isclass(thing)}
    modules = {name for name in classes if issubclass(getattr(metrics, name), torch.nn.Module)}
    assert {owner for owner, _ in rows} == modules - {"GlareRating", "ShapeClassifier", "ResizeCropNormalize"}


def test_one_line_of_the_registry_is_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def brightness(camera: Camera, threshold_factor: float = 2.0) -> Any:
        return lambda image: threshold_factor * image.mean() * camera.width

    monkeypatch.setitem(metrics.BY_NAME, "brightness", NamedMetric(brightness, "100 % of the light"))
    assert run("brightness", tmp_path, "--threshold-factor", "3") == 0
    triple = json.loads(capsys.readouterr().out)["metric"]["value"]
    assert run("brightness", tmp_path) == 0
    assert triple == pytest.approx(1.5 * json.loads(capsys.readouterr().out)["metric"]["value"])
    with pytest.raises(SystemExit):
        cli.main(["attribute", "--help"])
    assert "brightness (100 % of the light)" in " ".join(capsys.readouterr().out.split())
    assert run("brightnes", tmp_path) == 2
    assert "'brightness'" in capsys.readouterr().err


def test_a_metric_of_points_needs_a_grid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = ["attribute", *TINY, *VIEW, *QUIET, "--metric", "uniformity", "--out", str(tmp_path)]
    assert cli.main(wrong) == 2
    assert (
        "A metric of points in a room (smallest over mean illuminance of a sensor grid): add --sensor grid"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("command", ["attribute", "tradeoff", "validate"])
def test_an_unknown_metric_is_one_line_that_lists_all(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([command, "cornell-box", "--metric", "brightest"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(name in error for name in metrics.BY_NAME)
