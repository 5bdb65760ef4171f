"""Our blend of two materials: the mean of the images of both, and derivatives that agree with differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from rooms import room
from seeds import seeds, shifted

from scenecaptum import SceneRenderer
from scenecaptum.scene import load_scene

Config = dict[str, Any]

MIRROR: Config = {"type": "conductor"}
GLASS: Config = {"type": "dielectric"}
COATED: Config = {"type": "plastic"}
PAINT: Config = {"type": "diffuse", "reflectance": 0.3}
METAL: Config = {"type": "roughconductor", "alpha": 0.3}
ROUGH_COATED: Config = {"type": "roughplastic", "alpha": 0.2}
RUNS = 6


def blend(one: Config, two: Config, weight: Any = 0.4) -> Config:
    return {"type": "blendbsdf", "weight": weight, "one": one, "two": two}


def texels(mi: Any, values: list[float]) -> Config:
    pixels = np.array(values, np.float32).reshape(2, 2, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}


def mean_and_error(numbers: list[float]) -> tuple[float, float]:
    found = torch.tensor(numbers, dtype=torch.float64)
    return found.mean().item(), found.std().item() / math.sqrt(len(numbers))


@pytest.mark.parametrize(
    ("one", "two"),
    [(MIRROR, ROUGH_COATED), (GLASS, METAL), (PAINT, COATED), (MIRROR, {"type": "null"})],
    ids=["mirror, rough plastic", "glass, rough metal", "diffuse, plastic", "mirror, nothing"],
)
def test_the_image_is_the_weighted_mean_of_the_images_of_both(mi: Any, one: Config, two: Config) -> None:
    """A path of two segments meets the material once. Mitsuba's own plugin reflects too little."""

    def brightness(material: Config) -> tuple[float, float]:
        renderer = SceneRenderer(room(mi, material), "emitters", resolution=(16, 16), spp=256, max_depth=2)
        return mean_and_error([renderer({}, seed=seed).mean().item() for seed in seeds(RUNS)])

    (mixed, error), (first, first_error), (second, second_error) = map(
        brightness, (blend(one, two), one, two)
    )
    expected = 0.6 * first + 0.4 * second
    noise = math.hypot(error, 0.6 * first_error, 0.4 * second_error)
    assert abs(mixed - expected) < allowed(RUNS - 1) * noise, f"{mixed=} {expected=} {noise=}"


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0, "texture"])
def test_images_without_specular_lobes_are_those_of_mitsuba(mi: Any, weight: float | str) -> None:
    material = blend(METAL, ROUGH_COATED, texels(mi, [0, 0.2, 0.7, 1]) if weight == "texture" else weight)
    scene = room(mi, material, rr_depth=100)
    scene["other"] = {
        "type": "sphere",
        "center": [1, -1.5, -0.7],
        "radius": 0.4,
        "bsdf": {"type": "twosided", "material": material},
    }
    theirs, mine = (
        np.array(mi.render(loaded, spp=16, seed=shifted(1)))
        for loaded in (mi.load_dict(scene), load_scene(scene))
    )
    np.testing.assert_allclose(mine, theirs, rtol=1e-4)


@pytest.mark.parametrize(
    ("one", "two", "weight", "steps"),
    [
        (MIRROR, ROUGH_COATED, 0.4, {"bsdf_1.diffuse_reflectance.value": 0.05}),
        pytest.param(GLASS, PAINT, [0.2, 0.4, 0.6, 0.8], {"weight.data": 0.05}, marks=pytest.mark.long),
        # Of each texel only one material is sampled.
        (MIRROR, PAINT, [0.0, 1.0, 1.0, 0.0], {"weight.data": 0.05}),
    ],
    ids=["mirror, rough plastic", "glass, diffuse, texture", "mirror, diffuse, texels at the bounds"],
)
def test_derivatives_agree_with_differences(
    mi: Any, one: Config, two: Config, weight: Any, steps: dict[str, float]
) -> None:
    material = blend(one, two, texels(mi, weight) if isinstance(weight, list) else weight)
    names = {f"ball.bsdf.{name}": step for name, step in steps.items()}
    renderer = SceneRenderer(room(mi, material), list(names), resolution=(16, 16), spp=256)
    weights = torch.linspace(0.5, 1.5, 16)[:, None]

    def metric(values: dict[str, torch.Tensor], **seeds: int) -> torch.Tensor:
        return (renderer(values, **seeds).mean(-1) * weights).mean()

    def derivatives(seed: int) -> dict[str, float]:
        leaves = renderer.leaves()
        metric(leaves, seed=seed, seed_grad=seed + 1000).backward()
        return {name: leaf.grad.sum().item() for name, leaf in leaves.items()}

    def difference(name: str, seed: int) -> float:
        # Both within the bounds; the distance is the same for all texels.
        high, low = ((renderer.inputs[name] + h).clamp(0, 1) for h in (names[name], -names[name]))
        after, before = (metric({name: value}, seed=seed).item() for value in (high, low))
        return (after - before) / (high - low).max().item()

    found = [derivatives(seed) for seed in seeds(RUNS)]
    for name in names:
        ours, our_error = mean_and_error([one[name] for one in found])
        theirs, error = mean_and_error([difference(name, seed) for seed in seeds(100, 100 + RUNS)])
        assert max(our_error, error) < 0.1 * abs(theirs), "the case is lost in its noise and shows nothing"
        noise = math.hypot(our_error, error, 0.005 * abs(theirs))  # and the bias of the step
        assert abs(ours - theirs) < allowed(2 * RUNS - 1) * noise, f"{name}: {ours=} {theirs=} {noise=}"


def test_a_weight_takes_no_renders_of_its_own(mi: Any) -> None:
    renderer = SceneRenderer(room(mi, blend(MIRROR, PAINT)), "ball.*", resolution=(8, 8))
    assert "ball.bsdf.weight.value" in renderer.inputs
    assert not renderer.rendered_separately
    assert not renderer.plan.cautions


def test_a_blend_of_one_material_is_refused(mi: Any) -> None:
    from scenecaptum import SceneCaptumError

    with pytest.raises(SceneCaptumError, match="two nested materials, not 1"):
        load_scene(room(mi, {"type": "blendbsdf", "one": PAINT}))


def test_what_is_inside_a_blend_that_mitsuba_renders_wrongly_is_marked(mi: Any) -> None:
    """A loaded scene is used as it is, with Mitsuba's plugin."""

    def cautions(scene: Any) -> dict[str, str]:
        return dict(SceneRenderer(scene, "ball.*", resolution=(8, 8)).plan.cautions)

    scene = room(mi, blend(MIRROR, METAL))
    assert not cautions(scene)
    marked = cautions(mi.load_dict(scene, optimize=False))
    assert "load the scene from its file or dict" in marked["ball.bsdf.bsdf_1.alpha.value"]
    assert not cautions(mi.load_dict(room(mi, blend(METAL, PAINT)), optimize=False))
