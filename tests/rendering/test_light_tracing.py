"""Light tracing from glossy surfaces gives the derivatives of path replay, with less noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from rooms import room
from seeds import seeds, shifted

from scenecaptum import SceneRenderer

SEEDS = 40
METAL = {"type": "roughconductor", "material": "Al", "distribution": "ggx", "alpha": 0.2}
TWO_SIDED = {"type": "twosided", "nested": METAL}
FROSTED = {"type": "roughdielectric", "alpha": 0.2}
LACQUER = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.3}
POLISHED = {"type": "plastic", "diffuse_reflectance": 0.5}
LENS = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 4.0}


def both(renderer: SceneRenderer, adjoint: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ``(seeds, numbers)`` gradients by path replay alone, and with light tracing."""

    def gradient(seed: int, seed_grad: int | None) -> torch.Tensor:
        leaves = renderer.leaves()
        renderer(leaves, seed=seed, seed_grad=seed_grad).backward(adjoint)
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]).double()

    replayed = torch.stack([gradient(seed, None) for seed in seeds(SEEDS)])
    traced = torch.stack([gradient(shifted(), 100 + seed) for seed in seeds(SEEDS)])
    return replayed, traced


def assert_agree(first: torch.Tensor, second: torch.Tensor) -> None:
    z = (first.mean(0) - second.mean(0)) / ((first.var(0) + second.var(0)) / SEEDS).sqrt()
    assert second.mean(0).abs().max() > 5 * (second.var(0).max() / SEEDS).sqrt(), "lost in its noise"
    assert z.abs().max() < allowed(2 * SEEDS - 1, z.numel()), (
        f"{first.mean(0)} against {second.mean(0)}, z = {z}"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("ball", "changes", "spp"),
    [
        (TWO_SIDED, {"integrator": {"type": "path", "max_depth": -1, "rr_depth": 3}}, 32),
        (FROSTED, {}, 128),
        (LACQUER, {"camera": LENS}, 32),
        (METAL, {"floor": {"bsdf": POLISHED}}, 32),
    ],
    ids=["two-sided, unlimited", "frosted glass", "lacquer, lens", "polished floor"],
)
def test_derivatives_of_the_surroundings_of_a_glossy_ball(
    mi: Any, ball: dict[str, Any], changes: dict[str, dict[str, Any]], spp: int
) -> None:
    """The adjoint is 0 on pixels that show the ball, so that little is left to path replay."""
    scene = room(mi, ball)
    for name, change in changes.items():
        scene[name] |= change
    renderer = SceneRenderer(scene, "*alpha*", spp=spp)
    seen = torch.from_numpy(renderer.surfaces.shown(list(renderer.inputs)))
    adjoint = ((seen == 0).float() / seen.numel())[..., None].expand(*seen.shape, 3).contiguous()
    assert_agree(*both(renderer, adjoint))


@pytest.mark.long
@pytest.mark.parametrize(
    "ball",
    [METAL | {"alpha": 0.1}, FROSTED, LACQUER],
    ids=["metal", "frosted glass", "lacquer"],
)
def test_derivatives_of_a_whole_picture(mi: Any, ball: dict[str, Any]) -> None:
    """The ball is seen by the camera, directly and by light that it reflects onto the floor."""
    renderer = SceneRenderer(room(mi, ball), "*alpha*", spp=64)
    height, width = renderer.surfaces.shown(list(renderer.inputs)).shape
    assert_agree(*both(renderer, torch.ones(height, width, 3) / (3 * height * width)))


UNEVEN = np.linspace(0.08, 0.3, 64, dtype=np.float32).reshape(8, 8, 1)


@pytest.mark.parametrize(
    ("plugin", "role", "texels", "inputs"),
    [
        pytest.param("roughconductor", "alpha", UNEVEN, "roughness", marks=pytest.mark.long),
        pytest.param("roughdielectric", "alpha", UNEVEN.repeat(3, 2), "ball.*", marks=pytest.mark.long),
        ("principled", "roughness", np.full((1, 1, 1), 0.4, np.float32), "roughness"),
    ],
    ids=["metal", "frosted glass among other inputs", "principled, one texel"],
)
def test_derivatives_of_a_low_roughness_texture(
    mi: Any, plugin: str, role: str, texels: np.ndarray, inputs: str
) -> None:
    """Of all texels together, and of half of the rows, against differences of renders."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    renderer = SceneRenderer(room(mi, {"type": plugin, role: texture}), [inputs], spp=64)
    assert "1 of them by light tracing" in str(renderer.plan)
    name = f"ball.bsdf.{role}.data"
    own = renderer.inputs[name]
    half = torch.ones_like(own)
    half[: len(own) // 2] = 0
    changes = [own, own * half]

    def differences(seed: int) -> torch.Tensor:
        def metric(change: torch.Tensor) -> torch.Tensor:
            return renderer({name: own + change}, seed=seed).double().mean()

        return torch.stack([(metric(0.05 * c) - metric(-0.05 * c)) / 0.1 for c in changes])

    def gradients(seed: int) -> torch.Tensor:
        leaves = renderer.leaves()
        renderer(leaves, seed=shifted(), seed_grad=seed).mean().backward()
        return torch.stack([(leaves[name].grad * change).double().sum() for change in changes])

    expected = torch.stack([differences(seed) for seed in seeds(SEEDS)])
    assert_agree(expected, torch.stack([gradients(100 + seed) for seed in seeds(SEEDS)]))


@pytest.mark.parametrize("cosine", [0.9, -0.9], ids=["from outside", "from inside"])
def test_the_value_of_a_valid_sample_is_its_weight_times_its_density(mi: Any, cosine: float) -> None:
    """Frosted glass also returns samples on the wrong side, with a density that is not that of the direction."""
    import drjit as dr

    from scenecaptum.rendering.integrators.path import is_valid_sample

    count = 100_000
    random = mi.PCG32(count, shifted())
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.sh_frame, si.n = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1)
    si.wi = mi.Vector3f((1 - cosine**2) ** 0.5, 0, cosine)
    bsdf = mi.load_dict(FROSTED | {"alpha": 0.5})
    point = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = bsdf.sample(mi.BSDFContext(), si, random.next_float32(), point)
    value = bsdf.eval(mi.BSDFContext(), si, sample.wo).x
    valid = is_valid_sample(sample, weight)
    wrong = (sample.pdf > 0) & ~valid
    estimate = dr.mean(dr.select(valid, value / sample.pdf, 0))
    assert estimate[0] == pytest.approx(dr.mean(weight.x)[0], rel=1e-3)
    assert dr.count(wrong & (value > 0))[0] > 0


@pytest.mark.long
def test_a_low_roughness_is_less_noisy(mi: Any) -> None:
    """For a metal box in the Cornell box, next to another input that uses path replay alone."""
    from scenecaptum.scene.bundled import cornell_box

    scene = cornell_box()
    scene["tall_box"] = METAL | {"alpha": 0.1}
    scene["sensor"]["film"] |= {"width": 16, "height": 16}
    names = ["tall_box.alpha.value", "light.emitter.radiance.value"]
    renderer = SceneRenderer(scene, names, spp=16, max_depth=4)
    replayed, traced = both(renderer, torch.ones(16, 16, 3) / (16 * 16 * 3))
    assert_agree(replayed, traced)
    assert replayed.var(0)[0] > 4 * traced.var(0)[0]


def test_path_replay_is_used_where_light_tracing_is_not_possible(mi: Any) -> None:
    """Light paths cannot be connected to the camera, or a bump map makes scattering non-reciprocal."""
    from scenecaptum.rendering.integrators.light_tracing import find_sampled_shapes

    relief = mi.Bitmap(np.random.default_rng(shifted()).uniform(0, 0.1, (8, 8, 1)).astype(np.float32))
    bumpy = {"type": "bumpmap", "map": {"type": "bitmap", "bitmap": relief, "raw": True}, "nested": METAL}
    flat = {"type": "orthographic"}
    for changes in ({}, {"ball": {"bsdf": bumpy}}, {"camera": flat}, {"integrator": {"hide_emitters": True}}):
        scene = room(mi, METAL)
        for name, change in changes.items():
            scene[name] |= change
        renderer = SceneRenderer(scene, "*alpha*", spp=4)
        graph, params_by_shape = renderer._graph, renderer.surfaces.parameters
        found = find_sampled_shapes(
            graph, params_by_shape, renderer._sensors[0], renderer.plan, list(renderer.inputs)
        )
        assert (found is None) == bool(changes), changes


@pytest.mark.parametrize(("inputs", "expected"), [("*alpha*", True), ("materials", False)])
def test_the_plan_names_light_tracing(mi: Any, inputs: str, expected: bool) -> None:
    """For one roughness among six other parameters it would take samples from these."""
    plan = SceneRenderer(room(mi, METAL), inputs, spp=4).plan
    assert ("1 of them by light tracing" in str(plan)) == expected


@pytest.mark.parametrize(("roughness", "expected"), [(0.44, True), (0.46, False)])
def test_a_principled_roughness_is_low_if_its_square_is(mi: Any, roughness: float, expected: bool) -> None:
    plan = SceneRenderer(room(mi, {"type": "principled", "roughness": roughness}), "*roughness*", spp=4).plan
    assert ("1 of them by light tracing" in str(plan)) == expected


def test_what_is_left_to_path_replay_is_importance_sampled(mi: Any) -> None:
    """Only on pixels that show the ball, and by the derivative of the highlight, not its brightness."""
    renderer = SceneRenderer(room(mi, METAL | {"alpha": 0.05}), "*alpha*", spp=16)
    (name,) = renderer.inputs
    leaves = renderer.leaves()
    renderer(leaves, seed=shifted(), seed_grad=shifted(1)).mean().backward()
    ((_, noise), (_, by_surface)) = next(iter(renderer._views[0].engine._importance_maps._maps.values()))
    shown = torch.from_numpy(renderer.surfaces.shown([name]))
    near = torch.nn.functional.max_pool2d(shown[None], 5, 1, 2)[0]  # partly covered pixels, and neighbours
    assert noise.any()
    assert not noise[near == 0].any()
    assert by_surface.sum() == pytest.approx(1)
    assert noise.max() > 3 * noise[near > 0].mean()


@pytest.mark.parametrize(
    ("inputs", "changes", "noisy"),
    [
        (["*alpha*", "*reflectance*", "emitters"], {}, ["ball.bsdf.alpha.value"]),
        (["*alpha*"], {}, []),
        (["*alpha*", "floor.*"], {}, []),  # half of the inputs: light traced
        (["*alpha*", "*reflectance*", "emitters"], {"camera": {"type": "orthographic"}}, []),
    ],
    ids=["among others", "alone", "half", "no connection to the camera"],
)
def test_the_plan_names_the_low_roughness_that_is_better_attributed_alone(
    mi: Any, inputs: list[str], changes: dict[str, dict[str, Any]], noisy: list[str]
) -> None:
    scene = room(mi, METAL)
    for name, change in changes.items():
        scene[name] |= change
    renderer = SceneRenderer(scene, inputs, spp=4)
    assert list(renderer.plan.noisy_roughness) == renderer.info["noisy_roughness"] == noisy
    assert ("low roughness among other inputs" in str(renderer.plan)) is bool(noisy)
    assert renderer.replace(integrator="prb").plan.noisy_roughness == ()


@pytest.mark.long
def test_a_low_roughness_lit_by_a_lamp_has_a_smaller_error_alone(mi: Any) -> None:
    """What the plan claims."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": 24, "height": 24, "rfilter": {"type": "box"}}
    box["large-box"]["bsdf"] = METAL | {"alpha": 0.1}
    name, names = "large-box.bsdf.alpha.value", ["*alpha*", "*reflectance*", "emitters"]
    spread = []
    for inputs in (names[:1], names):
        renderer = SceneRenderer(box, inputs, spp=32, max_depth=5)
        assert list(renderer.plan.noisy_roughness) == ([] if inputs == names[:1] else [name])
        gradients = []
        for seed in seeds(SEEDS):
            leaves = renderer.leaves()
            renderer(leaves, seed=shifted(), seed_grad=100 + seed).mean().backward()
            gradients.append(leaves[name].grad.item())
        spread.append(np.std(gradients, ddof=1))
    alone, among_others = spread
    assert alone < among_others / 2, f"standard deviation {alone} alone, {among_others} among other inputs"
