"""Attribution by plain gradients: error bars, the result object, interruption and refusals."""

from __future__ import annotations

import dataclasses
import math
import operator
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from refusals import message
from seeds import seeds, shifted
from toy import ReplayingToyRenderer, ToyRenderer, log_mean

import scenecaptum
from scenecaptum import (
    FeatureAblationScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    SceneAttribution,
    SceneCaptumError,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.attr import AttributionInterrupted
from scenecaptum.estimation import channel_totals
from scenecaptum.explanation import explain
from scenecaptum.validation import dgsm, sensitivity_n
from scenecaptum.visualization import metric_line, metric_name, table_text


def glare_like(image: torch.Tensor) -> torch.Tensor:
    return torch.sigmoid((image - 0.9) / 0.1).mean()


METRICS = {"linear": torch.mean, "log": log_mean, "sigmoid": glare_like}
REPEATS = 100


def assert_bars_are_honest(spread: torch.Tensor, bars: torch.Tensor) -> None:
    """The standard deviation of n repeats has a relative error of 1/√(2n); four of these are allowed."""
    ratio, width = spread / bars.square().mean(0).sqrt(), 4 / math.sqrt(2 * REPEATS)
    assert ((ratio - 1).abs() < width).all(), f"spread over bar {ratio.tolist()}, allowed 1 ± {width:.2f}"


def exact_gradient(renderer: ToyRenderer, metric) -> torch.Tensor:
    x = renderer.inputs["x"].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(metric(renderer.exact({"x": x})), x)
    return gradient


# ------------------------------------------------------------------------------------------ the error bars


@pytest.mark.parametrize(
    ("metric", "renderer_class"),
    [
        pytest.param(torch.mean, ToyRenderer, id="linear-ToyRenderer"),
        pytest.param(torch.mean, ReplayingToyRenderer, id="linear-ReplayingToyRenderer"),
        pytest.param(log_mean, ReplayingToyRenderer, id="log-ReplayingToyRenderer"),
        pytest.param(glare_like, ToyRenderer, id="sigmoid-ToyRenderer"),
        pytest.param(log_mean, ToyRenderer, id="log-ToyRenderer", marks=pytest.mark.long),
        pytest.param(
            glare_like, ReplayingToyRenderer, id="sigmoid-ReplayingToyRenderer", marks=pytest.mark.long
        ),
    ],
)
def test_standard_error_is_the_spread_over_repeats_and_the_mean_is_right(renderer_class, metric):
    # The jackknife is of first order: the noise of an image must be far smaller than the sigmoid's width.
    renderer = renderer_class(noise=0.1 if metric is glare_like else 0.3)
    repeats = [VanillaSceneGradient(renderer, metric).attribute(seed=seed) for seed in seeds(REPEATS)]
    values = torch.stack([one["x"] for one in repeats])
    assert_bars_are_honest(values.std(0), torch.stack([one.standard_error["x"] for one in repeats]))

    error = values.std(0) / math.sqrt(REPEATS)
    z = (values.mean(0) - exact_gradient(renderer, metric)) / error
    assert (z.abs() < allowed(REPEATS, 3)).all(), f"bias in standard errors {z.tolist()}"


def test_error_bars_include_the_noise_of_the_image():
    """The gradient of the log of a noisy image: half of its error comes from the image, which adjoints of
    leave-one-out means alone would not show."""
    renderer = ReplayingToyRenderer(noise=0.3)
    repeats = [VanillaSceneGradient(renderer, log_mean).attribute(seed=seed) for seed in seeds(REPEATS)]
    truth = exact_gradient(renderer, log_mean)
    covered = torch.stack(
        [(lo <= truth) & (truth <= hi) for lo, hi in (one.interval(0.95)["x"] for one in repeats)]
    )
    share = covered.float().mean().item()
    # The three channels are correlated, so their number does not make the share more accurate.
    width = 4 * math.sqrt(0.95 * 0.05 / REPEATS)
    assert abs(share - 0.95) < width, f"95 % intervals cover {share:.1%}, allowed 95 ± {width:.1%}"


def test_bias_of_a_linear_metric_is_zero():
    attribution = VanillaSceneGradient(ToyRenderer(), torch.mean).attribute()
    assert not attribution.bias["x"].any()


def test_one_replicate_has_no_error_bars():
    attribution = VanillaSceneGradient(ToyRenderer(), log_mean).attribute(replicates=1)
    assert attribution.standard_error is None
    assert attribution.saliency_error() is None
    assert attribution.metric_standard_error is None
    assert attribution.info["replicates"] == 1
    with pytest.raises(SceneCaptumError, match="at least two replicates"):
        attribution.interval()


def test_a_renderer_that_ignores_the_seed_gets_errors_of_zero():
    renderer = ToyRenderer(noise=0.0)
    attribution = VanillaSceneGradient(renderer, log_mean).attribute()
    torch.testing.assert_close(attribution["x"], exact_gradient(renderer, log_mean))
    assert attribution.standard_error["x"].max() < 1e-6


# ------------------------------------------------------------------------------------------ the metric


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        (lambda image: image.mean().item(), "must return a torch tensor, not float"),
        (lambda image: image.mean((0, 1)), r"must return a scalar; it returned shape \(3,\)"),
        (lambda image: image.detach().mean(), "does not depend on the image"),
        (lambda image: torch.tensor(1.0, requires_grad=True) * 2, "does not depend on the image"),
        (lambda image: (image > 0.5).sum(), "does not depend on the image"),
        (lambda image: (image * float("nan")).mean(), "is nan on the rendered image"),
        (
            lambda image: (image - image).clamp_min(0).sqrt().sum(),
            "derivative that is not finite on 16 of 16 pixels",
        ),
    ],
)
def test_a_metric_that_cannot_be_attributed_is_refused_with_the_reason(metric, message):
    with pytest.raises(SceneCaptumError, match=message):
        VanillaSceneGradient(ToyRenderer(), metric).attribute()


def test_a_target_that_is_no_index_is_refused():
    renderer = ToyRenderer()
    for target in ("cube", 0.5, ("cube",), torch.tensor(0.0), torch.tensor([0, 1]), torch.tensor(True)):
        with pytest.raises(SceneCaptumError, match="must be the index of an element"):
            VanillaSceneGradient(renderer, torch.mean).attribute(renderer.inputs, target=target)


def test_a_target_is_a_class_by_its_name(torchvision: Any) -> None:
    renderer = ToyRenderer(noise=0.0)
    categories = torchvision.models.ResNet18_Weights.DEFAULT.meta["categories"]
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 1000))
    logits = metrics.ClassLogit(network, transform=torch.nn.Identity(), classes=categories)
    named, indexed = (VanillaSceneGradient(renderer, logits).attribute(target=t) for t in ("desk", 526))
    assert named.info["measure"]["name"] == "logit of desk"
    torch.testing.assert_close(named["x"], indexed["x"], rtol=0, atol=0)
    both = VanillaSceneGradient(renderer, logits).attribute(target=["desk", "table lamp"])
    assert [one.info["measure"]["name"] for one in both] == ["logit of desk", "logit of table lamp"]
    with pytest.raises(SceneCaptumError, match=r"no class called 'lamp'.*Did you mean 'table lamp'"):
        VanillaSceneGradient(renderer, logits).attribute(target="lamp")


@pytest.mark.parametrize("classes", [("red", "green", "blue"), ()])
def test_a_negative_target_is_the_class_that_it_counts_to(classes):
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())
    logits = metrics.ClassLogit(network, transform=torch.nn.Identity(), classes=classes)
    method = VanillaSceneGradient(ToyRenderer(noise=0.0), logits)
    same, last = (method.attribute(target=target) for target in (-1, 2))
    assert torch.equal(last["x"], same["x"])
    assert last.info["verdict"] == same.info["verdict"]
    name = "blue" if classes else "class 2"
    assert same.info["measure"]["name"] == f"logit of {name}"
    assert same.info["metric"] == last.info["metric"] == f"ClassLogit[{'blue' if classes else 2}]"
    if not classes:
        return
    for beyond in (3, -4):
        with pytest.raises(
            SceneCaptumError, match=rf"target={beyond} does not .* classes: red, green, blue\.$"
        ):
            method.attribute(target=beyond)


@pytest.mark.parametrize("kind", [metrics.ClassLogit, metrics.ClassProbability])
def test_methods_and_metrics_of_metrics_name_the_class_of_a_negative_target(kind):
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten())
    metric = metrics.Smoothed(kind(network, transform=torch.nn.Identity()), n=2)
    info = FeatureAblationScene(ToyRenderer(), metric).attribute(target=-1).info
    assert info["metric"] == f"smoothed {kind.__name__}[2]"
    assert info["measure"]["name"].endswith(" of class 2")
    of_cameras = metrics.PerCamera(kind(network, transform=torch.nn.Identity()))
    of_cameras(torch.rand(2, 4, 4, 3))
    assert of_cameras.measure_of((0, -1)).name.endswith(" of class 2 of camera 0")


def test_target_chooses_an_element_of_a_vector():
    renderer = ToyRenderer(noise=0.0)

    def per_channel(image: torch.Tensor) -> torch.Tensor:
        return image.mean((0, 1))

    attribution = VanillaSceneGradient(renderer, per_channel).attribute(target=1)
    for target in (torch.tensor(1), torch.tensor([1])):
        same = VanillaSceneGradient(renderer, per_channel).attribute(target=target)
        assert same.info["metric"] == "per_channel[1]"
        assert torch.equal(same["x"], attribution["x"])
    torch.testing.assert_close(attribution["x"], exact_gradient(renderer, lambda image: image[..., 1].mean()))
    with pytest.raises(SceneCaptumError, match=r"target=3 does not index .* shape \(3,\)\.$"):
        VanillaSceneGradient(renderer, per_channel).attribute(target=3)
    with pytest.raises(SceneCaptumError, match=r"a batch of one: use target=\(0, 1\)"):
        VanillaSceneGradient(renderer, lambda image: per_channel(image)[None]).attribute(target=1)


def test_linearity_in_the_metric():
    renderer = ReplayingToyRenderer()
    one = VanillaSceneGradient(renderer, torch.mean).attribute(seed=shifted(3))
    thrice = VanillaSceneGradient(renderer, lambda image: 3 * image.mean()).attribute(seed=shifted(3))
    torch.testing.assert_close(thrice["x"], 3 * one["x"])


def test_without_inputs_there_is_nothing_to_attribute_to():
    def renderer(inputs, *, seed, spp):
        return inputs["x"].expand(2, 2, 3)

    with pytest.raises(SceneCaptumError, match="give inputs="):
        VanillaSceneGradient(renderer, torch.mean).attribute()
    attribution = VanillaSceneGradient(renderer, torch.mean).attribute({"x": torch.ones(())})
    assert attribution["x"] == pytest.approx(1)


# ------------------------------------------------------------------------------------------ the result


@pytest.fixture(scope="module")
def cornell_attribution(cornell):
    return VanillaSceneGradient(cornell, metrics.MeanLuminance()).attribute(seed=shifted(5))


def test_attribution_agrees_with_finite_differences_of_many_seeds(cornell, cornell_attribution):
    """The attribution has independent seeds: it agrees with the expected derivative within its error bars."""
    name = "light.emitter.radiance.value"
    value, step = cornell.inputs[name], torch.tensor([1.0, 0.0, 0.0])
    metric = metrics.MeanLuminance()

    def difference(seed: int) -> float:
        with torch.no_grad():
            up, down = (metric(cornell({name: value + sign * step}, seed=seed)) for sign in (1, -1))
        return ((up - down) / 2).item()

    differences = torch.tensor([difference(seed) for seed in seeds(8)])
    error = math.hypot(differences.std() / math.sqrt(8), cornell_attribution.standard_error[name][0])
    z = (cornell_attribution[name][0] - differences.mean()).item() / error
    assert abs(z) < allowed(8), f"z = {z:.2f}"


def test_light_attributions_add_up_to_the_metric(cornell, cornell_attribution):
    """Radiance enters linearly: Σ L ∂M/∂L = M."""
    name = "light.emitter.radiance.value"
    total = (cornell.inputs[name] * cornell_attribution[name]).sum().item()
    error = math.hypot(
        cornell_attribution.metric_standard_error,
        (cornell.inputs[name] * cornell_attribution.standard_error[name]).norm(),
    )
    difference = total - cornell_attribution.metric_value
    assert abs(difference) < allowed(8) * error, f"differs by {difference:.2e}, standard error {error:.1e}"


def test_info_records_how_it_was_computed(cornell_attribution):
    info = cornell_attribution.info
    assert info["method"] == "VanillaSceneGradient"
    assert info["metric"] == "MeanLuminance"
    assert (info["seed"], info["spp"], info["replicates"]) == (shifted(5), 16, 8)
    assert info["integrator"] == "scenecaptum_replay"
    assert {"scenecaptum", "torch", "mitsuba", "drjit", "python"} <= info["versions"].keys()


def test_ranking_is_by_descending_effect(cornell_attribution):
    rows = cornell_attribution.ranking()
    saliencies = [row.saliency for row in rows]
    assert saliencies == sorted(saliencies, reverse=True)
    assert [row.rank for row in rows] == list(range(1, len(rows) + 1))
    assert len(cornell_attribution.ranking(top=3)) == 3
    for top in (0, -1, 2.5):
        for use in (cornell_attribution.ranking, lambda top: table_text(cornell_attribution, top)):
            with pytest.raises(
                SceneCaptumError, match=f"top must be a whole number of at least 1, not {top}"
            ):
                use(top)
    first = rows[0]
    assert first.saliency == pytest.approx(abs(cornell_attribution.effects()[first.name]))
    norms = [row.saliency for row in cornell_attribution.ranking(scale="unit")]
    assert norms == sorted(norms, reverse=True)
    assert norms[0] == pytest.approx(max(value.norm().item() for value in cornell_attribution.values()))


def test_texture_ranks_like_its_colour():
    """A texture's saliency is that of its texel sum, so that a constant texture ranks like the colour it shows."""
    per_texel = torch.full((4, 5, 3), 0.1)
    torch.testing.assert_close(channel_totals(per_texel), torch.full((3,), 2.0))
    torch.testing.assert_close(channel_totals(torch.tensor([3.0, 4.0])).norm(), torch.tensor(5.0))
    assert channel_totals(torch.tensor(2.0)).shape == (1,)


def test_saliency_error_follows_the_covariance_of_the_channels():
    repeats = [
        VanillaSceneGradient(ToyRenderer(), torch.mean).attribute(seed=seed) for seed in seeds(REPEATS)
    ]
    norms = torch.tensor([one.saliency()["x"] for one in repeats])
    assert_bars_are_honest(norms.std(), torch.tensor([one.saliency_error()["x"] for one in repeats]))


def test_unknown_name_suggests_a_similar_one(cornell_attribution):
    with pytest.raises(SceneCaptumError, match=r"Did you mean 'light\.emitter\.radiance\.value'"):
        cornell_attribution["light.emitter.radiance"]


def test_dataframe_has_a_row_for_each_parameter(cornell_attribution):
    pytest.importorskip("pandas")
    frame = cornell_attribution.to_dataframe()
    assert list(frame["name"]) == [row.name for row in cornell_attribution.ranking()]
    assert (frame["saliency_error"] > 0).all()


def test_saved_result_loads_with_everything_and_still_draws(cornell_attribution, tmp_path):
    cornell_attribution.save(tmp_path / "result.npz")
    loaded = SceneAttribution.load(tmp_path / "result.npz")
    assert list(loaded) == list(cornell_attribution)
    for name in loaded:
        torch.testing.assert_close(loaded[name], cornell_attribution[name], rtol=0, atol=0)
        torch.testing.assert_close(loaded.standard_error[name], cornell_attribution.standard_error[name])
    assert loaded.ranking() == cornell_attribution.ranking()
    assert loaded.info == cornell_attribution.info
    assert loaded.metric_value == cornell_attribution.metric_value
    assert torch.equal(loaded.metric_error_parts, cornell_attribution.metric_error_parts)
    torch.testing.assert_close(loaded.heatmap(), cornell_attribution.heatmap())
    assert str(loaded) == str(cornell_attribution)


def test_a_result_without_error_bars_survives_saving(tmp_path):
    attribution = VanillaSceneGradient(ToyRenderer(), torch.mean).attribute(replicates=1)
    attribution.save(tmp_path / "result.npz")
    loaded = SceneAttribution.load(tmp_path / "result.npz")
    assert loaded.standard_error is None
    assert loaded.bias is None


@pytest.mark.parametrize("damage", ["truncated", "pickle", "text", "foreign", "missing"])
def test_a_damaged_file_is_refused(damage, cornell_attribution, tmp_path):
    path = tmp_path / "result.npz"
    match damage:
        case "truncated":
            cornell_attribution.save(path)
            path.write_bytes(path.read_bytes()[:-400])
        case "pickle":
            np.savez(path, header=np.array([{"format": "evil"}], dtype=object))
        case "text":
            path.write_text("not an archive")
        case "foreign":
            np.savez(path, header='{"format": "something else"}')
    said = message(lambda: SceneAttribution.load(path))
    assert "result.npz" in said
    assert "pickle" not in said, "NumPy's advice, which is unsafe and does not help"


def test_failed_saving_leaves_no_file(tmp_path, cornell_attribution):
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneCaptumError, match="cannot be written"):
        cornell_attribution.save(tmp_path / "file" / "result.npz")


def test_difference_of_a_result_with_itself_is_exactly_zero(cornell_attribution):
    zero = cornell_attribution - cornell_attribution
    assert all(not zero[name].any() and not zero.standard_error[name].any() for name in zero)


def made(metric: Any = None, inputs: Any = None, **info: Any) -> SceneAttribution:
    attribution = VanillaSceneGradient(ToyRenderer(), metric or metrics.MeanLuminance()).attribute(
        inputs and {"x": torch.tensor(inputs)}, seed=shifted()
    )
    return dataclasses.replace(attribution, info={**attribution.info, **info})


def test_a_difference_names_both_of_its_metrics_and_keeps_their_common_unit():
    difference = made() - made(metrics.LuminancePercentile(50))
    assert metric_line(difference).startswith("mean luminance − 50th percentile of luminance = ")
    assert metric_line(difference).endswith(" cd/m²")


def test_a_difference_of_two_renderers_names_the_class_of_ones_own() -> None:
    ours, theirs = made(), made(scene="the scene dict", integrator="prb")
    assert metric_name(ours - theirs) == "mean luminance (ToyRenderer − the scene dict)"
    info = {key: value for key, value in ours.info.items() if key != "renderer"}
    older = dataclasses.replace(ours, info=info)
    assert metric_name(older - theirs) == "mean luminance (first − second)"


@pytest.mark.parametrize(
    ("a", "b", "name"),
    [
        ({"integrator": "ours"}, {"integrator": "prb"}, "(ours − prb)"),
        ({"scene": "night", "seed": 0}, {"scene": "day", "seed": 1}, "(night − day)"),
        ({"seed": 0}, {"seed": 1}, "(seed 0 − 1)"),
        ({"inputs": [0.8] * 3}, {"inputs": [0.4] * 3}, "(x 0.8 − 0.4)"),
        ({"inputs": [0.8, 0.1, 0.1]}, {}, "(x, first − second)"),
        ({}, {}, "(first − second)"),
    ],
)
def test_a_difference_of_one_metric_says_what_its_sides_differ_by(a, b, name):
    assert metric_line(made(**a) - made(**b)).startswith(f"mean luminance {name} = ")
    is_repeated = a.keys() | b.keys() <= {"seed"}
    total = "2 × mean luminance" if is_repeated else f"mean luminance {name.replace('−', '+')}"
    assert metric_line(made(**a) + made(**b)).startswith(f"{total} = ")
    assert metric_line(made(log_mean, **a) - made(log_mean, **b)).startswith(f"log_mean {name} = ")


@pytest.mark.parametrize("result", [lambda a, b: a - b, lambda a, b: a + b, lambda a, b: (a - b) / 2])
def test_values_in_different_units_are_not_subtracted_to_a_number(result):
    combined = result(made(), made(metrics.MeanLuminance(efficacy=1)))
    assert "of different units (cd/m² and W/(m² sr))" in metric_line(combined)
    assert "=" not in metric_line(combined)


def test_errors_of_a_difference_use_shared_noise_where_there_is_some():
    """Two metrics on the same samples: the error bar of their difference is its actual spread."""
    renderer = ReplayingToyRenderer()

    def difference(seed: int) -> SceneAttribution:
        a = VanillaSceneGradient(renderer, torch.mean).attribute(seed=seed)
        return a - VanillaSceneGradient(renderer, lambda image: image[:2].mean()).attribute(seed=seed)

    repeats = [difference(seed) for seed in seeds(REPEATS)]
    spread = torch.stack([one["x"] for one in repeats]).std(0)
    assert_bars_are_honest(spread, torch.stack([one.standard_error["x"] for one in repeats]))


def smoothed(metric: Any) -> Any:
    return metrics.Smoothed(metric, sigma=0.3, n=32)


@pytest.mark.parametrize("sign", [pytest.param(1, marks=pytest.mark.long), -1])
def test_the_error_of_the_value_of_a_combination_uses_shared_noise(sign):
    """The error bar of the sum or difference of two metrics of the same pictures is its actual spread."""
    renderer = ReplayingToyRenderer()

    def combined(seed: int) -> SceneAttribution:
        a = VanillaSceneGradient(renderer, log_mean).attribute(seed=seed)
        b = VanillaSceneGradient(renderer, lambda image: image[:2].mean()).attribute(seed=seed)
        return a + sign * b

    repeats = [combined(seed) for seed in seeds(REPEATS)]
    spread = torch.tensor([one.metric_value for one in repeats]).std(0)
    assert_bars_are_honest(spread, torch.tensor([one.metric_standard_error for one in repeats]))


@pytest.mark.parametrize("metric", [torch.mean, log_mean, smoothed(log_mean)])
def test_the_error_of_a_sum_is_that_of_the_same_multiple(metric):
    one = VanillaSceneGradient(ReplayingToyRenderer(), metric).attribute(seed=shifted())
    assert one.metric_error_parts.norm().item() == pytest.approx(one.metric_standard_error)
    assert (one + one).metric_interval() == pytest.approx((2 * one).metric_interval())
    assert (one - one).metric_standard_error == 0
    other = VanillaSceneGradient(ReplayingToyRenderer(), metric).attribute(seed=shifted(1))
    added = math.hypot(one.metric_standard_error, other.metric_standard_error)
    assert (one + other).metric_standard_error == pytest.approx(added)


def test_a_smoothed_metric_and_a_plain_one_share_the_noise_of_the_picture():
    a, b = (
        VanillaSceneGradient(ReplayingToyRenderer(), metric).attribute(seed=shifted(), picture_spp=64)
        for metric in (smoothed(log_mean), log_mean)
    )
    assert (a - b).metric_standard_error < math.hypot(a.metric_standard_error, b.metric_standard_error)


def test_errors_of_unrelated_results_add_in_squares():
    a = VanillaSceneGradient(ToyRenderer(), torch.mean).attribute(seed=shifted())
    b = VanillaSceneGradient(ToyRenderer(), torch.mean).attribute(seed=shifted(1))
    expected = torch.hypot(a.standard_error["x"], b.standard_error["x"])
    torch.testing.assert_close((a - b).standard_error["x"], expected)
    assert (a - b).saliency_error()["x"] > 0


def test_attributions_have_a_negative_and_a_sum():
    one, other = made(), made(torch.mean)
    assert torch.equal((-one)["x"], -one["x"])
    assert torch.equal((-one).standard_error["x"], one.standard_error["x"])
    assert (-one).metric_value == -one.metric_value
    total = sum([one, other])
    assert torch.equal(total["x"], (one + other)["x"])
    assert total.info["metric"] == (one + other).info["metric"]
    for impossible in (lambda: 1 + one, lambda: "0" + one):
        with pytest.raises(TypeError):
            impossible()


def named(metric: str, measure: str | None, **info: Any) -> SceneAttribution:
    info |= {"metric": metric, "measure": measure and {"name": measure}}
    return SceneAttribution({"x": torch.ones(())}, None, 1.0, None, info=info)


def night(scene: str = "night") -> SceneAttribution:
    return named("a", "a", scene=scene)


def test_a_difference_is_called_by_what_its_sides_measure():
    cube, sphere = named("ClassLogit[cube]", "logit of cube"), named("ClassLogit[sphere]", "logit of sphere")
    assert metric_name(cube - sphere) == "logit of cube − logit of sphere"
    assert metric_name(cube + sphere) == "logit of cube + logit of sphere"
    assert metric_name(2 * cube) == "2 × logit of cube"
    assert metric_name(cube - named("own", None)) == "logit of cube − own"
    assert metric_name(cube - cube) == "logit of cube (first − second)"


@pytest.mark.parametrize(
    ("combined", "name"),
    [
        (lambda a, b, c, _: a - (b + c), "a − b − c"),
        (lambda a, b, c, _: a - (b - c), "a − b + c"),
        (lambda a, b, c, _: (a - b) - c, "a − b − c"),
        (lambda a, b, *_: (a + b) / 2, "0.5 × (a + b)"),
        (lambda a, b, *_: 2 * (a - b), "2 × (a − b)"),
        (lambda a, b, *_: a - 2 * b, "a − 2 × b"),
        (lambda a, b, *_: a + -b, "a − b"),
        (lambda a, b, *_: -a + b, "−a + b"),
        (lambda a, b, *_: -(a + b), "−(a + b)"),
        (lambda a, b, *_: -2 * (a + b), "−2 × (a + b)"),
        (lambda a, b, *_: 0 * (a - b), "0 × a + 0 × b"),
        (lambda a, *_: -a, "−a"),
        (lambda a, *_: -1 * -a, "a"),
        (lambda a, *_: a + a, "2 × a"),
        (lambda a, b, *_: (a + b) - (a + b), "(a + b) (first − second)"),
        (lambda a, b, c, seeds: sum(seeds), "4 × a"),
        (lambda a, b, c, seeds: sum(seeds) / 4, "a (mean of 4)"),
        (lambda a, b, c, seeds: (seeds[0] + seeds[1]) / 2 - b, "a (mean of 2) − b"),
        (lambda a, b, c, seeds: (seeds[0] + b) + (seeds[1] + c), "2 × a + b + c"),
        (lambda *_: (night() + night(scene="day")) / 2, "0.5 × a (night + day)"),
    ],
)
def test_a_combination_has_the_name_of_its_value(combined, name):
    repeats = [named("a", "a", seed=seed) for seed in range(4)]
    result = combined(repeats[0], named("b", "b", seed=0), named("c", None, seed=0), repeats)
    assert metric_name(result) == name


def test_a_mean_over_seeds_keeps_its_unit():
    assert metric_line((made(seed=0) + made(seed=1)) / 2).startswith("mean luminance (mean of 2) = ")
    assert metric_line((made(seed=0) + made(seed=1)) / 2).endswith(" cd/m²")


def test_results_for_different_parameters_cannot_be_subtracted(cornell_attribution):
    other = VanillaSceneGradient(ToyRenderer(), torch.mean).attribute()
    with pytest.raises(SceneCaptumError, match="same parameters"):
        cornell_attribution - other


@pytest.mark.parametrize(
    ("method", "quantity"),
    [
        (IntegratedGradientsScene, "contribution"),
        (InputXGradientScene, "input × gradient"),
        (FeatureAblationScene, "effect of ablation"),
    ],
)
@pytest.mark.parametrize("combined", [operator.sub, operator.add, lambda a, b: b - a])
def test_results_of_different_quantities_cannot_be_subtracted(method, quantity, combined):
    renderer = ToyRenderer()
    gradient, other = (one(renderer, torch.mean).attribute() for one in (VanillaSceneGradient, method))
    said = message(lambda: combined(gradient, other))
    assert f"{quantity} ({method.__name__})" in said
    assert "gradient per unit (VanillaSceneGradient)" in said
    assert "results of the same method, or the effects() of each side by side" in said


def test_mean_gradients_can_be_subtracted_from_gradients():
    renderer = ToyRenderer()
    renderer.bounds = {"x": (0.0, 1.0)}
    gradient, mean = (
        one(renderer, torch.mean).attribute() for one in (VanillaSceneGradient, SmoothGradScene)
    )
    torch.testing.assert_close((gradient - mean)["x"], gradient["x"] - mean["x"])


# ------------------------------------------------------------------------------------------ interruption


class InterruptedRenderer(ToyRenderer):
    """Raises KeyboardInterrupt during the backward passes."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.left = after

    def __call__(self, inputs, *, seed, spp):
        image = super().__call__(inputs, seed=seed, spp=spp)
        if image.requires_grad:
            image.register_hook(self.count)
        return image

    def count(self, gradient: torch.Tensor) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


def test_interruption_carries_the_result_of_the_finished_replicates():
    with pytest.raises(AttributionInterrupted) as caught:
        VanillaSceneGradient(InterruptedRenderer(after=3), torch.mean).attribute()
    partial = caught.value.partial
    assert partial.info["replicates"] == 3
    assert partial.info["interrupted"]
    assert partial.standard_error["x"].min() > 0


def test_interruption_before_the_first_backward_pass_has_no_result():
    with pytest.raises(KeyboardInterrupt) as caught:
        VanillaSceneGradient(InterruptedRenderer(after=0), torch.mean).attribute()
    assert not isinstance(caught.value, AttributionInterrupted)


# ----------------------------------------------------------------------------------- wrong arguments


def test_a_renderer_and_a_metric_in_the_wrong_order_are_refused_at_construction() -> None:
    with pytest.raises(SceneCaptumError, match="swapped"):
        VanillaSceneGradient(metrics.MeanLuminance(), ToyRenderer())
    with pytest.raises(SceneCaptumError, match="metric must be callable, not int"):
        VanillaSceneGradient(ToyRenderer(), 3)


@pytest.mark.parametrize("metric", [metrics.MeanLuminance, torch.nn.Identity])
def test_a_class_in_place_of_a_metric_is_refused(metric: type) -> None:
    """A class can be called, and constructs a metric then; its properties are not those of a metric."""
    expected = rf"metric is the class {metric.__name__}: write {metric.__name__}\(\)"
    for use in (
        lambda: VanillaSceneGradient(ToyRenderer(), metric),
        lambda: explain(ToyRenderer(), metric),
        lambda: sensitivity_n(ToyRenderer(), metric),
        lambda: dgsm(ToyRenderer(), metric, points=4),
        lambda: metrics.Smoothed(metric),
    ):
        with pytest.raises(SceneCaptumError, match=expected):
            use()
    with pytest.raises(SceneCaptumError, match=r"renderer is the class ToyRenderer: write ToyRenderer\(\)"):
        VanillaSceneGradient(ToyRenderer, torch.mean)


@pytest.mark.parametrize("inputs", [torch.ones(3), (torch.ones(3),), 3])
def test_inputs_that_are_not_a_mapping_are_refused(inputs: object) -> None:
    method = VanillaSceneGradient(ToyRenderer(), torch.mean)
    with pytest.raises(
        SceneCaptumError, match=f"a dict from parameter name to tensor.*{type(inputs).__name__}"
    ):
        method.attribute(inputs)


def test_a_result_has_the_inputs_that_are_given(cornell) -> None:
    """The others keep their values in the scene; with all values the others are in the result too."""
    method, (name, *_) = VanillaSceneGradient(cornell, torch.mean), cornell.inputs
    value = {name: 0.5 * cornell.inputs[name]}
    part, whole = (
        method.attribute(values, seed=shifted(), spp=64) for values in (value, {**cornell.inputs, **value})
    )
    assert list(part) == [name]
    assert list(whole) == list(cornell.inputs)
    assert float(part.metric_value) == pytest.approx(float(whole.metric_value), rel=0.05)


def test_subpackages_are_attributes_and_load_when_used() -> None:
    code = (
        "import sys, scenecaptum as sc\n"
        "assert 'scenecaptum.validation' not in sys.modules\n"
        "assert sc.validation.ablation_test is not None and sc.report.write_report is not None\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'valdation'"):
        _ = scenecaptum.valdation  # type: ignore[attr-defined]


def test_a_network_as_a_metric_gets_a_hint_about_its_input() -> None:
    network = torch.nn.Sequential(
        torch.nn.Conv2d(3, 4, 3), torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(0)
    )
    with pytest.raises(SceneCaptumError, match=r"metrics\.ClassLogit\(network\)"):
        VanillaSceneGradient(ToyRenderer(), network).attribute()
