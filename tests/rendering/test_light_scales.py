"""Scales of lights, in which the image is linear: their derivative is the image of that light alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from scenecaptum import SceneRenderer, metrics
from scenecaptum.scene.bundled import cornell_box

SPP, SEEDS = 8, 24
SCALES = "sky.sky_scale", "sky.sun_scale"


@pytest.fixture(scope="module")
def sunlit(mi: Any) -> SceneRenderer:
    """The Cornell box under an open sky and a sun, with its lamp on."""
    scene = cornell_box()
    del scene["ceiling_shape"], scene["left_wall_shape"]
    scene["sky"] = {
        "type": "sunsky",
        "sun_direction": [-0.6, -0.2, 0.7],
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 20.0),
        "sky_scale": 2.0,
        "sun_aperture": 5.0,
    }
    return SceneRenderer(scene, list(SCALES), resolution=(12, 12), spp=SPP, max_depth=3)


def gradients(renderer: SceneRenderer, seed: int) -> torch.Tensor:
    leaves = renderer.leaves()
    metrics.MeanLuminance()(renderer(leaves, seed=seed, seed_grad=10_000 + seed)).backward()
    return torch.stack([leaf.grad for leaf in leaves.values()]).double()


def differences(renderer: SceneRenderer, seed: int) -> torch.Tensor:
    """Differences of ±20 % with common random numbers; each side has as many samples as a gradient."""

    def moved(name: str, factor: float) -> float:
        values = {**renderer.inputs, name: factor * renderer.inputs[name]}
        return metrics.MeanLuminance()(renderer(values, seed=20_000 + seed)).item()

    return torch.tensor(
        [(moved(n, 1.2) - moved(n, 0.8)) / (0.4 * renderer.inputs[n].item()) for n in SCALES],
        dtype=torch.float64,
    )


@pytest.mark.long
def test_a_scale_is_never_noisier_than_a_difference(sunlit: SceneRenderer) -> None:
    """Mitsuba samples sky and sun by brightness: a short step changes the samples, and its signal is lost."""
    ours = torch.stack([gradients(sunlit, seed) for seed in range(SEEDS)])
    theirs = torch.stack([differences(sunlit, seed) for seed in range(SEEDS)])
    z = (ours.mean(0) - theirs.mean(0)) / ((ours.var(0) + theirs.var(0)) / SEEDS).sqrt()
    assert z.abs().max() < 4, z
    # Two equal variances of 24 draws have a ratio above 2.7 in one of a hundred cases.
    assert (ours.var(0) < 2.7 * theirs.var(0)).all(), ours.var(0) / theirs.var(0)


def test_light_that_does_not_reach_the_image_has_no_derivative(mi: Any) -> None:
    """It has no noise either: the lamp's light is the same on both sides of the difference."""
    scene = cornell_box()
    scene["front_wall"] = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90),
    }
    scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at([0, -0.9, 0], [0, 1, 0], [0, 0, 1])
    scene["sky"] = {"type": "sunsky", "sun_direction": [0, 0, 1]}
    renderer = SceneRenderer(scene, list(SCALES), resolution=(8, 8), spp=4, max_depth=3)
    leaves = renderer.leaves()
    image = renderer(leaves, seed=0, seed_grad=1)
    assert image.mean() > 0
    image.mean().backward()
    assert [leaf.grad.item() for leaf in leaves.values()] == [0, 0]
