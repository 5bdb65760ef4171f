"""Derivatives from samples that start on a glossy surface: those of path replay, with less noise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from rooms import room

from scenecaptum import SceneRenderer

SEEDS = 40
METAL = {"type": "roughconductor", "material": "Al", "distribution": "ggx", "alpha": 0.2}
TWO_SIDED = {"type": "twosided", "nested": METAL}
FROSTED = {"type": "roughdielectric", "alpha": 0.2}
LACQUER = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.3}
POLISHED = {"type": "plastic", "diffuse_reflectance": 0.5}
MIRROR = {"type": "conductor", "specular_reflectance": 0.8}
LENS = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 4.0}


def both(renderer: SceneRenderer, adjoint: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ``(seeds, numbers)`` gradients by path replay alone, and with samples that start on surfaces."""

    def gradient(seed: int, seed_grad: int | None) -> torch.Tensor:
        leaves = renderer.leaves()
        renderer(leaves, seed=seed, seed_grad=seed_grad).backward(adjoint)
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]).double()

    replayed = torch.stack([gradient(seed, None) for seed in range(SEEDS)])
    started = torch.stack([gradient(0, 100 + seed) for seed in range(SEEDS)])
    return replayed, started


def assert_agree(first: torch.Tensor, second: torch.Tensor) -> None:
    z = (first.mean(0) - second.mean(0)) / ((first.var(0) + second.var(0)) / SEEDS).sqrt()
    assert second.mean(0).abs().max() > 5 * (second.var(0).max() / SEEDS).sqrt(), "lost in its noise"
    assert z.abs().max() < 4, f"{first.mean(0)} against {second.mean(0)}, z = {z}"


@pytest.mark.parametrize(
    ("ball", "changes"),
    [
        (METAL, {}),
        (TWO_SIDED, {"integrator": {"type": "path", "max_depth": -1, "rr_depth": 3}}),
        (FROSTED, {}),
        (LACQUER, {"camera": LENS}),
        (METAL, {"floor": {"bsdf": POLISHED}}),
        (METAL, {"floor": {"bsdf": MIRROR}}),
    ],
    ids=["metal", "two-sided, unlimited", "frosted glass", "lacquer, lens", "polished floor", "mirror"],
)
def test_what_a_glossy_ball_does_to_its_surroundings(
    mi: Any, ball: dict[str, Any], changes: dict[str, dict[str, Any]]
) -> None:
    scene = room(mi, ball)
    for name, change in changes.items():
        scene[name] |= change
    renderer = SceneRenderer(scene, "*alpha*", spp=64)
    seen = torch.from_numpy(renderer.surfaces.shown(list(renderer.inputs)))
    adjoint = ((seen == 0).float() / seen.numel())[..., None].expand(*seen.shape, 3).contiguous()
    assert_agree(*both(renderer, adjoint))
