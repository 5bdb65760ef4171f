"""Materials at the extremes: black and white, smooth and rough, there and not, and light that cannot leave."""

from __future__ import annotations

import hypothesis
import numpy as np
import pytest
import torch
from chance import allowed
from hypothesis import given, settings
from hypothesis import strategies as st
from seeds import seeds, shifted

from scenecaptum import FeatureAblationScene, SceneCaptumError, SceneRenderer, VanillaSceneGradient

from .scenes import GREY, attribute, coverage, furnace, in_the_sky, mean, rgb, room, texture, total, z

WALLS, GLOW = "walls.bsdf.reflectance.value", "walls.emitter.radiance.value"
MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": rgb(1.0)}
COVERED = 2e-3  # accuracy of the coverage of a ball


def series(passed: float, depth: int) -> tuple[float, float]:
    """Return ``Σ_{k<d} r^k``, the light in a furnace, and its derivative."""
    return sum(passed**k for k in range(depth)), sum(k * passed ** (k - 1) for k in range(1, depth))


@pytest.fixture(scope="module")
def oven(mi):
    return SceneRenderer(furnace(mi, GREY), inputs="all")


@hypothesis.seed(shifted())
@settings(max_examples=4, deadline=None, database=None)
@given(reflectance=st.floats(0.01, 1.0), radiance=st.floats(1e-3, 1e3))
def test_furnace(oven, reflectance, radiance):
    check_furnace(oven, reflectance, radiance)


@pytest.mark.parametrize("reflectance", [0.0, 1.0])
def test_furnace_of_black_and_of_white_walls(oven, reflectance):
    # At 0 the derivative is that at 0.001 (_derivative_routes.SINGULARITY_OFFSETS): 0.3 % is the accuracy.
    check_furnace(oven, reflectance, 2.0, rounding=3e-3 if reflectance == 0 else 2e-5)


def check_furnace(oven, reflectance, radiance, rounding=2e-5):
    values = {WALLS: torch.full((3,), reflectance), GLOW: torch.full((3,), radiance)}
    found = VanillaSceneGradient(oven, mean).attribute(values, seed=shifted(), spp=64)
    light, slope = series(reflectance, 4)
    assert abs(z((found.metric_value, found.metric_standard_error), radiance * light)) < allowed(8)
    assert abs(z(total(found, GLOW), light, rounding)) < allowed(8)
    assert abs(z(total(found, WALLS), radiance * slope, rounding)) < allowed(8)


@pytest.fixture(scope="module")
def mirrors(mi):
    return SceneRenderer(furnace(mi, MIRROR, depth=7), ["walls.bsdf.specular_reflectance.*", GLOW])


@pytest.mark.parametrize("passed", [0.0, 0.7, 1.0])
def test_closed_mirror_box(mirrors, passed):
    """Without noise, the light and its derivatives equal the series up to rounding."""
    tint = {"walls.bsdf.specular_reflectance.value": torch.full((3,), passed)}
    found = VanillaSceneGradient(mirrors, mean).attribute({**mirrors.inputs, **tint}, seed=shifted())
    light, slope = series(passed, 7)
    assert found.metric_value == pytest.approx(light, rel=1e-5)
    assert total(found, GLOW)[0] == pytest.approx(light, rel=2e-3 if passed == 0 else 1e-5)
    assert total(found, "walls.bsdf.specular_reflectance.value")[0] == pytest.approx(slope, rel=3e-3)


def test_white_surfaces_lose_nothing_and_black_ones_all(mi):
    """A convex ball under a uniform sky: M = 1 − c + c·r for a coverage c."""
    renderer = SceneRenderer(in_the_sky(mi, GREY), inputs="reflectance")
    covered, name = coverage(renderer), "ball.bsdf.reflectance.value"
    for reflectance in (0.0, 1.0):
        values = {name: torch.full((3,), reflectance)}
        found = VanillaSceneGradient(renderer, mean).attribute(values, seed=shifted(), spp=64)
        assert abs(
            z(
                (found.metric_value, found.metric_standard_error),
                1 - covered + covered * reflectance,
                COVERED,
            )
        ) < allowed(8)
        assert abs(z(total(found, name), covered, COVERED)) < allowed(8)


@pytest.mark.long
@pytest.mark.parametrize("plugin", ["roughconductor", "roughdielectric"])
def test_roughness_from_a_ten_thousandth_to_one(mi, plugin):
    """The derivative is that of the image, within the noise of both, and never exactly 0."""
    fixed = {"material": "none"} if plugin == "roughconductor" else {"int_ior": 1.5}
    renderer = SceneRenderer(
        room(mi, lamp=5.0, ball={"type": plugin, "alpha": 0.1, **fixed}), inputs="ball.bsdf.alpha.*"
    )
    name = "ball.bsdf.alpha.value"
    for alpha in (1e-4, 1e-3, 0.03, 0.3, 1.0):
        value = torch.tensor(alpha)
        found = VanillaSceneGradient(renderer, mean).attribute({name: value}, seed=shifted(), spp=256)
        low, high = (
            (0.999 * value, 1.001 * value)
            if 1e-4 < alpha < 1
            else (value, 1.5 * value)
            if alpha < 1
            else (0.98 * value, value)
        )
        slopes = torch.stack(
            [
                (
                    renderer({name: high}, seed=s, spp=256).double().mean()
                    - renderer({name: low}, seed=s, spp=256).double().mean()
                )
                / (high - low)
                for s in seeds(8)
            ]
        )
        error = (
            (found.standard_error[name] ** 2 + slopes.var() / 8).sqrt() + 0.02 * slopes.mean().abs() + 1e-4
        )
        assert abs(found[name] - slopes.mean()) < allowed(8) * error, alpha


@pytest.mark.parametrize(
    "ior",
    [1 + 1e-6, *(pytest.param(one, marks=pytest.mark.long) for one in (1 / 3, 1 - 1e-6, 1.0, 1.5, 3.0))],
)
def test_clear_glass_in_an_even_sky_is_invisible(mi, ior):
    """What glass does not reflect it transmits, whatever its index: M = 1, with no derivative."""
    found = attribute(
        in_the_sky(mi, {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0}, depth=16),
        ["ior", "emitters"],
        spp=64,
    )
    assert found.metric_value == pytest.approx(1.0, abs=1e-4)
    assert abs(z(total(found, "sky.radiance.value"), 1.0, 1e-4)) < allowed(8)
    slope, error = total(found, "ball.bsdf.eta")
    assert abs(slope) < allowed(8) * error + 1e-3


def test_nested_dielectrics(mi):
    """Water in glass in air, all clear: invisible too."""
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    water = {"type": "sphere", "radius": 0.6, "bsdf": {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.5}}
    found = attribute(in_the_sky(mi, glass, depth=16, water=water), ["ior", "emitters"], spp=64)
    assert found.metric_value == pytest.approx(1.0, abs=2e-4)
    for name in ("ball.bsdf.eta", "water.bsdf.eta"):
        slope, error = total(found, name)
        assert abs(slope) < allowed(8) * error + 1e-3


def test_opacity_zero_and_one(mi):
    """Rays cross two skins, the inner side black: M = 1 − c + c (r o + (1 − o)²)."""
    mask = {"type": "mask", "opacity": 0.5, "skin": GREY}
    renderer = SceneRenderer(in_the_sky(mi, mask, depth=6), inputs=["opacity", "reflectance"])
    covered = coverage(renderer)
    for opacity in (0.0, 1.0):
        values = {"ball.bsdf.opacity.value": torch.tensor(opacity)}
        found = VanillaSceneGradient(renderer, mean).attribute(values, seed=shifted(), spp=256)
        light = 1 - covered + covered * (0.5 * opacity + (1 - opacity) ** 2)
        assert abs(z((found.metric_value, found.metric_standard_error), light, COVERED)) < allowed(8)
        assert abs(
            z(total(found, "ball.bsdf.opacity.value"), covered * (0.5 - 2 * (1 - opacity)), 0.02)
        ) < allowed(8)


@pytest.mark.parametrize(
    ("shape", "value"),
    [
        ((1, 1), 0.5),
        pytest.param((1, 8192), 0.5, marks=pytest.mark.long),
        pytest.param((8192, 1), 0.5, marks=pytest.mark.long),
        ((4, 4), 0.0),
    ],
)
def test_odd_textures(mi, shape, value):
    """A uniform texture counts like its colour, also if it is black, 1×1 or one texel high."""
    scene = in_the_sky(mi, texture(mi, np.full((*shape, 3), value)))
    renderer = SceneRenderer(scene, inputs="textures")
    found = VanillaSceneGradient(renderer, mean).attribute(seed=shifted(), spp=64)
    name = "ball.bsdf.reflectance.data"
    assert found[name].shape == (*(max(2, side) for side in shape), 3)  # Mitsuba stores at least two texels
    assert torch.isfinite(found[name]).all()
    assert torch.isfinite(found.standard_error[name]).all()
    assert abs(z(total(found, name), coverage(renderer), COVERED)) < allowed(8)


KNOB = {
    "type": "roughconductor",
    "alpha": 0.2,
    "eta": {"type": "rgb", "value": [1.5, -0.0485, 1.5]},
    "k": 3.0,
}
ETA = "knob.bsdf.eta.value"


@pytest.fixture(scope="module")
def radiator(mi):
    """A room with a ball of an impossible metal, as on a radiator knob in a published scene."""
    knob = {"type": "sphere", "center": [1.2, 0, 0], "radius": 0.4, "bsdf": KNOB}
    return SceneRenderer(room(mi, knob=knob), inputs=["materials", "knob.*"])


def test_an_impossible_index_is_left_out_by_kinds_and_globs_and_a_caution_names_it(radiator):
    said = "it is -0.0485 at channel 1, outside the physical range [0, ∞) of its kind (ior)"
    assert ETA not in radiator.inputs
    assert {"knob.bsdf.k.value", "knob.bsdf.alpha.value", "ball.bsdf.reflectance.value"} <= set(
        radiator.inputs
    )
    assert radiator.plan.cautions == ((ETA, f"{said}; left out, and rendered as it is"),)
    assert f"caution: {ETA}: {said}" in " ".join(str(radiator.plan).split())
    assert radiator.parameters_table()[ETA].problem == said
    assert radiator.parameters_table()[ETA].status == f"not differentiable: {said}"


def test_an_impossible_index_raises_by_its_exact_name_only(mi):
    knob = {"type": "sphere", "bsdf": KNOB}
    for inputs in (ETA, ["materials", ETA]):
        with pytest.raises(SceneCaptumError, match=f"'{ETA}' cannot be differentiated: it is -0.0485"):
            SceneRenderer(room(mi, knob=knob), inputs=inputs)


@pytest.mark.parametrize(
    ("bsdf", "name", "said"),
    [
        (
            {"type": "dielectric", "int_ior": 0.0},
            "knob.bsdf.eta",
            "it is 0, outside the physical range (0, ∞)",
        ),
        ({"type": "roughconductor", "alpha": 1.7}, "knob.bsdf.alpha.value", "it is 1.7, outside"),
        ({"type": "roughconductor", "alpha": -0.3}, "knob.bsdf.alpha.value", "it is -0.3, outside"),
        ({"type": "principled", "roughness": -0.1}, "knob.bsdf.roughness.value", "it is -0.1, outside"),
        ({"type": "principled", "metallic": 1.5}, "knob.bsdf.metallic.value", "it is 1.5, outside"),
        ({"type": "principled", "anisotropic": 3.0}, "knob.bsdf.anisotropic.value", "it is 3, outside"),
    ],
)
def test_an_impossible_property_of_a_material_has_a_caution(mi, bsdf, name, said):
    renderer = SceneRenderer(room(mi, knob={"type": "sphere", "bsdf": bsdf}), inputs="materials")
    assert name not in renderer.inputs
    assert [where for where, _ in renderer.plan.cautions] == [name]
    assert renderer.parameters_table()[name].problem.startswith(said)


@pytest.mark.parametrize(
    ("bsdf", "name"),
    [
        ({"type": "conductor"}, "knob.bsdf.eta.value"),  # a perfect mirror
        ({"type": "principled", "roughness": 0.0}, "knob.bsdf.roughness.value"),
        ({"type": "roughconductor", "alpha": 0.0}, "knob.bsdf.alpha.value"),
        ({"type": "principled", "clearcoat": 1.0}, "knob.bsdf.clearcoat.value"),
    ],
)
def test_a_convention_of_mitsuba_is_no_fault(mi, bsdf, name):
    renderer = SceneRenderer(room(mi, knob={"type": "sphere", "bsdf": bsdf}), inputs=["materials", "knob.*"])
    assert renderer.parameters_table()[name].fault is None


def test_results_carry_the_caution(radiator):
    for method in (VanillaSceneGradient, FeatureAblationScene):
        found = method(radiator, mean).attribute(seed=0, replicates=2)
        assert found.info["left_out"][ETA].startswith("it is -0.0485")
        assert f"! {ETA} is left out: it is -0.0485" in " ".join(str(found).split())
        assert ETA not in found


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "least", "bsdf"),
    [
        ("alpha", 1e-4, {"type": "roughconductor", "material": "Al"}),
        ("roughness", 1e-3**0.5, {"type": "principled", "metallic": 1.0}),
    ],
)
def test_below_the_lowest_roughness_there_is_no_derivative_and_a_note(mi, name, least, bsdf):
    renderer = SceneRenderer(in_the_sky(mi, bsdf), "roughness", resolution=(8, 8), spp=16)

    def attribution(value):
        values = {one: torch.full_like(own, value) for one, own in renderer.inputs.items()}
        return VanillaSceneGradient(renderer, mean).attribute(values, seed=shifted())

    below, above = attribution(0.99 * least), attribution(1.01 * least)
    assert max(below.saliency().values()) == 0
    assert max(above.saliency().values()) > 0
    assert "renders a roughness this low as its lowest" in " ".join(str(below).split())
    assert "as its lowest" not in str(above)
