"""Views: cameras of a scene that are turned, moved and zoomed."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from refusals import message
from seeds import shifted

from scenecaptum import SceneRenderer, View

SIZE = (33, 17)


def scene(mi: Any, **camera: Any) -> dict[str, Any]:
    """Return a bright ball ahead of a camera at the origin, which looks along y with z up."""
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1])
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": look,
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 64},
            **camera,
        },
        "ball": {"type": "sphere", "center": [0, 10, 0], "radius": 0.6, "light": {"type": "area"}},
    }


def ball(image: torch.Tensor) -> tuple[float, float]:
    """Return the place of the ball in pixels from the centre of the picture: right and up."""
    weight = image.sum(-1)
    y, x = torch.meshgrid(*(torch.arange(n) - (n - 1) / 2 for n in weight.shape), indexing="ij")
    return ((x * weight).sum() / weight.sum()).item(), (-(y * weight).sum() / weight.sum()).item()


@pytest.mark.parametrize(
    ("view", "side"),
    [
        (View(turn=10), (-1, 0)),  # what is ahead moves to the left
        (View(turn=-10), (1, 0)),
        (View(tilt=8), (0, -1)),
        (View(move=(1.5, 0, 0)), (-1, 0)),
        (View(move=(0, 1.0, 0)), (0, -1)),
    ],
)
def test_the_picture_moves_the_other_way(mi: Any, view: View, side: tuple[int, int]) -> None:
    image = SceneRenderer(scene(mi), "emitters", sensor=view)(seed=shifted())
    x, y = ball(image)
    for place, sign in zip((x, y), side, strict=True):
        assert place * sign > 2 if sign else abs(place) < 0.2


def test_a_turn_is_that_of_a_camera_that_looks_there(mi: Any) -> None:
    angle = torch.tensor(12.0).deg2rad()
    target = [angle.sin().item(), angle.cos().item(), 0]
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=target, up=[0, 0, 1])
    expected = SceneRenderer(scene(mi, to_world=look), "emitters")(seed=shifted())
    found = SceneRenderer(scene(mi), "emitters", sensor=View(turn=12))(seed=shifted())
    assert ball(found) == pytest.approx(ball(expected), abs=0.02)
    assert ball(found)[0] < -3


def test_a_field_of_view_zooms_and_no_change_changes_nothing(mi: Any) -> None:
    own = SceneRenderer(scene(mi), "emitters")
    same = SceneRenderer(scene(mi), "emitters", sensor=View())
    assert torch.allclose(same(seed=shifted()), own(seed=shifted()), atol=1e-5)
    assert same.camera.fov == pytest.approx(60, abs=1e-3)
    near = SceneRenderer(scene(mi), "emitters", sensor=View(fov=20))
    assert near.camera.fov == pytest.approx(20, abs=1e-3)
    larger = near(seed=shifted()).sum() / own(seed=shifted()).sum()
    zoom = math.tan(math.radians(30)) / math.tan(math.radians(10))
    assert larger.item() == pytest.approx(zoom**2, rel=0.05)  # the ball covers few pixels


def test_a_view_moves_with_its_own_poses_and_checkpoints(mi: Any, tmp_path: Any) -> None:
    left, right = (
        SceneRenderer(scene(mi), "camera", sensor=View(turn=turn)).with_checkpoint(tmp_path)
        for turn in (-5, 5)
    )
    assert ball(left(seed=shifted()))[0] > 1 > -1 > ball(right(seed=shifted()))[0]
    assert right.checkpoint.rendered == 1
    assert right.checkpoint.reused == 0


def test_views_that_cannot_be(mi: Any) -> None:
    for view, expected in (
        (View(fov=180), "fov of a View must be above 0 and below 180"),
        (View(turn=float("nan")), "must be finite"),
        (View(sensor=1), "sensor must be 0"),
    ):
        assert expected in message(lambda view=view: SceneRenderer(scene(mi), "emitters", sensor=view))
    fish = scene(mi, type="thinlens", aperture_radius=0.1, focus_distance=3.0)
    assert "needs a pinhole camera" in message(lambda: SceneRenderer(fish, "emitters", sensor=View(turn=3)))
