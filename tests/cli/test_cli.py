from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from scenecaptum import SceneAttribution, VanillaSceneGradient, cli
from scenecaptum.attr import AttributionInterrupted
from scenecaptum.cli import _validate
from scenecaptum.cli._formats import FORMATS
from scenecaptum.errors import SceneCaptumError
from scenecaptum.metrics import import_metric
from scenecaptum.validation import AblationTest

FILES = [one.file for one in FORMATS.values() if one.by_default]
SMALL = ["--resolution", "24x24", "--spp", "16", "--max-depth", "3", "--no-progress"]

USER_METRICS = """
import torch

def brightness(image):
    return image.mean()

def per_channel(image):
    return image.mean((0, 1))

def blind(image):
    return torch.ones((), requires_grad=True) * 2

def number(image):
    return float(image.mean())

not_a_function = 3
"""


# Mitsuba's thin-lens and orthographic example scenes also leave $spp to the command line.
OPEN = """<scene version="2.0.0">
    <default name="distance" value="4"/>
    <sensor type="thinlens">
        <float name="aperture_radius" value="0.1"/><float name="focus_distance" value="$distance"/>
        <transform name="to_world"><lookat origin="0, -$distance, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$size"/><integer name="height" value="$size"/>
        </film>
    </sensor>
    <shape type="sphere"/>
    <emitter type="constant"/>
</scene>"""


@pytest.fixture
def user_metrics(tmp_path) -> Path:
    path = tmp_path / "my_metrics.py"
    path.write_text(USER_METRICS)
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, str]:
    """One complete run: its output folder and what it printed."""
    out = tmp_path_factory.mktemp("cli") / "deep" / "out"
    command = [sys.executable, "-m", "scenecaptum.cli", "attribute", "cornell-box", *SMALL, "--out", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return out, run.stdout


def test_attribute_writes_and_lists_every_file(finished):
    out, printed = finished
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    for name in FILES:
        assert str(out / name) in printed


def test_numbers_agree_between_the_files(finished):
    out, printed = finished
    numbers = json.loads((out / "attribution.json").read_text())
    rows = list(csv.DictReader((out / "attribution.csv").open()))
    loaded = SceneAttribution.load(out / "attribution.npz")
    assert [row["name"] for row in rows] == [row["name"] for row in numbers["ranking"]]
    assert [row.name for row in loaded.ranking()] == [row["name"] for row in rows]
    assert float(rows[0]["effect"]) == numbers["ranking"][0]["effect"] != 0
    assert float(rows[0]["total_1"]) == numbers["ranking"][0]["total"][0]
    assert numbers["metric"]["value"] == loaded.metric_value
    assert numbers["info"]["replicates"] == 8
    assert loaded.ranking()[0].label in printed


def test_image_files_are_valid(finished):
    out, _ = finished
    for name in ("render.png", "heatmap.png", "bars.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_json_output_is_only_json(tmp_path, capsys, user_metrics):
    arguments = ["attribute", "cornell-box", *SMALL, "--json", "--out", str(tmp_path / "out")]
    assert cli.main([*arguments, "--metric", f"{user_metrics}:brightness", "--inputs", "emitters"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["metric"]["name"] == "brightness"
    assert [row["name"] for row in numbers["ranking"]] == ["light.emitter.radiance.value"]


def test_placeholder_values_reach_the_scene(tmp_path, capsys):
    (tmp_path / "open.xml").write_text(OPEN)
    scene, out = str(tmp_path / "open.xml"), str(tmp_path / "out")
    given = ["-D", "spp=4", "-D", "size=8", "--define", "distance=6.5"]
    command = ["attribute", scene, *given, "--replicates", "2", "--json", "--no-progress"]
    assert cli.main([*command, "--max-depth", "2", "--out", out]) == 0
    info = json.loads(capsys.readouterr().out)["info"]
    assert (info["spp"], info["resolution"]) == (4, [8, 8])
    assert info["parameters"] == {"spp": "4", "size": "8", "distance": "6.5"}


DEEPER = (
    "deep.xml: light of paths of more than 6 segments is missing; the scene asks for {}. For its own light use "
    "--max-depth {}"
)
SHORTER = (
    "deep.xml: light of paths of more than 3 segments is included, which the scene leaves out. For its own light "
    "use --max-depth 3"
)


@pytest.mark.parametrize(
    ("in_scene", "option", "notes"),
    [
        ("12", [], [DEEPER.format("up to 12", 12)]),
        ("-1", [], [DEEPER.format("any length", -1)]),
        ("3", [], [SHORTER]),
        ("6", [], []),
        ("12", ["--max-depth", "3"], []),
    ],
)
def test_a_command_says_that_the_scene_asks_for_another_depth(tmp_path, recwarn, in_scene, option, notes):
    own = f'<integrator type="path"><integer name="max_depth" value="{in_scene}"/></integrator>'
    scene = tmp_path / "deep.xml"
    scene.write_text(OPEN.replace("<emitter", f"{own}<emitter"))
    command = ["render", str(scene), "-D", "spp=1", "-D", "size=8", *option]
    assert cli.main([*command, "--to", str(tmp_path / "picture.png")]) == 0
    assert [str(one.message) for one in recwarn] == notes


@pytest.mark.parametrize(
    ("command", "in_scene", "is_said"),
    [
        ("attribute --replicates 2 --no-progress --report --out {folder}", "12", True),
        ("attribute --replicates 2 --no-progress --report --out {folder}", "6", False),
        ("explore --to {folder}/report.html", "12", True),
        ("compare --set constant.radiance.value=0.7 --no-progress --out {folder}", "12", True),
    ],
)
def test_a_page_says_which_light_is_missing(
    tmp_path: Path, command: str, in_scene: str, is_said: bool
) -> None:
    own = f'<integrator type="path"><integer name="max_depth" value="{in_scene}"/></integrator>'
    scene = tmp_path / "deep.xml"
    scene.write_text(OPEN.replace("<emitter", f"{own}<emitter"))
    name, *options = command.format(folder=tmp_path).split()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the depth
        assert cli.main([name, str(scene), "-D", "spp=4", "-D", "size=8", *options]) == 0
    note = "light of paths of more than 6 segments is missing; the scene asks for up to 12"
    (page,) = tmp_path.glob("*.html")
    assert (note in page.read_text()) is is_said


@pytest.mark.parametrize(
    ("rfilter", "option", "warns"),
    [("tent", ["--denoise"], True), ("box", ["--denoise"], False), ("tent", [], False)],
)
def test_a_denoised_picture_warns_of_a_filter_that_spreads_noise(tmp_path, recwarn, rfilter, option, warns):
    scene = tmp_path / "open.xml"
    scene.write_text(OPEN.replace("</film>", f'<rfilter type="{rfilter}"/></film>'))
    command = ["render", str(scene), "-D", "spp=1", "-D", "size=8", "--max-depth", "2", *option]
    assert cli.main([*command, "--to", str(tmp_path / "picture.png")]) == 0
    assert any("it spreads noise over pixels" in str(one.message) for one in recwarn) == warns


@pytest.mark.parametrize("sensor", ["0", "fisheye"])
def test_glare_is_rated_for_the_selected_camera(tmp_path, capsys, sensor):
    out = tmp_path / "out"
    glare = ["--metric", "ugr", "--threshold-factor", "5", "--sensor", sensor]
    assert cli.main(["attribute", "cornell-box", *SMALL, "--out", str(out), *glare]) == 0
    assert "unified glare rating" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)


def test_a_metric_may_import_what_lies_beside_its_file(tmp_path, monkeypatch):
    (tmp_path / "beside_it.py").write_text("def mean(image):\n    return image.mean()\n")
    (tmp_path / "of_a_file.py").write_text("from beside_it import mean\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    image = torch.ones(2, 2, 3)
    assert import_metric(f"{tmp_path / 'of_a_file.py'}:mean")(image) == 1
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "of_a_module.py").write_text("def total(image):\n    return image.sum()\n")
    monkeypatch.chdir(tmp_path / "here")
    assert import_metric("of_a_module:total")(image) == 12
    (tmp_path / "broken.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')\n")
    with pytest.raises(SceneCaptumError, match=r"nms does not exist\. 'scenecaptum doctor' shows the fix"):
        import_metric(f"{tmp_path / 'broken.py'}:mean")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.xml"], ["nowhere.xml", "no scene file"]),
        (["ofice"], ["'ofice'", "Did you mean 'office'"]),
        (["broken.xml"], ["broken.xml", "cannot be loaded"]),
        (["blind.xml"], ["blind.xml", "no sensor"]),
        (["open.xml"], ["no value for $size, $spp", "-D size=… -D spp=…"]),
        (["open.xml", "-D", "spp=4"], ["no value for $size:", "parameters={'size': …}"]),
        (
            ["open.xml", "-D", "spp=4", "-D", "size=8", "-D", "siz=8"],
            ["no placeholder $siz", "Did you mean 'size'"],
        ),
        (["cornell-box", "-D", "spp=4"], ["-D gives values", "cornell-box is not an XML file"]),
        (
            ["cornell-box", "--inputs", "reflectence"],
            ["--inputs 'reflectence' matches", "Did you mean 'reflectance'"],
        ),
        (["cornell-box", "--inputs", "light.to_world"], ["'light.to_world'", "changes visibility"]),
        (["cornell-box", "--metric", "luminence"], ["'luminence'", "Did you mean 'luminance'"]),
        (["cornell-box", "--metric", "my_metrics.py:per_channel"], ["(3,)", "--target"]),
        (["cornell-box", "--metric", "my_metrics.py:blind"], ["blind", "does not depend on the image"]),
        (["cornell-box", "--metric", "my_metrics.py:number"], ["number", "torch tensor, not float"]),
        (
            ["cornell-box", "--metric", "my_metrics.py:nothing"],
            ["my_metrics.py:nothing", "cannot be imported", "has no 'nothing'. It has ", "per_channel, "],
        ),
        (["cornell-box", "--metric", "my_metrics.py:blnid"], ["has no 'blnid'. Did you mean 'blind'?"]),
        (["cornell-box", "--metric", "my_metrics.py:not_a_function"], ["not_a_function", "not a function"]),
        (["cornell-box", "--metric", "nowhere.py:f"], ["nowhere.py:f", "cannot be imported"]),
        (["cornell-box", "--sensor", "panorama"], ["index or id of a sensor", "fisheye", "'panorama'"]),
        (
            ["cornell-box", "--threshold-factor", "5"],
            ["--threshold-factor", "luminance", "--metric ugr, dgp or dgi"],
        ),
        (["cornell-box", "--metric", "ugr", "--threshold-factor", "-1"], ["threshold_factor", "-1"]),
        (["cornell-box", "--spp", "0"], ["spp", "at least 1"]),
        (["cornell-box", "--resolution", "0x10"], ["width", "at least 1"]),
        (["cornell-box", "--seed", "-1"], ["seed"]),
        (["cornell-box", "--replicates", "0"], ["replicates"]),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(
    arguments, words, tmp_path, monkeypatch, capsys, user_metrics
):
    monkeypatch.chdir(tmp_path)
    Path("broken.xml").write_text("<scene version='3.0.0'><shape></scene>")
    Path("blind.xml").write_text("<scene version='3.0.0'><shape type='sphere'/></scene>")
    Path("open.xml").write_text(OPEN)
    before = sorted(tmp_path.iterdir())
    scene, *options = arguments
    status = cli.main(["attribute", scene, *SMALL, *options, "--out", "out"])
    printed = capsys.readouterr()
    assert status == 2
    assert printed.out == ""
    assert printed.err.startswith("scenecaptum: error: ")
    assert printed.err.count("\n") == 1, printed.err
    for word in words:
        assert word in printed.err
    left = [path for path in sorted(tmp_path.iterdir()) if path.name != "__pycache__"]
    assert left == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "COMMAND"),
        (["attribute"], "required: scene"),
        (["fly"], "invalid choice: 'fly'"),
        (["attribute", "office", "--resolution", "big"], "'big' is not WIDTHxHEIGHT"),
        (["attribute", "office", "--spp", "1e3"], "argument --spp: '1e3' is not a whole number"),
        (["attribute", "office", "--tolerance", "5%"], "argument --tolerance: '5%' is not a number"),
        (["compare", "office", "--seed", "x"], "argument --seed: 'x' is not a whole number"),
        (["attribute", "office", "--format", "bmp"], "invalid choice: 'bmp'"),
        (["attribute", "office", "--method", "gradients"], "invalid choice: 'gradients'"),
        (["tradeoff", "office", "--vary", "spp"], "--vary"),
        (["attribute", "office", "-D", "spp"], "'spp'"),
        (["attribute", "office", "-D", "=4"], "'=4'"),
    ],
)
def test_bad_usage_exits_with_2_and_says_why_first(arguments, said, capsys):
    """Without the usage of the command, whose many lines would hide it."""
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    reason, pointer = capsys.readouterr().err.splitlines()
    command = " ".join(["scenecaptum", *(one for one in arguments[:1] if one != "fly")])
    assert reason.startswith(f"{command}: error: ")
    assert said in reason
    assert pointer == f"`{command} --help` says what can be given."


def unwritable_folders(tmp_path: Path) -> list[Path]:
    (tmp_path / "file").write_text("")
    folders = [tmp_path / "file", tmp_path / "file" / "out"]
    if Path("/proc/self").exists():
        folders.append(Path("/proc/scenecaptum"))  # not even root may write there
    if os.geteuid() != 0:
        (tmp_path / "locked").mkdir(mode=0o555)
        folders.append(tmp_path / "locked")
    return folders


def test_an_output_folder_that_cannot_be_written_is_refused_before_rendering(tmp_path, capsys, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise AssertionError("the scene was loaded although its results could not be kept")

    monkeypatch.setattr(cli._arguments, "SceneRenderer", fail)
    for folder in unwritable_folders(tmp_path):
        assert cli.main(["attribute", "cornell-box", "--out", str(folder)]) == 2
        error = capsys.readouterr().err
        assert "cannot be written" in error
        assert str(folder) in error
        assert error.count("\n") == 1


def test_interruption_keeps_finished_and_partial_results(tmp_path, capsys, monkeypatch, user_metrics):
    out = tmp_path / "out"
    attribute = VanillaSceneGradient.attribute

    def interrupted_at_the_second_metric(self, *arguments, **options):
        result = attribute(self, *arguments, **options)
        if result.info["metric"] == "brightness":
            raise AttributionInterrupted(result)
        return result

    monkeypatch.setattr(VanillaSceneGradient, "attribute", interrupted_at_the_second_metric)
    metrics = ["--metric", "luminance", "--metric", f"{user_metrics}:brightness"]
    status = cli.main(["attribute", "cornell-box", *SMALL, "--out", str(out), *metrics])
    assert status == 130
    assert "interrupted" in capsys.readouterr().err
    folders = sorted(out.iterdir())
    assert len(folders) == 2
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)


def test_ctrl_c_before_anything_is_finished_leaves_no_folder(tmp_path, capsys, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(VanillaSceneGradient, "attribute", interrupt)
    assert cli.main(["attribute", "cornell-box", *SMALL, "--out", str(tmp_path / "out")]) == 130
    assert not (tmp_path / "out").exists()


TRADEOFF = ["tradeoff", "cornell-box", *SMALL, "--inputs", "reflectance", "--runs", "2"]


def test_tradeoff_writes_what_it_measured_and_recommends(tmp_path, capsys):
    out = tmp_path / "out"
    glare = ["--metric", "ugr", "--threshold-factor", "2", "--reference-spp", "32"]
    vary = ["--vary", "spp=4", "--vary", "resolution=12x12", "--vary", "spp=64", "--tolerance", "0.5"]
    assert cli.main([*TRADEOFF, *glare, *vary, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    lines = list(csv.DictReader((out / "tradeoff.csv").open()))
    assert [line["varied"] for line in lines] == ["own", "spp", "spp", "resolution"]
    assert lines[-1]["resolution"] == "12x12"
    assert (out / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    for words in ("unified glare rating", "spp 64", "12×12", "50 %", str(out / "tradeoff.csv")):
        assert words in printed


def test_tradeoff_prints_json(tmp_path, capsys):
    vary = ["--vary", "spp=4", "--reference-spp", "32"]
    assert cli.main([*TRADEOFF, *vary, "--json", "--out", str(tmp_path / "out")]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert [one["primal_spp"] for one in numbers["settings"]] == [16, 4]
    assert "5 %" in numbers["recommendation"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--vary", "sp=4"], ["'sp'", "Did you mean 'spp'"]),
        (["--vary", "spp=many"], ["spp", "whole number", "'many'"]),
        (["--vary", "integrator=path"], ["prb", "'path'"]),
        (["--metric", "luminence"], ["'luminence'", "Did you mean 'luminance'"]),
        (["--tolerance", "0"], ["--tolerance", "above 0"]),
        (["--runs", "1"], ["runs", "at least 2"]),
    ],
)
def test_a_tradeoff_that_cannot_be_measured_is_one_clear_line(options, words, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main([*TRADEOFF, "--out", str(out), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("scenecaptum: error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert not out.exists()


@pytest.mark.parametrize("command", [[], ["attribute"], ["tradeoff"], ["demo"], ["doctor"]])
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main([*command, "--help"])
    assert caught.value.code == 0
    assert "usage: scenecaptum" in capsys.readouterr().out


def test_validate_writes_its_figure_and_exits_with_the_verdict(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    arguments = ["validate", "cornell-box", "--resolution", "16x16", "--spp", "64", "--inputs", "reflectance"]
    arguments += ["--top", "2", "--max-depth", "3", "--no-progress", "--out", str(out)]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "Confirmed: 2 of 2 parameters" in printed
    numbers = json.loads((out / "validation.json").read_text())
    rows = list(csv.DictReader((out / "validation.csv").open()))
    assert [float(row["measured"]) for row in rows] == [row["measured"] for row in numbers["parameters"]]
    assert (out / "validation.png").read_bytes().startswith(b"\x89PNG")
    assert all(str(path) in printed for path in out.iterdir())

    monkeypatch.setattr(AblationTest, "is_confirmed", False)
    assert cli.main([*arguments, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["confirmed"] is False
    assert cli.main([*arguments, "--top", "0"]) == 2


def test_validate_without_anything_to_test_says_so_and_writes_its_files(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["validate", "cornell-box", "--metric", "ugr", "--threshold-factor", "100000"]
    arguments += [
        "--resolution",
        "8x8",
        "--spp",
        "16",
        "--inputs",
        "floor*",
        "--no-progress",
        "--out",
        str(out),
    ]
    assert cli.main(arguments) == 1
    assert "Nothing to test" in capsys.readouterr().out
    assert json.loads((out / "validation.json").read_text())["parameters"] == []
    assert (out / "validation.png").read_bytes().startswith(b"\x89PNG")


def test_validate_prints_its_table_before_it_writes_files(tmp_path, capsys, monkeypatch):
    def fail(*_args: object, **_options: object) -> None:
        raise SceneCaptumError("the disk is full")

    monkeypatch.setattr(_validate, "write_files", fail)
    arguments = ["validate", "cornell-box", "--metric", "luminance", "--resolution", "8x8", "--spp", "16"]
    arguments += ["--inputs", "floor*", "--no-progress", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert "measured slope" in printed.out
    assert "the disk is full" in printed.err
