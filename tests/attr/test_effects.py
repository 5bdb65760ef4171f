"""Effects over ranges: what rankings, figures and groups compare."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    InputXGradientScene,
    SceneAttribution,
    SceneCaptumError,
    SceneRenderer,
    ShapleyValueScene,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.attr import range_lengths
from scenecaptum.attr._groups import sum_groups
from scenecaptum.estimation import channel_totals
from scenecaptum.visualization import light_notes, range_notes


def attribution(**other: object) -> SceneAttribution:
    """Three parameters of different units: a colour, an index, and a radiance."""
    values = {
        "wall": torch.tensor([0.1, 0.2, -0.1]),
        "glass": torch.tensor(1.5),
        "lamp": torch.tensor([0.01, 0.02, 0.03]),
    }
    lamp = torch.tensor([10.0, 20.0, 0.0])
    return SceneAttribution(
        attributions=values,
        standard_error={name: torch.full_like(value, 0.01) for name, value in values.items()},
        metric_value=1.0,
        covariance={name: 1e-4 * torch.eye(value.numel()) for name, value in values.items()},
        extents={"wall": torch.ones(3), "glass": torch.tensor([0.5]), "lamp": lamp},
        parameter_values={"wall": torch.full((3,), 0.5), "glass": torch.tensor(1.5), "lamp": lamp},
        info={"metric": "m", "method": "VanillaSceneGradient", "replicates": 8, **other},
    )


def test_an_effect_is_the_sum_over_the_channels_times_their_ranges():
    found = attribution().effects()
    assert found == pytest.approx({"wall": 0.2, "glass": 0.75, "lamp": 0.5})
    expected = {"wall": 0.01 * math.sqrt(3), "glass": 0.005, "lamp": 0.01 * math.hypot(10, 20)}
    assert attribution().effects_error() == pytest.approx(expected)


def test_rankings_compare_effects_and_the_mapping_holds_gradients():
    one = attribution()
    assert [row.name for row in one.ranking()] == ["glass", "lamp", "wall"]
    assert one["wall"].tolist() == pytest.approx([0.1, 0.2, -0.1])
    assert one.ranking()[0].total == pytest.approx((1.5,))


def test_other_scales_compare_norms_per_unit_and_relative_changes():
    one = attribution()
    assert one.saliency("unit")["wall"] == pytest.approx(math.sqrt(0.06))
    assert one.effects("value") == pytest.approx({"wall": 0.1, "glass": 2.25, "lamp": 0.5})
    assert one.ranking(scale="unit")[0].name == "glass"


def test_without_ranges_parameters_are_compared_per_unit():
    one = attribution()
    bare = SceneAttribution(one.attributions, None, 1.0, info=dict(one.info))
    assert bare.scale_or_default() == "unit"
    assert bare.saliency() == one.saliency("unit")
    with pytest.raises(SceneCaptumError, match="needs the range of 'wall'"):
        bare.ranking(scale="range")
    with pytest.raises(SceneCaptumError, match="scale must be"):
        one.ranking(scale="percent")


def test_contributions_are_compared_as_they_are():
    one = attribution(quantity="contribution")
    assert one.effects() == one.effects("unit") == pytest.approx({"wall": 0.2, "glass": 1.5, "lamp": 0.06})


def test_the_effect_of_a_light_is_its_contribution():
    """From off to its value, to first order: the image is linear in the radiance."""
    renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), spp=256)
    metric = metrics.MeanLuminance()
    effects = VanillaSceneGradient(renderer, metric).attribute(seed=3)
    contributions = InputXGradientScene(renderer, metric).attribute(seed=3)
    for name, effect in effects.effects().items():
        assert effect == pytest.approx(contributions[name].sum().item(), rel=1e-4)


def test_ranges_come_from_the_parameters_and_from_the_user():
    glass = {"type": "sphere", "bsdf": {"type": "dielectric"}}
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "sky": {"type": "constant"},
        "glass": glass,
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
    }
    renderer = SceneRenderer(scene, "all", spp=1)
    assert renderer.ranges["glass.bsdf.eta"] == (1.45, 1.95)
    assert renderer.ranges["wall.bsdf.reflectance.value"] == (0.0, 1.0)
    assert math.isinf(renderer.ranges["sky.radiance.value"][1])
    narrow = SceneRenderer(scene, "all", spp=1, ranges={"reflectance": (0.2, 0.4), "*.eta": (1.5, 1.6)})
    assert narrow.ranges["wall.bsdf.reflectance.value"] == (0.2, 0.4)
    assert narrow.ranges["glass.bsdf.eta"] == (1.5, 1.6)
    for ranges, message in (
        ({"floor": (0, 1)}, "no input matches"),
        ({"*.eta": (1.6, 1.5)}, "low < high"),
        ({"*.eta": 1.5}, "low < high"),
    ):
        with pytest.raises(SceneCaptumError, match=message):
            SceneRenderer(scene, "all", spp=1, ranges=ranges)


def test_the_range_of_what_is_zero_is_one_unit(mi):
    """A lamp that is off, and a conductor without a material, whose index is 0."""
    view = mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1])
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": view,
            "film": {"type": "hdrfilm", "width": 16, "height": 16},
        },
        "sky": {"type": "constant"},
        "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 0.0},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)},
        "chrome": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "conductor"}},
    }
    lamp, eta = "lamp.intensity.value", "chrome.bsdf.eta.value"
    renderer = SceneRenderer(scene, [lamp, eta, "sky.radiance.value"], spp=64, max_depth=3)
    assert renderer.ranges[eta] == renderer.ranges[lamp] == (0.0, math.inf)
    assert not renderer.inputs[eta].any()
    metric = metrics.MeanLuminance()
    found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted(1))
    assert found.extents[eta].tolist() == [1]
    assert found.extents[lamp].tolist() == [1, 1, 1]
    assert found.effects()[eta] == pytest.approx(found[eta].item())
    assert found.info["unit_ranges"] == [lamp, eta]
    labels = "; ".join(found.labels[name] for name in (lamp, eta))
    assert f"~  off, or 0, in the scene: per unit of 1: {labels}" in str(found)
    on = {lamp: torch.ones(3)}
    rise = metric(renderer(on, seed=shifted(2), spp=1024)) - metric(renderer(seed=shifted(2), spp=1024))
    assert found.effects()[lamp] == pytest.approx(rise.item(), abs=6 * found.effects_error()[lamp])


def test_a_light_that_is_switched_off_keeps_the_range_of_the_scene(mi):
    """Its effect is what it would contribute, so it can be compared with that of the light as it is."""
    lamp = "light.emitter.radiance.value"
    renderer = SceneRenderer("cornell-box", [lamp], resolution=(8, 8), spp=16, max_depth=3)
    off = {lamp: torch.zeros(3)}
    on, without = (
        VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(values, seed=shifted(1))
        for values in (None, off)
    )
    assert torch.equal(without.extents[lamp], on.extents[lamp])
    assert without.effects()[lamp] == pytest.approx(on.effects()[lamp], rel=1e-3)
    assert without.info["unit_ranges"] == []
    assert range_lengths(renderer, off)[lamp] == renderer.inputs[lamp].max()
    assert without.lights_off() == {lamp}
    assert without.ranked_last() == frozenset(), "the metric is linear in the light"


def test_the_effect_of_a_light_that_is_off_has_a_note_under_a_metric_that_is_not_linear(mi):
    lamp, floor = "lamp.intensity.value", "floor.bsdf.reflectance.value"
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8},
        },
        "sky": {"type": "constant"},
        "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 20.0},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)},
    }
    renderer = SceneRenderer(scene, [lamp, floor], spp=16, max_depth=3)
    dark = {name: torch.zeros_like(value) for name, value in renderer.inputs.items()}

    def squared(image):
        return (1 + image.mean()).square()

    on, without, linear = (
        VanillaSceneGradient(renderer, metric).attribute(values, seed=shifted(1))
        for metric, values in ((squared, None), (squared, dark), (torch.mean, dark))
    )
    assert on.lights_off() == frozenset()
    assert without.lights_off() == linear.lights_off() == {lamp}, "a black reflectance is no light"
    (note,) = range_notes(without)
    assert note.startswith(f"{without.labels[lamp]}: off, and squared is not linear in the light")
    assert note.endswith("render the change")
    assert f"~ {note}" in " ".join(str(without).split())
    assert range_notes(on) == {}
    (note,) = range_notes(linear)
    assert (
        note == f"{linear.labels[lamp]}: off: the effect is that of switching on, to the value in the scene"
    )
    grouped = VanillaSceneGradient(renderer, squared).attribute(groups="object", seed=shifted(1))
    for result, is_noted in ((on, True), (grouped, True), (without, False), (linear, False)):
        text = " ".join(str(result).split())
        assert (
            "effects of lights are to first order: squared is not linear in the light" in text
        ) is is_noted


@pytest.mark.parametrize(("value", "covariance"), [(1.0, 1.0), (1.0, 4.0), (0.05, 1e-4)])
def test_the_note_on_lights_is_about_small_and_noisy_effects_too(value, covariance):
    found = attribution(lights_on=["lamp"])
    found = dataclasses.replace(
        found,
        attributions={**found, "lamp": value * found["lamp"]},
        covariance={**(found.covariance or {}), "lamp": covariance * 1e-4 * torch.eye(3)},
    )
    assert len(light_notes(found, found.ranking())) == 1
    assert light_notes(found, found.ranking(), scale="unit") == []
    others = [row for row in found.ranking() if row.name != "lamp"]
    assert light_notes(found, others) == [], "the lamp is not shown"


def test_a_light_that_is_off_ranks_after_the_others():
    """To first order, its effect may be far off, however large it is."""

    def order(scale=None, **info):
        return [row.name for row in attribution(**info).ranking(scale=scale)]

    assert order() == ["glass", "lamp", "wall"]
    assert order(lights_off=["lamp"]) == ["glass", "wall", "lamp"]
    assert attribution(lights_off=["lamp"]).ranking(2)[-1].name == "wall"
    assert order("unit", lights_off=["lamp"]) == order("unit"), (
        "per unit there is no effect of switching it on"
    )
    assert order(lights_off=["lamp", "glass", "wall"]) == order(), "nothing else could lead"


def test_a_group_leaves_out_a_light_that_is_off_unless_it_has_nothing_else():
    found = attribution()
    rows = {name: channel_totals(value)[None].double().repeat(8, 1) for name, value in found.items()}
    found = dataclasses.replace(found, replicates=rows)
    off = dataclasses.replace(found, info={**found.info, "lights_off": ["glass", "lamp"]})
    groups = {"both": ("wall", "glass"), "own": ("lamp",)}
    whole, summed = sum_groups(found, groups), sum_groups(off, groups)
    assert whole.effects() == pytest.approx({"both": 0.95, "own": 0.5})
    assert summed.effects() == pytest.approx({"both": 0.2, "own": 0.5})
    assert summed.ranked_last() == {"own"}
    assert [row.name for row in summed.ranking()] == ["both", "own"]
    last, left_out = range_notes(summed)
    assert last.startswith("own: off, ")
    assert "ranked last" in last
    assert left_out.startswith("glass: off, ")
    assert "left out of groups" in left_out
    assert "not shown" not in str(summed)


def sky(quantity: str) -> SceneAttribution:
    """A map of light and its scale, either of which has all of its light, and a wall."""
    values = {
        "sky.data": torch.full((2, 2, 3), 0.5),
        "sky.scale": torch.tensor(6.0),
        "wall": torch.tensor(0.2),
    }
    rows = {name: channel_totals(value)[None].double().repeat(8, 1) for name, value in values.items()}
    return SceneAttribution(
        attributions=values,
        standard_error=None,
        metric_value=6.0,
        replicates=rows,
        extents={name: torch.ones_like(channel_totals(value)) for name, value in values.items()},
        parameter_values={name: torch.ones_like(channel_totals(value)) for name, value in values.items()},
        info={"metric": "m", "method": "VanillaSceneGradient", "replicates": 8, "quantity": quantity},
    )


@pytest.mark.parametrize(
    ("quantity", "light"), [("gradient per unit", 6.0), ("effect of ablation", 6.0), ("contribution", 12.0)]
)
def test_a_group_counts_the_light_of_a_map_once(quantity, light):
    """Unless the map and its scale share it, as in contributions, which add up."""
    found = sky(quantity)
    groups = {"lights": ("sky.data", "sky.scale"), "map": ("sky.data",), "rest": ("wall",)}
    summed = sum_groups(found, groups)
    assert summed.effects() == pytest.approx({"lights": light, "map": 6.0, "rest": 0.2})
    assert summed.replicates["lights"].flatten().tolist() == pytest.approx(8 * [light])
    assert summed.info["groups"]["lights"] == ["sky.data", "sky.scale"]
    note = "sky.data: left out of groups with sky.scale, which is for all of its light"
    assert (note in range_notes(summed)) == (quantity != "contribution")
    assert "shown" not in str(summed)


@pytest.mark.parametrize("is_linear", [True, False])
@pytest.mark.parametrize("groups", [None, {"lights": ("lamp", "glass"), "rest": ("wall",)}])
def test_a_light_that_is_switched_off_takes_its_effect_with_it(is_linear, groups):
    """Dimmed to 1 % it takes nearly all of it, and its effect when it is off is that of switching it on."""
    on = attribution()
    rows = {name: channel_totals(value)[None].double().repeat(8, 1) for name, value in on.items()}
    on = dataclasses.replace(on, replicates=rows, info={**on.info, "linear_in_light": is_linear})
    off = dataclasses.replace(on, info={**on.info, "lights_off": ["lamp"]})
    if groups:
        on, off = (sum_groups(one, groups) for one in (on, off))
        assert any("lamp: off" in note for note in range_notes(off))
    lamp = "lights" if groups else "lamp"
    difference, back = on - off, off - on
    assert difference.effects()[lamp] == pytest.approx(0.5)
    assert back.effects()[lamp] == pytest.approx(-0.5)
    assert {name for name, effect in difference.effects().items() if effect} == {lamp}
    assert difference.ranking()[0].name == lamp
    assert range_notes(difference) == {}
    assert (off - off).effects()[lamp] == 0


def test_the_effect_of_a_lamp_that_is_switched_off_is_the_rendered_change(mi):
    lamp = "light.emitter.radiance.value"
    renderer = SceneRenderer(
        "cornell-box", ["reflectance", "emitters"], resolution=(8, 8), spp=64, max_depth=3
    )
    method, metric = VanillaSceneGradient(renderer, metrics.MeanLuminance()), metrics.MeanLuminance()
    dark = {**renderer.inputs, lamp: torch.zeros(3)}
    groups = {"lights": [lamp], "walls": "*.reflectance.*"}
    for grouping in (None, groups):
        on, off = (method.attribute(one, seed=shifted(1), groups=grouping) for one in (None, dark))
        difference, name = on - off, "lights" if grouping else lamp
        assert difference.effects()[name] == pytest.approx(
            metric(renderer(seed=shifted(5), spp=512)).item(), rel=0.1
        )
        assert difference.effects_error()[name] == pytest.approx(on.effects_error()[name], rel=0.02)
        assert range_notes(difference) == {}


def test_groups_add_effects_not_gradients_of_different_units():
    renderer = ToyRenderer()
    metric = torch.mean
    single = VanillaSceneGradient(renderer, metric).attribute(seed=1)
    grouped = VanillaSceneGradient(renderer, metric).attribute(seed=1, groups={"all": list(single)})
    assert grouped["all"].item() == pytest.approx(sum(single.effects().values()), rel=1e-5)


def test_a_saved_result_keeps_its_ranges(tmp_path):
    one = attribution()
    one.save(tmp_path / "one.npz")
    assert SceneAttribution.load(tmp_path / "one.npz").effects() == pytest.approx(one.effects())


def test_arithmetic_carries_errors():
    one = attribution()
    double, total, half = 2 * one, one + one, one / 2
    assert double.effects() == pytest.approx({name: 2 * effect for name, effect in one.effects().items()})
    assert total.effects() == pytest.approx(double.effects())
    assert half.metric_value == 0.5
    assert half.effects_error()["glass"] == pytest.approx(one.effects_error()["glass"] / 2)
    # Without common random numbers the errors of a sum are those of independent results.
    assert total.effects_error()["glass"] == pytest.approx(math.sqrt(2) * one.effects_error()["glass"])


def test_a_difference_is_that_of_effects_over_the_range_of_each_result():
    """A lamp at half its power has half the effect, where its gradient is the same."""
    renderer = ToyRenderer()
    half = {"x": renderer.inputs["x"] / 2}
    on, dimmed = (
        VanillaSceneGradient(renderer, torch.mean).attribute(values, seed=shifted(1))
        for values in (None, half)
    )
    on, dimmed = (
        dataclasses.replace(one, extents={"x": value["x"]})
        for one, value in ((on, renderer.inputs), (dimmed, half))
    )
    effects = on.effects()["x"], dimmed.effects()["x"]
    assert effects[1] == pytest.approx(effects[0] / 2)
    difference = on - dimmed
    assert difference.effects()["x"] == pytest.approx(effects[0] - effects[1])
    assert difference.effects_error()["x"] == pytest.approx(on.effects_error()["x"] / 2, rel=1e-3)
    assert (difference + dimmed).effects()["x"] == pytest.approx(effects[0])
    assert "x: over the range in each result, not per unit" in " ".join(str(difference).split())
    assert "over the range in each result" not in str(on - on)
    torch.testing.assert_close((on - on / 2)["x"], on["x"] / 2)


def test_the_name_of_an_object_suggests_its_parameters():
    with pytest.raises(KeyError, match=r"Did you mean 'floor\.reflectance\.value'"):
        SceneAttribution({"floor.reflectance.value": torch.ones(3)}, None, 1.0)["floor"]
    with pytest.raises(SceneCaptumError, match="indexed by a parameter's name"):
        attribution()[0]


def test_sums_of_sampled_shapley_values_have_the_largest_error_that_they_can():
    class Brightness(ToyRenderer):
        def __init__(self) -> None:
            super().__init__()
            self.inputs = {name: torch.full((3,), 0.5) for name in ("floor", "wall", "ceiling", "door")}

        def __call__(self, inputs, *, seed, spp):
            generator = torch.Generator().manual_seed(seed)
            light = math.prod(value.mean() for value in inputs.values())
            return light * (1 + 0.1 * torch.randn((4, 4, 3), generator=generator))

    renderer = Brightness()
    method = ShapleyValueScene(renderer, lambda image: image.mean())
    runs = [method.attribute(baselines=0.1, n_samples=4, seed=seed) for seed in seeds(12)]
    assert not runs[0].replicates
    groups = {"room": ("floor", "wall", "ceiling"), "door": ("door",)}
    sums = [sum_groups(one, groups) for one in runs]
    for one, summed in zip(runs, sums, strict=True):
        assert summed["room"] == pytest.approx(sum(one.effects()[name] for name in groups["room"]), rel=1e-5)
        errors = one.effects_error()
        assert summed.effects_error()["room"] == pytest.approx(sum(errors[name] for name in groups["room"]))
        assert summed.effects_error()["door"] == pytest.approx(errors["door"])
    spread = torch.stack([one["room"] for one in sums]).std()
    assert spread < 1.5 * max(one.effects_error()["room"] for one in sums)


def test_the_mean_of_an_environment_map_is_that_of_its_own_texels(mi):
    """Mitsuba stores a copy of the first column at the end, and of the last at the beginning."""
    texels = np.full((4, 8, 3), 0.5, np.float32)
    texels[:, 0] = 8  # at the seam
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)},
    }
    renderer = SceneRenderer(scene, "*.data", spp=2, max_depth=2)
    (name,) = renderer.inputs
    assert renderer.inputs[name].shape == (4, 10, 3)
    found = VanillaSceneGradient(renderer, torch.mean).attribute()
    mean = pytest.approx([0.5 + 7.5 / 8] * 3)
    assert found.extents[name].tolist() == mean
    assert found.parameter_values[name].tolist() == mean
    removed = FeatureAblationScene(renderer, torch.mean).attribute(replicates=2)
    assert removed.parameter_values[name].tolist() == mean
