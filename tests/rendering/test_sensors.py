"""Directions of a renderer's pixels, fisheyes, and lists of sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from rooms import room
from seeds import seeds, shifted

from scenecaptum import SceneCaptumError, SceneRenderer


def directions_of_rays(mi: Any, renderer: SceneRenderer) -> torch.Tensor:
    """Return the directions of Mitsuba's rays through the pixel centres, in camera space."""
    width, height = renderer.resolution
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    with renderer._views[0].live.exclusive():
        position = mi.Point2f(x.ravel(), y.ravel())
        ray, _ = renderer._sensors[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
        local = renderer._sensors[0].world_transform().inverse() @ ray.d
        return torch.from_numpy(np.array(local).T * [-1, 1, 1]).reshape(height, width, 3)


@pytest.mark.parametrize(
    ("camera", "options"),
    [
        ({}, {}),
        ({}, {"resolution": (24, 10)}),
        ({"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0}, {}),
        ({"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.05}, {}),
        ({"fov": 70.0, "fov_axis": "y"}, {"resolution": (8, 20)}),
        ({}, {"sensor": "fisheye"}),
        ({}, {"sensor": "fisheye", "resolution": (30, 20)}),
    ],
    ids=["pinhole", "wide", "lens", "shifted", "tall", "fisheye", "wide fisheye"],
)
def test_the_cameras_directions_are_those_of_mitsubas_rays(
    mi: Any, camera: dict[str, Any], options: dict[str, Any]
) -> None:
    scene = room(mi, {"type": "diffuse"})
    scene["camera"] |= camera
    renderer = SceneRenderer(scene, "reflectance", spp=1, **options)
    found, rays = renderer.camera, directions_of_rays(mi, renderer)
    seen = found.solid_angles > 0
    assert (found.directions - rays)[seen].abs().max() < 2e-6
    if found.projection == "fisheye":
        torch.testing.assert_close(found.solid_angles.sum().item(), 2 * math.pi, rtol=1e-4, atol=0)


@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger"])
def test_another_aspect_ratio_keeps_the_horizontal_field_of_view(mi: Any, axis: str) -> None:
    scene = mi.cornell_box()
    scene["sensor"] = {**scene["sensor"], "fov": 40.0, "fov_axis": axis}
    scene["sensor"]["film"] = {**scene["sensor"]["film"], "width": 32, "height": 18}
    own, tall, wide = (
        SceneRenderer(scene, "reflectance", spp=1, resolution=size) for size in (None, (8, 16), (32, 8))
    )
    assert tall.camera.fov == wide.camera.fov == own.camera.fov
    params = mi.traverse(mi.load_dict(scene))
    params["sensor.film.size"] = [8, 16]
    params.update()
    assert params["sensor.x_fov"][0] == pytest.approx(tall.camera.fov, rel=1e-6), "that of Mitsuba"


def test_a_crop_has_the_directions_of_its_part(mi: Any) -> None:
    scene = room(mi, {"type": "diffuse"})
    scene["camera"]["film"] |= {"crop_width": 5, "crop_height": 7, "crop_offset_x": 2, "crop_offset_y": 8}
    part = SceneRenderer(scene, "reflectance", spp=1).camera
    whole = SceneRenderer(room(mi, {"type": "diffuse"}), "reflectance", spp=1).camera
    torch.testing.assert_close(part.directions, whole.directions[8:15, 2:7], rtol=0, atol=2e-6)
    torch.testing.assert_close(part.solid_angles, whole.solid_angles[8:15, 2:7], rtol=1e-4, atol=0)


def test_a_fisheye_image_has_correct_derivatives(mi: Any) -> None:
    """Against a difference quotient with common random numbers, and with independent samples over seeds."""
    scene = room(mi, {"type": "diffuse", "reflectance": 0.5})
    renderer = SceneRenderer(scene, "ball.*", sensor="fisheye", resolution=(16, 16), spp=64)
    name = "ball.bsdf.reflectance.value"
    weight = renderer.camera.solid_angles.float()[..., None]

    def seen(value: torch.Tensor, **seeds: int) -> torch.Tensor:
        return (weight * renderer({name: value}, **seeds)).sum()

    value = renderer.leaves()[name]
    (gradient,) = torch.autograd.grad(seen(value, seed=shifted(1)), value)
    with torch.no_grad():
        slope = (seen(value + 0.02, seed=shifted(1)) - seen(value - 0.02, seed=shifted(1))) / 0.04
    torch.testing.assert_close(gradient.sum(), slope, rtol=3e-3, atol=0)
    others = torch.stack(
        [torch.autograd.grad(seen(value, seed=shifted(), seed_grad=s), value)[0].sum() for s in seeds(10, 20)]
    )
    own = torch.stack([torch.autograd.grad(seen(value, seed=s), value)[0].sum() for s in seeds(10)])
    z = (others.mean() - own.mean()) / ((others.var() + own.var()) / 10).sqrt()
    assert z.abs() < allowed(19), (others.mean(), own.mean())


def test_pixels_outside_the_circle_are_black_and_show_nothing(mi: Any) -> None:
    renderer = SceneRenderer(room(mi, {"type": "diffuse"}), "all", sensor="fisheye", spp=4)
    outside = renderer.camera.solid_angles == 0
    assert outside.any()
    assert (renderer()[outside] == 0).all()
    covered = np.bincount(renderer.surfaces.pixel, renderer.surfaces.fraction, outside.numel())
    assert (covered.reshape(outside.shape)[outside] == 0).all()


def test_other_cameras_are_named_in_the_error(mi: Any) -> None:
    scene = room(mi, {"type": "diffuse"})
    scene["camera"]["type"] = "orthographic"
    with pytest.raises(SceneCaptumError, match=r"geometry of Orthographic.* is not known.*fisheye"):
        _ = SceneRenderer(scene, "reflectance", spp=1).camera
    with pytest.raises(
        SceneCaptumError, match=r'index or id of a sensor or "fisheye" or "grid", not \'panorama\'.*own: 0: '
    ):
        SceneRenderer(scene, "reflectance", sensor="panorama")


def test_a_sensor_is_selected_by_its_id(mi: Any) -> None:
    scene = room(mi, {"type": "diffuse"})
    scene["other"] = {**scene["camera"], "fov": 20.0}
    by_id, by_index = (SceneRenderer(scene, "reflectance", sensor=one, spp=1) for one in ("other", 1))
    assert by_id.camera.fov == by_index.camera.fov != SceneRenderer(scene, "reflectance", spp=1).camera.fov


def test_several_cameras_render_a_stack_that_is_differentiated_together(mi: Any) -> None:
    """A list of sensors: each image is that of a separate renderer, and so is the gradient of their sum."""
    from scenecaptum import VanillaSceneGradient
    from scenecaptum.scene.bundled import cornell_box

    scene = cornell_box()
    scene["sensor"]["film"] |= {"width": 12, "height": 12}
    both = SceneRenderer(scene, "reflectance", spp=8, sensor=[0, "fisheye"], resolution=(12, 12))
    front, around = (
        SceneRenderer(scene, "reflectance", spp=8, sensor=one, resolution=(12, 12)) for one in (0, "fisheye")
    )
    x = both.leaves()
    images = both(x, seed=shifted(3))
    assert images.shape == (2, 12, 12, 3)
    torch.testing.assert_close(images[0], front(seed=shifted(3)))
    weights = torch.tensor([1.0, 0.5])[:, None, None, None]
    (images * weights).mean().backward()

    name = "floor.reflectance.value"
    first = front.leaves()
    front(first, seed=shifted(3)).mean().backward()
    second = around.leaves()
    seed = int(np.random.SeedSequence([shifted(3), 1]).generate_state(1)[0])
    around(second, seed=seed).mean().backward()
    torch.testing.assert_close(
        x[name].grad, first[name].grad / 2 + second[name].grad / 4, rtol=1e-4, atol=1e-7
    )

    assert [camera.projection for camera in both.cameras] == ["perspective", "fisheye"]
    attribution = VanillaSceneGradient(both, lambda images: images.mean()).attribute()
    assert attribution.image.shape == (2, 12, 12, 3)
    with pytest.raises(SceneCaptumError, match="pictures of 2 sensors, and a map is of one"):
        attribution.heatmap()


@pytest.mark.parametrize(
    ("sensor", "message"), [([], "empty list"), ([0, 5], "sensor"), ([0, "round"], "fisheye")]
)
def test_an_invalid_list_of_sensors_is_refused(mi: Any, sensor: list[Any], message: str) -> None:
    with pytest.raises(SceneCaptumError, match=message):
        SceneRenderer("cornell-box", sensor=sensor)


def test_a_list_of_sensors_has_cameras(mi: Any) -> None:
    with pytest.raises(SceneCaptumError, match=r"renderer\.cameras"):
        _ = SceneRenderer("cornell-box", sensor=[0]).camera


def test_a_fisheye_cannot_be_moved_and_the_error_says_what_to_do(mi: Any) -> None:
    with pytest.raises(
        SceneCaptumError,
        match=r"'camera.pose.translation' cannot be moved: a sensor of type fisheye .*place the camera in",
    ):
        SceneRenderer(room(mi, {"type": "diffuse"}), "camera.pose.translation", sensor="fisheye", spp=4)
