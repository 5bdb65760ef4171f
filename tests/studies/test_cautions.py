"""The cautions of the cells of a study: counted, noted, marked in tables; and effects that do not add up."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from seeds import seeds

from scenecaptum.studies import Study, StudyResult
from scenecaptum.visualization import convergence_notes

from . import made

NOISY = "the picture is too noisy for this metric: the noise of a pixel is {} %, and more than 5 % biases it"
SUM = "does not add up: delta 0.111 ± 0.035 of −0.111"


def steep(image: torch.Tensor) -> torch.Tensor:
    """Return a metric whose gradient at half of the image is far from its mean on the path."""
    return (4 * image.mean()).pow(8)


@pytest.fixture(scope="module")
def doubtful(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    """Four cells: two noisy ones, of which one does not add up; one that adds up; one of an older version."""
    cells = made.cells(["office", "attic"], ["front", "left"])
    said = {
        cells[0]: {
            "notes": ["valid if so", f"caution: {NOISY.format(12)}"],
            "cautions": [NOISY.format(12)],
            "convergence": "does not add up",
            "convergence_note": SUM,
        },
        cells[1]: {"notes": [f"caution: {NOISY.format(9)}"], "cautions": [NOISY.format(9)]},
        cells[2]: {"notes": [], "cautions": [], "convergence": "adds up", "convergence_note": ""},
    }
    folder = tmp_path_factory.mktemp("doubtful")
    return made.study(folder, made.random_effects(cells, 0), said=said)


def test_cautions_of_cells_are_columns_and_counted(doubtful: StudyResult, tmp_path: Path) -> None:
    frame = doubtful.values().set_index(["scene", "camera"])
    assert frame.loc[("office", "front"), "caution"] == NOISY.format(12)
    assert frame["convergence"].to_dict() == {
        ("office", "front"): "does not add up",
        ("office", "left"): "",
        ("attic", "front"): "adds up",
        ("attic", "left"): "",
    }
    assert frame.loc["attic", "caution"].tolist() == ["", ""], "an older version has no cautions"
    doubtful.write_table(tmp_path / "values.csv", of="values")
    assert NOISY.format(9) in (tmp_path / "values.csv").read_text(encoding="utf-8")
    count = "2 of 4 cells have a caution; 1 does not add up"
    for text in (str(doubtful), "\n".join(doubtful.summary().notes())):
        assert count in text
        # One note of what differs in its numbers only, before what the values take for granted.
        noted = (
            f"caution: {NOISY.format(12)} (office · front · luminance · as it is · gradient · seed 0 and 1 more "
            "cell, with numbers of their own)"
        )
        assert noted in text
        assert NOISY.format(9) not in text
        assert f"{SUM} (office · front" in text
        assert text.index("caution: the picture") < text.index("valid if so (office")


@pytest.mark.parametrize(("count", "whose"), [(3, "all cells"), (2, "office and 1 more cell"), (1, "office")])
def test_a_note_of_all_cells_says_so(count: int, whose: str, tmp_path: Path) -> None:
    cells = made.cells(["office", "attic", "kitchen"])
    said = {cell: {"notes": ["valid if so"]} for cell in cells[:count]}
    result = made.study(tmp_path, made.random_effects(cells, 0), said=said)
    pattern = whose.replace("office", "office[^()]*")
    for notes in (str(result).splitlines(), result.summary().notes()):
        assert [note for note in notes if re.fullmatch(rf"valid if so \({pattern}\)", note)]
    alone = made.study(tmp_path / "alone", made.random_effects(cells[:1], 0), said={cells[0]: said[cells[0]]})
    assert "all cells" not in str(alone), "the only cell has a name"


def test_cells_that_are_undecided_are_counted(tmp_path: Path) -> None:
    cells = made.cells(["office", "attic", "kitchen"])
    said = {cell: {"convergence": "inconclusive", "convergence_note": ""} for cell in cells[:2]}
    result = made.study(tmp_path / "two", made.random_effects(cells, 0), said=said)
    count = "2 of 3 cells are inconclusive whether the effects add up"
    assert count in str(result).splitlines()
    assert count in result.summary().notes()
    assert count in result.write_report(tmp_path / "report", pages=False).read_text(encoding="utf-8")
    said[cells[2]] = {"convergence": "does not add up", "convergence_note": SUM}
    said[cells[0]]["cautions"] = [NOISY.format(12)]
    del said[cells[1]]
    result = made.study(tmp_path / "each", made.random_effects(cells, 0), said=said)
    each = "1 of 3 cells has a caution; 1 does not add up; 1 is inconclusive whether the effects add up"
    assert each in str(result).splitlines()


def test_cautions_of_cells_are_marked_in_the_table_of_the_report(
    doubtful: StudyResult, tmp_path: Path
) -> None:
    text = doubtful.write_report(tmp_path, pages=False).read_text(encoding="utf-8")
    before, table = text.split('<table id="cells">')
    assert "<p>2 of 4 cells have a caution; 1 does not add up</p>" in before
    assert '<th scope="col">caution</th>' in table
    marks = [
        "! the picture is too noisy for this metric; the effects do not add up",
        "! the picture is too noisy",
    ]
    for mark in marks:
        assert f">{mark}" in table
    assert table.count(">! ") == 2
    assert f"<p>{SUM} (office" in table


def test_a_study_without_cautions_has_no_column_for_them(tmp_path: Path) -> None:
    result = made.study(tmp_path / "cells", made.random_effects(made.cells(["office"]), 0))
    assert "a caution" not in str(result)
    text = result.write_report(tmp_path / "report", pages=False).read_text(encoding="utf-8")
    assert '<th scope="col">caution</th>' not in text


def test_a_cell_says_what_its_own_page_says(run: Callable[..., StudyResult], tmp_path: Path) -> None:
    """The cautions of a noisy picture, and whether effects add up: with one step of the path, these do not."""
    path = {"method": "integrated-gradients", "n_steps": 1}
    options = {"methods": {"path": path}, "seeds": seeds(1), "resolution": (12, 12), "max_depth": 3}
    logit = {"metric": "shape-logit", "target": "cube"}
    noisy = run(
        Study(["cornell-box"], metrics={"logit": logit}, spp=8, inputs="reflectance", **options), tmp_path
    )
    unequal = run(
        Study(["cornell-box"], metrics={"steep": steep}, spp=512, inputs="emitters", **options),
        tmp_path / "steep",
    )
    for result, is_noisy, adds_up in ((noisy, True, None), (unequal, False, False)):
        (cell,) = result.cells
        attribution, numbers = result.attribution(cell), result.numbers(cell)
        assert numbers["cautions"] == ([attribution.info["picture"]["caution"]] if is_noisy else [])
        assert numbers["convergence"] == attribution.info["convergence"]
        assert (numbers["convergence"] == "does not add up") == (adds_up is False)
        assert numbers["convergence_advised"] == (
            convergence_notes(attribution)[0] if adds_up is False else ""
        )
