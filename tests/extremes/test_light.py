"""Light at the extremes: none, hardly any, far too much, all of it in one place, and impossible light."""

from __future__ import annotations

import re

import hypothesis
import numpy as np
import pytest
import torch
from bitmaps import write_bitmap
from chance import allowed
from hypothesis import given, settings
from hypothesis import strategies as st
from seeds import seeds, shifted

from scenecaptum import (
    FeatureAblationScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    SceneCaptumError,
    SceneRenderer,
    VanillaSceneGradient,
)
from scenecaptum.projection import heatmap

from .scenes import GREY, attribute, camera, furnace, mean, rgb, room, sky, slope, total, z

RADIANCE = "lamp.emitter.radiance.value"
BALL, FLOOR = "ball.bsdf.reflectance.value", "floor.bsdf.reflectance.value"


@pytest.fixture(scope="module")
def lit(mi):
    """The room under a lamp of radiance 1, and its attribution."""
    renderer = SceneRenderer(room(mi, lamp=1.0), inputs="all")
    return renderer, attribute_at(renderer, 1.0)


def attribute_at(renderer, radiance):
    values = {**renderer.inputs, RADIANCE: torch.full((3,), radiance)}
    return VanillaSceneGradient(renderer, mean).attribute(values, seed=shifted())


def test_all_lights_off(lit):
    """A black image: reflectances have no effect, and the lamp has the same derivative as when it is on."""
    renderer, on = lit
    off = attribute_at(renderer, 0.0)
    assert off.metric_value == 0
    assert torch.equal(off[BALL], torch.zeros(3))
    assert off.saliency_error()[BALL] == 0
    torch.testing.assert_close(off[RADIANCE], on[RADIANCE], rtol=0.3, atol=0.0)
    (a, one), (b, other) = total(off, RADIANCE), total(on, RADIANCE)
    assert abs(a - b) < allowed(8) * (one**2 + other**2) ** 0.5
    assert float(heatmap(off).max()) in (0.0, 1.0)


def test_no_light_at_all(mi):
    dark = attribute(room(mi, lamp=None), "reflectance")
    assert dark.metric_value == 0
    assert set(dark.saliency().values()) == {0.0}


@hypothesis.seed(shifted())
@settings(max_examples=4, deadline=None, database=None)
@given(exponent=st.integers(-30, 34))
def test_gradients_and_errors_scale_with_the_light(lit, exponent):
    """Light 10ⁿ times as strong gives 10ⁿ times the gradient of a reflectance, and the same relative error."""
    check_scaling(lit, exponent)


@pytest.mark.parametrize("exponent", [-20, 20])
def test_scaling_holds_at_1e20_and_1e_minus_20(lit, exponent):
    check_scaling(lit, exponent)


def check_scaling(lit, exponent):
    renderer, one = lit
    scaled, factor = attribute_at(renderer, 10.0**exponent), 10.0**exponent
    assert scaled.metric_value == pytest.approx(one.metric_value * factor, rel=1e-4)
    for name in (BALL, FLOOR):
        for ours, theirs in ((scaled, one), (scaled.standard_error, one.standard_error)):
            torch.testing.assert_close(
                ours[name].double() / factor, theirs[name].double(), rtol=2e-3, atol=1e-9
            )
        assert scaled.saliency()[name] == pytest.approx(one.saliency()[name] * factor, rel=1e-3)
        assert scaled.saliency_error()[name] == pytest.approx(one.saliency_error()[name] * factor, rel=1e-2)
    torch.testing.assert_close(scaled[RADIANCE], one[RADIANCE], rtol=1e-3, atol=1e-9)


def test_light_beyond_single_precision_is_refused_by_name_and_place(mi):
    """3e38 is finite in float32, its sum over bounces is not: it is refused."""
    renderer = SceneRenderer(furnace(mi, GREY), inputs="emitters")
    brightest = {"walls.emitter.radiance.value": torch.full((3,), 3e38)}
    with pytest.raises(
        SceneCaptumError, match=rf"seed {shifted(5)} is inf on 64 of 64 pixels: rows 0 to 7.* show walls"
    ):
        renderer(brightest, seed=shifted(5))
    with pytest.raises(SceneCaptumError, match="In replicate 1 of 8: The render with seed"):
        VanillaSceneGradient(renderer, mean).attribute(brightest, seed=shifted())


@pytest.mark.long
@pytest.mark.parametrize(("what", "exponent"), [(IntegratedGradientsScene, -20), (FeatureAblationScene, 20)])
def test_other_methods_scale_too(lit, what, exponent):
    renderer, _ = lit
    options = {"n_steps": 2} if what is IntegratedGradientsScene else {}
    found = [
        what(renderer, mean).attribute(
            {**renderer.inputs, RADIANCE: torch.full((3,), light)}, seed=shifted(), spp=32, **options
        )
        for light in (1.0, 10.0**exponent)
    ]
    one, scaled = (one.saliency() for one in found)
    for name in (BALL, FLOOR, RADIANCE):
        assert scaled[name] == pytest.approx(10.0**exponent * one[name], rel=2e-3)
    assert found[1].saliency_error()[BALL] == pytest.approx(
        10.0**exponent * found[0].saliency_error()[BALL], rel=0.02
    )


def test_one_pixel_a_hundred_million_times_brighter(mi):
    """A lamp one pixel wide before a sky: both derivatives are right."""
    transform = mi.ScalarTransform4f()
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": camera(mi, [0, 0, 0], [0, 1, 0]),
        "lamp": {
            "type": "sphere",
            "center": [0.05, 1, 0.05],
            "radius": 0.03,
            "to_world": transform,
            "emitter": {"type": "area", "radiance": rgb(1e8)},
        },
        "sky": {"type": "constant", "radiance": rgb(1.0)},
    }
    found = attribute(scene, ["emitters"], spp=64)
    (lamp, error), (sky, other) = total(found, RADIANCE), total(found, "sky.radiance.value")
    assert 1e-3 < lamp < 1 / 64
    assert (
        abs(lamp + sky - 1) < allowed(8) * (error + other) + 1e-4
    )  # every ray hits one of them, with 1 per unit
    assert abs(lamp * 1e8 - found.metric_value) < allowed(8) * (error * 1e8 + found.metric_standard_error)
    elsewhere = attribute(scene, ["emitters"], lambda image: image[:, :2].mean(), spp=16)
    assert elsewhere.metric_value == pytest.approx(1.0, rel=1e-5)
    assert total(elsewhere, RADIANCE) == (0.0, 0.0)


def test_sun_disc_through_a_window(mi):
    """A sun of half a degree and radiance 1e5 lights half of the floor through a window."""
    transform = mi.ScalarTransform4f()
    radius = np.sin(np.radians(0.25))
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            **camera(mi, [0, 0, 0.9], [0, 0, 0]),
            "to_world": transform.look_at(origin=[0, 0, 0.9], target=[0, 0, 0], up=[0, 1, 0]),
        },
        "ground": {"type": "rectangle", "to_world": transform.scale(2), "bsdf": GREY},
        "wall": {"type": "rectangle", "to_world": transform.translate([5, 0, 1.5]).scale(5), "bsdf": GREY},
        "sun": {
            "type": "sphere",
            "center": [0, 0, 1000],
            "radius": 1000 * radius,
            "emitter": {"type": "area", "radiance": rgb(1e5)},
        },
    }
    found = attribute(scene, ["sun.emitter.*", "ground.*"], spp=64)
    irradiance = np.pi * radius**2
    assert abs(z(total(found, "sun.emitter.radiance.value"), 0.5 * 0.5 / np.pi * irradiance, 2e-3)) < allowed(
        8
    )
    assert abs(
        z(total(found, "ground.bsdf.reflectance.value"), 0.5 * 1e5 / np.pi * irradiance, 2e-3)
    ) < allowed(8)


def test_single_hot_texel(mi):
    """An image is linear in the sky: value times gradient sums to the brightness, including the hot texel."""
    texels = np.full((8, 16, 3), 1.0)
    texels[2, 4] = 1e8
    renderer = SceneRenderer(room(mi, lamp=None, sky=sky(mi, texels)), inputs="emitters")
    found = InputXGradientScene(renderer, mean).attribute(seed=shifted(), spp=128)
    share = total(found, "sky.data")
    truth = torch.stack([renderer(seed=one, spp=256).mean() for one in seeds(8)])
    error = (share[1] ** 2 + (truth.std() ** 2 / 8).item()) ** 0.5
    assert abs(share[0] - truth.mean().item()) < allowed(8) * error
    hottest = found["sky.data"].sum(-1).flatten().argmax().item()
    assert divmod(hottest, found["sky.data"].shape[1])[0] in (2, 3)
    assert torch.isfinite(found["sky.data"]).all()
    assert slope(renderer, "sky.scale", 0.01) == pytest.approx(truth.mean().item(), rel=0.2)


BAD = [(-5.0, "outside the physical range"), (np.nan, "not finite"), (np.inf, "not finite")]


@pytest.mark.parametrize(("value", "words"), BAD)
def test_impossible_light_raises_where_it_is_asked_for_by_name(mi, tmp_path, value, words):
    """With texel and channel; kinds and globs leave it out, and the plan says so."""
    texels = np.full((8, 16, 3), 1.0, np.float32)
    texels[2, 4, 1] = value
    path = tmp_path / "sky.exr"
    write_bitmap(path, texels)
    scene = room(mi, sky={"type": "envmap", "filename": str(path)})
    said = rf"it is {value:g} at row 2, column 4, channel 1.*{words}"
    for inputs in ("sky.data", ["emitters", "sky.data"]):
        with pytest.raises(SceneCaptumError, match=rf"'sky.data' cannot be differentiated: {said}"):
            SceneRenderer(scene, inputs=inputs)
    for inputs in ("emitters", "*"):
        renderer = SceneRenderer(scene, inputs=inputs)
        assert "sky.data" not in renderer.inputs
        assert {"sky.scale", RADIANCE} <= set(renderer.inputs)
        assert re.match(said, dict(renderer.plan.cautions)["sky.data"])
        assert re.match(said, renderer.parameters_table()["sky.data"].problem)
    with pytest.raises(
        SceneCaptumError, match=rf"{RADIANCE!r} cannot be differentiated: it is {value:g}.*{words}"
    ):
        SceneRenderer(room(mi, lamp=value), inputs=RADIANCE)
    with pytest.raises(SceneCaptumError, match=f"only {RADIANCE}, which cannot be differentiated: it is"):
        SceneRenderer(room(mi, lamp=value), inputs="*radiance*")


def test_impossible_light_that_nobody_asked_for_is_rendered_as_mitsuba_renders_it(mi):
    scene = room(mi, lamp=-5.0)
    renderer = SceneRenderer(scene, inputs="reflectance", resolution=(8, 8))
    ours = torch.stack([renderer(seed=seed, spp=64) for seed in seeds(8)]).double()
    loaded = mi.load_dict(scene, optimize=False)
    theirs = torch.stack([mi.render(loaded, seed=seed, spp=64).torch() for seed in seeds(8, 16)]).double()
    assert float(ours.mean()) < 0
    means = [pictures.mean((1, 2, 3)) for pictures in (ours, theirs)]
    error = sum(float(one.var()) / len(one) for one in means) ** 0.5
    assert abs(float(means[0].mean() - means[1].mean())) < allowed(8) * error


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_light_that_is_not_finite_is_named_where_it_reaches_the_picture(mi, value):
    renderer = SceneRenderer(room(mi, lamp=value), inputs="reflectance")
    with pytest.raises(
        SceneCaptumError, match=rf"on \d+ of 64 pixels.*{RADIANCE!r} may be the cause: it is {value:g}"
    ):
        renderer(seed=1)
