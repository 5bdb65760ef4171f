"""docs/extending.md: the code of each section, as a file, and its line of the registry are all that is needed."""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from extending import PAGE, code, entry, section
from seeds import shifted

from scenecaptum import IntegratedGradientsScene, SceneCaptumError, SceneRenderer, cli, metrics
from scenecaptum.attr import METHODS, NamedMethod
from scenecaptum.cli import _formats
from scenecaptum.cli._files import OutputFormat
from scenecaptum.metrics import NamedMetric
from scenecaptum.rendering import INTEGRATORS, SENSORS, IntegratorKind, SensorType, integrators
from scenecaptum.scene.bundled import BUNDLED

REPOSITORY = Path(__file__).parents[2]
TINY = ["cornell-box", "--resolution", "16x16", "--spp", "8", "--max-depth", "2", "--inputs", "emitters"]
QUIET = ["--replicates", "2", "--denoise", "off", "--no-progress"]


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


@pytest.mark.parametrize(
    ("title", "expected"),
    [
        ("An attribution method", "TrapezoidGradientScene"),
        ("A method without derivatives", "HalvingScene"),
    ],
)
def test_an_attribution_method(
    title: str,
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, method in entry(title, code(title), NamedMethod=NamedMethod).items():
        monkeypatch.setitem(METHODS, name, method)
        assert attribute(tmp_path, "--method", name, "--json") == 0
        result = json.loads(capsys.readouterr().out)
        assert result["info"]["method"] == expected


def test_a_method_whose_contributions_are_those_of_integrated_gradients() -> None:
    method = code("An attribution method").TrapezoidGradientScene
    renderer = SceneRenderer("cornell-box", "light.*", resolution=(16, 16), spp=512, max_depth=3)
    found, integrated = (
        one(renderer, metrics.MeanLuminance()).attribute(baselines="dark", seed=shifted(seed))
        for one, seed in ((method, 1), (IntegratedGradientsScene, 2))
    )
    # The metric is linear in the light, so that two points are enough.
    for name, effect in found.effects().items():
        error = math.hypot(found.effects_error()[name], integrated.effects_error()[name])
        assert abs(effect - integrated.effects()[name]) <= 4 * error
    assert found.kind is integrated.kind
    assert "compared with: all lights off" in str(found)


def test_an_integrator(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    title = "An integrator"
    module = code(title)
    (line,) = re.findall(r"^        (IntegratorKind\(.*\)),$", section(title), re.MULTILINE)
    for kind in eval(f"({line},)", {"IntegratorKind": IntegratorKind}):
        name = kind.plugin
        monkeypatch.setitem(INTEGRATORS, name, kind)
        monkeypatch.setitem(sys.modules, f"scenecaptum.rendering.integrators.{kind.module}", module)
        renderer = SceneRenderer("cornell-box", resolution=(8, 8), spp=16, max_depth=5)
        direct = renderer.replace(max_depth=2)
        assert torch.equal(renderer.replace(integrator=name)(seed=1), direct(seed=1))
        assert not torch.equal(renderer(seed=1), direct(seed=1))


def test_a_scene_may_name_a_listed_integrator_that_nothing_has_imported(
    tmp_path: Path, mi: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = "from scenecaptum.rendering.integrators.path import ReplayIntegrator, mi\n"
    late += "mi.register_integrator('scenecaptum_late', ReplayIntegrator)\n"
    (tmp_path / "late.py").write_text(late)
    monkeypatch.setattr(integrators, "__path__", [*integrators.__path__, str(tmp_path)])
    kind = IntegratorKind("scenecaptum_late", "late", media=False, reason="for a test")
    monkeypatch.setitem(INTEGRATORS, kind.plugin, kind)
    scene = {**BUNDLED["cornell-box"](), "integrator": {"type": kind.plugin, "max_depth": 3}}
    assert SceneRenderer(scene, resolution=(8, 8), spp=1).plan.max_depth == 3


def test_an_integrator_that_is_not_listed_is_refused_with_a_hint() -> None:
    renderer = SceneRenderer("cornell-box", resolution=(8, 8), spp=1)
    with pytest.raises(SceneCaptumError, match=r"not 'mine'\. To use one of your own, list it"):
        renderer.replace(integrator="mine")


TITLES = re.findall(r"^## (.*)$", PAGE.read_text(), re.MULTILINE)


@pytest.mark.parametrize("title", TITLES)
def test_the_files_that_it_touches_exist(title: str) -> None:
    first, *others = re.findall(r"`([\w/]+\.\w+)`", section(title).rpartition("\nFiles: ")[2])
    source = REPOSITORY / "src" / "scenecaptum"
    assert (source / first).parent.is_dir()
    assert len(others) <= 3
    assert all((source / path).is_file() or (REPOSITORY / path).is_file() for path in others)
