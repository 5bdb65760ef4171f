"""Every command with every documented option: what it prints, how it exits and what it leaves."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bitmaps import read_bitmap, write_bitmap
from PIL import Image

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, cli, metrics
from scenecaptum.cli import _compared_effects, _demo, _explore, _main, _optimize, _tradeoff
from scenecaptum.cli._messages import in_options
from scenecaptum.denoising import denoise
from scenecaptum.designs import design_of, read_design, settings_of
from scenecaptum.optimize import Optimization
from scenecaptum.tradeoff import Tradeoff

VIEW = "--resolution 16x16 --spp 16 --max-depth 3 --seed 1"
FILE_WALL = "wall_shape.bsdf.reflectance.value"
FILE = f"scene.xml -D level=0.25 {VIEW}"
BOXES = "--object boxes=short_box_shape,tall_box_shape"
SCENE = f"cornell-box {VIEW} {BOXES} --inputs reflectance --inputs emitters --sensor 0 --checkpoint kept"
WALL = "left_wall.reflectance.value"

# Four points under a pane.
DAYLIGHT = (
    "room.xml -D level=0.4 --inputs reflectance --spp 8 --max-depth 3 --spacing 1 --height 0.5 --margin 0.4 "
    "--object floor=floor_shape "
    "--floor floor_shape --rectangle -1 -1 1 1 --weather year.epw.gz --north 90 --subdivision 1"
)

# The first needs a scheduler: test_study.py; the second is the same for all commands: below.
ELSEWHERE = {"--dask", "--smoothing"}

STUDY = """scenes = ["cornell-box"]
inputs = "reflectance"
resolution = [16, 9]
spp = 8
[cameras]
front = 0
left = { turn = -10 }
"""

# Arguments, exit status, words that are printed, and files that are left.
Case = tuple[str, int, list[str], list[str]]
CASES: dict[str, Case] = {
    "explain": (
        f"explain {SCENE} --metric luminance --set {WALL}=0.5 --design design.json --below 25 --changes 1 "
        "--report --title 'The box' --no-progress --out out",
        0,
        [
            "mean luminance = ",
            "cd/m²",
            "What it depends on",
            "What would change it",
            "goal",
            "explanation.md",
        ],
        ["design.json", "explanation.json", "explanation.md", "report.html"],
    ),
    "explain a relative glare rating": (
        f"explain {SCENE} --metric ugr --threshold-factor 2 --json --out out",
        0,
        ['"sentences"', "unified glare rating"],
        ["explanation.json", "explanation.md"],
    ),
    "explain an element": (
        f"explain {FILE} --metric own_metric.py:channels --target 1 --out out",
        0,
        ["channels[1] = "],
        ["explanation.json", "explanation.md"],
    ),
    "explore": (
        f"explore cornell-box {VIEW} {BOXES} --inputs reflectance --sensor 0 --metric luminance --metric ugr "
        f"--threshold-factor 2 --set {WALL}=0.5 --set {WALL}*=0.5 --design design.json --top 2 --port 0 "
        "--no-browser --no-progress --checkpoint kept --to explore.html",
        0,
        ["explore.html"],
        [],
    ),
    "explore an element": (
        f"explore {FILE} --metric own_metric.py:channels --target 1 --to explore.html",
        0,
        ["explore.html"],
        [],
    ),
    "study": (
        "study rooms.toml --workers 1 --threads 1 --retry-failed --no-progress --report --out out",
        0,
        ["2 cells finished", "2 cameras", "index.html"],
        ["cells", "effects.csv", "report", "study.json", "values.csv"],
    ),
    "study as numbers": (
        "study rooms.toml --no-progress --workers 1 --json --out out",
        0,
        ['"measure": "mean luminance"', '"camera": "left"', '"cautions": []', '"failed": []'],
        ["cells", "effects.csv", "study.json", "values.csv"],
    ),
    "explain daylight": (
        f"explain {DAYLIGHT} --metric annual-illumination --changes 0 --report --out out",
        0,
        ["total annual illumination = ", "SYNTHETIC", "latitude 48°", "Which points decide", "plan.png"],
        ["explanation.json", "explanation.md", "plan.png", "report.html"],
    ),
    "daylight": (
        f"daylight {DAYLIGHT} --metric sda --metric daylight-factor --changes 1 --checkpoint kept --seed 1 "
        "--set roof.bsdf.specular_transmittance.value=0.5 --design empty.json --report --title A "
        "--no-progress --out out",
        0,
        ["quote ", "only serves the derivatives", "SYNTHETIC", "CIE overcast", "roof specular transmittance"],
        ["daylight-factor", "report.html", "sda"],
    ),
    "daylight as numbers": (
        f"daylight {DAYLIGHT} --metric da --changes 0 --json --out out",
        0,
        ['"definition"', '"rows"'],
        ["explanation.json", "explanation.md", "plan.png"],
    ),
    "attribute": (
        f"attribute {SCENE} --metric luminance --method gradient --scale unit --groups kind --signed "
        f"--set {WALL}=0.5 --design design.json --replicates 2 --tolerance 2.0 --time-limit 30 --denoise off "
        "--picture-spp 256 --report --title Box --no-progress --format csv --format heatmap --out out",
        0,
        ["mean luminance = ", "reflectance", "emitters", "attribution.csv", "heatmap.png", "report.html"],
        ["attribution.csv", "heatmap.png", "report.html"],
    ),
    "attribute daylight": (
        f"attribute {DAYLIGHT} --metric udi --replicates 2 --report --out out",
        0,
        ["useful daylight illuminance", "by the definition", "SYNTHETIC", "plan.png"],
        [
            "attribution.csv",
            "attribution.json",
            "attribution.npz",
            "bars.png",
            "plan.png",
            "report.html",
        ],
    ),
    "attribute an element": (
        f"attribute {FILE} --metric own_metric.py:channels --target 2 --json --format json --out out",
        0,
        ["channels[2]"],
        ["attribution.json"],
    ),
    "attribute against a baseline": (
        f"attribute {SCENE} --metric ugr --threshold-factor 2 --method ablation --baselines dark "
        "--format npz --out out",
        0,
        ["unified glare rating = ", "attribution.npz"],
        ["attribution.npz"],
    ),
    "compare": (
        f"compare {SCENE} --metric luminance --set {WALL}=0.1 --design design.json --titles before after "
        "--title Both --from other.toml --no-progress --out out",
        0,
        [
            "before: mean luminance",
            "after: mean luminance",
            "change: −",
            "cd/m²",
            "separate renders",
            "comparison.html",
        ],
        ["comparison.html"],
    ),
    "compare daylight": (
        f"compare {DAYLIGHT} --metric da --set roof.bsdf.specular_transmittance.value=0.01 --out out",
        0,
        [
            "as it is: daylight autonomy",
            "by the definition",
            "change: −",
            "The effects are those of the relaxed",
            "both plans",
            "SYNTHETIC",
            "comparison.html",
        ],
        ["comparison.html"],
    ),
    "compare an element": (
        f"compare {FILE} --metric own_metric.py:channels --target 0 --set {FILE_WALL}=0.1 --json --out out",
        0,
        ['"change"'],
        ["comparison.html"],
    ),
    "compare a glare rating": (
        f"compare {SCENE} --metric ugr --threshold-factor 2 --set {WALL}=0.1 --out out",
        0,
        ["unified glare rating"],
        ["comparison.html"],
    ),
    "optimize": (
        f"optimize {SCENE} --metric luminance --below 25 --top 2 --change 0.9 --steps 20 "
        f"--set {WALL}=0.5 --design design.json --no-progress --out out",
        0,
        ["changed", "below the goal of 25 cd/m²", "design.json"],
        ["design.json", "optimization.png"],
    ),
    "optimize towards what cannot be reached": (
        f"optimize {SCENE} --metric ugr --threshold-factor 2 --below -50 --steps 1 --json --out out",
        1,
        ['"reached": false'],
        ["design.json", "optimization.png"],
    ),
    "optimize an element": (
        f"optimize {FILE} --metric own_metric.py:channels --target 0 --below 100 --steps 1 --out out",
        0,
        ["already below the goal of 100"],
        [],
    ),
    "validate": (
        f"validate {SCENE} --metric luminance --top 2 --set {WALL}=0.5 --design design.json --no-progress "
        "--out out",
        0,
        ["Confirmed", "validation.json"],
        ["validation.csv", "validation.json", "validation.png"],
    ),
    "validate daylight": (
        f"validate {DAYLIGHT} --metric annual-illumination --top 1 --out out",
        0,
        ["Confirmed", "SYNTHETIC"],
        ["validation.csv", "validation.json", "validation.png"],
    ),
    "validate an element": (
        f"validate {FILE} --metric own_metric.py:channels --target 0 --top 1 --json --out out",
        0,
        ['"confirmed": true'],
        ["validation.csv", "validation.json", "validation.png"],
    ),
    "validate a glare rating": (
        f"validate {SCENE} --spp 1024 --metric ugr --threshold-factor 2 --top 1 --out out",
        0,
        ["Confirmed"],
        ["validation.csv", "validation.json", "validation.png"],
    ),
    "tradeoff": (
        f"tradeoff {SCENE} --metric luminance --vary spp=8,32 --reference-spp 64 --runs 2 --tolerance 0.5 "
        f"--set {WALL}=0.5 --design design.json --no-progress --out out",
        0,
        ["For an error of 50 %"],
        ["tradeoff.csv", "tradeoff.png"],
    ),
    "tradeoff of an element": (
        f"tradeoff {FILE} --metric own_metric.py:channels --target 0 --vary spp=8 --reference-spp 64 --runs 2 "
        "--json --out out",
        0,
        ["channels"],
        ["tradeoff.csv", "tradeoff.png"],
    ),
    "tradeoff of a glare rating": (
        f"tradeoff {SCENE} --metric ugr --threshold-factor 2 --vary spp=8 --reference-spp 64 --runs 2 --out out",
        0,
        ["unified glare rating"],
        ["tradeoff.csv", "tradeoff.png"],
    ),
    "parameters": ("parameters cornell-box left_* --kind reflectance", 0, [WALL], []),
    "all parameters": ("parameters cornell-box --all", 0, [WALL, "setting of the camera"], []),
    "parameters that can be inputs": (
        "parameters cornell-box",
        0,
        [WALL, "others cannot be inputs: --all lists them"],
        [],
    ),
    "parameters of a file": (
        "parameters scene.xml -D level=0.25 --json",
        0,
        ['"wall_shape.bsdf.reflectance.value"'],
        [],
    ),
    "render": (
        f"render cornell-box {VIEW} {BOXES} --sensor 0 --set {WALL}=0.5 --set boxes.pose.translation=0.1,0,0 "
        "--design design.json --denoise --no-progress --to out/after.png",
        0,
        ["out/after.png"],
        ["after.png"],
    ),
    "demo": (
        "demo --json --no-progress --report --title Demo --format json --out out",
        0,
        ["ranking"],
        ["attribution.json", "report.html"],
    ),
    "doctor": ("doctor", 0, ["llvm"], []),
    "render with $names": (f"render scene.xml -D level=0.25 {VIEW} --to out.exr", 0, ["out.exr"], []),
}

XML = """<scene version="3.0.0">
  <default name="level" value="0.5"/>
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="rectangle" id="wall_shape"><bsdf type="diffuse" id="wall">
    <rgb name="reflectance" value="$level"/></bsdf></shape>
  <emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>
</scene>
"""
ROOM = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,-1,1" target="0,1,1" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="rectangle" id="floor_shape"><bsdf type="diffuse">
    <rgb name="reflectance" value="$level"/></bsdf></shape>
  <shape type="rectangle" id="roof"><transform name="to_world"><translate z="2"/></transform>
    <bsdf type="thindielectric"><rgb name="specular_transmittance" value="0.6"/></bsdf></shape>
  <emitter type="constant" id="sky"/>
</scene>
"""
METRIC = "def channels(image):\n    return 179 * image.mean((0, 1))\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a scene, a metric and two designs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_demo, "ARGUMENTS", ("office", "--resolution", "16x9", "--spp", "8"))
    (tmp_path / "scene.xml").write_text(XML)
    (tmp_path / "room.xml").write_text(ROOM)
    (tmp_path / "empty.json").write_text("{}")
    (tmp_path / "rooms.toml").write_text(STUDY)
    with as_file(files("scenecaptum.daylight") / "synthetic.epw.gz") as year:
        (tmp_path / "year.epw.gz").write_bytes(year.read_bytes())
    (tmp_path / "own_metric.py").write_text(METRIC)
    (tmp_path / "design.json").write_text(json.dumps({WALL: [0.3, 0.2, 0.1]}))
    (tmp_path / "other.toml").write_text("[left_wall.reflectance]\nvalue = [0.9, 0.2, 0.1]\n")
    return tmp_path


def subparsers() -> dict[str, argparse.ArgumentParser]:
    (commands,) = (
        action for action in cli.parser()._actions if isinstance(action, argparse._SubParsersAction)
    )
    return dict(commands.choices)


def options(parser: argparse.ArgumentParser) -> Iterator[list[str]]:
    """Return the ways to write each option of a command."""
    for action in parser._actions:
        if action.option_strings and "--help" not in action.option_strings:
            yield list(action.option_strings)


def test_every_option_of_every_command_is_driven() -> None:
    for name, parser in subparsers().items():
        given = {word for text, *_ in CASES.values() for word in shlex.split(text) if text.split()[0] == name}
        missing = [names for names in options(parser) if not given & set(names)]
        missing = [names for names in missing if not ELSEWHERE & set(names)]
        assert not missing, f"{name}: no case has {missing}"


@pytest.mark.skipif(sys.version_info < (3, 11), reason="a design in TOML needs tomllib")
@pytest.mark.parametrize("name", CASES)
def test_a_command_prints_exits_and_leaves_what_it_says(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, status, words, files = CASES[name]
    assert cli.main(shlex.split(text)) == status
    printed = capsys.readouterr()
    assert printed.err == ""
    assert [word for word in words if word not in printed.out] == []
    if "--json" in text:
        json.loads(printed.out)
    found = sorted(path.name for path in (folder / "out").iterdir()) if (folder / "out").exists() else []
    assert found == files
    if "--json" not in text:
        assert [file for file in files if file not in printed.out] == []


def test_an_empty_checkpoint_promises_no_resume(tmp_path: Path) -> None:
    options = argparse.Namespace(checkpoint=tmp_path, out=None)
    assert "no render was finished" in _main._kept(options, 0.0)
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "file").touch()
    assert f"resume from {tmp_path}" in _main._kept(options, 0.0)


def test_the_samples_of_the_first_round_can_be_given(folder: Path) -> None:
    goal = "--inputs emitters --tolerance 50 --format json --out out"
    assert cli.main(shlex.split(f"attribute cornell-box {VIEW} {goal}")) == 0
    assert json.loads((folder / "out" / "attribution.json").read_text())["info"]["spp"] == 16


def test_a_logit_is_smoothed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logit = "--metric shape-logit --target cube --smoothing 0.3"
    assert cli.main(shlex.split(f"attribute cornell-box {VIEW} --inputs emitters {logit} --out out")) == 0
    assert "smoothed logit of cube = " in capsys.readouterr().out
    assert (
        cli.main(shlex.split(f"attribute cornell-box {VIEW} --metric luminance --smoothing 0.3 --out out"))
        == 2
    )
    assert "--smoothing has no effect on luminance: add --metric shape-logit" in capsys.readouterr().err


def test_a_class_that_is_unknown_is_named_before_rendering(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"attribute cornell-box {VIEW} --inputs emitters --out out"
    assert cli.main(shlex.split(f"{command} --metric shape-logit --target cylindre")) == 2
    known = "It has 3 classes: sphere, cube, cylinder. Did you mean 'cylinder'?"
    assert f"no class called 'cylindre'. {known}" in capsys.readouterr().err
    assert cli.main(shlex.split(f"{command} --metric shape-logit")) == 2
    choice = "choose one with --target on the command line or target= in Python: sphere, cube, cylinder."
    assert choice in capsys.readouterr().err
    assert cli.main(shlex.split(f"{command} --metric luminance --target cube")) == 2
    assert "only the metrics of classifiers, such as ClassLogit, have elements" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--set chair.pose.translation=0.1,0,0", "'chair.pose.translation' matches no parameter"),
        ("--object boxes", "'boxes' is not NAME=SHAPE,SHAPE"),
        ("--object boxes=box_*", "box_*"),
    ],
)
def test_objects_that_are_not_there_are_named(
    option: str, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):  # as the parser ends it, too
        sys.exit(cli.main(shlex.split(f"render cornell-box {VIEW} {option} --to out.png")))
    assert words in capsys.readouterr().err
    assert not (folder / "out.png").exists()


SLOW_EXAMPLES = ("tradeoff", "validate")  # which render dozens of settings or parameters


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=pytest.mark.long if one in SLOW_EXAMPLES else ()) for one in subparsers()],
)
def test_the_example_in_the_help_runs(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = subparsers()[name]
    if name == "doctor":
        return  # it has no options
    assert parser.epilog is not None
    example = shlex.split(parser.epilog.replace("\n", " ").partition("example: scenecaptum ")[2])
    assert example[0] == name
    if name == "tradeoff":
        example = ["cornell-box" if word == "office" else word for word in example] + ["--runs", "2"]
    small = {
        "parameters": [],
        "demo": [],
        "study": [],
        "daylight": ["--spacing", "4", "--inputs", "pane.*", "--changes", "0", "--spp", "2"],
    }.get(name, ["--resolution", "16x9", "--spp", "16"])
    small += ["--to", "explore.html"] if name == "explore" else []  # which would wait for Ctrl-C
    status = cli.main([*example, *small])
    # A tiny picture need not reach the goal or confirm the prediction.
    assert status == 0 or (status == 1 and name in ("optimize", "validate"))


def test_a_design_that_was_found_is_rendered_and_compared(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(shlex.split(f"optimize {SCENE} --metric luminance --below 25 --out found")) == 0
    design = json.loads((folder / "found" / "design.json").read_text())
    capsys.readouterr()
    assert cli.main(shlex.split(f"compare {SCENE} --design found/design.json --json --out out")) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["change"]["value"] < -5 * numbers["change"]["standard_error"]
    for name, (_, after) in numbers["values"].items():
        np.testing.assert_allclose(after, design[name], rtol=1e-5)
    assert cli.main(shlex.split(f"render cornell-box {VIEW} --design found/design.json --to found.png")) == 0
    assert Image.open(folder / "found.png").size == (16, 16)


@pytest.mark.parametrize(("change", "form"), [(0.05, "+"), (0.9, "")])
def test_the_design_of_a_search_has_the_values_that_were_measured(
    change: float,
    form: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Also of a texture: as an offset, or with all its texels where some have been clamped."""
    results = []

    @functools.wraps(_optimize.minimize)
    def minimize(*given: Any, **more: Any) -> Optimization:
        results.append(_optimize.minimize.__wrapped__(*given, **more))
        return results[-1]

    monkeypatch.setattr(_optimize, "minimize", minimize)
    floor, view = "floor.reflectance.data", "office --resolution 16x9 --spp 16 --max-depth 3"
    goal = f"--inputs {floor} --metric luminance --below 0 --change {change} --steps 20 --json"
    assert cli.main(shlex.split(f"optimize {view} {goal} --out found")) == 1
    file = folder / "found" / "design.json"
    assert [*read_design(file)] == [f"{floor}{form}"]
    renderer = SceneRenderer("office", floor, resolution=(16, 9), spp=16)
    (found,) = results
    mean = found.values[floor].mean((0, 1))
    in_file = {floor: {"file": "design.json", "mean": pytest.approx(mean.tolist())}}
    printed = json.loads(capsys.readouterr().out)["design"]
    assert printed == (json.loads(file.read_text()) if form else in_file)
    own, wanted = renderer.inputs[floor], found.values[floor]
    read = design_of(renderer, read_design(file))[floor]
    torch.testing.assert_close(read, wanted, rtol=1e-6, atol=2e-6)
    assert (wanted - own).mean() < -0.04
    assert ((wanted - own).std() > 1e-3) == (not form), "some texels are clamped"


def sky_and_floor(folder: Path) -> Path:
    """Write a scene of textures: an environment map, and a floor of which a texel is nearly white."""
    generator = np.random.default_rng(0)
    texels = generator.random((8, 16, 3), dtype=np.float32)
    write_bitmap(folder / "sky.exr", texels + 0.1)
    floor = 0.2 + 0.2 * texels[:, :8]
    write_bitmap(folder / "even.exr", floor)
    floor[0, 0] = 0.97
    write_bitmap(folder / "white.exr", floor)
    wall = """<shape type="rectangle" id="{0}"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="{0}.exr"/><boolean name="raw" value="true"/></texture></bsdf></shape>"""
    (folder / "room.xml").write_text(
        f"""<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
        <lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
        <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
        {wall.format("even")}{wall.format("white")}</scene>"""
    )
    return folder / "room.xml"


def test_the_numbers_of_an_explanation_have_no_texels(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "--inputs reflectance --inputs sky.data --resolution 8x8 --spp 16 --max-depth 3 --no-progress"
    command = f"explain {sky_and_floor(folder)} --metric luminance {options} --changes 3 --json --out out"
    assert cli.main(shlex.split(command)) == 0
    printed = capsys.readouterr().out
    assert len(printed) < 10_000
    assert json.loads((folder / "out/explanation.json").read_text()) == json.loads(printed)
    changes = {one["name"]: one for one in json.loads(printed)["changes"]}
    assert changes["sky.data"]["setting"] == {"sky.data*": 1.25}
    before, after = (changes["sky.data"][side] for side in ("before", "after"))
    assert after == pytest.approx([1.25 * channel for channel in before], rel=1e-5)
    even = changes["even.bsdf.reflectance.data"]
    assert even["setting"] == {"even.bsdf.reflectance.data+": pytest.approx([0.1] * 3)}
    assert even["after"] == pytest.approx([channel + 0.1 for channel in even["before"]], rel=1e-5)
    # A texel that is nearly white cannot move as far.
    white = changes["white.bsdf.reflectance.data"]
    assert white["setting"] is None
    assert len(white["before"]) == len(white["after"]) == 3


def test_a_dimmed_map_is_written_as_a_factor(folder: Path) -> None:
    renderer = SceneRenderer(sky_and_floor(folder), ["sky.data"], resolution=(8, 8))
    dimmed = {"sky.data": 0.4 * renderer.inputs["sky.data"]}
    written = settings_of(renderer, dimmed)
    assert written == {"sky.data*": pytest.approx(0.4)}
    torch.testing.assert_close(design_of(renderer, written), dimmed)


def test_the_design_of_a_goal_has_the_values_that_the_search_began_with(folder: Path) -> None:
    light = "--inputs light.emitter.radiance.value --set light.emitter.radiance.value*=0.9"
    text = (
        f"explain cornell-box {VIEW} {light} --set {WALL}=0.5 --inputs {WALL} --metric luminance --below 20"
    )
    assert cli.main(shlex.split(f"{text} --changes 0 --out out")) == 0
    design = json.loads((folder / "out" / "design.json").read_text())
    assert design[WALL] == [0.5, 0.5, 0.5]
    assert set(design) == {WALL, "light.emitter.radiance.value"}


def test_the_code_of_an_exploration_reads_a_texture_from_its_file(folder: Path) -> None:
    floor = "floor.reflectance.data"
    renderer = SceneRenderer("office", floor, resolution=(16, 9), spp=1)
    texels = 0.5 * renderer.inputs[floor]
    (folder / "texels.json").write_text(json.dumps({floor: texels.tolist()}))
    text = f"explore office --inputs {floor} --resolution 16x9 --design texels.json"
    parsed = cli.parser().parse_args(shlex.split(text))
    metric = metrics.MeanLuminance()
    python = _explore._recipe(parsed, renderer, {"luminance": metric})["python"]
    assert len(python) < 1000
    names: dict[str, Any] = {}
    exec(python.replace("{inputs}", repr(floor)), names)
    torch.testing.assert_close(names["values"][floor], texels)


def test_the_demo_ends_with_a_next_step(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_demo, "attribute", lambda options: 0)
    assert cli.main(["demo"]) == 0
    question, command = capsys.readouterr().out.strip().split("? ")
    assert "glare" in question
    assert _main.parser().parse_args(shlex.split(command)[1:]).metric == "ugr"
    assert cli.main(["demo", "--json"]) == 0
    assert capsys.readouterr().out == ""


def test_the_change_of_an_effect_is_the_difference_of_both(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That of a lamp that is dimmed is over its own range: for a linear metric, its change is the rendered one."""
    dimmed = "--set light.emitter.radiance.value*=0.5"
    assert cli.main(shlex.split(f"compare {SCENE} --metric luminance {dimmed} --json --out out")) == 0
    found = json.loads(capsys.readouterr().out)
    effects = {one["label"]: one for one in found["effects"]}
    light, change = effects["light: radiance"], found["change"]
    assert light["after"] == pytest.approx(light["before"] / 2, rel=1e-3)
    assert light["is_clear"]
    assert light["change"] == pytest.approx(
        change["value"], abs=4 * (light["standard_error"] + change["standard_error"])
    )
    assert sum(one["is_clear"] for one in effects.values()) > 2
    for one in effects.values():
        assert one["change"] == pytest.approx(one["after"] - one["before"], rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(("scale", "changes"), [(1 - 1e-6, False), (1.01, True)])
def test_a_difference_of_rounding_is_not_a_change_of_an_effect(scale: float, changes: bool) -> None:
    """Half a lamp over its former range has the same effect, up to the order of a sum in single precision."""
    renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(8, 8), spp=4)
    before = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute()
    scaled = {
        field: {name: scale * one for name, one in getattr(before, field).items()}
        for field in ("attributions", "replicates")
    }
    (found,) = _compared_effects.compared_effects(before, dataclasses.replace(before, **scaled))
    assert found.is_clear == changes


def test_a_design_changes_values_within_their_bounds(folder: Path) -> None:
    for name, change in (("doubled", f"{WALL}*=2"), ("lighter", f"{WALL}+=0.1,0.2,0.3")):
        text = f"attribute cornell-box {VIEW} --inputs reflectance --set {change} --format npz --out {name}"
        assert cli.main(shlex.split(text)) == 0
    own = SceneRenderer("cornell-box", inputs="reflectance").inputs[WALL]
    expected = {"doubled": (2 * own).clamp(max=1), "lighter": own + torch.tensor([0.1, 0.2, 0.3])}
    for name, value in expected.items():
        found = SceneAttribution.load(folder / name / "attribution.npz").parameter_values[WALL]
        torch.testing.assert_close(found, value)


def test_a_design_sets_what_is_not_among_the_inputs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lamp = "light.emitter.radiance.value"
    view = f"cornell-box {VIEW} --inputs emitters"
    assert cli.main(shlex.split(f"attribute {view} --design design.json --format npz --out designed")) == 0
    found = SceneAttribution.load(folder / "designed" / "attribution.npz")
    np.testing.assert_allclose(found.info["values"][WALL], [0.3, 0.2, 0.1], rtol=1e-6)
    assert set(found) == {lamp}
    assert cli.main(shlex.split(f"attribute {view} --set {WALL}=0.5 --format npz --out other")) == 0
    capsys.readouterr()
    saved = "designed/attribution.npz other/attribution.npz"
    assert cli.main(shlex.split(f"compare {saved} --json --out out")) == 0
    both = json.loads(capsys.readouterr().out)["values"]
    np.testing.assert_allclose(both[WALL], [[0.3, 0.2, 0.1], [0.5] * 3], rtol=1e-6)
    changes = f"--from design.json --set {WALL}*=0.5 --set *.radiance.value*=0.5"
    assert cli.main(shlex.split(f"compare {view} --metric luminance {changes} --json --out out")) == 0
    before, after = json.loads(capsys.readouterr().out)["values"][WALL]
    own = SceneRenderer("cornell-box", WALL).inputs[WALL]
    np.testing.assert_allclose(before, [0.3, 0.2, 0.1], rtol=1e-6)
    np.testing.assert_allclose(after, 0.5 * own, rtol=1e-6)
    assert cli.main(shlex.split(f"attribute {view} --set left_wal.reflectance.value=0.5 --out out")) == 2
    assert "left_wall.reflectance.value" in capsys.readouterr().err


def test_a_search_a_check_and_a_tradeoff_start_from_the_design(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lamp = "light.emitter.radiance.value"
    view, dimmed = f"cornell-box {VIEW} --inputs all --metric luminance", f"--set {lamp}*=0.5"

    def printed(command: str) -> dict[str, Any]:
        cli.main(shlex.split(f"{command} --json --out out"))
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    metric = printed(f"attribute {view} {dimmed}")["metric"]
    before = printed(f"optimize {view} {dimmed} --below 1000")["before"]
    error = math.hypot(metric["standard_error"], before["standard_error"])
    assert before["value"] == pytest.approx(metric["value"], abs=4 * error)
    # Half the light is half the slope of a surface, of the same paths.
    own, half = (printed(f"validate {view} --top 4 {more}")["parameters"] for more in ("", dimmed))
    slopes = {row["name"]: row["predicted"] for row in own if row["name"] != lamp}
    for row in half:
        if row["name"] in slopes:
            assert row["predicted"] == pytest.approx(slopes[row["name"]] / 2, rel=1e-3)
    given: list[dict[str, torch.Tensor]] = []

    @functools.wraps(_tradeoff.measure)
    def measure(*arguments: Any, **more: Any) -> Tradeoff:
        given.append(more["inputs"])
        return _tradeoff.measure.__wrapped__(*arguments, **more)

    monkeypatch.setattr(_tradeoff, "measure", measure)
    printed(f"tradeoff {view} {dimmed} --vary spp=8 --reference-spp 64 --runs 2")
    torch.testing.assert_close(given[0][lamp], SceneRenderer("cornell-box", lamp).inputs[lamp] / 2)


def test_a_design_stays_fixed_unless_the_inputs_select_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    placed = {"camera.pose.translation": [0.1, 0.0, 0.0], WALL: [0.3, 0.2, 0.1]}
    (folder / "placed.json").write_text(json.dumps(placed))
    lamp, view = "light.emitter.radiance.value", f"cornell-box {VIEW} --metric luminance"
    design = f"--design placed.json --set {lamp}*=0.5"

    def printed(command: str) -> dict[str, Any]:
        cli.main(shlex.split(f"{command} --json --out out"))
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    everything = SceneRenderer("cornell-box", ["all", "camera"], resolution=(16, 16), spp=16, max_depth=3)
    values = design_of(everything, {**placed, f"{lamp}*": 0.5})
    expected = VanillaSceneGradient(everything, metrics.MeanLuminance()).attribute(
        {
            lamp: values[lamp],
            WALL: values[WALL],
            "camera.pose.translation": values["camera.pose.translation"],
        },
        seed=1,
    )
    for inputs, names in (
        (f"--inputs {lamp}", {lamp}),
        ("", set(SceneRenderer("cornell-box", "all").inputs)),
    ):
        printed(f"attribute {view} {inputs} {design} --format npz")
        found = SceneAttribution.load(folder / "out" / "attribution.npz")
        assert set(found) == names
        assert found.metric_value == pytest.approx(expected.metric_value, rel=1e-5)
        torch.testing.assert_close(found.parameter_values[lamp], values[lamp])
        explained = printed(f"explain {view} {inputs} {design} --changes 3")
        assert {one["name"] for one in explained["effects"]} == names
        assert {one["name"] for one in explained["changes"]} <= names
        compared = printed(f"compare {view} {inputs} {design}")
        assert set(compared["values"]) == {*placed, lamp}
        assert {one["name"] for one in compared["effects"]} == names
        assert compared["results"][1]["value"] == pytest.approx(found.metric_value, rel=1e-5)
    printed(f"attribute {view} --inputs camera {design} --format npz")
    found = SceneAttribution.load(folder / "out" / "attribution.npz")
    torch.testing.assert_close(
        found.parameter_values["camera.pose.translation"], values["camera.pose.translation"]
    )
    assert found.metric_value == pytest.approx(expected.metric_value, rel=1e-5)
    reached = printed(f"optimize {view} --inputs {lamp} {design} --below 8 --steps 20")
    for name, value in placed.items():
        np.testing.assert_allclose(reached["design"][name], value, rtol=1e-6)
    assert json.loads((folder / "out" / "design.json").read_text()) == reached["design"]
    again = printed(f"attribute {view} --inputs {lamp} --design out/design.json")["metric"]
    error = math.hypot(again["standard_error"], reached["after"]["standard_error"])
    assert again["value"] == pytest.approx(reached["after"]["value"], abs=4 * error)


def test_a_part_of_what_a_design_turns_is_selected_with_its_whole(capsys: pytest.CaptureFixture[str]) -> None:
    objects = "--object 'boxes=short_box_shape,tall_box_shape' --object tall=tall_box_shape"
    turned = f"attribute cornell-box {VIEW} {objects} --inputs tall.pose.translation --metric luminance"
    assert cli.main(shlex.split(f"{turned} --set boxes.pose.rotation=0,0,0.2")) == 2
    assert "select both, with --inputs boxes.pose.rotation" in capsys.readouterr().err


def test_set_takes_precedence_over_the_design(folder: Path) -> None:
    for name, more in (("design", ""), ("set", f"--set {WALL}=0.9"), ("alone", "")):
        design = "" if name == "alone" else "--design design.json"
        text = f"attribute cornell-box {VIEW} --inputs reflectance {design} {more} --format npz --out {name}"
        assert cli.main(shlex.split(text)) == 0
    values = {
        name: SceneAttribution.load(folder / name / "attribution.npz").parameter_values[WALL]
        for name in ("design", "set", "alone")
    }
    torch.testing.assert_close(values["design"], torch.tensor([0.3, 0.2, 0.1]))
    torch.testing.assert_close(values["set"], torch.full((3,), 0.9))
    assert not torch.allclose(values["alone"], values["design"])


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("--set left_wal.reflectance.value=0.5", ["not an input", "left_wall.reflectance.value"]),
        (f"--set {WALL}=0.1,0.2", [WALL, "one number or 3"]),
        ("--design nowhere.json", ["nowhere.json", "cannot be read"]),
        ("--design own_metric.py", ["own_metric.py", "not valid JSON"]),
        ("", ["--set or --design"]),
        ("office --from design.json", ["--from"]),
    ],
)
def test_a_bad_design_is_one_clear_line(
    more: str, words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(shlex.split(f"compare cornell-box {more} {VIEW} --out out")) == 2
    error = capsys.readouterr().err
    assert [word for word in words if word not in error] == []
    assert error.count("\n") == 1
    assert not (folder / "out").exists()


def test_saved_results_are_compared_if_they_are_of_one_metric(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, metric, seed in (("one", "luminance", 1), ("two", "luminance", 2), ("three", "contrast", 1)):
        text = f"attribute cornell-box {VIEW} --seed {seed} --metric {metric} --format npz --out {name}"
        assert cli.main(shlex.split(text)) == 0
    capsys.readouterr()
    files = [f"{name}/attribution.npz" for name in ("one", "two", "three")]
    assert cli.main(["compare", *files[:2], "--out", "out"]) == 0
    assert "one: mean luminance" in capsys.readouterr().out
    assert cli.main(["compare", *files[1:], "--out", "other"]) == 2
    assert "different metrics" in capsys.readouterr().err
    assert not (folder / "other").exists()


def test_a_relative_threshold_and_the_premises_stand_below_an_attributed_rating(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"attribute cornell-box {VIEW} --metric ugr --threshold-factor 2 --format json --report --out out"
    assert cli.main(shlex.split(text)) == 0
    page, printed = (folder / "out" / "report.html").read_text(), capsys.readouterr().out
    for note in ("threshold 2 times the mean luminance", "UGR and its limits are for luminaires"):
        assert note in printed
        assert note in page
    assert "threshold 2 times" in (folder / "out" / "attribution.json").read_text()


def test_a_scene_below_its_goal_gets_no_design(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    goal = "--metric luminance --below 1e6 --changes 0 --report"
    assert cli.main(shlex.split(f"explain cornell-box {VIEW} {goal} --out out")) == 0
    assert "already below the goal of 1e+06 cd/m²" in capsys.readouterr().out
    assert not (folder / "out" / "design.json").exists()
    assert (folder / "out" / "report.html").exists()


def test_rotations_are_named_radians(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turned = "tall_box_shape.pose.rotation"
    setting = f"compare cornell-box {VIEW} --metric luminance --inputs {WALL} --set {turned}=0,0"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cli.main(shlex.split(f"{setting},0.5 --out out")) == 0
    assert "tall_box_shape: rotation (rad)" in capsys.readouterr().out
    assert '"label":"tall_box_shape: rotation (rad)"' in (folder / "out" / "comparison.html").read_text()
    with pytest.warns(UserWarning, match="turns by 20 rad, more than once around: rotations are in radians"):
        assert cli.main(shlex.split(f"{setting},20")) == 0
    capsys.readouterr()
    assert (
        cli.main(["parameters", "cornell-box", turned, "tall_box_shape.pose.translation", "camera.fov"]) == 0
    )
    table = capsys.readouterr().out
    assert table.count("(−∞, ∞)") == 2
    assert table.count("(−∞, ∞) rad") == 1
    assert "(0, 179] °" in table


def test_a_goal_below_an_illuminance_is_warned_of(folder: Path) -> None:
    goal = "classroom --sensor grid --spp 4 --max-depth 2 --metric mean-illuminance --below 1e6"
    for command in ("optimize", "explain --changes 0"):
        with pytest.warns(UserWarning, match="More is better for mean illuminance") as found:
            assert cli.main(shlex.split(f"{command} {goal} --out out")) == 0
        (said,) = [str(one.message) for one in found if "More is" in str(one.message)]
        said = in_options(said, argparse.Namespace(below=1e6))
        assert "and --below 1e+06 asks for less: a value" in said
        assert "`explain` without --below renders the changes that raise it" in said


def test_the_design_of_a_missed_goal_has_the_values_that_were_tried(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"explain cornell-box {VIEW} --metric luminance --below -1 --changes 0 --out out"
    assert cli.main(shlex.split(text)) == 1
    assert "design.json  the values that were tried, for --design" in capsys.readouterr().out
    assert cli.main(shlex.split(f"{text} --json")) == 1


def test_the_rating_at_the_other_threshold_is_of_the_design_that_was_tried(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = "--resolution 16x9 --spp 8 --max-depth 3 --inputs sky.*.value"
    for goal, status, words in ((-50, 1, "of the design that was tried: "), (24, 0, "at the goal: ")):
        text = f"explain office --metric ugr --below {goal} {small} --changes 0 --json --report --out out"
        assert cli.main(shlex.split(text)) == status
        found = json.loads(capsys.readouterr().out)["premises"]
        assert [one for one in found if one.startswith(f"{words}with a threshold of 5 times")], found
    page = (folder / "out" / "report.html").read_text()
    cards = json.loads(page.partition('id="data">')[2].partition("</script>")[0])["results"]
    assert not [one for card in cards for one in card["premises"] if one.startswith("at the goal: ")], (
        "said on the card of the goal itself, without these words"
    )
    assert [any("5 times the mean luminance" in one for one in card["premises"]) for card in cards] == [
        True
    ] * 2


def test_the_report_of_a_goal_has_both_scenes_and_the_change(folder: Path) -> None:
    goal = "--metric luminance --below 25 --changes 0 --report --title Darker"
    assert cli.main(shlex.split(f"explain cornell-box {VIEW} {goal} --out out")) == 0
    page = (folder / "out" / "report.html").read_text()
    assert "<title>Darker</title>" in page
    assert '"title":"as it is"' in page
    assert '"title":"below 25"' in page
    found = json.loads(page.partition('"comparison":')[2].partition(',"views"')[0])
    design = json.loads((folder / "out" / "design.json").read_text())
    assert {one["name"] for one in found["values"]} <= set(design)
    assert found["change"] < 0
    goal_values = json.loads((folder / "out" / "explanation.json").read_text())["goal"]
    (note,) = found["notes"]
    assert all(f"{goal_values[side]['value']:.1f}" in note for side in ("before", "after"))
    card = json.loads(page.partition('id="data">')[2].partition("</script>")[0])["results"][1]
    reached = goal_values["after"]
    assert card["value"] == pytest.approx(reached["value"], rel=1e-6)
    assert card["error"] == pytest.approx(reached["standard_error"], rel=1e-6)


def test_titles_stand_in_the_report(folder: Path) -> None:
    text = f"compare cornell-box {VIEW} --set {WALL}=0.1 --titles Bright Dim --out out"
    assert cli.main(shlex.split(text)) == 0
    page = (folder / "out" / "comparison.html").read_text()
    assert '"title":"Bright"' in page
    assert '"title":"Dim"' in page
    found = json.loads(page.partition('"comparison":')[2].partition(',"views"')[0])
    assert found["written"].startswith("−")
    assert [one["name"] for one in found["values"]] == [WALL]


def test_a_moved_scene_is_denoised_with_its_own_guides(mi: Any, folder: Path) -> None:
    """Those of the scene as loaded drew the old outlines into the picture."""
    values = {"short_box_shape.pose.translation": torch.tensor([0.0, 0.0, 0.6])}
    renderer = SceneRenderer("cornell-box", [*values], resolution=(16, 16), spp=16, max_depth=3)
    with torch.no_grad():
        image = renderer(values, seed=1)
    expected = denoise(image, renderer.guides_of(values))
    assert not torch.allclose(expected, denoise(image, renderer.guides), rtol=0.02)
    moved = "--set short_box_shape.pose.translation=0,0,0.6"
    assert cli.main(shlex.split(f"render cornell-box {VIEW} {moved} --denoise --to moved.exr")) == 0
    written = torch.from_numpy(np.array(read_bitmap(folder / "moved.exr"))).float()
    torch.testing.assert_close(written, expected, rtol=2e-3, atol=1e-3)  # the file has half precision


def test_only_pictures_that_can_be_written_are_rendered(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["render", "cornell-box", "--to", "out.jpg"]) == 2
    assert ".png or .exr" in capsys.readouterr().err


def test_a_reader_that_ends_is_no_error(folder: Path) -> None:
    command = f"{shlex.quote(sys.executable)} -m scenecaptum.cli parameters office --all"
    found = subprocess.run(
        ["bash", "-c", f"{command} | head -n 1; echo ${{PIPESTATUS[0]}}"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert found.stdout.splitlines()[0].startswith("name")
    assert found.stdout.splitlines()[-1] in ("0", "141")
    assert found.stderr == ""


def test_filters_select_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["parameters", "office", "desk.*", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows
    assert all(row["name"].startswith("desk.") for row in rows)
    assert cli.main(["parameters", "office", "--kind", "emitters", "--json"]) == 0
    assert {row["kind"] for row in json.loads(capsys.readouterr().out)} == {"emitters"}
    assert cli.main(["parameters", "office", "desk.pose.*", "camera.fov", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"]: row["kind"] for row in rows} == {
        "desk.pose.translation": "poses",
        "desk.pose.rotation": "poses",
        "desk.pose.scale": "poses",
        "camera.fov": "camera",
    }


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("'dsk.*'", ["'dsk.*' matches no parameter of the scene. Did you mean 'desk.*'", "office --all"]),
        ("'desk.*' '*rofl*'", ["'*rofl*' matches no parameter of the scene."]),
        ("--kind lamps", ["no kind 'lamps'", "Did you mean 'emitters'?", "reflectance", "media"]),
        ("--kind reflectence", ["Did you mean 'reflectance'"]),
        ("--kind media", ["no parameter of the kind 'media'."]),
        ("'desk.*' --kind emitters", ["no parameter of the kind 'emitters' that these globs match."]),
    ],
)
def test_parameters_that_are_not_there_are_an_error(
    given: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for form in ("", " --json"):
        assert cli.main(shlex.split(f"parameters office {given}{form}")) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert [word for word in words if word not in printed.err] == []
        assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            "compare office --metric ugr --metric luminance",
            "compare takes one --metric, not both ugr and lum",
        ),
        ("explain office --metric luminance --metric luminance", "explain takes one --metric"),
        ("optimize office --below 19 --metric ugr --metric luminance", "optimize takes one --metric"),
        ("validate office --metric ugr --metric luminance", "validate takes one --metric"),
        ("tradeoff office --metric ugr --metric luminance", "tradeoff takes one --metric"),
        ("render office --sensor 0 --sensor fisheye", "render takes one --sensor, not both 0 and fisheye"),
        ("render office --design a.json --design b.json", "takes one --design, not both a.json and b.json"),
        ("compare office --from a.json --from b.json", "compare takes one --from"),
        ("attribute office --target 0 --target 1", "attribute takes one --target, not both 0 and 1"),
        ("attribute office --method gradient --method ablation", "attribute takes one --method"),
        ("attribute office --scale unit --scale value", "attribute takes one --scale"),
        ("attribute office --groups kind --groups object", "attribute takes one --groups"),
        ("daylight classroom --weather a.epw --weather b.epw", "daylight takes one --weather"),
        ("daylight classroom --floor a --floor b", "daylight takes one --floor"),
        ("render office --set a=1 --set a=2", "--set a= is given twice"),
        ("render office --object a=b --object a=c", "--object a= is given twice"),
        ("parameters office -D a=1 -D a=2", "-D a= is given twice"),
    ],
)
def test_what_is_taken_once_is_not_dropped_silently(
    given: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):  # as the parser ends it, too
        sys.exit(cli.main(shlex.split(given)))
    assert words in capsys.readouterr().err


def test_a_camera_is_chosen_as_a_sensor(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(shlex.split("explain office --metric ugr --camera 1"))
    assert "Did you mean '--sensor'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ("parameters office --inputs textures", "Did you mean '--kind'?"),
        ("compare office --set a=1 --report", "compare always writes its page, comparison.html"),
    ],
)
def test_an_option_of_other_commands_has_a_hint(
    given: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(shlex.split(given))
    error = capsys.readouterr().err
    assert hint in error


@pytest.mark.parametrize("name", [name for name in subparsers() if name != "doctor"])
def test_a_misspelt_option_points_to_the_help_of_its_command(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = {"demo": [], "optimize": ["office", "--below", "1"]}.get(name, ["office"])
    with pytest.raises(SystemExit) as caught:
        cli.main([name, *needed, "--jsno"])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"scenecaptum {name}: error: unrecognized arguments: --jsno")
    assert error.endswith(f"`scenecaptum {name} --help` says what can be given.\n")
    if name not in ("render", "explore"):
        assert "Did you mean '--json'" in error


def test_ctrl_c_during_a_render_says_that_nothing_was_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "scenecaptum.cli", "attribute", "office", "--resolution", "320x180"]
    process = subprocess.Popen(
        [*command, "--spp", "8192", "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True
    )
    while not (tmp_path / "out").exists() and process.poll() is None:  # created when the command starts
        time.sleep(0.1)
    started = _cpu_seconds(process.pid)
    while process.poll() is None and _cpu_seconds(process.pid) < started + _LOADING:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted; nothing was kept; --checkpoint DIR keeps finished replicates" in error
    assert "Traceback" not in error


_LOADING = 4.0  # seconds of computing, after which the render has begun


def _cpu_seconds(pid: int) -> float:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
