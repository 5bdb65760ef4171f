"""Colours and coloured textures that a material evaluates as one number, such as opacities and roughnesses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from extremes.scenes import GREY, mean, room
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient

COLOUR = {"type": "rgb", "value": [0.2, 0.5, 0.8]}
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
TEXELS = np.random.default_rng(2).uniform(0.2, 0.9, (3, 4, 3)).astype(np.float32)
OPACITY, TEXTURE, ALPHA = "ball.bsdf.opacity.value", "ball.bsdf.opacity.data", "ball.bsdf.alpha.value"


def mask(opacity: Any, skin: Any = GREY) -> dict[str, Any]:
    return {"type": "mask", "opacity": opacity, "skin": skin}


def picture(mi: Any, texels: Any) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": True}


def gradient(renderer: SceneRenderer, name: str, **options: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """The image, and the gradient of its mean."""
    leaf = renderer.inputs[name].requires_grad_()
    image = renderer({name: leaf}, seed=shifted(3), spp=32, **options)
    return image.detach(), torch.autograd.grad(image.mean(), leaf)[0]


@pytest.fixture(scope="module")
def masked(mi: Any) -> SceneRenderer:
    return SceneRenderer(room(mi, ball=mask(COLOUR), lamp=20.0), "opacity")


@pytest.mark.parametrize(
    "ready", [False, pytest.param(True, marks=pytest.mark.long)], ids=["dict", "mi.Scene"]
)
@pytest.mark.parametrize(
    ("name", "coloured", "plain"),
    [
        (OPACITY, mask(COLOUR), mask(0.5)),
        (OPACITY, mask(COLOUR, {"type": "conductor"}), mask(0.5, {"type": "conductor"})),
        (
            ALPHA,
            {"type": "roughconductor", "alpha": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
            {"type": "roughconductor", "alpha": 0.3},
        ),
    ],
    ids=["opacity", "opacity of a mirror", "roughness"],
)
def test_a_colour_counts_as_the_mean_of_its_channels(
    mi: Any, name: str, coloured: Any, plain: Any, ready: bool
) -> None:
    """Image and derivative are those of the number, with and without importance sampling of pixels."""
    scenes = [room(mi, ball=ball, lamp=20.0) for ball in (coloured, plain)]
    ours, same = (
        SceneRenderer(mi.load_dict(scene, optimize=False) if ready else scene, name) for scene in scenes
    )
    assert ours.inputs[name].shape == ()
    torch.testing.assert_close(ours.inputs[name], same.inputs[name])
    for options in ({}, {"seed_grad": 4}):
        for found, expected in zip(
            gradient(ours, name, **options), gradient(same, name, **options), strict=True
        ):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-8)
    tangent = torch.func.jvp(
        lambda x: ours({name: x}, seed=shifted(3), spp=32).mean(),
        *[(ours.inputs[name],)],
        (torch.tensor(1.0),),
    )
    torch.testing.assert_close(tangent[1], gradient(ours, name)[1], rtol=1e-3, atol=1e-8)


@pytest.mark.long
def test_a_grey_parameter_is_ranked_as_one_number(mi: Any, masked: SceneRenderer) -> None:
    """Its derivative agrees with a finite difference."""
    found = VanillaSceneGradient(masked, mean).attribute(seed=shifted(0), spp=256)
    plain = SceneRenderer(room(mi, ball=mask(0.5), lamp=20.0), "opacity")
    same = VanillaSceneGradient(plain, mean).attribute(seed=shifted(0), spp=256)
    assert found.saliency()[OPACITY] == pytest.approx(same.saliency()[OPACITY], rel=1e-3)
    step = 0.05
    slopes = torch.stack(
        [
            sum(
                side * masked({OPACITY: torch.tensor(0.5 + side * step)}, seed=seed, spp=128).mean()
                for side in (-1, 1)
            )
            / (2 * step)
            for seed in seeds(8)
        ]
    ).double()
    error = (slopes.var() / 8 + found.standard_error[OPACITY].double() ** 2).sqrt()
    assert abs(found[OPACITY] - slopes.mean()) < allowed(8) * error


def test_a_coloured_texture_counts_as_its_luminance(mi: Any) -> None:
    grey = (TEXELS @ LUMINANCE)[..., None]
    ours, same = (
        SceneRenderer(room(mi, ball=mask(picture(mi, texels)), lamp=20.0), "opacity")
        for texels in (TEXELS, grey)
    )
    assert ours.inputs[TEXTURE].shape == (3, 4, 1)
    torch.testing.assert_close(ours.inputs[TEXTURE], same.inputs[TEXTURE])
    for found, expected in zip(gradient(ours, TEXTURE), gradient(same, TEXTURE), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-8)
    shown, expected_shown = (one.surfaces_with_texels().texels[TEXTURE] for one in (ours, same))
    np.testing.assert_array_equal(shown.texel, expected_shown.texel)


def test_set_values_are_rendered_as_given(mi: Any, masked: SceneRenderer) -> None:
    opaque = SceneRenderer(room(mi, ball=GREY, lamp=20.0), "reflectance")
    torch.testing.assert_close(masked({OPACITY: torch.tensor(1.0)}, seed=shifted(1)), opaque(seed=shifted(1)))


def test_the_users_scene_keeps_its_colour(mi: Any) -> None:
    scene = mi.load_dict(room(mi, ball=mask(COLOUR)), optimize=False)
    renderer = SceneRenderer(scene, "opacity")
    gradient(renderer, OPACITY)
    renderer({OPACITY: torch.tensor(0.1)}, seed=shifted(1))
    assert np.array(mi.traverse(scene)[OPACITY]).ravel().tolist() == pytest.approx([0.2, 0.5, 0.8])


def test_a_texture_that_is_also_used_as_a_colour_stays_one(mi: Any) -> None:
    """One material uses it as an opacity, another as a reflectance."""
    shared = {**picture(mi, TEXELS), "id": "shared"}
    skin = {"type": "diffuse", "reflectance": {"type": "ref", "id": "shared"}}
    renderer = SceneRenderer(
        room(mi, shared=shared, ball=mask({"type": "ref", "id": "shared"}, skin)), "textures"
    )
    assert [tuple(value.shape) for value in renderer.inputs.values()] == [(3, 4, 3)]
