"""Maps on the plan of a room: contours at the levels within the range, and blanks where no point is."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from matplotlib.collections import QuadMesh
from matplotlib.contour import QuadContourSet

from scenecaptum import SceneCaptumError
from scenecaptum.visualization import plot_plan, share_scale


def plan(rows: int, columns: int) -> torch.Tensor:
    """Return points in steps of half a metre, the first row at the top."""
    y, x = torch.meshgrid(torch.arange(rows).flip(0).double(), torch.arange(columns).double(), indexing="ij")
    return torch.stack([x, y], -1) / 2


def ramp(rows: int = 5, columns: int = 7) -> torch.Tensor:
    """Return 100 lx at the left and 700 lx at the right."""
    return torch.linspace(100, 700, columns).expand(rows, columns)


def contours(figure) -> list[QuadContourSet]:
    return [part for part in figure.axes[0].get_children() if isinstance(part, QuadContourSet)]


def test_contours_are_at_the_levels_within_the_range():
    (drawn,) = contours(plot_plan(ramp(), plan(5, 7)))
    assert drawn.levels.tolist() == [150, 200, 300, 500]
    # 300 lx is at a third of the width of 3 m.
    np.testing.assert_allclose(np.concatenate(drawn.allsegs[2])[:, 0], 1.0)
    (own,) = contours(plot_plan(ramp(), plan(5, 7), levels=(400, 250, 9e9)))
    assert own.levels.tolist() == [250, 400]


@pytest.mark.parametrize("width", [7.2, 4.2])
def test_a_contour_near_another_is_labelled_as_well(width):
    """As of a daylight factor near a window: the label moves along its contour until there is room."""
    falling = torch.tensor([0.3, 0.35, 0.4, 0.6, 1.0, 1.8, 3.8])[:, None].expand(7, 9)
    figure = plot_plan(falling, plan(7, 9), levels=(0.5, 1.0001, 2.0, 3.0), width=width)
    labels = figure.axes[0].texts
    assert sorted(label.get_text() for label in labels) == ["0.5", "1", "2", "3"]
    places = [label.get_position() for label in labels]
    apart = [math.dist(one, other) for one, other in itertools.combinations(places, 2)]
    assert min(apart) >= 0.08 * 7.2 / width * 4.0


def test_no_contour_passes_between_blank_points():
    inside = torch.ones(5, 7, dtype=torch.bool)
    inside[2, 2] = False
    values = ramp().clone()
    values[2, 2] = 1e6
    (drawn,) = contours(plot_plan(values, plan(5, 7), inside, levels=(290.0,)))
    ends = np.concatenate(drawn.allsegs[0])
    assert len(ends)
    # In the cells around the blank point, which is at (1, 1), nothing is known.
    assert not ((abs(ends[:, 1] - 1) < 0.499) & (abs(ends[:, 0] - 1) < 0.499)).any()


def test_points_outside_are_blank_and_do_not_count():
    inside = torch.ones(5, 7, dtype=torch.bool)
    inside[:4, 6] = False
    values = ramp().clone()
    values[:4, 6] = float("nan")
    figure = plot_plan(values, plan(5, 7), inside)
    mesh = figure.axes[0].collections[0]
    assert mesh.get_array().mask.reshape(5, 7)[:4, 6].all()
    assert mesh.get_array().count() == 31
    assert figure.axes[0].get_title(loc="left").startswith("blank: inside an object")
    assert plot_plan(ramp(), plan(5, 7)).axes[0].get_title(loc="left") == ""


def test_a_title_names_a_line_only_where_one_is_drawn():
    def title(shown: torch.Tensor, points: torch.Tensor, **parts: float) -> str:
        text = "from 50 % on (line), a point counts"
        return plot_plan(shown, points, levels=(350.0,), title=text, **parts).axes[0].get_title(loc="left")

    assert title(ramp(), plan(5, 7)) == "from 50 % on (line), a point counts"
    without = "from 50 % on, a point counts"
    assert title(ramp() + 300, plan(5, 7)) == without  # all above
    assert title(ramp(), plan(5, 7), error=200.0) == without  # too noisy
    assert title(ramp(1, 7), plan(1, 7)) == without  # a single row has no contours


def test_outer_rows_and_columns_without_a_point_are_left_out():
    inside = torch.zeros(5, 7, dtype=torch.bool)
    inside[1:, 2:5] = True
    inside[2, 3] = False
    figure = plot_plan(ramp(), plan(5, 7), inside)
    ax = figure.axes[0]
    assert ax.get_xlim() == (0.75, 2.25)
    assert ax.get_ylim() == (-0.25, 1.75)
    assert ax.collections[0].get_array().count() == 11
    assert ax.collections[0].get_clim() == (300, 500)


@pytest.mark.parametrize("shape", [(5, 7), (7, 9), (12, 5), (5, 12)])
@pytest.mark.parametrize(
    "title",
    [
        "Occupied hours with at least 300 lx in %\nfrom 50 % on (line), a point counts for sDA300/50%",
        "Occupied hours with more than 1000 lx of direct sun\n"
        "above 250 hours (line), a point counts for ASE1000,250h",
    ],
)
def test_long_texts_are_inside_a_narrow_plan(title, shape):
    inside = torch.ones(shape, dtype=torch.bool)
    inside[2, 2] = False
    values, label = ramp(*shape), title.partition("\n")[0].lower()
    figure = plot_plan(values, plan(*shape), inside, width=4.2, title=title, label=label)
    assert_texts_are_inside(figure)


@pytest.mark.parametrize("sides", [(7, 5), (8, 6), (12, 3), (3, 9), (4, 4)])
@pytest.mark.parametrize("blank", [False, True])
@pytest.mark.parametrize("width", [4.2, 7.2])
def test_the_texts_of_a_plan_are_inside_its_figure_whatever_the_room(sides, blank, width):
    inside, points = torch.ones(5, 7, dtype=torch.bool), plan(5, 7)
    inside[2, 2] = not blank
    room = points / points.amax((0, 1)) * torch.tensor(sides)
    title = "Occupied hours with at least 300 lx in %\nfrom 50 % on (line), a point counts for sDA300/50%"
    assert_texts_are_inside(plot_plan(ramp(), room, inside, width=width, title=title))


def assert_texts_are_inside(figure) -> None:
    figure.canvas.draw()
    (width, height), (ax, bar) = figure.bbox.size, figure.axes
    for text in (ax._left_title, ax.xaxis.label, ax.yaxis.label, bar.yaxis.label):
        box = text.get_window_extent()
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height


def test_a_narrow_plan_has_text_of_the_same_size():
    wide, narrow = (plot_plan(ramp(), plan(5, 7), width=width) for width in (7.2, 4.2))
    assert narrow.get_size_inches()[0] == pytest.approx(4.2)
    sizes = [figure.axes[0].xaxis.label.get_size() for figure in (wide, narrow)]
    assert sizes[0] == sizes[1]


def test_axes_are_in_metres_with_equal_aspect():
    figure = plot_plan(ramp(), plan(5, 7), title="Office", label="illuminance in lx")
    ax, bar = figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_aspect()) == ("x in m", "y in m", 1.0)
    assert ax.get_title(loc="left") == "Office"
    assert bar.get_ylabel() == "illuminance in lx"
    # Each point is the centre of its cell, and y points up.
    assert ax.get_xlim() == (-0.25, 3.25)
    assert ax.get_ylim() == (-0.25, 2.25)
    other, _ = plot_plan(ramp(), plan(5, 7), axes=("x", "z")).axes
    assert other.get_ylabel() == "z in m"
    # Where y is up, x to the right and z up would be the room from below.
    assert (other.get_xlim(), other.get_ylim()) == ((-0.25, 3.25), (2.25, -0.25))


@pytest.mark.parametrize("shape", [(1, 6), (6, 1), (1, 1), (6, 3)])
def test_a_few_rows_of_points_have_no_contours(shape):
    values = torch.arange(100.0, 100 + 100 * shape[0] * shape[1], 100).reshape(shape)
    figure = plot_plan(values, plan(*shape))
    figure.canvas.draw()
    assert not contours(figure)


def test_bad_input_is_one_clear_line():
    with pytest.raises(SceneCaptumError, match=r"not \(5, 7\), \(4, 7, 2\) and \(5, 7\)"):
        plot_plan(ramp(), plan(4, 7))
    with pytest.raises(SceneCaptumError, match="No point"):
        plot_plan(ramp(), plan(5, 7), torch.zeros(5, 7, dtype=torch.bool))
    with pytest.raises(SceneCaptumError, match="not finite"):
        plot_plan(ramp() / 0 * 0, plan(5, 7))
    with pytest.raises(SceneCaptumError, match="rows and columns"):
        plot_plan(torch.rand(3, 3), torch.rand(3, 3, 2))


def test_plans_that_are_compared_have_one_scale():
    figures = [plot_plan(factor * ramp(), plan(5, 7)) for factor in (1, 2)]
    share_scale(figures)
    for figure in figures:
        mapped = next(part for part in figure.axes[0].get_children() if isinstance(part, QuadMesh))
        assert mapped.get_clim() == (100, 1400)
        assert figure.axes[1].get_ylim() == (100, 1400)


def test_contours_within_the_noise_of_a_point_are_left_out():
    # The median step between 100 and 750 lx is 100 lx.
    for error, drawn in ((24, 1), (26, 0)):
        figure = plot_plan(ramp(), plan(5, 7), error=error)
        assert len(contours(figure)) == drawn
        below = figure.axes[0].get_xlabel()
        assert f"± {error:.0f} lx at a point" in below
        assert ("too noisy for contours" in below) == (not drawn)
    assert "±" not in plot_plan(ramp(), plan(5, 7)).axes[0].get_xlabel()
    # Of a single level it is the range of the values.
    assert len(contours(plot_plan(ramp(), plan(5, 7), levels=(200,), error=149))) == 1
    assert not contours(plot_plan(ramp(), plan(5, 7), levels=(200,), error=151))
