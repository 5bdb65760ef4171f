"""Effective sample sizes from the pilot render: exact where they can be counted, small for rare light."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.scene.bundled import cornell_box

SIDE, SPP, REPLICATES = 16, 4, 8
BULB = "bulb.emitter.radiance.value"


def bulb(mi: Any, **more: Any) -> dict[str, Any]:
    """A shining disk that covers π/64 of the image."""
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "orthographic", "to_world": mi.ScalarTransform4f(), "film": film},
        "bulb": {
            "type": "disk",
            "to_world": mi.ScalarTransform4f().translate([0.1, 0.2, 1]).rotate([0, 1, 0], 180).scale(0.25),
            "emitter": {"type": "area", "radiance": 5.0},
        },
        **more,
    }


def fog(mi: Any) -> dict[str, Any]:
    """Out of sight, so that the volumetric integrator renders the same image."""
    return {
        "type": "sphere",
        "center": [9, 9, 9],
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5},
    }


@pytest.mark.parametrize("volumetric", [False, True])
def test_a_bulb_has_as_many_samples_as_hit_it(mi: Any, volumetric: bool) -> None:
    scene = bulb(mi, fog=fog(mi)) if volumetric else bulb(mi)
    renderer = SceneRenderer(scene, BULB)
    assert ("volumetric" in renderer.plan.integrator) == volumetric
    found = renderer.effective_samples(
        renderer.inputs, torch.ones(SIDE, SIDE, 3), spp=SPP, replicates=REPLICATES
    )[BULB]
    expected = SIDE**2 * SPP * REPLICATES * torch.pi / 64
    error = (4 * expected) ** -0.5  # relative: the pilot has four times the samples
    assert abs(found / expected - 1) < 4 * error


def test_twice_the_samples_count_twice(cornell: SceneRenderer) -> None:
    adjoint = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    once, twice, brighter = (
        cornell.effective_samples(cornell.inputs, factor * adjoint, spp=16, replicates=replicates)
        for factor, replicates in ((1, 8), (1, 16), (1e12, 8))
    )
    assert set(once) == set(cornell.inputs)
    for name, count in once.items():
        assert twice[name] == pytest.approx(2 * count)
        assert brighter[name] == pytest.approx(count, rel=1e-3)


def test_the_brightness_of_light_does_not_matter(mi: Any) -> None:
    def counted(radiance: float) -> float:
        scene = bulb(mi)
        scene["bulb"]["emitter"]["radiance"] = radiance
        renderer = SceneRenderer(scene, BULB)
        return renderer.effective_samples(renderer.inputs, torch.ones(SIDE, SIDE, 3), spp=SPP)[BULB]

    assert counted(1e30) == pytest.approx(counted(1.0), rel=1e-4)


@pytest.mark.parametrize("reflectance", [0.5, None])
def test_a_lamp_that_also_reflects_is_counted(mi: Any, reflectance: float | None) -> None:
    """Without a material, Mitsuba gives a lamp a black one, whose derivative is that of any other."""
    scene = cornell_box()
    del scene["light"]["bsdf"]
    if reflectance is not None:
        scene["light"]["bsdf"] = {"type": "diffuse", "reflectance": reflectance}
    name = "light.bsdf.reflectance.value"
    renderer = SceneRenderer(scene, name, resolution=(32, 32), spp=64, max_depth=4)
    assert renderer.inputs[name].unique().tolist() == [reflectance or 0.0]
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute()
    assert found[name].sum() > 5 * found.standard_error[name].sum() > 0
    assert found.info["effective_samples"][name] > 0
    assert not found.untrusted_errors()


@pytest.mark.parametrize("others", [True, False])
def test_a_lamp_that_is_off_is_counted_like_one_that_shines(mi: Any, others: bool) -> None:
    def counted(radiance: float) -> dict[str, float]:
        scene = bulb(mi, **({"sky": {"type": "constant", "radiance": 2.0}} if others else {}))
        scene["bulb"]["emitter"]["radiance"] = radiance
        renderer = SceneRenderer(scene, "emitters")
        return renderer.effective_samples(renderer.inputs, torch.ones(SIDE, SIDE, 3), spp=SPP)

    assert counted(0.0) == pytest.approx(counted(5.0), rel=1e-4)


def test_the_values_of_the_pilot_are_not_left_in_the_scene(mi: Any) -> None:
    scene = bulb(mi)
    scene["bulb"]["emitter"]["radiance"] = 0.0
    renderer = SceneRenderer(scene, BULB)
    assert renderer.effective_samples(renderer.inputs, torch.ones(SIDE, SIDE, 3), spp=SPP)[BULB] > 0
    assert not renderer.inputs[BULB].any()
    assert not renderer(seed=1).any()


def test_parameters_without_any_path_are_marked(mi: Any, tmp_path: Path) -> None:
    scene = cornell_box()
    scene["hidden"] = {"type": "sphere", "center": [0.335, -0.38, -0.7], "radius": 0.1}
    renderer = SceneRenderer(scene, "reflectance", resolution=(16, 16), spp=16, max_depth=3)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute()
    name = "hidden.bsdf.reflectance.value"
    assert found[name].abs().max() == 0
    reasons = found.untrusted_errors()
    assert reasons[name].startswith("reached by no sample: the light is rare, or there is none")
    assert not any(one.startswith("floor") for one in reasons)
    found.save(tmp_path / "found.npz")
    assert SceneAttribution.load(tmp_path / "found.npz").untrusted_errors() == found.untrusted_errors()
    assert (found - found).untrusted_errors() == found.untrusted_errors()
    # Of a metric that the picture does not change, no samples would be missing.
    without = VanillaSceneGradient(renderer, lambda image: image.clamp(max=-1.0).mean()).attribute()
    assert not any(without.effects().values())
    assert without.untrusted_errors() == {}


def test_an_exact_zero_of_few_samples_is_a_result(mi: Any) -> None:
    """The absorption of a perfect mirror, whose eta is 0, has no derivative, however few samples there are."""
    scene = bulb(mi, sky={"type": "constant"})
    del scene["bulb"]["emitter"]
    scene["bulb"]["bsdf"] = {
        "type": "conductor",
        "eta": {"type": "rgb", "value": 0.0},
        "k": {"type": "rgb", "value": 3.0},
    }
    zero, other = (f"bulb.bsdf.{role}.value" for role in ("k", "specular_reflectance"))
    found = VanillaSceneGradient(SceneRenderer(scene, [zero, other]), metrics.MeanLuminance()).attribute(
        spp=SPP
    )
    assert found[other].all()
    assert not found.replicates[zero].any()

    def doubtful(count: float, one: SceneAttribution = found) -> set[str]:
        info = {**one.info, "effective_samples": dict.fromkeys(one, count)}
        return set(dataclasses.replace(one, info=info).untrusted_errors())

    assert doubtful(3.0) == {other}, "its error is of as few samples, but not 0"
    # Where less than one sample is expected, 0 says nothing; and a difference may be 0 as that of equal values.
    assert doubtful(0.5) == doubtful(0.0) == {zero, other}
    assert doubtful(3.0, found - found) == {zero, other}


@pytest.fixture(scope="module")
def in_the_hall(mi: Any) -> SceneAttribution:
    from _hall import hall

    renderer = SceneRenderer(hall(), "all", spp=16)
    return VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute()


def test_faint_lamps_and_objects_lit_by_them_are_marked(in_the_hall: SceneAttribution) -> None:
    """Their 95 % intervals contain the truth in 55 to 77 % of runs, see ``benchmarks/interval_coverage.py``."""
    rare = ("store_lamp.emitter", "store.", "crate.", "urn.", "door.diffuse", "vestibule.", "stone.")
    doubtful = in_the_hall.untrusted_errors()
    for start in rare:
        assert any(name.startswith(start) for name in doubtful), start


def test_parameters_with_many_paths_are_not_marked(in_the_hall: SceneAttribution) -> None:
    bright = ("floor.", "ceiling.", "wall_", "carpet.", "bench.", "column.", "niche_1.", "panel_0.emitter")
    assert not [name for name in in_the_hall.untrusted_errors() if name.startswith(bright)]
