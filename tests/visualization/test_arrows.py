"""Arrows on maps: where moving an object raises the metric most."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from results import make
from seeds import shifted

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient
from scenecaptum.visualization import arrows, plot_overlay

NAME = "short_box_shape.pose.translation"


@pytest.fixture(scope="module")
def renderer(mi: Any) -> SceneRenderer:
    objects = {"boxes": ["short_box_shape", "tall_box_shape"], "short_box_shape": ["short_box_shape"]}
    inputs = [NAME, "light.pose.translation"]
    return SceneRenderer("cornell-box", inputs, resolution=(32, 32), spp=64, objects=objects)


def left_to_right(image: torch.Tensor) -> torch.Tensor:
    """Return a metric that rises where bright things move to the right; the box is brighter than what it hides."""
    return (image.mean(-1) * torch.linspace(-1, 1, image.shape[1])).mean()


def test_an_object_is_where_the_picture_shows_it(renderer: SceneRenderer) -> None:
    (x, y), slopes = renderer.shown_moves()[NAME]
    mask = renderer.surfaces.mask("short_box_shape")
    rows, columns = np.nonzero(mask > 0.5)
    assert columns.min() < x < columns.max() + 1
    assert rows.min() < y < rows.max() + 1
    # Right is right, up is up, and what comes nearer moves away from the centre.
    across, down = np.array(slopes)
    assert across[0] > 1
    assert abs(across[2]) < 0.05
    assert down[2] < -1


@pytest.mark.parametrize(
    ("name", "move"),
    [
        (NAME, (-0.7, 0.3, 0.0)),
        ("boxes.pose.translation", (-0.5, 0.0, 0.3)),
        ("camera.pose.translation", (0.4, 0.0, 0.0)),
        ("camera.pose.rotation", (0.0, 0.0, 0.2)),
        ("camera.fov", 60.0),
    ],
)
def test_an_object_is_where_the_values_show_it(
    renderer: SceneRenderer, name: str, move: float | tuple[float, ...]
) -> None:
    values = {name: torch.tensor(move)}
    place, before = (np.array(renderer.shown_moves((NAME,), moved)[NAME][0]) for moved in (values, {}))
    assert np.abs(place - before).max() > 2
    rows, columns = np.nonzero(renderer.surfaces_with_texels((), values).mask("short_box_shape") > 0.5)
    assert columns.min() < place[0] < columns.max() + 1
    assert rows.min() < place[1] < rows.max() + 1


def test_a_thin_lens_shows_an_object_where_a_pinhole_does(mi: Any) -> None:
    shown = []
    for camera in (
        {"type": "perspective"},
        {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 3.0},
    ):
        scene = mi.cornell_box()
        scene["sensor"] = {**scene["sensor"], **camera}
        one = SceneRenderer(scene, "small-box.pose.translation", resolution=(32, 32), spp=1)
        shown += one.shown_moves().values()
    (place, slopes), (expected, expected_slopes) = shown
    assert place == pytest.approx(expected, abs=1e-3)
    assert np.array(slopes) == pytest.approx(np.array(expected_slopes), abs=1e-3)
    assert one.info["sensor"].startswith("thin lens of radius 0.2, focused at 3, 39.31° wide")


def test_slopes_are_those_of_moved_objects(renderer: SceneRenderer) -> None:
    values = {
        NAME: torch.tensor([-0.3, 0.1, 0.2]),
        "boxes.pose.rotation": torch.tensor([0.1, 0.2, 0.5]),
        "camera.pose.rotation": torch.tensor([0.05, 0.1, 0.0]),
    }
    slopes = np.array(renderer.shown_moves((NAME,), values)[NAME][1])
    for axis, step in enumerate(0.01 * torch.eye(3)):
        ends = [{**values, NAME: values[NAME] + sign * step} for sign in (-1, 1)]
        low, high = (np.array(renderer.shown_moves((NAME,), end)[NAME][0]) for end in ends)
        assert (high - low) / 0.02 == pytest.approx(slopes[:, axis], abs=0.02)


def test_an_arrow_starts_where_its_object_was_moved(renderer: SceneRenderer) -> None:
    values = {**renderer.inputs, NAME: torch.tensor([-0.7, 0.3, 0.0])}
    found = VanillaSceneGradient(renderer, left_to_right).attribute(values, seed=shifted(), spp=8)
    assert found.info["shown_moves"] == renderer.shown_moves(None, values)
    assert found.info["shown_moves"][NAME][0][0] < renderer.shown_moves()[NAME][0][0] - 2


def test_an_arrow_points_to_where_the_metric_rises(renderer: SceneRenderer) -> None:
    found = VanillaSceneGradient(renderer, left_to_right).attribute(seed=shifted(), spp=256)
    by_name = {arrow.name: arrow for arrow in arrows(found)}
    gradient = found[NAME]
    assert NAME in by_name
    assert np.sign(by_name[NAME].dx) == np.sign(gradient[0].item())
    figure = found.plot_heatmap()
    assert "arrows" in " ".join(text.get_text() for text in figure.texts)


def of_a_move(x: float, y: float, towards: tuple[float, float]) -> SceneAttribution:
    """Return the effect of moving an object at a point of a picture, along and across it."""
    effects = {"box": torch.tensor([0.6, -0.8])}
    slopes = [[towards[0] * 0.6, towards[0] * -0.8], [towards[1] * 0.6, towards[1] * -0.8]]
    return dataclasses.replace(
        make(),
        attributions=effects,
        standard_error=None,
        covariance=None,
        extents={"box": torch.ones(2)},
        image=torch.zeros(20, 40, 3),
        info={"vectors": ["box"], "shown_moves": {"box": ((x, y), slopes)}},
    )


@pytest.mark.parametrize(
    ("x", "y", "towards", "end"),
    [
        (20, 10, (0, 1), (20, 16)),  # within the picture
        (20, 17, (0, 1), (20, 20)),
        (20, 3, (0, -1), (20, 0)),
        (37, 10, (1, 0), (40, 10)),
        (3, 10, (-1, 0), (0, 10)),
        (37, 10, (0.8, 0.6), (40, 12.25)),  # in the same direction
    ],
)
def test_an_arrow_ends_within_the_picture(
    x: float, y: float, towards: tuple[float, float], end: tuple[float, float]
) -> None:
    found = of_a_move(x, y, towards)
    (arrow,) = arrows(found)
    assert (arrow.x + arrow.dx, arrow.y + arrow.dy) == pytest.approx(end, abs=1e-6)
    (drawn,) = plot_overlay(found).axes[0].texts
    assert drawn.xy == pytest.approx(np.array(end) - 0.5, abs=1e-6), "the first pixel is from -0.5 to 0.5"


def test_an_arrow_of_which_the_edge_leaves_little_is_not_drawn() -> None:
    assert arrows(of_a_move(20, 20, (0, 1))) == []
    assert arrows(of_a_move(20, 19, (0, 1))) == []


def test_no_arrow_where_renders_contradict_the_effect() -> None:
    found = of_a_move(20, 10, (0, 1))
    beside = {"lamp": torch.tensor([1.0, 1.0])}
    extents = {**found.extents, "lamp": torch.ones(2)}
    for change, count in ((0.6, 1), (0.4, 0), (-1.0, 0)):
        info = {**found.info, "range_changes": {"box": (change, 0.1)}}
        two = dataclasses.replace(
            found, attributions={**found.attributions, **beside}, extents=extents, info=info
        )
        assert len(arrows(two)) == count


def test_no_arrows_without_poses(mi: Any) -> None:
    plain = SceneRenderer("cornell-box", "floor.reflectance.value", resolution=(8, 8), spp=4)
    assert arrows(VanillaSceneGradient(plain, left_to_right).attribute(seed=shifted())) == []
