"""Frozen kernels see every change of the scene."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient
from scenecaptum.attr import METHODS
from scenecaptum.tradeoff import measure


def room(plugin: str) -> dict[str, Any]:
    """A ball of a principled material under a uniform sky."""
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "sky": {"type": "constant", "radiance": 1.0},
        "lamp": {"type": "point", "position": [2.0, 2.0, 0.0], "intensity": 5.0},
        "ball": {"type": "sphere", "center": [0.0, 0.0, 3.0], "bsdf": {"type": plugin}},
    }


@pytest.mark.parametrize("plugin", ["principled", pytest.param("principledthin", marks=pytest.mark.long)])
def test_a_lobe_that_was_off_when_the_scene_was_loaded_can_be_switched_on(mi: Any, plugin: str) -> None:
    """A principled material skips lobes of weight 0, but a kernel recorded then must not go on doing so."""
    renderer = SceneRenderer(room(plugin), "materials", spp=4)
    renderer(seed=1), renderer(seed=1)
    off = renderer(seed=2)
    zeros = {name: value for name, value in renderer.inputs.items() if value.ndim == 0 and value == 0}
    effective = 0
    for name in zeros:
        on = renderer({name: torch.tensor(0.5)}, seed=2)
        fresh = SceneRenderer(room(plugin), "materials", spp=4)({name: torch.tensor(0.5)}, seed=2)
        assert torch.allclose(on, fresh, rtol=1e-5), name
        effective += not torch.allclose(on, off, rtol=1e-4)
    # The others, such as the tint of the sheen, need another lobe that is on.
    assert effective >= 4


def test_the_derivative_of_a_lobe_that_is_off_is_not_zero(mi: Any) -> None:
    renderer = SceneRenderer(room("principled"), "materials", spp=4)
    renderer(seed=1), renderer(seed=1)
    leaves = renderer.leaves()
    renderer(leaves, seed=2).mean().backward()
    assert leaves["ball.bsdf.metallic.value"].grad != 0
    assert leaves["ball.bsdf.spec_trans.value"].grad != 0


@pytest.fixture
def collector_off() -> Iterator[None]:
    """Keep the garbage of a test: a scene of another test that is freed in between is a reason to record again."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.fixture
def recorded(mi: Any, monkeypatch: pytest.MonkeyPatch, collector_off: None) -> list[str]:
    """The modes of all recordings of our integrator so far."""
    from scenecaptum.rendering.integrators.path import ReplayIntegrator

    modes: list[str] = []
    sample = ReplayIntegrator.sample

    def counted(self: Any, *args: Any, **options: Any) -> Any:
        modes.append(str(options.get("mode", args[:1])))
        return sample(self, *args, **options)

    monkeypatch.setattr(ReplayIntegrator, "sample", counted)
    return modes


def furnished_room() -> dict[str, Any]:
    """A room whose inputs take every route: path replay, light tracing, differences of paths, and none."""
    glass = {"type": "sphere", "center": [1.0, 1.0, 3.0], "radius": 0.3, "bsdf": {"type": "dielectric"}}
    texture, bumps = ({"type": "bitmap", "data": mitsuba_texture(), "raw": True} for _ in range(2))
    wall = {"type": "rectangle", "to_world": behind(), "bsdf": {"type": "diffuse", "reflectance": texture}}
    unused = {"type": "bumpmap", "map": bumps, "nested": {"type": "diffuse"}}
    furniture = room("principled") | {"glass": glass, "wall": wall, "unused": unused}
    furniture["ball"]["bsdf"]["roughness"] = 0.15
    return furniture


def mitsuba_texture() -> Any:
    import mitsuba as mi

    return mi.TensorXf([0.2, 0.4, 0.6, 0.8] * 12, (4, 4, 3))


def behind() -> Any:
    """Return the transform of a wall behind the objects."""
    import mitsuba as mi

    return mi.ScalarTransform4f().translate([0.0, 0.0, 5.0]).scale(3.0).rotate([0, 1, 0], 180)


INPUTS = ["*.eta", "*.roughness.value", "*.base_color.value", "*.radiance.value", "wall.*", "unused.scale"]


def test_kernels_are_recorded_once_for_all_values_seeds_adjoints_and_sample_counts(
    recorded: list[str],
) -> None:
    renderer = SceneRenderer(furnished_room(), INPUTS, resolution=(11, 7), spp=4)
    assert "glass.bsdf.eta" in dict(renderer.plan.differences)

    def differentiate(shift: float, seed: int, spp: int) -> None:
        leaves = {name: (value + shift).requires_grad_() for name, value in renderer.inputs.items()}
        image = renderer(leaves, seed=seed, seed_grad=seed + 10, spp=spp)
        (image**2).mean().backward()

    # The first recording of a process may be discarded.
    differentiate(0.0, 1, 4), differentiate(0.0, 2, 4)
    before = len(recorded)
    assert before > 0
    for number in range(1, 5):
        differentiate(0.01 * number, 100 * number, 3 + 5 * number)
    assert recorded[before:] == []


def glare(image: torch.Tensor) -> torch.Tensor:
    """A metric that is not linear, so that its adjoint and its bias need passes of their own."""
    return (image**2).mean()


FEW = {"integrated-gradients": {"n_steps": 3}, "gradient-shap": {"n_samples": 3}}  # points, to save time


@pytest.fixture(scope="module")
def furnished(mi: Any) -> SceneRenderer:
    return SceneRenderer(furnished_room(), INPUTS, resolution=(11, 7), spp=16, max_depth=4)


@pytest.fixture(scope="module")
def light_traced(mi: Any) -> SceneRenderer:
    inputs = ["ball.bsdf.roughness.value", "ball.bsdf.base_color.value"]
    return SceneRenderer(furnished_room(), inputs, resolution=(11, 7), spp=16, max_depth=4)


# The methods that take gradients differ in where they take them, and those that change inputs in which.
QUICK = {"gradient", "integrated-gradients"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.long)
        for name in (*METHODS, "planner", "tradeoff")
    ],
)
def test_no_method_records_a_kernel_again(recorded: list[str], furnished: SceneRenderer, name: str) -> None:
    check_recordings(recorded, furnished, name)


@pytest.mark.parametrize("name", ["gradient", pytest.param("planner", marks=pytest.mark.long)])
def test_light_tracing_is_recorded_once(recorded: list[str], light_traced: SceneRenderer, name: str) -> None:
    check_recordings(recorded, light_traced, name)


def check_recordings(recorded: list[str], renderer: SceneRenderer, name: str) -> None:
    def run(seed: int, spp: int) -> None:
        if name == "planner":
            VanillaSceneGradient(renderer, glare).attribute(seed=seed, spp=spp, tolerance=0.5)
        elif name == "tradeoff":
            measure(renderer, glare, vary={"spp": [4, spp]}, runs=2, reference_spp=2 * spp, seed=seed)
        else:
            METHODS[name].create(renderer, glare).attribute(seed=seed, spp=spp, **FEW.get(name, {}))

    run(1, 16), run(2, 16)
    # A pilot is rendered if the noise of a run asks for it, which may be that of the last run only.
    for spp in (17, 18):
        renderer.effective_samples(renderer.inputs, torch.ones_like(renderer()), spp=spp)

    def new(seed: int, spp: int) -> list[str]:
        before = len(recorded)
        run(seed, spp)
        return recorded[before:]

    # Dr.Jit records again if two arrays have the same size by chance, also one of another scene in the process.
    assert [] in (new(3, 40), new(4, 43))


def test_kernels_stay_frozen_beside_a_scene_with_a_material_that_no_shape_uses(
    mi: Any, recorded: list[str]
) -> None:
    """Virtual functions are recorded for the objects of all scenes, also for what no shape refers to."""
    texture = {"type": "bitmap", "data": mi.TensorXf([0.5] * 64, (8, 8, 1)), "raw": True}
    unused = {"type": "bumpmap", "map": texture, "nested": {"type": "diffuse"}}
    other = mi.load_dict(room("principled") | {"unused": unused}, optimize=False)
    renderer = SceneRenderer(room("principled"), "ball.*", spp=2)
    for seed in range(3):
        before = len(recorded)
        renderer(renderer.inputs, seed=seed)
    assert other is not None
    assert len(recorded) == before


@pytest.mark.long
@pytest.mark.parametrize("name", ["metal.alpha.value", "glass.eta"])
def test_a_kernel_is_right_for_other_sample_counts_than_that_of_its_recording(mi: Any, name: str) -> None:
    """Dr.Jit guesses the sizes of arrays in a frozen function from those of the arguments."""
    scene = room("diffuse") | {
        "metal": {
            "type": "sphere",
            "center": [-0.7, 0.0, 3.0],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "alpha": 0.1},
        },
        "glass": {"type": "sphere", "center": [0.7, 0.0, 3.0], "radius": 0.5, "bsdf": {"type": "dielectric"}},
    }

    pattern = name.replace(".", ".*", 1)

    def create() -> SceneRenderer:
        return SceneRenderer(scene, pattern, spp=4)

    def slope(renderer: SceneRenderer, spp: int) -> float:
        leaves = renderer.leaves()
        renderer(leaves, seed=1, seed_grad=2, spp=spp).mean().backward()
        (leaf,) = leaves.values()
        return float(leaf.grad)

    used = create()
    for spp in (4, 64, 8):
        assert slope(used, spp) == pytest.approx(slope(create(), spp), rel=1e-3), spp
        gc.collect()  # the next scene is compiled together with those that exist


def test_an_image_is_that_of_mitsuba_at_every_sample_count(mi: Any) -> None:
    renderer = SceneRenderer(room("principled"), "ball.*", resolution=(11, 7), max_depth=6)
    integrator = renderer.plan.create_integrator()
    scene = mi.load_dict(room("principled"), optimize=False)
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = [11, 7]
    film.update()
    for spp in (4, 1, 16, 3):
        reference = integrator.render(scene, seed=5, spp=spp).torch()[..., :3]
        torch.testing.assert_close(renderer(seed=5, spp=spp), reference, rtol=1e-5, atol=1e-6)
