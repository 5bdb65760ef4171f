"""Lamps that are smaller than a pixel."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from scenecaptum import SceneRenderer


def bulb(radius: float, x: float, z: float, radiance: float = 60.0) -> dict[str, Any]:
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "sphere", "radius": radius, "center": [x, 0.2, z], "emitter": lamp}


@pytest.fixture
def bulbs(mi: Any) -> dict[str, Any]:
    """A wall, one large bulb and five small ones, two of which no pixel shows, and a pane before the last."""
    transform = mi.ScalarTransform4f()
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": transform.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
        },
        "wall": {"type": "rectangle", "to_world": transform.translate([0, 0, -1]).scale(9)},
        "large": bulb(0.6, -1.0, 0.0),
        "small": bulb(0.1, 0.4, 0.0, 30.0),
        "tiny": bulb(0.001, 0.9, 0.0),
        "behind_the_wall": bulb(0.001, 0.0, -1.5),
        "beside_the_picture": bulb(0.001, 5.0, 0.0),
        "behind_a_pane": bulb(0.001, 1.4, 0.0),
        "pane": {
            "type": "rectangle",
            "to_world": transform.translate([1.05, 0.15, 1.0]).scale(0.1),
            "bsdf": {"type": "thindielectric"},
        },
    }


@pytest.mark.parametrize("sensor", [0, "fisheye"])
def test_small_lamps_are_those_that_the_camera_sees(bulbs: dict[str, Any], sensor: int | str) -> None:
    renderer = SceneRenderer(bulbs, "reflectance", sensor=sensor, resolution=(8, 8), spp=1)
    found = renderer.small_lamps
    beside = {"beside_the_picture"} if sensor == "fisheye" else set()  # a hemisphere shows it
    assert {*found} - {"large"} == {"small", "tiny", "behind_a_pane"} | beside
    for name, radiance, radius in (("small", 30.0, 0.1), ("tiny", 60.0, 0.001)):
        assert found[name].radiance.tolist() == pytest.approx([radiance] * 3)
        x, y, z = bulbs[name]["center"]
        distance = math.hypot(x, y, z - 4)
        assert found[name].solid_angle == pytest.approx(math.pi * (radius / distance) ** 2, rel=0.15)
        ahead = renderer.camera.directions[found[name].pixel]
        assert ahead @ torch.tensor([x, y, 4 - z]).double() / distance > 0.96


def test_lamps_are_not_small_in_a_large_picture(bulbs: dict[str, Any]) -> None:
    renderer = SceneRenderer(bulbs, "reflectance", resolution=(64, 64), spp=1)
    assert {*renderer.small_lamps} == {"tiny", "behind_a_pane"}
