"""docs/extending.md: the code of each section, as a file, and its line of the registry are all that is needed."""

from __future__ import annotations

import doctest
import json
import math
import re
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from scenecaptum import SceneRenderer, cli, metrics
from scenecaptum.cli import _formats
from scenecaptum.cli._files import OutputFormat
from scenecaptum.metrics import NamedMetric
from scenecaptum.rendering import SENSORS, SensorType

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
REPOSITORY = Path(__file__).parents[2]
TINY = ["cornell-box", "--resolution", "16x16", "--spp", "8", "--max-depth", "2", "--inputs", "emitters"]
QUIET = ["--replicates", "2", "--denoise", "off", "--no-progress"]


def section(title: str) -> str:
    (text,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return str(text)


def code(title: str) -> types.ModuleType:
    """Return a module with the imports and definitions of a section."""
    module = types.ModuleType(title)
    parser = doctest.DocTestParser()
    kept = r"(import|from|class|def|mi) |mi\."
    for example in parser.get_examples(
        "".join(re.findall(r"```python\n(.*?)```", section(title), re.DOTALL))
    ):
        if re.match(kept, example.source):
            exec(compile(example.source, str(PAGE), "exec"), vars(module))
    return module


def entry(title: str, module: types.ModuleType, **known: Any) -> dict[str, Any]:
    """Return the line of the registry, as a dict."""
    (line,) = re.findall(r'^    ("\w+": .*),$', section(title), re.MULTILINE)
    found: dict[str, Any] = eval(f"{{{line}}}", {**vars(module), **known})
    return found


def attribute(out: Path, *options: str) -> int:
    return cli.main(["attribute", *TINY, *QUIET, *options, "--out", str(out)])


def test_a_metric(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, metric in entry("A metric", code("A metric"), NamedMetric=NamedMetric).items():
        monkeypatch.setitem(metrics.BY_NAME, name, metric)
        assert attribute(tmp_path, "--metric", name, "--json") == 0
        assert json.loads(capsys.readouterr().out)["metric"]["name"] == "BlueFraction"


def test_an_output_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    title = "An output format"
    for name, one in entry(title, code(title), OutputFormat=OutputFormat).items():
        monkeypatch.setitem(_formats.FORMATS, name, one)
        assert attribute(tmp_path, "--format", name) == 0
        (file,) = tmp_path.iterdir()
        assert file.name == one.file
        assert "light: radiance" in file.read_text()


def test_a_sensor(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = code("A sensor")
    for name, sensor in entry("A sensor", module, SensorType=SensorType).items():
        monkeypatch.setitem(SENSORS, name, sensor)
        monkeypatch.setitem(sys.modules, f"scenecaptum.rendering.sensors.{name}", module)
        camera = SceneRenderer("cornell-box", sensor=name, resolution=(24, 12), spp=1).camera
        assert camera.projection == name
        assert camera.solid_angles.sum().item() == pytest.approx(4 * math.pi)
        assert attribute(tmp_path, "--sensor", name, "--metric", "illuminance") == 0


@pytest.mark.parametrize("title", ["A metric", "An output format", "A sensor"])
def test_the_files_that_it_touches_exist(title: str) -> None:
    new, *others = re.findall(r"`([\w/]+\.\w+)`", section(title).rpartition("\nFiles: ")[2])
    source = REPOSITORY / "src" / "scenecaptum"
    assert (source / new).parent.is_dir()
    assert len(others) <= 3
    assert all((source / path).is_file() or (REPOSITORY / path).is_file() for path in others)
