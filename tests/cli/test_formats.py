"""The registry of output formats: every format is written, alone and with all others, and from Python."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import results
import torch
from matplotlib.figure import Figure

from scenecaptum import SceneAttribution, cli
from scenecaptum.cli._files import OutputFormat
from scenecaptum.cli._formats import FORMATS, selected_formats
from scenecaptum.cli._optimize import with_design_option
from scenecaptum.denoising import denoise
from scenecaptum.optimize import Measured, Optimization
from scenecaptum.report import write_csv, write_json
from scenecaptum.visualization import save_render

TINY = ["cornell-box", "--resolution", "16x16", "--spp", "8", "--max-depth", "2", "--inputs", "emitters"]
QUIET = ["--replicates", "2", "--no-progress"]


def attribute(out: Path, *formats: str) -> int:
    selected = [word for name in formats for word in ("--format", name)]
    return cli.main(["attribute", *TINY, *QUIET, *selected, "--out", str(out)])


def test_every_format_writes_its_own_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [one.file for one in FORMATS.values()]
    assert len({*files, "report.html"}) == len(files) + 1
    assert attribute(tmp_path, *FORMATS) == 0
    printed = capsys.readouterr().out
    for one in FORMATS.values():
        assert f"{tmp_path / one.file}  {one.description}" in printed
        assert (tmp_path / one.file).stat().st_size > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)


def test_files_have_the_cautions_on_the_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At 16 pixels around the room, the lamp is smaller than a pixel."""
    fisheye = [*TINY, *QUIET, "--sensor", "fisheye", "--metric", "ugr"]
    files = ["--format", "csv", "--format", "json", "--out", str(tmp_path)]
    assert cli.main(["attribute", *fisheye, *files]) == 0
    assert "caution: pixels at the edges of light average its light" in " ".join(
        capsys.readouterr().out.split()
    )
    said = json.loads((tmp_path / FORMATS["json"].file).read_text())["metric"]["caution"]
    assert said.startswith("pixels at the edges of light average its light")
    with (tmp_path / FORMATS["csv"].file).open(newline="") as file:
        assert [row["metric_caution"] for row in csv.DictReader(file)] == [said]


def test_a_noisy_uniformity_has_its_caution(tmp_path: Path) -> None:
    points = ["office", "--sensor", "grid", "--spacing", "1", "--spp", "4", "--inputs", "emitters", *QUIET]
    files = ["--format", "json", "--out", str(tmp_path)]
    assert cli.main(["attribute", *points, "--metric", "uniformity", *files]) == 0
    said = json.loads((tmp_path / FORMATS["json"].file).read_text())["metric"]["caution"]
    assert "noise lowers the smallest illuminance" in said


def test_only_what_is_selected_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new format is one line of the registry."""

    def write_names(attribution: SceneAttribution, path: Path) -> None:
        path.write_text("\n".join(attribution))

    names = OutputFormat("names.txt", "names of the parameters", write_names, by_default=False)
    monkeypatch.setitem(FORMATS, "names", names)
    assert attribute(tmp_path, "names", "csv", "names") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["attribution.csv", "names.txt"]
    assert (tmp_path / "names.txt").read_text() == "light.emitter.radiance.value"
    for command in ("attribute", "demo"):
        with pytest.raises(SystemExit):
            cli.main([command, "--help"])
        assert "names (names of the parameters)" in " ".join(capsys.readouterr().out.split())


def test_the_map_has_signs_where_effects_have_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[dict[str, Any]] = []

    def plot_heatmap(attribution: SceneAttribution, **options: Any) -> Figure:
        drawn.append(options)
        return Figure()

    monkeypatch.setattr(SceneAttribution, "plot_heatmap", plot_heatmap)
    both = results.make()
    raising = dataclasses.replace(both, attributions={name: one.abs() for name, one in both.items()})
    errors = {name: 1e6 * one for name, one in both.covariance.items()}
    unclear = dataclasses.replace(both, covariance=errors)
    for signed, attribution, expected in (
        (None, both, True),
        (None, raising, False),
        (None, unclear, False),
        (False, both, False),
        (True, raising, True),
    ):
        (heatmap,) = selected_formats(["heatmap"], None, signed=signed, denoised=True)
        heatmap.write(attribution, tmp_path / "heatmap.png")
        assert drawn[-1] == {"scale": None, "signed": expected, "denoised": True}


@pytest.mark.parametrize("denoised", [True, False])
def test_the_render_is_denoised_unless_off(tmp_path: Path, denoised: bool) -> None:
    attribution = results.make()
    (render,) = selected_formats(["render"], None, signed=None, denoised=denoised)
    render.write(attribution, tmp_path / "render.png")
    save_render(denoise(attribution.image) if denoised else attribution.image, tmp_path / "expected.png")
    assert (tmp_path / "render.png").read_bytes() == (tmp_path / "expected.png").read_bytes()


def test_an_unknown_format_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        attribute(tmp_path / "out", "jsonl")
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert "'jsonl'" in error
    assert all(name in error for name in FORMATS)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("errors", [True, False])
def test_numbers_are_written_from_python(tmp_path: Path, errors: bool) -> None:
    attribution = results.make(barred=errors)
    write_json(attribution, tmp_path / "a.json")
    write_csv(attribution, tmp_path / "a.csv")
    numbers = json.loads((tmp_path / "a.json").read_text())
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    ranking = attribution.ranking()
    assert [row["name"] for row in rows] == [row["name"] for row in numbers["ranking"]]
    assert [float(row["effect"]) for row in rows] == [row.effect for row in ranking]
    assert (rows[0]["total_error_1"] == "") is not errors
    assert numbers["metric"]["name"] == attribution.info["metric"]


def test_numbers_have_values_ranges_and_what_puts_a_row_in_doubt(tmp_path: Path) -> None:
    made = results.make(cautions={"floor": "it is biased"}, measure={"name": "Glare", "unit": "cd/m²"})
    attribution = dataclasses.replace(
        made,
        parameter_values={name: torch.full_like(value, 0.5) for name, value in made.items()},
        extents={name: torch.full(value.shape[-1:], 2.0) for name, value in made.items()},
    )
    write_json(attribution, tmp_path / "a.json")
    write_csv(attribution, tmp_path / "a.csv")
    numbers = json.loads((tmp_path / "a.json").read_text())
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert numbers["metric"]["unit"] == rows["floor"]["metric_unit"] == "cd/m²"
    assert numbers["metric"]["measure"] == rows["floor"]["metric"]
    for one in numbers["ranking"]:
        doubt = "! it is biased" if one["name"] == "floor" else None
        assert one["caution"] == doubt
        assert rows[one["name"]]["caution"] == (doubt or "")
        assert set(one["value"]) == {0.5}
        assert set(one["range"]) == {2.0}
        assert float(rows[one["name"]]["range_1"]) == 2.0
    frame = attribution.to_dataframe()
    assert set(frame.loc[frame["name"] == "floor", "caution"]) == {"! it is biased"}
    assert (frame["caution"] != "").sum() == 1
    assert {*itertools.chain(*frame["value"])} == {0.5}
    assert {*itertools.chain(*frame["range"])} == {2.0}
    assert frame.attrs == {
        "metric": rows["floor"]["metric"],
        "metric_value": numbers["metric"]["value"],
        "metric_error": numbers["metric"]["standard_error"],
        "metric_unit": "cd/m²",
    }


def test_demo_has_the_options_of_attribute() -> None:
    parse = cli.parser().parse_args
    demo, attribution = (
        {name: value for name, value in vars(parse(arguments)).items() if name != "run"}
        for arguments in (["demo"], ["attribute", "office", "--resolution", "320x180", "--spp", "64"])
    )
    assert demo == attribution


@pytest.mark.parametrize(("value", "is_named"), [(0.5, True), (2.0, False)])
def test_the_option_for_a_design_stands_beside_the_advice_to_rate_it_again(
    value: float, is_named: bool, tmp_path: Path
) -> None:
    measured = Measured(value, 0.1, torch.zeros(2, 2, 3))
    found = Optimization({}, (), measured, measured, (), below=1.0, metric="glare", note="what to do next")
    assert ("--design" in with_design_option(found, tmp_path).note) is is_named
