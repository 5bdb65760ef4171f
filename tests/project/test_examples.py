"""The scripts in examples/ run at a reduced size, and print what they claim."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from chance import allowed
from loading import load_script
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, metrics

EXAMPLES = Path(__file__).parents[2] / "examples"
SIZE = (32, 18)


@pytest.fixture(autouse=True)
def _examples_import_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)


def load(name: str) -> ModuleType:
    return load_script(EXAMPLES / f"{name}.py")


def test_the_picture_of_the_readme_says_what_causes_the_glare(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    load("readme_picture").main(tmp_path / "new" / "office.png", SIZE, 16)
    assert (tmp_path / "new" / "office.png").is_file()
    assert "Where the glare comes from" in capsys.readouterr().out


def test_lamps_add_up_to_the_brightness(mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lamps = load("which_lamp").main(tmp_path / "new", SIZE, 16)["mean luminance"]
    whole = sum(sum(lamp.total) for lamp in lamps.ranking())
    error = sum(lamp.saliency_error**2 for lamp in lamps.ranking()) ** 0.5 + lamps.metric_standard_error
    assert abs(whole - lamps.metric_value) < allowed(8) * error
    assert "all of them" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"mean-luminance.png", "ugr.png"}


def test_two_designs_are_compared(mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change = load("two_designs").main(tmp_path / "new", SIZE, 16)
    assert change.metric_value < 0, "lighter surroundings glare less"
    assert (tmp_path / "new" / "ranks.png").is_file()
    assert "lighter walls" in capsys.readouterr().out


def test_a_study_of_rooms_says_what_its_cells_cost(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    script = load("rooms_study")
    cameras = dict(list(script.CAMERAS.items())[:2])
    for name, value in {"BUNDLED": ["cornell-box"], "CAMERAS": cameras, "METRICS": ["luminance"]}.items():
        monkeypatch.setattr(script, name, value)
    options = ["--resolution", "16x9", "--spp", "2", "--workers", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["rooms_study.py", *options])
    assert script.main() == 0
    printed = capsys.readouterr().out
    assert "all 2 cells: " in printed
    assert "\ncornell-box                  2 " in printed
    assert {"luminance.png", "gallery.png", "report"} <= {path.name for path in tmp_path.iterdir()}


def test_a_metric_of_your_own_depends_most_on_its_object(mi: Any, tmp_path: Path) -> None:
    found = load("own_metric").main(tmp_path / "new", SIZE, 32)
    assert any("desk" in row.label for row in found.ranking(top=5)), found
    assert (tmp_path / "new" / "contrast.png").is_file()


def test_a_logit_depends_most_on_the_chair(mi: Any, torchvision: Any, tmp_path: Path) -> None:
    found = load("chair_logit").main(tmp_path / "new", (32, 32), 8, random=True)
    assert found.metric_value != 0
    assert (tmp_path / "new" / "chair.png").is_file()


def test_metrics_rank_parameters_each_in_its_own_way(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    correlations = load("specificity").main(tmp_path / "new", SIZE, 32)
    with_itself = [value for (one, other), value in correlations.items() if one == other]
    with_another = [value for (one, other), value in correlations.items() if one != other]
    # The metrics differ by far more than the noise.
    assert min(with_itself) > 0.8, correlations
    assert max(with_another) < 0.5, correlations
    assert correlations["UGR", "mean luminance"] == correlations["mean luminance", "UGR"]
    assert (tmp_path / "new" / "specificity.png").is_file()
    assert "desk's contrast" in capsys.readouterr().out


def test_the_ceiling_lights_the_work_plane(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = load("work_plane").main(tmp_path / "new", 64, 1.0)
    assert found["mean illuminance"].ranking(top=1)[0].label == "ceiling: reflectance"
    assert (tmp_path / "new" / "work-plane.png").is_file()
    assert "uniformity by the definition" in capsys.readouterr().out


def test_desk_and_lamp_move_until_the_glare_is_low(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    example = load("desk_lamp")
    monkeypatch.setattr(example, "PICTURE", SIZE)
    found = example.main(tmp_path / "new", (64, 36), 16, steps=3)
    renderer = SceneRenderer(
        example.evening_office(), list(found.values), objects=example.OBJECTS, resolution=(64, 36), spp=64
    )
    glare = metrics.UnifiedGlareRating(renderer.camera)
    falls = torch.stack(
        [glare(renderer(seed=seed)) - glare(renderer(found.values, seed=seed)) for seed in seeds(100, 108)]
    )
    assert falls.mean() > allowed(len(falls)) * falls.std() / math.sqrt(len(falls))
    assert {moved.name for moved in found.moved} == {example.DESK, example.SHADE}
    low, high = (torch.tensor(limit) for limit in example.LIMITS[example.DESK])
    assert ((low <= found.values[example.DESK]) & (found.values[example.DESK] <= high)).all()
    assert (tmp_path / "new" / "desk-lamp.png").is_file()
    assert "Move the desk" in capsys.readouterr().out


def test_the_camera_turns_along_the_gradient_of_a_margin(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    example = load("lost_view")
    monkeypatch.setattr(example, "SHIFTS", 3)
    found = example.main(tmp_path / "new", spp=16, steps=2, turns=2)
    angles = [view.turn.norm().item() for view in found.steps]
    assert angles[:2] == [0.0, pytest.approx(example.STEP)]
    assert angles[-1] <= 2 * example.STEP + 1e-6
    assert found.steps[0].margin > 2 * found.steps[0].error, "the sphere is seen at first"
    assert len(found.random) == 2
    assert found.classes[0] == "sphere"
    assert (tmp_path / "new" / "lost-view.png").is_file()
    assert "random turns" in capsys.readouterr().out


@pytest.mark.long
def test_a_turn_of_the_camera_loses_the_sphere(mi: Any, tmp_path: Path) -> None:
    found = load("lost_view").main(tmp_path / "new")
    last = found.steps[-1]
    assert last.margin + 2 * last.error < 0
    assert sum(margin < 0 for margin in found.random) < len(found.random) / 2


@pytest.mark.long
def test_the_scene_attribution_competes_with_pixels(
    mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("captum", reason="captum is not installed")
    curves = load("pixels_or_scene").main(tmp_path / "new", (16, 9), 8, draws=2)
    assert list(curves.others) == ["Captum's Saliency", "Captum's IntegratedGradients"]
    assert (tmp_path / "new" / "curves.png").is_file()
    printed = capsys.readouterr().out
    assert "of 29 parameters belong to no visible object" in printed
    assert "lead over it" in printed


def test_a_planted_shortcut_is_found(mi: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    planted, clean = load("planted_shortcut").main(
        tmp_path / "new", trainings=1, first_seed=shifted(0), rooms=120, epochs=24, spp=256, steps=4
    )
    assert planted.shortcut
    assert not clean.shortcut
    assert planted.accuracy_with > planted.accuracy_without + 0.1, "it has learned the shortcut"
    assert planted.finding.is_first_and_clear, planted.attribution
    assert abs(clean.finding.effect) < planted.finding.effect / 3, clean.attribution
    assert "1 of 1 with the shortcut" in capsys.readouterr().out
    assert (tmp_path / "new" / "trainings.png").is_file()
