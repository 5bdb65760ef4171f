"""Mitsuba's own sensors that have no picture: meters of radiance and irradiance, and a distant sensor."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.errors import SceneCaptumError

FREED_BEFORE_ANOTHER_IS_RECORDED = """
import gc
from scenecaptum import SceneRenderer, activate

look_at = activate().ScalarTransform4f().look_at
film = lambda width: {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": "box"}}
wall = {"type": "scene", "light": {"type": "constant"}, "wall": {"type": "rectangle"}}
meter = wall | {"meter": {"type": "rectangle", "sensor": {"type": "irradiancemeter", "film": film(1)}}}
camera = lambda: {"type": "perspective", "to_world": look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": film(4)}
pair = wall | {"pair": {"type": "batch", "a": camera(), "b": camera(), "film": film(8)}}

gc.disable()  # the collector runs sooner or later: here not in between
renderer = SceneRenderer(meter, "reflectance", spp=4)
renderer(seed=0)
renderer = SceneRenderer(pair, "reflectance", spp=4)
renderer(seed=0)
"""


def test_a_meter_on_a_shape_goes_together_with_its_shape() -> None:
    # In a separate process, because a failure is a segmentation fault: Dr.Jit calls all sensors that exist when it
    # records a batch of them, and a meter asks its shape.
    ran = subprocess.run(
        [sys.executable, "-c", FREED_BEFORE_ANOTHER_IS_RECORDED], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-400:]


ALBEDO = "wall.bsdf.reflectance.value"


def wall_seen_by(sensor: str, mi: Any) -> dict[str, Any]:
    """A wall under a small lamp, before which there is a sensor of one pixel."""
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    settings: dict[str, dict[str, Any]] = {
        "radiancemeter": {"to_world": transform().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])},
        "distant": {"direction": [0, 0, -1], "target": [0, 0, 0]},
        "irradiancemeter": {},
    }
    one = {"type": sensor, "film": film, **settings[sensor]}
    if sensor == "irradiancemeter":
        turned = transform().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.2)
        one = {"type": "rectangle", "to_world": turned, "sensor": one}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": one,
        "wall": {
            "type": "rectangle",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
        },
        "lamp": {"type": "point", "position": [0.0, 0.0, 2.0], "intensity": 3.0},
    }


METERS = ["radiancemeter", "distant", "irradiancemeter"]


@pytest.mark.parametrize("sensor", METERS)
@pytest.mark.parametrize("own_samples", [False, True])
def test_the_image_of_a_meter_has_the_derivative_of_a_difference(
    mi: Any, sensor: str, own_samples: bool
) -> None:
    """With a single diffuse wall, the image is proportional to its albedo; a meter of one ray has no noise."""
    renderer = SceneRenderer(wall_seen_by(sensor, mi), "wall.*", spp=4096)
    leaves = renderer.leaves()
    image = renderer(leaves, seed=shifted(0), seed_grad=shifted(1) if own_samples else None)
    image.sum().backward()
    assert image.shape == (1, 1, 3)
    exact = image[0, 0].detach() / 0.5
    noisy = own_samples and sensor == "irradiancemeter"
    assert torch.allclose(leaves[ALBEDO].grad, exact, rtol=0.1 if noisy else 1e-4)


@pytest.mark.parametrize("sensor", METERS)
def test_a_meter_can_be_attributed(mi: Any, sensor: str) -> None:
    renderer = SceneRenderer(wall_seen_by(sensor, mi), ["wall.*", "lamp.*"], spp=256)
    result = VanillaSceneGradient(renderer, metrics.MeanIlluminance()).attribute(seed=shifted(0))
    # Both enter as a product, so that the sum of value times derivative is the metric, for each.
    albedo = (result[ALBEDO] * renderer.inputs[ALBEDO]).sum()
    assert float(albedo) == pytest.approx(result.metric_value, rel=0.3)
    assert (result.surfaces is None) == (sensor == "irradiancemeter")


def test_an_irradiance_meter_has_neither_a_view_nor_a_grid(mi: Any) -> None:
    renderer = SceneRenderer(wall_seen_by("irradiancemeter", mi), "wall.*", spp=4)
    assert not renderer.shows_a_view
    assert not renderer.has_grid
    assert renderer.surfaces is None
    for ask, said in [
        (lambda: renderer.camera, "irradiancemeter has no camera"),
        (lambda: renderer.grid, "has a grid"),
        (lambda: renderer.mask("wall"), "show no objects"),
    ]:
        with pytest.raises(SceneCaptumError, match=said):
            ask()


def test_plain_prb_says_that_it_cannot_differentiate_a_single_ray(mi: Any) -> None:
    renderer = SceneRenderer(wall_seen_by("radiancemeter", mi), "wall.*", spp=16).replace(integrator="prb")
    image = renderer(renderer.leaves(), seed=0)
    with pytest.raises(SceneCaptumError, match="RadianceMeter, which has a single ray"):
        image.sum().backward()
