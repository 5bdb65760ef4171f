"""What a study says beside the values: relaxed ratings, and what they take for granted of the scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from seeds import seeds

from scenecaptum.studies import Study, StudyResult
from scenecaptum.studies._worker import _beside
from scenecaptum.visualization import Format

SMALL = {"inputs": "emitters", "resolution": (32, 18), "spp": 16, "max_depth": 3}
# A sky just above 2000 cd/m², which counts in full by the definition and in part in the relaxed rating.
DIM = {"sky.emitter.radiance.value*": 0.7}
NOTE = "this rating is relaxed near the threshold"


@pytest.mark.parametrize(("error", "doubt"), [(0.5, "; too close to 19 to be sure"), (0.1, ""), (None, "")])
def test_the_class_of_a_cell_says_if_noise_leaves_it_in_doubt(error: float | None, doubt: str) -> None:
    said = {"measure": {"limits": [16.0, 19.0]}, "verdict": "within 19", "notes": ["a note"]}
    assert _beside(said, 18.5, error) == {"verdict": f"within 19{doubt}", "notes": ["a note"]}
    assert _beside({**said, "verdict": ""}, 18.5, error)["verdict"] == ""


def test_a_rating_near_its_threshold_is_called_relaxed_and_has_no_class(
    run: Callable[..., StudyResult], tmp_path: Path
) -> None:
    """Of both methods, in table, summary, report and pages; the value alone is that of the attribution."""
    designs = {"dim": DIM, "bright": {"sky.emitter.radiance.value*": 4.0}}
    study = Study(
        ["office"], metrics=["ugr"], designs=designs, methods=["value", "gradient"], seeds=seeds(1), **SMALL
    )
    result = run(study, tmp_path)
    dim, bright = ([one for one in result.cells if one.design == name] for name in designs)
    for cells, relaxed in ((dim, True), (bright, False)):
        value, gradient = (result.numbers(cell) for cell in cells)
        assert value["value"] == pytest.approx(gradient["value"], rel=1e-5)
        assert value["standard_error"] == pytest.approx(gradient["standard_error"], rel=1e-3)
        for numbers in (value, gradient):
            assert numbers["measure"] == f"{'relaxed ' if relaxed else ''}unified glare rating"
            assert bool(numbers["verdict"]) != relaxed
            assert (NOTE in " ".join(numbers["notes"])) == relaxed
            assert "valid if the scene's lights are in W/(m² sr)" in " ".join(numbers["notes"])
            assert bool(numbers["threshold_note"]) == relaxed
    assert NOTE in str(result)
    assert NOTE in " ".join(result.summary(design="dim").notes())
    assert NOTE not in " ".join(result.summary(design="bright").notes())
    index = result.write_report(tmp_path / "report")
    assert NOTE in index.read_text(encoding="utf-8")
    # The rating by the other threshold is a number of the table, and its sentence is there once.
    numbers = result.numbers(dim[0])
    rating = Format.of(numbers["value"], numbers["standard_error"]).write(numbers["relative_rating"])
    assert f"UGR is {rating}" in " ".join(result.numbers(dim[0])["notes"])
    assert f"UGR is {rating}" not in str(result)
    text = index.read_text(encoding="utf-8")
    assert text.count("a source that is dimmed below it stops counting at once") == 1
    assert text.count(f">{rating}</td>") == len(dim)
    assert result.values()["relative_rating"].notna().all(), (
        "of bright rooms and of rooms without a source, too"
    )
    pages = {cell: index.parent / "cells" / f"{result.cells[cell]}.html" for cell in (dim[1], bright[1])}
    assert NOTE in pages[dim[1]].read_text(encoding="utf-8")
    assert NOTE not in pages[bright[1]].read_text(encoding="utf-8")


def share_above(image: torch.Tensor) -> torch.Tensor:
    """Return a metric without a derivative."""
    return (image > 0.5).float().mean()


def test_a_metric_without_a_derivative_has_a_value_and_an_error(
    run: Callable[..., StudyResult], tmp_path: Path
) -> None:
    metrics, options = {"share": f"{__file__}:share_above"}, {"resolution": (8, 8), "spp": 8, "max_depth": 3}
    result = run(
        Study(["cornell-box"], metrics=metrics, methods=["value"], seeds=seeds(1), **options), tmp_path
    )
    (numbers,) = (result.numbers(cell) for cell in result.cells)
    assert 0 < numbers["value"] < 1
    assert numbers["standard_error"] > 0


@pytest.mark.parametrize(("depth", "is_noted"), [("auto", True), (None, False)])
def test_a_note_says_that_the_paths_are_longer_than_the_scene_asks_for(
    run: Callable[..., StudyResult], tmp_path: Path, depth: str | None, is_noted: bool
) -> None:
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": {"type": "perspective"},
        "sky": {"type": "constant"},
    }
    options = {**SMALL, "resolution": (8, 8), "max_depth": depth}
    study = Study({"sky": scene}, metrics=["luminance"], methods=["value"], seeds=seeds(1), **options)
    note = "light of paths of more than 4 segments is included, which the scene leaves out"
    assert (note in str(run(study, tmp_path))) is is_noted
