"""What ``compare`` says of two results: which render a line is of, their settings, and their names."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import results
import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient, View, cli
from scenecaptum.attr import SceneAttribution
from scenecaptum.cli import _compare, _compared, _compared_effects

SMALL = "--spp 8 --max-depth 3 --inputs emitters --no-progress"


def compared(*settings: dict[str, Any], is_saved: bool = True) -> _compared.Compared:
    before, after = (
        dataclasses.replace(one, info={**one.info, **more})
        for one, more in zip([results.make()] * 2, settings, strict=True)
    )
    sides = [_compared.Side(is_saved=is_saved)] * 2
    return _compared.Compared(before, after, ["A", "B"], 0.0, None, sides)


@pytest.mark.long
def test_the_shares_of_points_are_of_the_render_whose_value_is_quoted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With few samples, those of the attribution are other points."""
    text = "compare classroom --spp 4 --spacing 1 --metric en17037 --inputs pane.* --no-progress --json"
    change = "--set pane.specular_transmittance.value=0.75"
    assert cli.main(shlex.split(f"{text} {change} --out {tmp_path}")) == 0
    printed = json.loads(capsys.readouterr().out)
    quoted = [one["definition"]["value"] for one in printed["results"]]
    page = (tmp_path / "comparison.html").read_text()
    (found,) = re.findall(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)
    written = json.loads(found)
    rows = written["comparison"]["effects"]["rows"]
    assert {row[0] for row in rows} <= {one["label"] for one in printed["effects"]}
    assert "pane" in rows[0][0], "what was set comes first"
    for value, card in zip(quoted, written["results"], strict=True):
        (line,) = [one for one in card["premises"] if "300 lx at" in one and "required" in one]
        shares = [float(share) for share in re.findall(r"at ([\d.]+) % of the points", line)]
        ratios = [100 * share / needed for share, needed in zip(shares, (50, 95), strict=True)]
        assert min(ratios) == pytest.approx(value, rel=2e-3)


@pytest.mark.parametrize(
    ("numbers", "written"),
    [
        ((7.862e-4, 7.028e-4, -8.34e-5, 2.4e-5), ("0.000786", "0.000703", "−0.000083 ± 0.000024")),
        ((7.862e-6, 7.028e-6, -8.34e-7, 2.4e-7), ("7.86e−6", "7.03e−6", "−0.83e−6 ± 0.24e−6")),
        ((0.5, 12.34, 11.84, 0.24), ("0.50", "12.34", "+11.84 ± 0.24")),
        ((1.5, 2.0, 0.5, None), ("1.500", "2.000", "+0.500")),
        ((0.0, 2.0, 2.0, 0.3), ("0", "2.00", "+2.00 ± 0.30")),
    ],
)
def test_a_row_of_the_table_has_one_notation(
    numbers: tuple[float, float, float, float | None], written: tuple[str, str, str]
) -> None:
    assert _compared_effects.ComparedEffect("eta", "sphere: eta", *numbers).numbers() == written


def test_settings_that_differ_are_named_as_a_part_of_the_change() -> None:
    office = "perspective, 66° wide, at 0 0 1.5, towards 0 1 0"
    ours = {"resolution": [32, 18], "sensor": office, "max_depth": 6}
    theirs = {
        "resolution": [64, 64],
        "sensor": office.replace("perspective, 66", "fisheye, 180"),
        "max_depth": -1,
    }
    found = compared(ours, theirs)
    (caution,) = found.notes()
    assert caution == (
        "caution: made with different settings, which are part of the change: resolution 32×18 against 64×64; "
        "camera perspective, 66° wide against fisheye, 180° wide; max depth 6 against no limit"
    )
    assert caution in " ".join(" ".join(_compared.lines(found)).split())
    assert compared(ours, ours).notes() == []
    assert compared(ours, {}).notes() == [], "a setting that an older file does not have"
    moved = {**ours, "sensor": f"{office}, turned"}
    assert "camera" in compared(ours, moved).notes()[0]
    found = compared(ours, moved)
    turned = [
        dataclasses.replace(one, parameter_values={"camera.pose.rotation": torch.tensor([0.0, 0.0, angle])})
        for one, angle in ((found.before, 0.0), (found.after, 0.3))
    ]
    # A design that turns the camera, which is listed as what it sets.
    assert dataclasses.replace(found, before=turned[0], after=turned[1]).notes() == []


@pytest.mark.long
def test_saved_ratings_of_glare_have_their_size_and_are_called_relaxed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, view in (("small", "--resolution 16x9"), ("wide", "--resolution 16x16 --sensor fisheye")):
        out = f"--format npz --out {tmp_path / name}"
        assert cli.main(shlex.split(f"attribute office --metric ugr {view} {SMALL} {out}")) == 0
    capsys.readouterr()
    files = [str(tmp_path / name / "attribution.npz") for name in ("small", "wide")]
    assert cli.main(["compare", *files, "--out", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert re.search(r"small: unified glare rating = \S+ ± \S+ at 16×9 pixels, relaxed ", printed)
    assert re.search(r"wide: unified glare rating = \S+ ± \S+ at 16×16 pixels, relaxed ", printed)
    assert "The change by the definition was not computed." in printed
    assert "Compare the scenes, not saved results, to get the change by the definition." in printed
    page = (tmp_path / "out" / "comparison.html").read_text()
    assert "The change by the definition was not computed." in page
    assert "ompare the scenes" not in page
    assert "has no value by the definition" not in printed, "its verdict may state one"
    assert (
        "resolution 16×9 against 16×16; camera perspective, 65.81° wide against fisheye, 180° wide" in printed
    )
    scene = f"compare office {files[0]} --metric ugr --resolution 16x9 {SMALL} --out {tmp_path / 'out'}"
    assert cli.main(shlex.split(scene)) == 0
    printed = capsys.readouterr().out
    assert printed.count("at 16×9 pixels, relaxed") == 2
    page = (tmp_path / "out" / "comparison.html").read_text()
    cards = json.loads(page.partition('id="data">')[2].partition("</script>")[0])["results"]
    assert [card["verdict"] for card in cards] == ["", ""], "as in the terminal"
    assert "different settings" not in printed


def test_a_light_that_is_off_has_one_effect_beside_any_other_design_and_two_equal_designs_are_called_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    design = tmp_path / "off.json"
    design.write_text('{"light.emitter.radiance.value": 0}')
    of_off = {}
    for origin in ("", f"--from {design}"):
        options = f"{origin} --design {design} --metric luminance --resolution 8x8 {SMALL} --json"
        assert cli.main(shlex.split(f"compare cornell-box {options} --out {tmp_path}")) == 0
        found = json.loads(capsys.readouterr().out)
        (of_off[origin],) = [one["after"] for one in found["effects"] if one["name"].startswith("light.")]
        are_equal = bool(origin)
        assert (_compare.SAME in found["notes"]) is are_equal
        assert any("their errors" in note for note in found["notes"]) is not are_equal
        assert not (are_equal and any(one["change"] for one in found["effects"]))
    assert set(of_off.values()) == {0}


def test_saved_results_of_different_quantities_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(tmp_path / "one.npz"), str(tmp_path / "other.pt")]  # a result may have any name
    for path, name in zip(files, ("gradient per unit", "contribution"), strict=True):
        results.make(quantity=name).save(path)
    assert cli.main(["compare", *files, "--out", str(tmp_path / "out")]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "contribution (VanillaSceneGradient)" in said
    assert "gradient per unit (VanillaSceneGradient)" in said
    assert not (tmp_path / "out").exists()


def test_two_designs_are_refused_with_the_options_that_compare_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        cli.main(["compare", "office", "--design", "a.json", "--design", "b.json"])
    assert "compared by --from FILE --design FILE" in capsys.readouterr().err


def test_a_saved_result_of_another_quantity_is_refused_before_the_scene_is_rendered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VanillaSceneGradient, "attribute", lambda *_, **__: pytest.fail("rendered"))
    path = str(tmp_path / "ablated.npz")
    results.make(quantity="effect of ablation").save(path)
    for files in (["office", path], [path, "office"]):
        assert cli.main(["compare", *files, "--metric", "ugr", "--out", str(tmp_path / "out")]) == 2
        (said,) = capsys.readouterr().err.splitlines()
        assert f"{path} has the quantity effect of ablation (VanillaSceneGradient), but of a scene" in said
    assert not (tmp_path / "out").exists()


def test_two_scenes_are_compared_by_the_definition_near_the_threshold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"compare office office --metric ugr --resolution 16x9 {SMALL} --json --out {tmp_path}"
    assert cli.main(shlex.split(text)) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(one["definition"] for one in found["results"])
    assert found["change"]["definition"]["value"] == 0
    assert [one["title"] for one in found["results"]] == ["office (A)", "office (B)"]


def test_a_renderer_tells_its_camera() -> None:
    told = {
        name: SceneRenderer("office", "emitters", sensor=sensor, resolution=(16, 16)).info["sensor"]
        for name, sensor in (("own", 0), ("fisheye", "fisheye"), ("turned", View(turn=90)))
    }
    assert told["own"].startswith("perspective, 65.81° wide, at −0.75 −0.55 1.52, towards ")
    assert told["fisheye"] == told["own"].replace("perspective, 65.81", "fisheye, 180")
    assert told["turned"].split(", ")[:3] == told["own"].split(", ")[:3]
    assert told["turned"] != told["own"]
    assert "sensor" not in SceneRenderer("classroom", "emitters", sensor="grid").info


@pytest.mark.parametrize(
    ("files", "titles"),
    [
        (("out/a/design.json", "out/b/design.json"), ["a", "b"]),
        (("out/a/lamp.json", "out/b/lamp.json"), ["a", "b"]),
        (("bright.json", "dark.toml"), ["bright", "dark"]),
        (("a/out/attribution.npz", "b/out/attribution.npz"), ["a/out/attribution", "b/out/attribution"]),
        (("out/attribution.npz", "out/attribution.npz"), ["out (A)", "out (B)"]),
        (("office", "office"), ["office (A)", "office (B)"]),
    ],
)
def test_titles_differ(files: tuple[str, str], titles: list[str]) -> None:
    assert _compare._titles(*files) == titles


@pytest.mark.parametrize(
    ("origin", "design", "is_changed", "titles"),
    [
        ("dusk.json", "dusk.json", True, ["dusk", "dusk, changed"]),
        ("dusk.json", "dusk.json", False, ["dusk (A)", "dusk (B)"]),
        ("dusk.json", "night.json", True, ["dusk", "night, changed"]),
        (None, "dusk.json", True, ["as it is", "dusk, changed"]),
        (None, "dusk.json", False, ["as it is", "dusk"]),
        ("dusk.json", None, True, ["dusk", "the design"]),
    ],
)
def test_a_design_with_other_values_is_called_changed(
    origin: str | None, design: str | None, is_changed: bool, titles: list[str]
) -> None:
    paths = [None if name is None else Path(name) for name in (origin, design)]
    assert _compare._design_titles(*paths, is_changed=is_changed) == titles


def test_designs_are_called_by_their_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, factor in (("first", 0.5), ("second", 0.8)):
        (tmp_path / name).mkdir()
        design = {"light.emitter.radiance.value*": factor}
        (tmp_path / name / "design.json").write_text(json.dumps(design))
    files = f"--from {tmp_path}/first/design.json --design {tmp_path}/second/design.json"
    text = f"compare cornell-box --resolution 8x8 {SMALL} {files} --json --out {tmp_path / 'out'}"
    assert cli.main(shlex.split(text)) == 0
    found = json.loads(capsys.readouterr().out)["results"]
    assert [one["title"] for one in found] == ["first", "second"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("a/design.json b/design.json", "compare SCENE --from a/design.json --design b/design.json"),
        (
            "office b/design.toml",
            "b/design.toml is a design, not a scene: scenecaptum compare office --design b/",
        ),
        ("office --set a=1 --titles A A", "--titles must differ"),
        (
            "cornell-box --inputs emitters --set Walls.x=1",
            "error: the design's 'Walls.x' matches no parameter",
        ),
    ],
)
def test_what_cannot_be_compared_has_its_command(
    given: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(shlex.split(f"compare {given} --out {tmp_path / 'out'}")) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_an_attribution_of_daylight_is_called_relaxed_and_its_report_quotes_the_definition(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "attribute classroom --spp 4 --spacing 2 --metric sda --inputs pane.* --report --no-progress"
    assert cli.main(shlex.split(f"{text} --out {tmp_path}")) == 0
    printed = capsys.readouterr().out
    assert "relaxed spatial daylight autonomy without blinds = " in printed.splitlines()[0]
    (quoted,) = re.findall(r"quote ([\d.]+) ± ([\d.]+) %, the value by the definition", printed)
    page = (tmp_path / "report.html").read_text()
    card = json.loads(page.partition('id="data">')[2].partition("</script>")[0])["results"][0]
    assert card["written"] == [*quoted]
    saved = SceneAttribution.load(tmp_path / "attribution.npz")
    assert saved.info["measure"]["name"] == "relaxed spatial daylight autonomy without blinds"


@pytest.mark.parametrize(
    ("error", "errors", "said"),
    [
        (0.1, (0.3, 0.3), "most of the noise of the change cancels"),
        (3.2, (2.7, 1.8), "half or more of the noise of the change remains"),  # as of independent renders
        (0.0, (0.1, 0.2), "most of the noise of the change cancels"),
        (0.0, (0.0, 0.0), ""),
        (None, (0.1, 0.2), ""),
        (0.1, (None, 0.2), ""),
    ],
)
def test_the_noise_of_a_change_is_said_to_cancel_only_where_it_does(
    error: float | None, errors: tuple[float | None, float | None], said: str
) -> None:
    assert _compare._remaining(error, errors) == (f", in which {said}" if said else "")
