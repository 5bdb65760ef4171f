"""Images of participating media against Mitsuba's, and their derivatives against finite differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, metrics

SEEDS = 16
luminance = metrics.MeanLuminance()

ALBEDO = "fog.interior_medium.albedo.value.value"
DENSITY = "fog.interior_medium.sigma_t.value.value"
GRID = "fog.interior_medium.sigma_t.data"


def homogeneous(sigma_t: Any = 1.0, albedo: float = 0.8) -> dict[str, Any]:
    return {
        "type": "homogeneous",
        "sigma_t": sigma_t,
        "albedo": albedo,
        "phase": {"type": "hg", "g": 0.6},
    }


def smoke(mi: Any, density: np.ndarray) -> dict[str, Any]:
    transform = mi.ScalarTransform4f
    grid = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(density.astype(np.float32)),
        "to_world": transform().translate([-1, -1, -1]).scale(2),
    }
    return {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.8}


def half_empty() -> np.ndarray:
    """Smoke at its maximum density in the upper half, and none in the lower half."""
    density = np.zeros((4, 4, 4, 1))
    density[2:] = 2.0
    return density


def room(mi: Any, medium: dict[str, Any], *, sky: float = 1.0, **others: Any) -> dict[str, Any]:
    """A ball of fog and another ball over a floor, under a sky, with a lamp behind them."""
    transform = mi.ScalarTransform4f
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 5, "hide_emitters": others.pop("hidden", False)},
        "camera": {
            "type": "perspective",
            "to_world": transform().look_at(origin=[0, -4, 1], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
        "fog": {
            "type": "sphere",
            "bsdf": others.pop("boundary", {"type": "null"}),
            "interior": medium,
        },
        "ball": {
            "type": "sphere",
            "center": [1.4, 0.4, -0.4],
            "radius": 0.5,
            "bsdf": others.pop("ball", {"type": "conductor", "specular_reflectance": 0.9}),
        },
        "floor": {"type": "rectangle", "to_world": transform().translate([0, 0, -1.1]).scale(3)},
        "lamp": {
            "type": "sphere",
            "center": [-1, 3, 2],
            "radius": 0.5,
            "emitter": {"type": "area", "radiance": 20.0},
        },
        **({"sky": {"type": "constant", "radiance": sky}} if sky else {}),
    }


def foggy_camera(mi: Any) -> dict[str, Any]:
    """A camera in fog that fills a cube."""
    scene = room(mi, homogeneous(0.2))
    fog = {"type": "ref", "id": "air"}
    scene["camera"]["medium"] = fog
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4.5), "bsdf": {"type": "null"}}
    scene["fog"] = {**cube, "interior": fog}
    return {"type": "scene", "air": homogeneous(0.2), **scene}


COLOURED = {"type": "rgb", "value": [0.2, 0.5, 1.0]}
GLASS = {"type": "dielectric", "specular_transmittance": 0.8}
VEIL = {"type": "mask", "opacity": 0.6, "nested": {"type": "diffuse"}}

PICTURES = {
    "coloured fog in glass": lambda mi: room(mi, homogeneous(COLOURED), boundary=GLASS),
    "thick fog beside a veil": lambda mi: room(mi, homogeneous(8.0, 0.99), ball=VEIL),
    "smoke, lights hidden": lambda mi: room(mi, smoke(mi, half_empty()), hidden=True),
    "camera in fog": foggy_camera,
}


@pytest.mark.parametrize("case", PICTURES)
def test_pictures_are_those_of_mitsubas_volumetric_path_tracer(mi: Any, case: str) -> None:
    scene = PICTURES[case](mi)
    renderer = SceneRenderer(scene, "media", spp=128)
    stock = mi.load_dict(scene)
    ours = torch.stack([renderer(seed=seed).mean((0, 1)) for seed in seeds(8)])
    theirs = torch.stack(
        [mi.render(stock, spp=128, seed=100 + seed).torch().mean((0, 1)) for seed in seeds(8)]
    )
    z = (ours.mean(0) - theirs.mean(0)) / ((ours.var(0) + theirs.var(0)) / 8).sqrt()
    assert z.abs().max() < allowed(15, 3), f"mean radiance {ours.mean(0)} against {theirs.mean(0)}, z = {z}"


def assert_agree_with_differences(renderer: SceneRenderer, steps: dict[str, float], *, central: bool) -> None:
    """Compare the derivatives of several seeds with differences that use common random numbers."""
    shifts = ((1, 0.5), (-1, -0.5)) if central else ((0, -1.5), (1, 2.0), (2, -0.5))

    def derivatives(seed: int) -> list[float]:
        leaves = renderer.leaves()
        luminance(renderer(leaves, seed=seed)).backward()
        return [leaves[name].grad.sum().item() for name in steps]

    def quotient(name: str, seed: int) -> float:
        value, step = renderer.inputs[name], steps[name]
        with torch.no_grad():
            rendered = (weight * renderer({name: value + k * step}, seed=seed) for k, weight in shifts)
            return sum(luminance(image).item() for image in rendered) / step

    ours = torch.tensor([derivatives(seed) for seed in seeds(SEEDS)])
    theirs = torch.tensor([[quotient(name, seed) for name in steps] for seed in seeds(SEEDS)])
    for name, derivative, slope in zip(steps, ours.T, theirs.T, strict=True):
        error = (derivative - slope).std().item() / math.sqrt(SEEDS)
        difference, size = (derivative - slope).mean().item(), slope.mean().abs().item()
        # The truncation error of a finite step is 0.3 %, more than the noise of the shared samples.
        most = max(allowed(SEEDS) * error, 3e-3 * size)
        assert size > 10 * error, f"{name}: the difference is lost in its noise: the case shows nothing"
        assert abs(difference) < most, (
            f"{name}: derivative {derivative.mean():.6f}, difference quotient {slope.mean():.6f}, "
            f"apart by {difference:.1e}, allowed {most:.1e}"
        )


@pytest.mark.parametrize(
    ("scene", "steps", "spp"),
    [
        # Neither decides where a path goes: the shared samples leave no noise.
        (
            lambda mi: room(mi, homogeneous()),
            {ALBEDO: 0.05, "ball.bsdf.specular_reflectance.value": 0.05},
            16,
        ),
        pytest.param(lambda mi: room(mi, homogeneous()), {DENSITY: 0.1}, 256, marks=pytest.mark.long),
        (
            lambda mi: room(mi, homogeneous(COLOURED), boundary=GLASS),
            {DENSITY: 0.1, "fog.bsdf.specular_transmittance.value": 0.05},
            256,
        ),
        pytest.param(
            lambda mi: room(mi, homogeneous(3.0), sky=0),
            {"fog.interior_medium.phase_function.g": 0.05, "lamp.emitter.radiance.value": 1.0},
            256,
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda mi: room(mi, smoke(mi, np.ones((2, 2, 2, 1))), ball=VEIL),
            {GRID: 0.1, "ball.bsdf.opacity.value": 0.05},
            256,
            marks=pytest.mark.long,
        ),
    ],
    ids=[
        "fog beside a mirror",
        "denser fog beside a mirror",
        "coloured fog in glass",
        "fog before a lamp",
        "smoke beside a veil",
    ],
)
def test_derivatives_agree_with_differences(mi: Any, scene: Any, steps: dict[str, float], spp: int) -> None:
    renderer = SceneRenderer(scene(mi), list(steps), spp=spp)
    assert_agree_with_differences(renderer, steps, central=True)


@pytest.mark.parametrize(
    ("scene", "name", "step", "spp"),
    [
        (lambda mi: room(mi, homogeneous(albedo=0.0)), ALBEDO, 0.02, 16),
        (lambda mi: room(mi, homogeneous(0.0), sky=0), DENSITY, 0.05, 256),
        pytest.param(lambda mi: room(mi, smoke(mi, half_empty())), GRID, 0.1, 256, marks=pytest.mark.long),
    ],
    ids=["black fog", "clear fog", "half empty smoke"],
)
def test_derivatives_at_exactly_zero_include_what_is_behind(
    mi: Any, scene: Any, name: str, step: float, spp: int
) -> None:
    renderer = SceneRenderer(scene(mi), name, spp=spp)
    assert_agree_with_differences(renderer, {name: step}, central=False)


def test_labels_tell_a_medium_from_its_object(mi: Any) -> None:
    labels = SceneRenderer(room(mi, homogeneous()), ["media", "fog.pose.scale"], spp=1).labels
    assert labels[ALBEDO] == "fog: medium albedo"
    assert labels["fog.pose.scale"] == "fog: scale"


def test_a_phase_function_may_change_between_calls(mi: Any) -> None:
    """Dr.Jit's frozen functions do not track phase functions, and would keep using the old one."""
    name = "fog.interior_medium.phase_function.g"
    renderer = SceneRenderer(room(mi, homogeneous(3.0)), name, spp=4)
    images = [renderer({name: torch.tensor(g)}, seed=shifted(1)) for g in (0.6, 0.6, 0.6, -0.6)]
    assert not torch.allclose(images[3], images[2], rtol=0.05)
    fresh = SceneRenderer(room(mi, homogeneous(3.0)), name, spp=4)
    torch.testing.assert_close(images[3], fresh({name: torch.tensor(-0.6)}, seed=shifted(1)))


def test_forward_mode_is_the_transpose_of_backward_mode(mi: Any) -> None:
    renderer = SceneRenderer(room(mi, smoke(mi, half_empty())), GRID, spp=16)
    (name,) = renderer.inputs
    value = renderer.inputs[name]
    tangent = torch.rand(value.shape, generator=torch.Generator().manual_seed(shifted()))

    def rendered(density: torch.Tensor) -> torch.Tensor:
        return renderer({name: density}, seed=shifted(1))

    _, change = torch.func.jvp(rendered, (value,), (tangent,))
    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(rendered(leaf).sum(), leaf)
    assert (gradient * tangent).sum().item() == pytest.approx(change.sum().item(), rel=1e-3)


@pytest.mark.long
def test_importance_sampled_pixels_give_the_same_derivatives(mi: Any) -> None:
    names = [ALBEDO, DENSITY, "ball.bsdf.specular_reflectance.value"]
    renderer = SceneRenderer(room(mi, homogeneous()), names, spp=8)
    adjoint = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(shifted())) ** 4

    def derivatives(seed: int, seed_grad: int | None) -> list[float]:
        leaves = renderer.leaves()
        renderer(leaves, seed=seed, seed_grad=seed_grad).backward(adjoint)
        return [leaf.grad.sum().item() for leaf in leaves.values()]

    own = torch.tensor([derivatives(seed, None) for seed in seeds(16)])
    chosen = torch.tensor([derivatives(shifted(), 100 + seed) for seed in seeds(16)])
    z = (own.mean(0) - chosen.mean(0)) / ((own.var(0) + chosen.var(0)) / 16).sqrt()
    assert z.abs().max() < allowed(31, 3), f"{own.mean(0)} against {chosen.mean(0)}, z = {z}"
    assert (own.std(0) / own.mean(0).abs() < 0.3).all(), "the derivatives are lost in their noise"
