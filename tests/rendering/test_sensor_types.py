"""The registry of sensors: each type renders with the geometry of its rays, and connects to light as it says."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from rooms import room

from scenecaptum import Camera, SceneCaptumError, SceneRenderer
from scenecaptum.rendering._sensors import SENSORS, SensorType, is_connectable, named_sensors

# Where a type cannot be named by sensor=: the plugins of Mitsuba with its classes.
PLUGINS = {"perspective": ("perspective", "thinlens")}
WITH_CAMERA = [name for name, sensor in SENSORS.items() if sensor.has_camera]
CASES = [(name, plugin) for name in WITH_CAMERA for plugin in PLUGINS.get(name, (None,))]


def make_renderer(mi: Any, name: str, plugin: str | None) -> SceneRenderer:
    scene = room(mi, {"type": "diffuse"})
    if plugin is None:
        return SceneRenderer(scene, "ball.*", spp=4, sensor=name, resolution=(16, 16))
    lens = {"aperture_radius": 0.05, "focus_distance": 4.0} if plugin == "thinlens" else {}
    scene["camera"] |= {"type": plugin, **lens}
    return SceneRenderer(scene, "ball.*", spp=4)


@pytest.mark.parametrize(("name", "plugin"), CASES)
def test_every_type_renders_with_the_geometry_of_its_rays(mi: Any, name: str, plugin: str | None) -> None:
    renderer = make_renderer(mi, name, plugin)
    image = renderer(renderer.leaves(), seed=0)
    image.mean().backward()
    camera, (sensor,) = renderer.camera, renderer._sensors
    assert image.shape == camera.directions.shape == (16, 16, 3)
    assert (camera.solid_angles >= 0).all()
    assert 0 < camera.solid_angles.sum() <= 4 * np.pi * (1 + 1e-6)
    y, x = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(16) + 0.5) / 16, indexing="ij")
    with renderer._views[0].live.exclusive():
        assert sensor.class_name() in SENSORS[name].class_names
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(x.ravel(), y.ravel()), mi.Point2f(0.5))
        local = np.array(sensor.world_transform().inverse() @ ray.d).T * [-1, 1, 1]
        if SENSORS[name].connectable:
            interaction = mi.SurfaceInteraction3f()
            interaction.p = ray.o + 3 * ray.d
            sample, importance = sensor.sample_direction(interaction, mi.Point2f(0.5))
            assert np.all(np.array(sample.pdf) > 0)
            assert np.all(np.array(importance) > 0)
            assert sensor.near_clip() >= 0
        assert is_connectable(sensor) is SENSORS[name].connectable
    seen = camera.solid_angles > 0
    rays = torch.from_numpy(local).reshape(16, 16, 3)
    assert (camera.directions - rays)[seen].abs().max() < 2e-6


def test_types_have_names_modules_and_classes_of_their_own(mi: Any) -> None:
    classes = [name for sensor in SENSORS.values() for name in sensor.class_names]
    assert len(set(classes)) == len(classes) >= len(SENSORS)
    assert not any(name.isdigit() for name in SENSORS)
    for name in SENSORS:
        module = import_module(f"scenecaptum.rendering.sensors.{name}")
        assert hasattr(module, "camera_of") is SENSORS[name].has_camera


def test_an_error_lists_the_types(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SENSORS, "panorama", SensorType("360°", ("PanoramaSensor",), "scenecaptum_panorama"))
    listed = 'index or id of a sensor or "fisheye" or "grid" or "panorama", not \'round\''
    with pytest.raises(SceneCaptumError, match=listed):
        SceneRenderer("cornell-box", sensor="round")
    assert list(named_sensors()) == ["fisheye", "grid", "panorama"]
    scene = room(mi, {"type": "diffuse"})
    scene["camera"]["type"] = "orthographic"
    with pytest.raises(SceneCaptumError, match=r'only that of "perspective" or "fisheye" or "panorama"'):
        _ = SceneRenderer(scene, "reflectance", spp=1).camera


def test_a_camera_made_by_hand_does_not_see_the_hemisphere() -> None:
    camera = Camera(2, 1, "strip", 10.0, torch.ones(1, 2, 3), torch.ones(1, 2))
    assert not camera.sees_hemisphere
