"""Albedo, normals and emission that guide the denoiser."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.denoising import denoise


def camera(mi: Any) -> dict[str, Any]:
    """A camera that looks along the z axis from z = 2, with 16×16 pixels."""
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    return {"type": "perspective", "fov": 40, "to_world": look, "film": film}


@pytest.fixture(scope="module")
def mirrored(mi: Any) -> SceneRenderer:
    """One half of the image is a grey wall, the other a mirror that shows the red wall behind the camera."""
    transform = mi.ScalarTransform4f
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.3, 0.3]}}
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    scene = {
        "type": "scene",
        "camera": camera(mi),
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([-5, 0, 0]).scale(5),
            "bsdf": diffuse,
        },
        "mirror": {
            "type": "rectangle",
            "to_world": transform().translate([5, 0, 0]).scale(5),
            "bsdf": {"type": "conductor"},
        },
        "behind": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale(20),
            "bsdf": red,
        },
        "lamp": {"type": "point", "position": [0, 1, 3], "intensity": {"type": "rgb", "value": 5.0}},
    }
    return SceneRenderer(scene, "reflectance", spp=16, max_depth=4)


def test_guides_follow_mirrors_and_have_no_noise(mirrored):
    guides = mirrored.guides
    torch.testing.assert_close(guides.albedo[:, :7], torch.full((16, 7, 3), 0.3))
    torch.testing.assert_close(guides.albedo[:, 9:], torch.tensor([0.8, 0.1, 0.1]).expand(16, 7, 3))
    torch.testing.assert_close(guides.normal[:, :7], torch.tensor([0.0, 0.0, 1.0]).expand(16, 7, 3))
    torch.testing.assert_close(guides.normal[:, 9:], torch.tensor([0.0, 0.0, -1.0]).expand(16, 7, 3))
    assert mirrored.guides is guides


def test_a_veil_hides_its_share_of_the_wall_beside_mirrors_too(mi: Any) -> None:
    """A ray that ended at the veil must not set out again while others go on between two mirrors."""
    transform = mi.ScalarTransform4f

    def panel(x: float, z: float, size: float, turn: float, bsdf: dict[str, Any]) -> dict[str, Any]:
        place = transform().translate([x, 0, z]).rotate([0, 1, 0], turn).scale(size)
        return {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "nested": bsdf}}

    def grey(value: float) -> dict[str, Any]:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}

    veil = panel(-1, 0, 1, 0, {})
    veil["bsdf"] = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "nested": grey(0.2)}}
    scene = {
        "type": "scene",
        "camera": camera(mi),
        "veil": veil,
        "wall": panel(-5, -1, 5, 0, grey(0.8)),
        "mirror": panel(1, 0, 1, 0, {"type": "conductor"}),
        "behind": panel(0, 3, 5, 180, {"type": "conductor"}),
        "lamp": {"type": "point", "position": [0, 1, 1]},
    }
    renderer = SceneRenderer(scene, "emitters", spp=4)
    torch.testing.assert_close(renderer.guides.albedo[:, :7], torch.full((16, 7, 3), 0.5))


def test_the_captum_bridge_denoises_on_request(mirrored):
    def metric(image: torch.Tensor) -> torch.Tensor:
        return image.square().mean()

    forward, inputs = mirrored.as_captum(metric, seed=shifted(4), denoise=True)
    image = mirrored(seed=shifted(4))
    assert math.isclose(forward(*inputs).item(), metric(denoise(image, mirrored.guides)).item(), rel_tol=1e-4)


def test_guides_and_maps_are_those_of_the_poses(mi: Any) -> None:
    """A pose moves what the denoiser and the maps see, and only there."""
    name, values = "tall_box_shape.pose.translation", torch.tensor([0.4, 0.0, 0.0])
    renderer = SceneRenderer("cornell-box", [name, "reflectance"], resolution=(24, 24), spp=4)
    loaded = SceneRenderer("cornell-box", "reflectance", resolution=(24, 24), spp=4)
    renderer({name: values}, seed=shifted())  # leaves the box where it was moved to
    assert torch.equal(renderer.mask("tall_box_shape"), loaded.mask("tall_box_shape"))
    assert torch.equal(renderer.guides.normal, loaded.guides.normal)

    guides, surfaces = renderer.guides_of({name: values}), renderer.surfaces_with_texels([], {name: values})
    before, after = (torch.from_numpy(one.mask("tall_box_shape")) for one in (renderer.surfaces, surfaces))
    columns = torch.arange(24.0)
    assert (after.sum(0) @ columns) / after.sum() > (before.sum(0) @ columns) / before.sum() + 2
    # Where the picture has become another one, so have the guides; rounding moves few rays across edges.
    differs = (guides.albedo - loaded.guides.albedo).abs().sum(-1) + (
        guides.normal - loaded.guides.normal
    ).abs().sum(-1)
    assert (differs[(before == 0) & (after == 0)] > 1e-5).float().mean() < 0.01
    assert differs[(before == 1) & (after == 0)].max() > 0.1
    assert torch.equal(renderer.guides.normal, loaded.guides.normal)

    result = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(
        {name: values}, seed=shifted(), replicates=2
    )
    assert result.surfaces.mask("tall_box_shape").tolist() == after.tolist()


def test_the_captum_bridge_denoises_with_the_guides_of_the_poses() -> None:
    name = "tall_box_shape.pose.translation"
    renderer = SceneRenderer("cornell-box", [name], resolution=(16, 16), spp=4)
    forward, _ = renderer.as_captum(lambda image: image.flatten(), seed=shifted(1), denoise=True)
    values = {name: torch.tensor([0.4, 0.0, 0.0])}
    with torch.no_grad():
        image = renderer(values, seed=shifted(1))
        (found,) = forward(values[name][None])
    expected = denoise(image, renderer.guides_of(values))
    assert not torch.allclose(expected, denoise(image, renderer.guides), rtol=0.02)
    torch.testing.assert_close(found.reshape(image.shape), expected, rtol=1e-4, atol=1e-5)


def lamp_before_a_wall(mi: Any, **integrator: Any) -> SceneRenderer:
    """A bulb of 40 × 1 W/(m² sr) that covers a few pixels, before a wall that it lights."""
    bulb = {"type": "area", "radiance": {"type": "rgb", "value": 40.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3, **integrator},
        "camera": camera(mi),
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(5)},
        "bulb": {"type": "sphere", "radius": 0.15, "emitter": bulb, "bsdf": {"type": "diffuse"}},
    }
    return SceneRenderer(scene, "emitters", spp=8)


def test_a_small_lamp_is_as_bright_in_the_denoised_picture_as_it_is(mi: Any) -> None:
    renderer = lamp_before_a_wall(mi)
    emission = renderer.guides.emission
    assert emission is not None
    assert 35 < emission.max() <= 40
    assert (emission[0] == 0).all()
    image = renderer(renderer.inputs, seed=shifted())
    denoised = denoise(image, renderer.guides)
    inside = emission.amin(-1) > 35
    assert inside.any()
    torch.testing.assert_close(denoised[inside].mean(), image[inside].mean(), rtol=0.02, atol=0.0)
    truth = renderer(renderer.inputs, seed=shifted(1), spp=4096)
    without = denoise(image, dataclasses.replace(renderer.guides, emission=None))
    errors = [(one - truth).square().mean().sqrt().item() for one in (denoised, without)]
    assert errors[0] < errors[1]


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_the_emission_of_a_pixel_at_the_edge_of_a_lamp_is_that_of_the_covered_part(
    mi: Any, rfilter: str
) -> None:
    """A square lamp that covers 5.15 of 16 pixels each way, and so 0.577 of the pixels at its sides."""
    half, height = 0.2345, 2 * math.tan(math.radians(20)) * 2  # of the lamp, and of what the camera sees
    covered = 2 * half / height * 16
    seen = camera(mi)
    seen["film"]["rfilter"] = {"type": rfilter}
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(half),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 40.0}},
    }
    emission = SceneRenderer(
        {"type": "scene", "camera": seen, "lamp": lamp}, "emitters", spp=1
    ).guides.emission
    assert emission is not None
    assert emission[..., 0].sum() == pytest.approx(40 * covered**2, rel=0.002)
    if rfilter == "box":
        torch.testing.assert_close(
            emission[8, 5], torch.full((3,), 40 * (covered - 4) / 2), rtol=0, atol=40 / 256
        )


def test_a_lamp_that_values_switch_off_is_not_in_the_denoised_picture(mi: Any) -> None:
    renderer = lamp_before_a_wall(mi)
    dimmed = {name: 0.01 * value for name, value in renderer.inputs.items()}
    image = renderer(dimmed, seed=shifted())
    guides = renderer.guides_of(dimmed)
    assert denoise(image, guides).max() < 0.5
    assert guides.emission is not None
    assert renderer.guides.emission is not None
    torch.testing.assert_close(guides.emission, 0.01 * renderer.guides.emission)


def test_lamps_that_are_hidden_from_the_camera_have_no_emission(mi: Any) -> None:
    assert lamp_before_a_wall(mi, hide_emitters=True).guides.emission is None
