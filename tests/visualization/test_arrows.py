"""Arrows on maps: where moving an object raises the metric most."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from seeds import shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient
from scenecaptum.visualization import arrows

NAME = "short_box_shape.pose.translation"


@pytest.fixture(scope="module")
def renderer(mi: Any) -> SceneRenderer:
    return SceneRenderer("cornell-box", [NAME, "light.pose.translation"], resolution=(32, 32), spp=64)


def left_to_right(image: torch.Tensor) -> torch.Tensor:
    """Return a metric that rises where bright things move to the right; the box is brighter than what it hides."""
    return (image.mean(-1) * torch.linspace(-1, 1, image.shape[1])).mean()


def test_an_object_is_where_the_picture_shows_it(renderer: SceneRenderer) -> None:
    (x, y), slopes = renderer.shown_moves[NAME]
    mask = renderer.surfaces.mask("short_box_shape")
    rows, columns = np.nonzero(mask > 0.5)
    assert columns.min() < x < columns.max() + 1
    assert rows.min() < y < rows.max() + 1
    # Right is right, up is up, and what comes nearer moves away from the centre.
    across, down = np.array(slopes)
    assert across[0] > 1
    assert abs(across[2]) < 0.05
    assert down[2] < -1


def test_an_arrow_points_to_where_the_metric_rises(renderer: SceneRenderer) -> None:
    found = VanillaSceneGradient(renderer, left_to_right).attribute(seed=shifted(), spp=256)
    by_name = {arrow.name: arrow for arrow in arrows(found)}
    gradient = found[NAME]
    assert NAME in by_name
    assert np.sign(by_name[NAME].dx) == np.sign(gradient[0].item())
    figure = found.plot_heatmap()
    assert "arrows" in " ".join(text.get_text() for text in figure.texts)


def test_no_arrows_without_poses(mi: Any) -> None:
    plain = SceneRenderer("cornell-box", "floor.reflectance.value", resolution=(8, 8), spp=4)
    assert arrows(VanillaSceneGradient(plain, left_to_right).attribute(seed=shifted())) == []
