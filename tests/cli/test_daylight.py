"""Metrics of daylight and sensor grids on the command line: refusals, and what is written of a grid."""

from __future__ import annotations

import argparse
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import results
import torch

from scenecaptum import SceneRenderer, SensorGrid, VanillaSceneGradient, cli, daylight, metrics
from scenecaptum.attr import Definition, Explanation
from scenecaptum.cli import _compared, _daylight, _plan
from scenecaptum.cli._explain import explanation_numbers
from scenecaptum.cli._points import coefficients_of
from scenecaptum.daylight import PlanValues
from scenecaptum.explanation import grid_premises
from scenecaptum.visualization import plot_plan, rounded

TINY = "classroom --spp 1 --spacing 4"

REFUSED = {
    "mixed": ("attribute classroom --metric sda --metric luminance", "sda needs daylight coefficients of a"),
    "direct and all": ("attribute classroom --metric sda --metric ase", "`scenecaptum daylight` with all of"),
    "a view": ("explain classroom --metric sda --sensor fisheye", "not by --sensor fisheye: remove it"),
    "resolution": (
        "explain classroom --metric sda --resolution 8x8",
        "--resolution has no effect on a sensor",
    ),
    "no grid": ("attribute classroom --spacing 1", "--spacing has no effect on a view: add --sensor grid"),
    "no daylight": ("compare classroom --set a=1 --weather a.epw", "--weather has no effect on luminance"),
    "overcast": (
        "daylight classroom --metric daylight-factor --north 9",
        "--north has no effect on daylight-f",
    ),
    "goal": (
        "optimize classroom --metric sda --below 3",
        "sda is a metric of daylight: use daylight, explain",
    ),
    "misspelt": ("attribute classroom --metric sdaa", "Did you mean 'sda'"),
    "no file": ("daylight classroom --weather nowhere.epw", "nowhere.epw cannot be read"),
    "bad file": (
        "daylight classroom --weather bad.epw",
        "bad.epw is not an EPW file: line 1 must be LOCATION",
    ),
    "no floor": (f"daylight {TINY} --floor flor", "--floor 'flor': the scene has no shape"),
    "no floor of this name": (f"daylight {TINY} --floor nowhere", "The largest level shapes are"),
    "no floor of this material": (f"daylight {TINY} --floor pane", "Name another with --floor. The largest"),
    "no room": (f"daylight {TINY} --height 50", "check --height, --margin and --rectangle against"),
    **{
        f"too many points of {command}": (
            f"{command} --metric sda --spacing 0.05",
            "too many, more than 2000. Choose a larger --spacing",
        )
        for command in (
            "daylight classroom",
            "explain classroom",
            "compare classroom --set pane.eta=1.6",
            "attribute classroom",
            "validate classroom",
        )
    },
    "too high": (f"daylight {TINY} --height 3.5", "No point of the sensor grid is in the room"),
    "no sky": ("daylight cornell-box --spacing 2 --height 0.1", 'in XML <emitter type="constant"/>'),
    "heatmap": (
        f"attribute {TINY} --metric sda --format heatmap",
        "--format heatmap needs a picture of objec",
    ),
    "exr": (
        f"attribute {TINY} --sensor grid --metric uniformity --format exr",
        "leave --format out, which als",
    ),
    "patches": (f"daylight {TINY} --subdivision 0", "subdivision must be a whole number from 1 to 16"),
    "north": (f"daylight {TINY} --north nan", "north must be an angle in degrees"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_one_clear_line_before_the_run(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.epw").write_text("no weather\n")
    monkeypatch.setattr(
        "scenecaptum.rendering.SceneRenderer.forward", lambda *_, **__: pytest.fail("it rendered")
    )
    text, message = REFUSED[case]
    assert cli.main(shlex.split(f"{text} --out out")) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["explain", "attribute", "validate", "compare"])
def test_a_grid_of_too_many_points_is_an_error_without_a_warning(
    command: str, recwarn: pytest.WarningsRecorder, capsys: pytest.CaptureFixture[str]
) -> None:
    # Of which some lie inside the desk.
    text = f"{command} office --sensor grid --metric mean-illuminance --spacing 0.05"
    text += " --set ceiling.reflectance.value=0.5" if command == "compare" else ""
    assert cli.main(shlex.split(text)) == 2
    assert "too many, more than 2000" in capsys.readouterr().err
    assert not [str(one.message) for one in recwarn if "inside objects" in str(one.message)]


def test_a_grid_is_not_rendered_to_a_picture_without_a_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"render office --sensor grid --spp 1 --to {tmp_path}/points"
    assert cli.main(shlex.split(f"{text}.png")) == 2
    error = capsys.readouterr().err
    assert "explain --sensor grid --metric mean-illuminance writes plan.png" in error
    assert error.count("\n") == 1
    assert cli.main(shlex.split(f"{text}.exr")) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["points.exr"]


def test_a_missing_sky_is_an_error_without_a_warning(
    recwarn: pytest.WarningsRecorder, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(shlex.split("daylight office --spacing 0.2")) == 2
    error = capsys.readouterr().err
    assert "Daylight coefficients need a sky" in error
    assert "its `sky` is an area light, not a constant emitter" in error
    assert not [str(one.message) for one in recwarn if "inside objects" in str(one.message)]


@pytest.mark.long
def test_a_warning_on_points_is_shown_once_where_nothing_is_wrong(tmp_path: Path) -> None:
    command = (
        f"attribute office --sensor grid --metric mean-illuminance --spacing 0.2 --spp 1 --out {tmp_path}"
    )
    with pytest.warns(UserWarning, match="of the sensor grid lie inside objects") as shown:
        assert cli.main(shlex.split(command)) == 0
    assert sum("inside objects" in str(one.message) for one in shown) == 1


def test_the_files_of_a_grid_are_numbers_bars_and_a_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "attribute cornell-box --sensor grid --spacing 0.7 --height 1.5 --metric mean-illuminance --spp 4 "
        f"--replicates 2 --inputs emitters --report --out {tmp_path}"
    )
    assert cli.main(shlex.split(text)) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "attribution.json",
        "attribution.csv",
        "attribution.npz",
        "bars.png",
        "plan.png",
        "report.html",
    }
    report = (tmp_path / "report.html").read_text()
    assert '"names":[]' in report
    assert re.search(r'"sensor grid":"\d+ points on \w+( \(\w+\))?, ', report)
    assert cli.main(["compare", f"{tmp_path}/attribution.npz", f"{tmp_path}/attribution.npz"]) == 2
    assert "compare the scenes, not the files" in capsys.readouterr().err


def test_a_rectangle_is_a_part_of_a_floor_that_is_larger_than_the_room(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the order of ``SensorGrid(rectangle=)``: x and y of both corners."""
    text = (
        "explain classroom --spp 1 --metric daylight-factor --spacing 0.5 --margin 0 --rectangle -2 1 -1 3 "
        f"--changes 0 --json --out {tmp_path}"
    )
    assert cli.main(shlex.split(text)) == 0
    (grid,) = [one for one in json.loads(capsys.readouterr().out)["premises"] if one.startswith("grid: ")]
    assert grid.startswith("grid: 8 points on floor_shape (floor), 0.8 m above it, 1 × 2 m, 0.5 m apart")


def test_every_name_of_daylight_is_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("daylight", "explain", "attribute", "compare", "validate"):
        with pytest.raises(SystemExit):
            cli.main([command, "--help"])
        printed = "".join(capsys.readouterr().out.split())  # lines may break after a hyphen
        for name, metric in daylight.BY_NAME.items():
            assert f"{name}({metric.description})".replace(" ", "") in printed


def test_the_kinds_that_a_designer_chooses_are_the_inputs_of_the_command() -> None:
    changes = "--set pane.eta=1.6 --set desk.base_color.value*=0.5"
    options = cli.parser().parse_args(shlex.split(f"daylight classroom --spacing 4 --spp 1 {changes}"))
    renderer = _daylight._renderer(options, coefficients_of("daylight-factor", options))
    chosen = _daylight._values(renderer, options)
    assert {"pane.specular_transmittance.value", "cloth.opacity.value", "desk.base_color.value"} <= set(
        chosen
    )
    assert "pane.eta" not in chosen
    assert renderer.own_value("pane.eta").item() == pytest.approx(1.6)
    desk = "desk.base_color.value"
    torch.testing.assert_close(chosen[desk], renderer.own_value(desk) / 2)
    assert not {name for name in chosen if "roughness" in name or "legs.eta" in name or "sky" in name}
    everything = _daylight._values(renderer, argparse.Namespace(**{**vars(options), "inputs": ["all"]}))
    assert set(everything) == set(renderer.inputs)


@pytest.mark.long
def test_the_cards_of_a_comparison_show_values_by_the_definition_and_their_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"compare {TINY} --metric sda --set ceiling.reflectance.value=0.3 --out {tmp_path} --json"
    assert cli.main(shlex.split(text)) == 0
    printed = json.loads(capsys.readouterr().out)
    (found,) = re.findall(
        r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', page(tmp_path), re.DOTALL
    )
    shown = json.loads(found)
    values = [one["definition"]["value"] for one in printed["results"]]
    assert [float(one["written"][0]) for one in shown["results"]] == pytest.approx(values, abs=0.5)
    assert shown["comparison"]["change"] == pytest.approx(values[1] - values[0])
    assert printed["change"]["definition"]["value"] == pytest.approx(values[1] - values[0])
    assert any("relaxed metric" in note and "changes by" in note for note in shown["comparison"]["notes"])
    for card in shown["results"]:
        assert any(one.startswith("caution: blinds are not modeled") for one in card["sampling"])
        for part in ("only serves the derivatives", "weather: made-up", "grid: "):
            assert any(part in one for one in card["premises"]), part


def test_what_one_result_alone_was_computed_for_begins_with_its_title() -> None:
    both, one = "weather: made-up", results.make()
    sides = [
        _compared.Side(premises=(both, "grid: 9 points")),
        _compared.Side(premises=("caution: dark", both)),
    ]
    found = _compared.Compared(one, one, ["A", "B"], 0.0, None, sides)
    assert found.premises() == [both, "A: grid: 9 points", "B: caution: dark"]
    assert [shown.notes()[-2:] for shown in found.shown()] == [list(side.premises) for side in sides]


@pytest.mark.parametrize("command", ["daylight", pytest.param("compare", marks=pytest.mark.long)])
def test_the_points_that_pass_on_a_plan_are_the_quoted_value(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With few samples, two estimates for the same room differ by whole points."""
    counted = []

    def count(values: torch.Tensor, plan: Any, inside: torch.Tensor, **options: Any) -> Any:
        (limit,) = options["levels"]
        counted.append((values[inside] >= limit).double().mean().item())
        return plot_plan(values, plan, inside, **options)

    monkeypatch.setattr(_plan, "plot_plan", count)
    text = f"{command} classroom --spp 4 --spacing 1 --metric sda --json --out {tmp_path}"
    of_command = {"daylight": "--changes 0 --report", "compare": "--set ceiling.reflectance.value=0.3"}
    assert cli.main(shlex.split(f"{text} {of_command[command]}")) == 0
    printed = json.loads(capsys.readouterr().out)
    if command == "compare":
        quoted = [one["definition"]["value"] for one in printed["results"]]
        assert [100 * share for share in counted] == pytest.approx(quoted)
        return
    (said,) = printed
    in_report_and_file = [100 * share for share in counted]
    assert in_report_and_file == pytest.approx([said["metric"]["definition"]["value"]] * 2)
    points = sum(row["count"] for row in said["rows"])
    share = sum(row["value"] * row["count"] for row in said["rows"]) / points
    assert share == pytest.approx(said["metric"]["definition"]["value"])


def page(folder: Path) -> str:
    return (folder / "comparison.html").read_text()


def test_the_verdict_of_the_numbers_is_that_of_the_definition() -> None:
    attribution = results.make(measure={"name": "sDA", "unit": "%", "limits": [55.0]}, verdict="below 55 %")
    definition = Definition(57.1, "at least 55 %", 63, error=0.5)
    renderer = SceneRenderer("cornell-box", resolution=(4, 4))
    numbers = explanation_numbers(Explanation(attribution, definition=definition), renderer)["metric"]
    assert numbers["verdict"] == numbers["definition"]["verdict"] == "at least 55 %"
    assert explanation_numbers(Explanation(attribution), renderer)["metric"]["verdict"] == "below 55 %"


def test_the_grid_is_a_premise_and_a_setting_with_those_that_were_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        f"explain {TINY} --metric daylight-factor --height 0.7 --changes 0 --json --report --out {tmp_path}"
    )
    assert cli.main(shlex.split(text)) == 0
    (grid,) = [one for one in json.loads(capsys.readouterr().out)["premises"] if one.startswith("grid: ")]
    assert re.fullmatch(
        r"grid: \d+ points on floor_shape \(floor\), 0.7 m above it, [\d.]+ × [\d.]+ m, [\d.]+ m apart, "
        "if the scene's unit is the metre",
        grid,
    )
    report = (tmp_path / "report.html").read_text()
    assert '"height":"0.7"' in report
    shown = grid.removeprefix("grid: ").partition(", if")[0]
    assert f'"sensor grid":"{shown}"'.replace("×", "\\u00d7") in report


def test_a_grid_mostly_outside_of_the_room_has_a_caution() -> None:
    def cautions(**options: object) -> list[str]:
        grid = SensorGrid(spacing=2.0, **options)
        return [line for line in grid_premises(SceneRenderer("classroom", sensor=grid)) if "caution" in line]

    (caution,) = cautions(rectangle=((-12.0, -12.0), (20.0, 20.0)))
    assert "points have nothing above them, no ceiling and no glass" in caution
    assert cautions() == []


def test_the_plan_says_the_error_of_a_point() -> None:
    room = SceneRenderer("classroom", "reflectance", sensor=SensorGrid(), spp=8, max_depth=2)
    metric = metrics.MeanIlluminance(room.grid)
    result = VanillaSceneGradient(room, metric).attribute(seed=0)
    error = 179 * result.info["picture"]["pixel_error"]
    assert error > (result.metric_standard_error or 0)
    below = _plan.draw_plan(result.image, room, metric, result.info).axes[0].get_xlabel()
    assert f"± {rounded(error, 2)} lx at a point" in below


@pytest.mark.parametrize("more", ["daylight classroom", "compare classroom --metric sda"])
def test_a_darker_sky_in_daylight_is_refused_with_the_reason(
    more: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Selecting the sky would be refused for the same reason: the weather sets it."""
    assert cli.main([*more.split(), "--set", "sky.radiance.value*=0.7", "--spacing", "2", "--spp", "4"]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "cannot be an input: daylight coefficients are per unit radiance of the sky, which the weather"
        in said
    )
    assert "selects it" not in said


def test_the_title_of_a_plan_is_one_sentence_that_keeps_its_unit() -> None:
    shares = PlanValues(
        torch.zeros(1), "occupied hours with at least 300 lx in %", (50.0,), "from 50 % on, one counts"
    )
    assert (
        _plan._title(shares)
        == "Occupied hours with at least 300\u00a0lx\u00a0in\u00a0%; from 50 % on, one counts"
    )
    assert _plan._title(PlanValues(torch.zeros(1), "lux")) == "Lux"
