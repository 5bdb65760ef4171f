"""Figures of studies: what they say, what they draw, and what they refuse."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.lines import Line2D
from results import NASTY, all_text, outside

from scenecaptum import SceneCaptumError
from scenecaptum.studies import StudyResult, plot_effect_by_room
from scenecaptum.visualization import LOWERS, RAISES, UNCLEAR

from . import made

NOISE = 0.1
# The effect of each room is as many standard errors from 0.
WIDE = "the-room-with-the-longest-name-of-all-rooms"
BY_ROOM = {"office": 30.0, "attic": -20.0, "kitchen": 0.0, NASTY: 10.0, WIDE: 20.0}


def by_room(folder: Path) -> StudyResult:
    cells = made.cells([*BY_ROOM], ["front", "left"])
    return made.study(
        folder, {cell: {"wall.alpha": NOISE * BY_ROOM[cell.scene]} for cell in cells}, noise=NOISE
    )


def dots(figure: Any) -> list[tuple[float, Any]]:
    """The height and the colour of every room's dot."""
    lines = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    return [(line.get_ydata()[0], line.get_color()) for line in lines]


def test_rooms_are_in_order_in_the_colours_of_their_signs(tmp_path: Path) -> None:
    figure = by_room(tmp_path).plot_effects("roughness")
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    order = [name for name, _ in sorted(BY_ROOM.items(), key=lambda item: -item[1])]
    assert [names[0], *names[3:5]] == ["office", *order[3:]]
    assert names[5:] == ["mean of all rooms", "a new room"]
    assert dots(figure) == [(0, RAISES), (1, RAISES), (2, RAISES), (3, UNCLEAR), (4, LOWERS)]
    text = all_text(figure)
    assert "roughness: positive in 3 and negative in 1 of 5 rooms" in text.replace("\n", " ")
    assert "change of mean luminance (cd/m²)" in text
    assert "bar: 95 % interval of the noise; diamond: of the mean; line: of a new room" in text
    assert outside(figure) == []


def test_an_effect_of_exactly_0_is_not_called_noise(tmp_path: Path) -> None:
    summary = by_room(tmp_path).summary()
    [row] = summary.rows
    exact = [dataclasses.replace(room, effect=0.0, error=0.0, low=0.0, high=0.0) for room in row.rooms]

    def text(*rooms: Any) -> str:
        one = dataclasses.replace(row, rooms=rooms)
        figure = plot_effect_by_room(dataclasses.replace(summary, rows=(one,)))
        assert [color for _, color in dots(figure)].count(UNCLEAR) >= len(exact)
        return all_text(figure).replace("\n", " ")

    unclear = next(room for room in row.rooms if not room.sign)
    assert "sign lost in the noise" not in text(*exact)
    assert "exactly 0 in all of 5 rooms" in text(*exact)
    assert "sign lost in the noise" in text(*exact, unclear)
    assert "no clear sign in any of 6 rooms" in text(*exact, unclear)


@pytest.mark.parametrize("rooms", [1, 5])
def test_a_long_label_is_whole_and_a_change_of_a_share_is_in_points(tmp_path: Path, rooms: int) -> None:
    share = {"name": "relaxed spatial daylight autonomy of the points of a floor", "unit": "%"}
    effects = {cell: {"wall.alpha": 3.0} for cell in made.cells([*BY_ROOM][-rooms:])}
    result = made.study(tmp_path, effects, measure=share)
    figure = result.plot_effects("roughness")
    assert outside(figure) == []
    label = figure.axes[0].get_xlabel().replace("\n", " ")
    assert label.endswith("(percentage points) over the range of the parameter")
    title = " ".join(figure.axes[0].get_title(loc="left").split())
    assert title.endswith("percentage points in the only room" if rooms == 1 else "percentage points")
    assert "bar: 95 % interval of the noise" in all_text(figure), "longer than the ± of the title"
    assert "%" not in title


def test_intervals_are_those_of_the_summary(tmp_path: Path) -> None:
    result = by_room(tmp_path)
    row = result.summary().row("roughness")
    ax = result.plot_effects("roughness").axes[0]
    lines = [line for line in ax.lines if isinstance(line, Line2D) and len(line.get_xdata()) == 2]
    drawn = [tuple(line.get_xdata()) for line in lines]
    assert (row.new_low, row.new_high) in drawn
    assert all((room.low, room.high) in drawn for room in row.rooms)
    [diamond] = ax.patches
    assert np.allclose([diamond.get_xy()[:, 0].min(), diamond.get_xy()[:, 0].max()], [row.low, row.high])


def test_no_dot_hides_the_marks_of_its_cameras(tmp_path: Path) -> None:
    cells = made.cells(["office", "attic"], ["front", "left"])
    effects = {cell: {"wall.alpha": 3.0 if cell.scene == "office" else -3.0} for cell in cells}
    figure = made.study(tmp_path, effects, noise=1e-3).plot_effects("roughness")
    figure.canvas.draw()
    transform, point = figure.axes[0].transData, figure.dpi / 72
    marked = {mark: [line for line in figure.axes[0].lines if line.get_marker() == mark] for mark in "o|"}
    assert [len(line.get_xdata()) for line in marked["|"]] == [2, 2]
    for dot, cameras in zip(marked["o"], marked["|"], strict=True):
        (_, at), (_, below) = (transform.transform(line.get_xydata())[0] for line in (dot, cameras))
        assert at - below > point * (dot.get_markersize() + cameras.get_markersize()) / 2


def test_a_few_of_many_rooms_can_be_drawn(tmp_path: Path) -> None:
    figure = by_room(tmp_path).plot_effects("roughness", top=1)
    assert figure.axes[0].get_yticklabels()[0].get_text() == "office"
    assert "4 rooms with smaller effects not shown" in all_text(figure)


def test_one_room_has_no_mean(tmp_path: Path) -> None:
    [cell] = made.cells(["office"])
    figure = made.study(tmp_path, {cell: {"wall.alpha": 3.0}}).plot_effects()
    text = all_text(figure)
    assert "in the only room" in text
    assert "one room: neither" in text
    assert "mean of all rooms" not in text
    assert outside(figure) == []


def test_effects_without_a_sign_are_drawn(tmp_path: Path) -> None:
    summary = by_room(tmp_path).summary()
    [row] = summary.rows
    unsigned = dataclasses.replace(row, quantity=row.quantity._replace(signs=None))
    assert "positive" in all_text(plot_effect_by_room(dataclasses.replace(summary, rows=(unsigned,))))


def test_rankings_differ_where_the_effects_do(tmp_path: Path) -> None:
    # Seeds keep the order, and the second room reverses it.
    ranks = {"a.alpha": 1.0, "b.alpha": 2.0, "c.alpha": 3.0}
    backwards = dict(zip(ranks, reversed(ranks.values()), strict=True))
    cells = made.cells(["office", "attic"], seeds=[0, 1])
    effects = {cell: ranks if cell.scene == "office" else backwards for cell in cells}
    figure = made.study(tmp_path, effects, noise=0.01).plot_stability(None)
    dotted = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert [sorted(line.get_xdata()) for line in dotted] == [[1, 1], [-1, -1]]
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["between seeds: 2 pairs", "between rooms: 2 pairs"]
    title = all_text(figure).replace("\n", " ")
    assert "differ most between rooms (mean τ −1), least between seeds (1)" in title
    assert outside(figure) == []


def test_rankings_of_too_few_groups_are_refused(tmp_path: Path) -> None:
    result = by_room(tmp_path)
    with pytest.raises(SceneCaptumError, match=r"at least 3 groups in common.*group=None for each parameter"):
        result.plot_stability()
    with pytest.raises(SceneCaptumError, match=r"at least 3 parameters in common whose effects .* equal\.$"):
        result.plot_stability(None)


def test_pairs_that_are_left_out_are_counted(tmp_path: Path) -> None:
    many = {"a.alpha": 1.0, "b.alpha": 2.0, "c.alpha": 3.0}
    cells = made.cells(["office", "attic", "kitchen"], ["front", "left"])
    effects = {cell: many if cell.scene == "office" else {"a.alpha": 1.0} for cell in cells}
    text = all_text(made.study(tmp_path, effects).plot_stability(None)).replace("\n", " ")
    reason = "with fewer than 3 parameters in common, or with all effects equal"
    assert f"left out: 2 pairs of cameras, 6 pairs of rooms {reason}" in text
    assert "Rankings of the parameters between cameras" in text


def test_a_gallery_has_a_map_for_each_room_and_camera(tmp_path: Path) -> None:
    cells = made.cells(["office", NASTY, "attic"], ["front", "left"])
    result = made.study(tmp_path, made.random_effects(cells[:-1], 0), failures={cells[-1]: "no camera"})
    figure = result.plot_gallery()
    maps = [ax for ax in figure.axes if ax.images]
    assert len(maps) == 5
    text = all_text(figure)
    assert "no picture" in text
    assert "10.00 ± 0.10 cd/m²" in text
    assert "Effects of the objects in each pixel on mean luminance; blue" in text.replace("\n", " ")
    assert "blue: raising it raises the metric" in text.replace("\n", " ")
    assert outside(figure) == []
    assert "2 more rooms not shown" in all_text(result.plot_gallery(1))
    assert "largest of all" in all_text(result.plot_gallery(shared=True))


@pytest.mark.parametrize(
    ("cameras", "headings"),
    [(["0", "1"], ["camera 0", "camera 1"]), (["0", "left"], ["camera 0", "left"])],
)
def test_cameras_are_named_where_there_are_several(
    cameras: list[str], headings: list[str], tmp_path: Path
) -> None:
    result = made.study(tmp_path, made.random_effects(made.cells(["office", "attic"], cameras), 0))
    titles = [ax.get_title() for ax in result.plot_gallery().axes if ax.images]
    value = "10.00 ± 0.10 cd/m²"
    assert titles == [*(f"{heading}\n{value}" for heading in headings), *[value] * len(cameras)]


@pytest.mark.parametrize(("rooms", "columns"), [(1, 1), (2, 2), (3, 3), (4, 2), (5, 3), (7, 3)])
def test_rooms_with_one_camera_stand_side_by_side(rooms: int, columns: int, tmp_path: Path) -> None:
    names = [f"room {number}" for number in range(rooms)]
    figure = made.study(tmp_path, made.random_effects(made.cells(names, ["front"]), 0)).plot_gallery(None)
    figure.draw_without_rendering()
    maps = [ax for ax in figure.axes if ax.images]
    assert [ax.get_title() for ax in maps] == [f"{name}\n10.00 ± 0.10 cd/m²" for name in names]
    assert len({round(ax.get_window_extent().x0) for ax in maps}) == columns
    assert outside(figure) == []


def test_a_gallery_says_what_has_no_colour(tmp_path: Path) -> None:
    """Over a dark render, what has no colour is black."""
    cells = made.cells(["office"])
    clear = made.study(tmp_path / "clear", {cells[0]: {"wall.alpha": 3.0, "desk.alpha": 2.0}})
    unclear = made.study(tmp_path / "unclear", {cells[0]: {"wall.alpha": 3.0, "desk.alpha": 0.0}})
    note = "; no colour: sign lost in the noise"
    titles = [" ".join(one.plot_gallery().get_suptitle().split()) for one in (clear, unclear)]
    assert [note in title for title in titles] == [False, True]


def test_a_gallery_needs_pictures(tmp_path: Path) -> None:
    cells = made.cells(["office"])
    result = made.study(tmp_path, made.random_effects(cells, 0), picture=False)
    with pytest.raises(SceneCaptumError, match="No cell of the study has a picture"):
        result.plot_gallery()
