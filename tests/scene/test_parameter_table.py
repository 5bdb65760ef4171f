"""How a scene's parameters and a renderer's plan are displayed in terminals and notebooks; nothing is rendered."""

from __future__ import annotations

import dataclasses
import html.parser
import sys
import unicodedata
from typing import Any

import pytest
from results import make

from scenecaptum.rendering import RenderPlan
from scenecaptum.scene import Parameter, SceneParameters
from scenecaptum.scene._bounds import Bounds
from scenecaptum.visualization import columns, shorten, table_html, table_text

NASTY = "<img src=x onerror=alert(1)>"


def parameter(name: str, problem: str | None = None, caution: str | None = None, **other: Any) -> Parameter:
    given: dict[str, Any] = {
        "label": name,
        "kind": "reflectance",
        "plugin": "SmoothDiffuse",
        "role": "reflectance",
        "shape": (3,),
        "bounds": Bounds(0, 1),
        "range": Bounds(0, 1),
        "owners": (name.split(".", maxsplit=1)[0],),
    }
    return Parameter(name=name, problem=problem, caution=caution, **{**given, **other})


MOVES = "it changes visibility, and a gradient without the boundary term would be wrong"
CAMERA = "it belongs to the camera, which Mitsuba does not differentiate"


def parameters() -> SceneParameters:
    long = "a_material_of_an_exporter_with_a_very_long_name"
    return SceneParameters(
        [
            parameter("floor.reflectance.data", shape=(64, 64, 3), caution="texels that are 0 are off"),
            parameter(f"{long}_1.reflectance.value", owners=(f"{long}_1", f"{long}_2")),
            parameter(f"{long}_2.reflectance.value"),
            parameter("lamp.vertex_positions", MOVES, kind="geometry", bounds=Bounds()),
            parameter("desk.vertex_positions", MOVES, kind="geometry", bounds=Bounds()),
            parameter(NASTY, CAMERA, kind="camera", owners=()),
        ]
    )


def plan() -> RenderPlan:
    return RenderPlan(
        integrator="scenecaptum_replay",
        max_depth=6,
        rr_depth=7,
        hide_emitters=False,
        reasons=(
            ("max_depth 6", "as asked, by somebody who wants it so"),
            ("2 inputs tracked", f"{NASTY} & 3"),
        ),
        differences=(
            ("desk.sheen.value", "at its bound"),
            ("glass.eta", "tables"),
            ("desk.metallic", "at its bound"),
        ),
        cautions=(("floor.reflectance.data", "texels that are 0 are off"),),
    )


class Page(html.parser.HTMLParser):
    """Parsed HTML: its tags, its text, and the cells of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.rows: list[list[str]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.open.append(tag)
        self.tags.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


@pytest.mark.parametrize("columns", [30, 40, 60, 80, 120])
def test_parameters_fit_a_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = str(parameters()).splitlines()
    assert max(map(len, lines)) <= columns
    table, notes = lines[: lines.index("")], " ".join(lines[lines.index("") :])
    assert len(table) == 1 + len(parameters())
    if columns >= 40:  # in fewer columns, long names that differ in the middle become equal
        assert len({line.split()[0] for line in table}) == len(table)
    if columns >= 60:
        cautioned, good, _, moves, also_moves, camera = table[1:]
        assert cautioned.endswith("yes, but: 1")
        assert good.endswith("yes")
        assert moves.endswith("no: 2")
        assert also_moves.endswith("no: 2")
        assert camera.endswith("no: 3")
        assert f"2 {MOVES}" in " ".join(notes.split())
        assert f"3 {CAMERA}" in " ".join(notes.split())


def test_wide_terminals_keep_more_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    heads = []
    for width in (50, 80, 120, 400):
        monkeypatch.setenv("COLUMNS", str(width))
        heads.append(str(parameters()).splitlines()[0].split())
    assert heads[-1] == ["name", "kind", "shape", "bounds", "owner", "status"]
    assert heads[-2] == ["name", "kind", "shape", "bounds", "owner", "differentiable"]
    assert [len(head) for head in heads] == sorted(len(head) for head in heads)
    assert len(heads[0]) < len(heads[-1])


def test_outside_a_terminal_no_line_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert not sys.stdout.isatty()
    header, *lines = str(parameters()).splitlines()
    assert header.split() == ["name", "kind", "shape", "bounds", "owner", "status"]
    for line, one in zip(lines, parameters().values(), strict=True):
        assert line.startswith(one.name)
        assert line.endswith(one.status)


def test_a_notebook_lists_differentiable_parameters_and_folds_the_rest() -> None:
    page = Page(parameters()._repr_html_())
    assert page.open == []
    assert "img" not in page.tags
    header, *rows = page.rows
    assert header == ["name", "kind", "shape", "bounds", "owner", "status"]
    assert [row[0] for row in rows] == [p.name for p in parameters().values() if not p.problem]
    assert rows[0][2] == "64×64×3"
    assert rows[0][5] == "differentiable, but texels that are 0 are off"
    assert page.tags.count("details") == 2
    assert f"2 parameters not differentiable: {MOVES}" in page.text
    assert "lamp.vertex_positions, desk.vertex_positions" in page.text
    assert NASTY in page.text
    assert "6 parameters, 3 of them differentiable" in page.text


def test_a_scene_without_parameters_can_be_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    assert str(SceneParameters([])).startswith("name")
    assert "0 parameters" in Page(SceneParameters([])._repr_html_()).text


@pytest.mark.parametrize("columns", [30, 60, 100])
def test_the_plan_fits_a_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    text = str(plan())
    assert max(map(len, text.splitlines())) <= columns
    said = " ".join(text.split())
    assert "max_depth 6 as asked, by somebody who wants it so" in said
    assert "finite difference for desk.sheen.value, desk.metallic: at its bound" in said
    assert "finite difference for glass.eta: tables" in said
    assert "caution: floor.reflectance.data: texels that are 0 are off" in said


def test_the_plan_in_a_notebook_is_a_table() -> None:
    page = Page(plan()._repr_html_())
    assert page.open == []
    assert "img" not in page.tags
    assert page.rows == [["decision", "reason"], *map(list, plan().reasons)]
    assert "Finite difference for desk.sheen.value, desk.metallic: at its bound" in page.text
    assert "Caution: floor.reflectance.data: texels" in page.text


def test_the_plan_names_the_first_of_many_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    names = [f"material_{number}" for number in range(46)]
    many = dataclasses.replace(
        plan(),
        differences=tuple((name, "at its bound") for name in names),
        cautions=tuple((name, "too dark") for name in names),
        noisy_roughness=tuple(names),
    )
    some = "material_0, material_1, material_2 and 43 more"
    assert str(many).splitlines()[2:] == [
        f"finite difference for {some}: at its bound",
        f"caution: {some}: too dark",
        f"low roughness among other inputs: {some}",
    ]
    page = Page(many._repr_html_())
    for said in (f"Finite difference for {some}:", f"Caution: {some}:", f"among other inputs: {some}"):
        assert said in page.text
    assert "material_3" not in page.text


def test_an_attribution_in_a_notebook_is_well_formed() -> None:
    page = Page(table_html(make(cautions={"lamp": NASTY})))
    assert page.open == []
    assert "img" not in page.tags
    assert NASTY in page.text


def test_without_a_terminal_the_ranking_is_100_columns_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    long = dataclasses.replace(make(), labels={"lamp": "lamp" * 60})
    widest = max(map(len, table_text(long).splitlines()))
    assert 90 < widest <= 100


@pytest.mark.parametrize("wide", [30, 60, 80, 100])
def test_wide_characters_count_twice(wide: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(wide))
    names = {"lamp": "机の上のランプ" * 6, "rough": "bure\u0301au: rugosité", "wall": "壁: reflectance"}
    text = table_text(dataclasses.replace(make(), labels=names))
    scene = SceneParameters([parameter(name) for name in names.values()])
    for line in [*text.splitlines(), *str(scene).splitlines()]:
        assert sum(2 if unicodedata.east_asian_width(c) == "W" else 1 for c in line) <= wide
    if wide >= 60:
        shown = [columns(line[: line.index(" ± ")]) for line in text.splitlines()[1:] if " ± " in line]
        assert len(shown) == 8
        assert len(set(shown)) == 1


def test_columns_of_text() -> None:
    assert [columns(text) for text in ("", "desk", "机", "e\u0301", "ﾗ", "Ａ")] == [0, 4, 2, 1, 1, 2]
    assert shorten(["机の上のランプの傘"], 8) == ["机の…傘"]


def test_bounds_have_a_minus_sign():
    assert [str(Bounds(-1.0, open_low=True)), str(Bounds(-0.5, 1.0))] == ["(−1, ∞)", "[−0.5, 1]"]
