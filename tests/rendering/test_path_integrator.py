"""Derivatives against finite differences, one small scene for each phenomenon."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from chance import allowed
from rooms import room
from seeds import seeds

from scenecaptum import SceneRenderer, metrics

SEEDS = 16
luminance = metrics.MeanLuminance()

MIRROR = {"type": "conductor", "eta": 1.2, "k": 3.0, "specular_reflectance": 0.9}
GLASS = {"type": "dielectric", "specular_reflectance": 0.7, "specular_transmittance": 0.8}
PANE = {"type": "thindielectric", "specular_reflectance": 0.7, "specular_transmittance": 0.8}
LACQUER = {"type": "plastic", "diffuse_reflectance": 0.4, "specular_reflectance": 0.9}
VEIL = {"type": "mask", "opacity": 0.6, "nested": {"type": "diffuse"}}


def assert_agrees_with_differences(renderer: SceneRenderer, name: str, step: float, *, central: bool) -> None:
    """Compare both derivatives seed by seed: they share the samples, so their difference has little noise."""
    value = renderer.inputs[name]

    def rendered(moved: torch.Tensor, seed: int) -> float:
        with torch.no_grad():
            return luminance(renderer({name: moved}, seed=seed)).item()

    def derivative(seed: int) -> float:
        leaf = value.clone().requires_grad_()
        luminance(renderer({name: leaf}, seed=seed)).backward()
        return leaf.grad.sum().item()

    low = value - step if central else value
    width = (2 if central else 1) * step
    ours = torch.tensor([derivative(seed) for seed in seeds(SEEDS)])
    theirs = torch.tensor([(rendered(value + step, s) - rendered(low, s)) / width for s in seeds(SEEDS)])
    difference, error = (ours - theirs).mean().item(), (ours - theirs).std().item() / math.sqrt(SEEDS)
    # The truncation error of a finite step is 0.3 %, more than the noise of the shared samples.
    most = max(allowed(SEEDS) * error, 3e-3 * abs(theirs.mean().item()))
    assert theirs.mean().abs() > 10 * error, "the difference is lost in its noise: the case shows nothing"
    assert abs(difference) < most, (
        f"{name}: derivative {ours.mean():.6f}, difference quotient {theirs.mean():.6f}, "
        f"apart by {difference:.1e}, allowed {most:.1e}"
    )


@pytest.mark.parametrize(
    ("ball", "parameter"),
    [
        (MIRROR, "eta.value"),
        pytest.param(MIRROR, "k.value", marks=pytest.mark.long),
        (MIRROR, "specular_reflectance.value"),
        pytest.param(
            {"type": "twosided", "nested": MIRROR},
            "brdf_0.specular_reflectance.value",
            marks=pytest.mark.long,
        ),
        pytest.param(GLASS, "specular_reflectance.value", marks=pytest.mark.long),
        (GLASS, "specular_transmittance.value"),
        pytest.param(PANE, "specular_reflectance.value", marks=pytest.mark.long),
        (PANE, "specular_transmittance.value"),
        pytest.param(LACQUER, "diffuse_reflectance.value", marks=pytest.mark.long),
        (LACQUER, "specular_reflectance.value"),
        (VEIL, "opacity.value"),
        pytest.param(VEIL, "nested_bsdf.reflectance.value", marks=pytest.mark.long),
    ],
)
def test_specular_lobes_have_derivatives(mi: Any, ball: dict[str, Any], parameter: str) -> None:
    # Where each path goes does not depend on the others: the shared samples leave no noise.
    spp = 256 if ball in (LACQUER, VEIL) else 16
    renderer = SceneRenderer(room(mi, ball), "ball.*", spp=spp)
    assert_agrees_with_differences(renderer, f"ball.bsdf.{parameter}", 0.02, central=True)


@pytest.mark.parametrize(
    ("ball", "parameter", "step"),
    [
        ({"type": "diffuse", "reflectance": 0.0}, "reflectance.value", 0.002),
        ({"type": "conductor", "material": "none"}, "eta.value", 0.006),
    ],
    ids=["black", "perfect mirror"],
)
def test_derivatives_at_exactly_zero_are_those_just_above(
    mi: Any, ball: dict[str, Any], parameter: str, step: float
) -> None:
    renderer = SceneRenderer(room(mi, ball), "ball.*", spp=16)
    assert_agrees_with_differences(renderer, f"ball.bsdf.{parameter}", step, central=False)


@pytest.mark.parametrize(
    ("settings", "ball"),
    [
        pytest.param(
            settings,
            ball,
            id=f"{settings}-{ball['type']}",
            marks=pytest.mark.long if settings and is_long else (),
        )
        for settings in ({}, {"hide_emitters": True}, {"max_depth": -1})
        for ball, is_long in ((MIRROR, True), (GLASS, False), (LACQUER, True), (VEIL, False))
    ],
)
def test_pictures_are_those_of_mitsubas_path_tracer(
    mi: Any, ball: dict[str, Any], settings: dict[str, Any]
) -> None:
    scene = room(mi, ball, **settings)
    renderer = SceneRenderer(scene, "ball.*", spp=64)
    stock = mi.load_dict(scene)
    ours = torch.stack([renderer(seed=seed).mean((0, 1)) for seed in seeds(8)])
    theirs = torch.stack(
        [mi.render(stock, spp=64, seed=100 + seed).torch().mean((0, 1)) for seed in seeds(8)]
    )
    z = (ours.mean(0) - theirs.mean(0)) / ((ours.var(0) + theirs.var(0)) / 8).sqrt()
    assert z.abs().max() < allowed(15, 3), f"mean radiance {ours.mean(0)} against {theirs.mean(0)}, z = {z}"


def test_the_derivatives_of_the_stock_integrator_have_a_caution(mi: Any) -> None:
    inputs = ["mirror.*", "sky.emitter.*"]
    renderer = SceneRenderer("office", inputs, resolution=(8, 8), spp=4)
    assert not renderer.plan.cautions
    cautions = dict(renderer.replace(integrator="prb").plan.cautions)
    assert {name for name in renderer.inputs if name.startswith("mirror.")} == set(cautions)
    assert all("mirrors" in text for text in cautions.values())
    own = renderer.replace(integrator="prb").replace(integrator=renderer.plan.integrator)
    assert own.plan == renderer.plan
