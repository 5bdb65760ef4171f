"""Lamps that are smaller than a pixel."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from seeds import shifted

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
    found = renderer.small_lamps()
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
    assert {*renderer.small_lamps()} == {"tiny", "behind_a_pane"}


def test_coverage_is_that_of_lamps_and_the_sky(bulbs: dict[str, Any]) -> None:
    """Also behind a pane, although it reflects a part of the light, and in a mirror."""
    bulbs = {**bulbs, "behind_a_pane": {**bulbs["behind_a_pane"], "radius": 0.1}}
    renderer = SceneRenderer(bulbs, "reflectance", resolution=(64, 64), spp=1)
    covered = renderer.lamp_coverage()
    assert {*covered} == {"large", "small", "behind_a_pane"}
    for name, radius in (("large", 0.6), ("small", 0.1), ("behind_a_pane", 0.1)):
        x, y, z = bulbs[name]["center"]
        expected = math.pi * (radius / math.hypot(x, y, z - 4)) ** 2
        assert (covered[name] * renderer.camera.solid_angles).sum() == pytest.approx(expected, rel=0.1)

    bulbs = {**bulbs, "wall": {**bulbs["wall"], "bsdf": {"type": "conductor"}}}
    mirrored = SceneRenderer(bulbs, "reflectance", resolution=(64, 64), spp=1).lamp_coverage()
    assert mirrored["large"].sum() > covered["large"].sum() + 10
    bulbs = {name: part for name, part in bulbs.items() if name != "wall"}
    bulbs["daylight"] = {"type": "constant", "radiance": 1.0}
    outside = SceneRenderer(bulbs, "reflectance", resolution=(64, 64), spp=1).lamp_coverage()
    assert (sum(outside.values()) == 1).float().mean() > 0.99, "but for bulbs that are smaller than a pixel"


def test_direct_light_is_that_of_a_render_without_reflecting_surfaces(bulbs: dict[str, Any]) -> None:
    pane = {**bulbs["pane"], "bsdf": {"type": "thindielectric", "specular_transmittance": 0.5}}
    camera = {**bulbs["camera"], "film": {"type": "hdrfilm", "rfilter": {"type": "box"}}}
    bulbs = {
        **bulbs,
        "camera": camera,
        "pane": pane,
        "behind_a_pane": {**bulbs["behind_a_pane"], "radius": 0.1},
    }
    renderer = SceneRenderer(bulbs, "reflectance", resolution=(64, 64), spp=4096, max_depth=2)
    light, covered, image = renderer.direct_light(), renderer.lamp_coverage(), renderer(seed=shifted())
    assert {"large", "small", "behind_a_pane"} <= {*light}
    for name in ("small", "behind_a_pane"):
        whole = covered[name] == 1
        assert light[name][whole].mean().item() == pytest.approx(image[whole].mean().item(), rel=0.05)
    off = {name: torch.zeros(3) for name in renderer.parameters if name.endswith("radiance.value")}
    assert renderer.direct_light(off) == {}


def test_small_lamps_are_as_the_values_have_them(bulbs: dict[str, Any]) -> None:
    inputs = ["small.*", "tiny.*", "camera.pose.*"]
    renderer = SceneRenderer(bulbs, inputs, resolution=(8, 8), spp=1)
    values = dict(renderer.inputs)
    as_loaded = renderer.small_lamps(values)
    radiance = next(name for name in values if name.startswith("small") and name.endswith("radiance.value"))
    dimmed = renderer.small_lamps({**values, radiance: 0.1 * values[radiance]})
    assert dimmed["small"].radiance.tolist() == pytest.approx([3.0] * 3)
    off = renderer.small_lamps({radiance: torch.zeros_like(values[radiance])})
    assert off["small"].radiance.tolist() == [0] * 3
    up = torch.tensor([0.0, 0.58, 0.0])  # the size of a pixel at the lamps
    moved = renderer.small_lamps({"tiny.pose.translation": up})
    row, column = as_loaded["tiny"].pixel
    assert moved["tiny"].pixel == (row - 1, column)
    gone = renderer.small_lamps({"tiny.pose.translation": 10 * up})
    assert {*as_loaded} - {*gone} == {"tiny"}
    from_above = renderer.small_lamps({"camera.pose.translation": up})
    assert from_above["tiny"].pixel == (row + 1, column)
    again = renderer.small_lamps()
    assert {name: lamp.pixel for name, lamp in again.items()} == {
        n: lamp.pixel for n, lamp in as_loaded.items()
    }
    assert again["small"].radiance.tolist() == pytest.approx([30.0] * 3)


@pytest.mark.parametrize("width", [8, 16, 64])
@pytest.mark.parametrize(("glass", "reflected"), [("thindielectric", 2 / 26), ("conductor", 0)])
def test_reflections_have_the_light_of_the_lamp_at_any_resolution(
    mi: Any, width: int, glass: str, reflected: float
) -> None:
    """Also its square. A pane of an index of 1.5 reflects a 26th of the light at each side; mirrors are none."""
    transform = mi.ScalarTransform4f()
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": transform.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
        },
        "pane": {"type": "rectangle", "to_world": transform.scale(9), "bsdf": {"type": glass}},
        "bulb": {**bulb(0.4, 0.5, 0.0), "center": [0.5, 0.2, 6.0]},
        "ahead": {**bulb(0.4, 0.5, 0.0), "center": [0.5, 0.2, -6.0]},
    }
    renderer = SceneRenderer(scene, "emitters", resolution=(width, width), spp=1)
    found = renderer.reflections()
    assert {*found} == ({"bulb"} if reflected else set())
    if reflected:
        radiance, fraction = found["bulb"].radiance[..., 0].double(), found["bulb"].fraction
        solid_angle = math.pi * 0.4**2 / (0.5**2 + 0.2**2 + 10**2)
        for power in (1, 2):
            sent = (radiance**power * fraction * renderer.camera.solid_angles).sum().item()
            assert sent == pytest.approx(
                (60 * reflected) ** power * solid_angle, rel=0.15
            )  # 64 positions in a pixel
        off = {name: torch.zeros(3) for name in renderer.parameters if name.endswith("radiance.value")}
        assert renderer.reflections(off) == {}
