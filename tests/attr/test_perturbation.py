from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping

import captum.attr
import numpy as np
import pytest
import torch
from chance import allowed, check_error_bars
from seeds import seeds, shifted
from toy import ToyRenderer, log_mean

from scenecaptum import (
    AttributionInterrupted,
    FeatureAblationScene,
    OcclusionScene,
    SceneAttribution,
    SceneCaptumError,
    SceneRenderer,
    ShapleyValueScene,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.attr._baselines import resolve_baselines
from scenecaptum.attr._groups import resolve_groups
from scenecaptum.estimation import Budget, channel_totals

METHODS = [FeatureAblationScene, ShapleyValueScene, OcclusionScene]
LIGHT = "light.emitter.radiance.value"
WINDOWS = {"sliding_window_shapes": (2, 3), "strides": (2, 2)}


class PartsRenderer(ToyRenderer):
    """A lamp that lights a wall, and a sheet of paper: the contribution of each depends on the others."""

    def __init__(self, noise: float = 0.3) -> None:
        super().__init__(noise)
        generator = torch.Generator().manual_seed(shifted(2))
        self.inputs = {
            "lamp": torch.tensor(1.5),
            "wall": torch.tensor([0.5, 0.3, 0.8]),
            "paper": torch.rand(5, 7, 3, generator=generator),
            "weights": torch.rand(5, 7, 1, generator=generator) / 20,
        }
        self.calls: list[int] = []

    def colour(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        x = {**self.inputs, **inputs}
        paper = (x["paper"] * x["weights"]).sum((0, 1))
        return x["lamp"] * x["wall"] * (1 + paper) + 0.1 * paper + 0.05

    def exact(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return self.matrix @ self.colour(inputs)

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        self.calls.append(spp)
        return self.sampled(seed, spp) @ self.colour(inputs)


PLAYERS = ("lamp", "wall", "paper")
BASELINES = {"lamp": 0.2, "wall": torch.tensor([0.1, 0.6, 0.3]), "paper": 0.4}


def parts(renderer: PartsRenderer) -> dict[str, torch.Tensor]:
    return {name: renderer.inputs[name] for name in PLAYERS}


def glare_like(image: torch.Tensor) -> torch.Tensor:
    return torch.sigmoid((image - 0.9) / 0.3).mean()


def per_channel(image: torch.Tensor) -> torch.Tensor:
    return image.mean((0, 1))


NOISE_FREE_METRICS = {"mean": torch.mean, "log": log_mean, "sigmoid": glare_like}


def for_captum(renderer: PartsRenderer, metric):
    """The same as a function of batched tensors, as Captum expects."""

    def forward(*tensors: torch.Tensor) -> torch.Tensor:
        scenes = (dict(zip(PLAYERS, one, strict=True)) for one in zip(*tensors, strict=True))
        return torch.stack([metric(renderer.exact(scene)) for scene in scenes])

    inputs = tuple(renderer.inputs[name][None] for name in PLAYERS)
    baselines = tuple(
        torch.as_tensor(BASELINES[name]).expand(renderer.inputs[name].shape)[None] for name in PLAYERS
    )
    return forward, inputs, baselines


# ------------------------------------------------------------------------------------- agreement with Captum


@pytest.mark.parametrize("metric", NOISE_FREE_METRICS.values(), ids=NOISE_FREE_METRICS)
def test_ablation_is_captums(metric):
    renderer = PartsRenderer(noise=0)
    ours = FeatureAblationScene(renderer, metric).attribute(parts(renderer), baselines=BASELINES)
    forward, inputs, baselines = for_captum(renderer, metric)
    channels = torch.arange(4, 7).expand(1, 5, 7, 3)
    masks = (torch.tensor([0]), torch.tensor([[1, 2, 3]]), channels)
    theirs = captum.attr.FeatureAblation(forward).attribute(inputs, baselines=baselines, feature_mask=masks)
    torch.testing.assert_close(ours["lamp"], theirs[0][0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(ours["wall"], theirs[1][0], rtol=1e-5, atol=1e-5)
    # Captum gives every texel the effect of the channel; here it is spread over them.
    torch.testing.assert_close(channel_totals(ours["paper"]), theirs[2][0, 0, 0], rtol=1e-5, atol=1e-5)
    assert ours["paper"].shape == (5, 7, 3)


@pytest.mark.parametrize("metric", NOISE_FREE_METRICS.values(), ids=NOISE_FREE_METRICS)
def test_exact_shapley_values_are_captums(metric):
    renderer = PartsRenderer(noise=0)
    ours = ShapleyValueScene(renderer, metric).attribute(
        parts(renderer), baselines=BASELINES, n_samples="all"
    )
    forward, inputs, baselines = for_captum(renderer, metric)
    masks = (torch.tensor([0]), torch.tensor([[1, 1, 1]]), torch.full((1, 5, 7, 3), 2))
    theirs = captum.attr.ShapleyValues(forward).attribute(inputs, baselines=baselines, feature_mask=masks)
    for name, one in zip(PLAYERS, theirs, strict=True):
        torch.testing.assert_close(ours[name], one.reshape(-1)[0], rtol=1e-5, atol=1e-5)
    assert abs(ours.convergence_delta) < 1e-6


def test_sampled_shapley_values_agree_with_captums_within_their_errors():
    """Six players that interact, no noise: only the permutations are random."""
    renderer = PartsRenderer(noise=0)
    groups = {f"column {i}": [f"c{i}"] for i in range(6)}

    def columns(inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return renderer.exact({"lamp": torch.stack([inputs[f"c{i}"] for i in range(6)]).prod()})

    inputs = {f"c{i}": torch.tensor(0.6 + 0.2 * i) for i in range(6)}
    ours = ShapleyValueScene(columns, log_mean).attribute(
        inputs, baselines=0.1, groups=groups, n_samples=60, spp=1, replicates=2
    )

    def forward(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([log_mean(renderer.exact({"lamp": one.prod()})) for one in x])

    values = torch.stack(list(inputs.values()))[None]
    (theirs,) = captum.attr.ShapleyValues(forward).attribute(values, baselines=torch.full((1, 6), 0.1))
    z = [(ours[group] - one) / ours.standard_error[group] for group, one in zip(groups, theirs, strict=True)]
    assert max(abs(one) for one in z) < allowed(30, 6), f"standard errors {z}"
    (sampled,) = captum.attr.ShapleyValueSampling(forward).attribute(
        values, baselines=torch.full((1, 6), 0.1), n_samples=600
    )
    together = math.sqrt(1 + 60 / 600)
    z = [(ours[group] - one) / ours.standard_error[group] for group, one in zip(groups, sampled, strict=True)]
    assert max(abs(one) for one in z) < allowed(30, 6) * together, f"standard errors {z}"


@pytest.mark.parametrize(("shape", "stride"), [((2, 3), (2, 2)), ((3, 3), (1, 3)), ((5, 7), (1, 1))])
def test_occlusion_is_captums(shape, stride):
    renderer = PartsRenderer(noise=0)
    ours = OcclusionScene(renderer, log_mean).attribute(
        {"paper": renderer.inputs["paper"]},
        sliding_window_shapes=shape,
        strides=stride,
        baselines=0.4,
    )

    def forward(paper: torch.Tensor) -> torch.Tensor:
        return torch.stack([log_mean(renderer.exact({"paper": one})) for one in paper])

    theirs = captum.attr.Occlusion(forward).attribute(
        renderer.inputs["paper"][None],
        sliding_window_shapes=(*shape, 3),
        strides=(*stride, 3),
        baselines=0.4,
    )
    torch.testing.assert_close(ours["paper"], theirs[0], rtol=1e-5, atol=1e-5)


# ------------------------------------------------------------------------------------------ honest error bars

REPEATS = 100


def exact_ablation(renderer: PartsRenderer, metric) -> torch.Tensor:
    here = metric(renderer.exact({}))
    return torch.stack([here - metric(renderer.exact({name: zero(renderer, name)})) for name in PLAYERS])


def zero(renderer: PartsRenderer, name: str) -> torch.Tensor:
    return torch.zeros_like(renderer.inputs[name])


def ablate(renderer: PartsRenderer, metric, seed: int, **settings) -> SceneAttribution:
    return FeatureAblationScene(renderer, metric).attribute(
        parts(renderer), groups={"lamp": "lamp", "wall": "wall", "paper": "paper"}, seed=seed, **settings
    )


def share_out(renderer: PartsRenderer, metric, seed: int, **settings) -> SceneAttribution:
    settings = {"n_samples": 8, **settings}
    return ShapleyValueScene(renderer, metric).attribute(parts(renderer), seed=seed, **settings)


def exact_shapley(renderer: PartsRenderer, metric) -> torch.Tensor:
    quiet = PartsRenderer(noise=0)
    assert torch.equal(quiet.matrix, renderer.matrix)
    return stacked(share_out(quiet, metric, 0, n_samples="all"))


def stacked(tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
    return torch.stack([tensors[name] for name in PLAYERS])


@pytest.mark.parametrize(
    ("run", "truth", "metric"),
    [
        pytest.param(ablate, exact_ablation, torch.mean, id="ablation-mean"),
        pytest.param(ablate, exact_ablation, log_mean, id="ablation-log_mean"),
        pytest.param(ablate, exact_ablation, glare_like, id="ablation-glare_like", marks=pytest.mark.long),
        pytest.param(share_out, exact_shapley, torch.mean, id="shapley-mean", marks=pytest.mark.long),
        pytest.param(share_out, exact_shapley, log_mean, id="shapley-log_mean", marks=pytest.mark.long),
        pytest.param(share_out, exact_shapley, glare_like, id="shapley-glare_like"),
    ],
)
def test_standard_error_is_the_spread_over_repeats_and_the_mean_is_right(run, truth, metric):
    renderer = PartsRenderer(noise=0.1)
    repeats = [run(renderer, metric, seed, spp=64) for seed in seeds(REPEATS)]
    values = torch.stack([stacked(one) for one in repeats])
    bars = torch.stack([stacked(one.standard_error) for one in repeats])
    check_error_bars(values, bars)
    z = (values.mean(0) - truth(renderer, metric)) / (values.std(0) / math.sqrt(REPEATS))
    assert (z.abs() < allowed(REPEATS, z.numel())).all(), f"bias in standard errors {z.tolist()}"


@pytest.mark.parametrize(
    ("nearness", "noise"),
    [
        pytest.param(0.05, 0.3, id="rendering", marks=pytest.mark.long),
        pytest.param(0.7, 0.01, id="permutations"),
    ],
)
def test_shapley_error_bars_include_render_noise_and_the_choice_of_permutations(nearness, noise):
    """Close to the baselines there is hardly any interaction, and the error is render noise."""
    renderer = PartsRenderer(noise)
    baselines = {name: (1 - nearness) * value for name, value in parts(renderer).items()}
    repeats = [share_out(renderer, torch.mean, seed, baselines=baselines) for seed in seeds(REPEATS)]
    values = torch.stack([stacked(one) for one in repeats])[:, :2]
    bars = torch.stack([stacked(one.standard_error) for one in repeats])[:, :2]
    check_error_bars(values, bars)


def test_occlusion_error_bars_are_the_spread_over_repeats():
    renderer = PartsRenderer(noise=0.3)
    repeats = [
        OcclusionScene(renderer, log_mean).attribute(
            {"paper": renderer.inputs["paper"]}, seed=seed, denoise=False, **WINDOWS
        )
        for seed in seeds(REPEATS)
    ]
    values = torch.stack([one["paper"] for one in repeats])
    bars = torch.stack([one.standard_error["paper"] for one in repeats])
    check_error_bars(values, bars)
    totals = torch.stack([channel_totals(value) for value in values])
    check_error_bars(totals, torch.stack([one.covariance["paper"].diagonal().sqrt() for one in repeats]))


def test_error_bars_include_pixels_that_jump():
    """As those that a lamp covers in part: one sample that meets it is enough for a metric with a threshold.

    By chance, none of them changes if a single replicate is left out, and the delete-one jackknife states an error
    near 0.
    """
    runs, covered = 200, torch.linspace(0.02, 0.5, 60).reshape(6, 10, 1)

    def renderer(inputs, *, seed, spp):
        met = torch.binomial(spp * torch.ones_like(covered), covered, torch.Generator().manual_seed(seed))
        return inputs["lamp"] * (met / spp).expand(6, 10, 3)

    def shown(image):
        return torch.sigmoid((image[..., 0] - 0.3) / 0.05).mean()

    light = {"lamp": torch.tensor(15.0)}
    truth = shown(15 * covered) - shown(0 * covered)
    found = [
        FeatureAblationScene(renderer, shown).attribute(
            light, baselines=0.0, seed=seed, spp=128, denoise=False
        )
        for seed in seeds(runs)
    ]
    ends = [one.interval()["lamp"] for one in found]
    within = [low <= truth <= high for low, high in ends]
    assert sum(within) / runs > 0.9 - 3 * math.sqrt(0.9 * 0.1 / runs)
    assert max(abs(one["lamp"] - truth) / one.standard_error["lamp"] for one in found) < 10


def test_the_noise_that_two_scenes_share_is_not_denoised_if_the_metric_stays_the_same(cornell):
    """The denoiser changes each of them in its own way, so that their noise cancels no longer."""

    def bright_part(image: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid((image.mean(-1) - 0.3) / 0.05).mean()

    def run(**options) -> SceneAttribution:
        method = FeatureAblationScene(cornell, bright_part)
        return method.attribute(groups="kind", baselines={"reflectance": 0.5}, spp=48, seed=0, **options)

    plain, default, denoised = run(denoise=False), run(), run(denoise=True)
    assert default["reflectance"] == plain["reflectance"] != denoised["reflectance"]
    assert [one.info["picture"]["denoised"] for one in (plain, default, denoised)] == [False, False, True]


def test_shared_samples_cancel_where_arms_agree():
    """The noise of a difference of two arms is far below that of the metric itself."""
    renderer = PartsRenderer(noise=0.3)
    renderer.inputs["paper"] = renderer.inputs["paper"] / 1000
    one = ablate(renderer, torch.mean, 0)
    assert one.standard_error["paper"] < one.metric_standard_error / 100


@pytest.mark.parametrize("method", METHODS)
def test_one_replicate_has_no_error_bars(method):
    renderer = PartsRenderer()
    one = method(renderer, log_mean).attribute(baselines=0.05, replicates=1)
    assert one.standard_error is None
    assert one.info["replicates"] == 1
    with pytest.raises(SceneCaptumError, match="at least two replicates"):
        one.interval()


def test_interval_of_a_sampled_shapley_value_uses_the_number_of_permutations():
    one = share_out(PartsRenderer(), log_mean, 0, n_samples=5)
    assert one.info["permutations"] == 6
    assert one.info["replicates"] == 3
    low, high = one.interval()["lamp"]
    assert low < one["lamp"] < high
    assert share_out(PartsRenderer(), log_mean, 0, n_samples=2).standard_error is None


# --------------------------------------------------------------------------------------------- what is rendered


def test_budget_is_split_over_arms_and_replicates():
    budget = Budget.with_common_seeds(64, 8, shifted(), 4)
    assert (budget.spp, budget.replicates, budget.total) == ((2,) * 4, (8,) * 4, 64)
    assert Budget.with_common_seeds(10, 8, shifted(), 4).spp == (1,) * 4
    assert Budget.with_common_seeds(None, 8, shifted(), 4).total is None
    (seeds,) = set(budget.seeds)
    (others,) = set(Budget.with_common_seeds(64, 8, shifted(1), 4).seeds)
    assert len({*seeds, *others}) == 16


def test_every_coalition_is_rendered_once():
    renderer = PartsRenderer()
    one = share_out(renderer, log_mean, 0, n_samples=40, spp=320, replicates=5)
    assert renderer.calls == [8] * 40  # 2³ coalitions, 5 replicates, 8 samples each
    assert one.info["budget"] == {"arms": 8, "spp_per_arm": 40, "replicates": 5, "total_spp": 320}
    assert one.info["spp"] == 320


def test_inputs_at_their_baselines_are_not_rendered():
    renderer = PartsRenderer()
    wall = renderer.inputs["wall"].clone()
    wall[0] = 0
    inputs = {"lamp": renderer.inputs["lamp"], "wall": wall}
    one = FeatureAblationScene(renderer, log_mean).attribute(inputs, baselines={"lamp": inputs["lamp"]})
    assert len(renderer.calls) == 3 * 8
    assert (one["lamp"], one["wall"][0]) == (0, 0)
    assert one.standard_error["lamp"] == 0


@pytest.mark.parametrize("method", METHODS)
def test_several_targets_share_their_renders(method):
    renderer = PartsRenderer()
    both = method(renderer, per_channel).attribute(target=[2, 0])
    count = len(renderer.calls)
    alone = [method(renderer, per_channel).attribute(target=target) for target in (2, 0)]
    assert len(renderer.calls) == 3 * count
    for one, other in zip(both, alone, strict=True):
        assert one.metric_value == other.metric_value
        assert one.info["metric"] == other.info["metric"]
        for name in one:
            torch.testing.assert_close(one[name], other[name], rtol=0, atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_differentiated_not_even_the_metric(method):
    class Primal(PartsRenderer):
        def __call__(self, inputs, *, seed, spp):
            assert not torch.is_grad_enabled()
            return super().__call__(inputs, seed=seed, spp=spp)

    def hard(image: torch.Tensor) -> torch.Tensor:
        return (image > 0.5).float().mean()

    for metric in (hard, torch.mean):
        method(Primal(), metric).attribute()


@pytest.mark.parametrize("method", METHODS)
def test_a_metric_that_returns_a_number_is_told_to_make_a_tensor_of_it(method):
    def count(image: torch.Tensor) -> np.float64:
        return np.count_nonzero(image.detach().numpy() > 0.5) / image.numel()

    with pytest.raises(
        SceneCaptumError,
        match=r"not float64\. .*for a method without gradients, such as an ablation, "
        r"torch\.tensor\(number\) will do",
    ):
        method(PartsRenderer(), count).attribute()
    method(PartsRenderer(), lambda image: torch.tensor(count(image))).attribute()


# ------------------------------------------------------------------------------------------------ interruption


class InterruptedRenderer(PartsRenderer):
    """Raises KeyboardInterrupt after so many renders."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def __call__(self, inputs, *, seed, spp):
        if len(self.calls) == self.after:
            raise KeyboardInterrupt
        return super().__call__(inputs, seed=seed, spp=spp)


def test_interrupted_ablation_keeps_the_finished_parameters():
    with pytest.raises(AttributionInterrupted) as caught:
        FeatureAblationScene(InterruptedRenderer(after=8 * 5 + 3), per_channel).attribute(target=[0, 1])
    assert [list(one) for one in caught.value.partials] == [["lamp", "wall"]] * 2
    assert caught.value.partial.info["interrupted"]


def test_interrupted_shapley_keeps_the_finished_permutations():
    groups = {f"row {i}": [f"r{i}"] for i in range(5)}
    renderer = InterruptedRenderer(after=8 * 20)

    def rows(inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return renderer({"lamp": torch.stack(list(inputs.values())).sum()}, seed=seed, spp=spp)

    inputs = {f"r{i}": torch.tensor(0.5 + i) for i in range(5)}
    with pytest.raises(AttributionInterrupted) as caught:
        ShapleyValueScene(rows, log_mean).attribute(inputs, groups=groups, spp=8)
    partial = caught.value.partial
    assert 2 <= partial.info["permutations"] < 26
    assert abs(partial.convergence_delta) < 1e-6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("after", [3, 11])
def test_interruption_before_anything_is_finished_has_no_result(method, after):
    renderer = InterruptedRenderer(after)
    inputs = {"paper": renderer.inputs["paper"], "weights": renderer.inputs["weights"]}
    with pytest.raises(KeyboardInterrupt) as caught:
        method(renderer, log_mean).attribute(inputs)
    assert not isinstance(caught.value, AttributionInterrupted)


# -------------------------------------------------------------------------------------------------- real scenes


@pytest.fixture(scope="module")
def cornell_small():
    return SceneRenderer(
        "cornell-box", inputs=["reflectance", "emitters"], resolution=(16, 16), spp=64, max_depth=4
    )


def test_without_light_the_whole_metric_is_lost(cornell_small):
    ablation = FeatureAblationScene(cornell_small, metrics.MeanLuminance())
    dark = ablation.attribute(baselines="dark", groups="kind")
    assert dark["emitters"].item() == pytest.approx(dark.metric_value, rel=1e-5)
    assert dark["reflectance"] == 0
    assert dark.info["budget"]["arms"] == 2
    by_channel = ablation.attribute(baselines="dark")
    assert by_channel[LIGHT].sum().item() == pytest.approx(by_channel.metric_value, rel=1e-5)


def test_shapley_values_add_up_to_the_difference_under_other_seeds(cornell_small):
    metric, baselines = metrics.LuminancePercentile(75), {"emitters": 10.0, "reflectance": 0.1}
    groups = {"light": "light.*", "walls": "*_wall.*", "boxes": "*_box.*", "rest": ["floor.*", "ceiling.*"]}
    settings = {"baselines": baselines, "groups": groups, "n_samples": "all", "spp": 16 * 64}
    one, other = (
        ShapleyValueScene(cornell_small, metric).attribute(**settings, seed=seed) for seed in seeds(2)
    )
    dark = resolve_baselines(cornell_small, cornell_small.inputs, baselines)
    ends = FeatureAblationScene(cornell_small, metric).attribute(
        baselines=dark, groups={"all": "*"}, spp=2 * 64, seed=shifted(2)
    )
    assert abs(one.convergence_delta) < 1e-6
    sums = [torch.stack(list(each.replicates.values())).sum(0) for each in (one, other)]
    for total in sums:
        error = math.hypot(total.std() / math.sqrt(len(total)), ends.standard_error["all"])
        difference = (total.mean() - ends["all"]).item()
        assert abs(difference) < allowed(8, 2) * error, f"{difference:.2e}, standard error {error:.1e}"


def lamps(mi, centres: list[float], width: float) -> dict:
    """Lamps in a row below the ceiling of a symmetric room."""
    transform = mi.ScalarTransform4f
    room = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 3},
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": transform().look_at(origin=[0, -4, 1], target=[0, 0, 1], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 64},
        },
        "floor": {"type": "rectangle", "to_world": transform().scale(3)},
    }
    for index, centre in enumerate(centres):
        room[f"lamp_{index}"] = {
            "type": "rectangle",
            "to_world": transform().translate([centre, 0, 2]).rotate([1, 0, 0], 180).scale([width, 0.5, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        }
    return room


@pytest.fixture(scope="module")
def two_lamps(mi):
    return SceneRenderer(lamps(mi, [-1.0, 1.0], 0.5), inputs="emitters")


@pytest.mark.parametrize("method", [FeatureAblationScene, ShapleyValueScene])
def test_equal_lamps_count_alike(two_lamps, method):
    one = method(two_lamps, metrics.MeanLuminance()).attribute(groups="object", spp=1024)
    assert list(one) == ["lamp_0", "lamp_1"]
    difference = one.replicates["lamp_0"] - one.replicates["lamp_1"]
    z = (difference.mean() / (difference.std() / math.sqrt(len(difference)))).item()
    assert abs(z) < allowed(len(difference))
    assert one["lamp_0"] > 10 * one.standard_error["lamp_0"]


def test_a_lamp_split_in_two_splits_its_attribution(mi):
    halves = SceneRenderer(lamps(mi, [-0.5, 0.5], 0.5), inputs="emitters")
    whole = SceneRenderer(lamps(mi, [0.0], 1.0), inputs="emitters")
    split, joined = (
        ShapleyValueScene(renderer, metrics.MeanLuminance()).attribute(groups="object", spp=2048)
        for renderer in (halves, whole)
    )
    sums = split.replicates["lamp_0"] + split.replicates["lamp_1"]
    error = math.hypot(sums.std() / math.sqrt(len(sums)), joined.standard_error["lamp_0"])
    difference = (sums.mean() - joined["lamp_0"]).item()
    assert abs(difference) < allowed(len(sums)) * error, f"{difference:.2e}, standard error {error:.1e}"


def test_occlusion_finds_the_texels_that_the_camera_sees(stage):
    one = OcclusionScene(stage, metrics.MeanLuminance()).attribute(
        spp=8000, replicates=4, sliding_window_shapes={"*": 2}, baselines={"emitters": 0.0}
    )
    assert set(one) == {name for name, value in stage.inputs.items() if value.ndim >= 3}
    sky = next(name for name in one if name.startswith("sky"))
    assert (one[sky] >= -4 * one.standard_error[sky]).all()
    assert one[sky].max() > 4 * one.standard_error[sky].max()


@pytest.mark.parametrize(
    "groups", ["material", {"walls": "*_wall.*", "boxes": ["short_box.*", "tall_box.*"]}]
)
def test_grouped_result_draws_saves_and_subtracts(cornell_small, tmp_path, groups):
    run = FeatureAblationScene(cornell_small, metrics.MeanLuminance())
    one = run.attribute(groups=groups, replicates=2)
    one.save(tmp_path / "one.npz")
    loaded = SceneAttribution.load(tmp_path / "one.npz")
    assert loaded.info["groups"] == one.info["groups"]
    torch.testing.assert_close(loaded.heatmap(), one.heatmap())
    assert "loss of mean luminance (cd/m²) by ablation" in str(loaded)
    assert not any((one - loaded).saliency().values())


def test_heatmap_shows_a_group_where_any_member_is(cornell_small):
    one = FeatureAblationScene(cornell_small, metrics.MeanLuminance()).attribute(
        groups={"walls": "*_wall.*"}, replicates=2
    )
    saliency = one.saliency()
    expected = saliency["walls"] / max(
        math.hypot(*(saliency[n] for n in saliency if "light" in n)), *saliency.values()
    )
    walls = torch.from_numpy(one.surfaces.shown([n for n in cornell_small.inputs if "_wall" in n]))
    whole = walls == 1
    assert whole.any()
    torch.testing.assert_close(one.heatmap(norm="linear")[whole], torch.full((int(whole.sum()),), expected))


# ------------------------------------------------------------------------------------------ baselines and groups


def test_presets_change_only_their_kind(stage):
    values, table = stage.inputs, stage.parameters_table()
    for preset, kind in (("dark", "emitters"), ("black", "reflectance"), ("grey", "reflectance")):
        for name, baseline in resolve_baselines(stage, values, preset).items():
            if table[name].kind != kind:
                assert torch.equal(baseline, values[name])
            elif preset == "grey":
                assert torch.equal(baseline, values[name].mean().expand_as(baseline))
            else:
                assert not baseline.any()
    default = resolve_baselines(stage, values)
    for name, baseline in default.items():
        gone = table[name].kind in ("emitters", "reflectance")
        assert torch.equal(baseline, torch.zeros_like(baseline) if gone else values[name])


def test_the_shape_of_a_light_stays_when_it_is_switched_off(mi):
    scene = lamps(mi, [], 1.0) | {"spot": {"type": "spot"}, "sky": {"type": "sunsky"}}
    renderer = SceneRenderer(scene, inputs="emitters")
    values, dark = renderer.inputs, resolve_baselines(renderer, renderer.inputs, "dark")
    kept = {name for name in values if torch.equal(values[name], dark[name])}
    assert {"spot.cutoff_angle", "spot.beam_width", "sky.turbidity"} <= kept
    assert not renderer(dark).any()


def test_exact_names_beat_globs_and_globs_beat_kinds(cornell_small):
    wall, floor = "left_wall.reflectance.value", "floor.reflectance.value"
    given = {wall: 0.3, "*wall*": 0.2, "left*": 0.25, "reflectance": 0.1}
    base = resolve_baselines(cornell_small, cornell_small.inputs, given)
    assert [base[n][0].item() for n in (wall, "right_wall.reflectance.value", floor, LIGHT)] == pytest.approx(
        [0.3, 0.2, 0.1, 0.0]
    )


def test_baselines_may_be_those_of_another_renderer(cornell_small):
    other = ToyRenderer()
    other.inputs = {name: value / 2 for name, value in cornell_small.inputs.items()}
    base = resolve_baselines(cornell_small, cornell_small.inputs, other)
    assert all(torch.equal(base[name], value) for name, value in other.inputs.items())


def test_baselines_are_copies(cornell_small):
    values = cornell_small.inputs
    resolve_baselines(cornell_small, values, "dark")["floor.reflectance.value"].zero_()
    assert values["floor.reflectance.value"].any()


def test_groups_hold_every_parameter_once(stage):
    for groups in (None, "kind", "material", "object", {"all of the sky": "sky.*"}):
        grouped = resolve_groups(stage, stage.inputs, groups)
        assert sorted(name for members in grouped.values() for name in members) == sorted(stage.inputs)


def test_a_material_of_several_shapes_is_a_group_named_by_it(mi):
    room = lamps(mi, [-1.0, 1.0], 0.5)
    shared = {"type": "ref", "id": "diffuser"}
    room = {"type": room.pop("type"), "diffuser": {"type": "diffuse"}, **room}
    renderer = SceneRenderer(
        {name: {**part, "bsdf": shared} if name.startswith("lamp_") else part for name, part in room.items()},
        inputs="all",
        spp=4,
    )
    assert resolve_groups(renderer, renderer.inputs, "object") == {
        "diffuser (lamp_0, lamp_1)": ("diffuser.reflectance.value",),
        "lamp_0": ("lamp_0.emitter.radiance.value",),
        "lamp_1": ("lamp_1.emitter.radiance.value",),
        "floor": ("floor.bsdf.reflectance.value",),
    }
    note = "a material that several shapes share is one row"
    for groups, count in {"object": 1, "material": 0}.items():
        result = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(groups=groups)
        assert str(result).count(note) == count, groups


def test_the_material_of_one_shape_names_it_unless_the_shape_has_that_name(mi):
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
    room = {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "constant"},
        "bulb": {"type": "point"},  # of no object in the picture
        "Floor": paint,
        "table": paint,
        "Mesh056": {"type": "sphere", "center": [0, 0, 4], "bsdf": {"type": "ref", "id": "Floor"}},
        "table_top": {"type": "sphere", "center": [1, 0, 4], "bsdf": {"type": "ref", "id": "table"}},
    }
    renderer = SceneRenderer(room, inputs=["reflectance", "emitters"])
    assert resolve_groups(renderer, renderer.inputs, "object") == {
        "Floor (Mesh056)": ("Floor.reflectance.value",),
        "table_top": ("table.reflectance.value",),
        "sky (background)": ("sky.radiance.value",),
        "bulb": ("bulb.intensity.value",),
    }


BAD_BASELINES = {
    "unknown preset": ("drak", r"not a preset.*'dark'"),
    "unknown name": ({"lihgt": 0.0}, "'lihgt', which matches none"),
    "near kind": ({"emitter": 0.0}, "Did you mean .*'emitters'"),
    "no name": ({3: 0.0}, "not int"),
    "shape": ({LIGHT: torch.zeros(4)}, r"shape \(4,\).*\(3,\)"),
    "text": ({LIGHT: "off"}, "number or a tensor, not str"),
    "object": (object(), "number or a tensor, not object"),
    "too bright": ({"floor.*": 1.5}, r"'floor\.reflectance\.value' is 1\.5, outside .* \[0, 1\]"),
    "negative": (-1.0, r"is -1, outside its physical bounds"),
    "nan": ({LIGHT: float("nan")}, "not finite"),
    "another scene": (ToyRenderer(), r"no input 'left_wall.*nor 8 more"),
}


@pytest.mark.parametrize(("baselines", "message"), BAD_BASELINES.values(), ids=BAD_BASELINES)
def test_bad_baselines_are_refused_with_the_fix(cornell_small, baselines, message):
    with pytest.raises(SceneCaptumError, match=message):
        resolve_baselines(cornell_small, cornell_small.inputs, baselines)


def test_a_preset_needs_a_renderer_that_knows_kinds():
    renderer = PartsRenderer()
    with pytest.raises(SceneCaptumError, match=r"'dark'.*parameters_table"):
        resolve_baselines(renderer, renderer.inputs, "dark")
    with pytest.raises(SceneCaptumError, match=r"kind 'emitters'.*parameters_table"):
        resolve_baselines(renderer, renderer.inputs, {"emitters": 0.0})
    with pytest.raises(SceneCaptumError, match=r"'kind'.*parameters_table"):
        resolve_groups(renderer, renderer.inputs, "kind")
    renderer.bounds = {"lamp": (1.0, 2.0)}
    with pytest.raises(SceneCaptumError, match=r"'lamp' is 0, outside its physical bounds \[1, 2\]"):
        resolve_baselines(renderer, renderer.inputs)


def test_a_preset_that_changes_nothing_is_refused(two_lamps):
    with pytest.raises(SceneCaptumError, match="no reflectance among the 2 inputs"):
        resolve_baselines(two_lamps, two_lamps.inputs, "grey")


BAD_GROUPS = {
    "preset": ("kinds", "'kind', 'material', 'object'"),
    "overlap": ({"a": "lamp", "b": ["wall", "l*"]}, "'lamp' is in two groups, 'a' and 'b'"),
    "empty": ({"a": []}, "'a' is empty"),
    "unknown": ({"a": ["wal"]}, "Did you mean 'wall'"),
    "type": ({"a": [3]}, "not int"),
    "clash": ({"lamp": ["wall"]}, "name of a parameter that is not in it"),
}


@pytest.mark.parametrize(("groups", "message"), BAD_GROUPS.values(), ids=BAD_GROUPS)
def test_bad_groups_are_refused_with_the_fix(groups, message):
    with pytest.raises(SceneCaptumError, match=message):
        resolve_groups(PartsRenderer(), PLAYERS, groups)


# ------------------------------------------------------------------------------------------------------- errors


def run(method, metric=log_mean, renderer=None, **settings):
    return method(PartsRenderer() if renderer is None else renderer, metric).attribute(**settings)


BAD_CALLS = {
    "replicates": (FeatureAblationScene, {"replicates": 0}, "replicates must be a whole number"),
    "seed": (FeatureAblationScene, {"seed": -1}, "seed must be"),
    "spp": (FeatureAblationScene, {"spp": 0.5}, "spp must be"),
    "targets": (FeatureAblationScene, {"target": []}, "empty list"),
    "target": (FeatureAblationScene, {"target": 3}, "target=3 does not index"),
    "vector": (FeatureAblationScene, {"metric": per_channel}, "must return a scalar"),
    "dark log": (
        FeatureAblationScene,
        {"metric": lambda image: (image.mean() - 0.25).clamp_min(0).log()},
        r"On the scene with 'lamp'\[0\] at its baseline: The metric .* is -inf",
    ),
    "not a tensor": (FeatureAblationScene, {"inputs": {"lamp": 1.0}}, "'lamp' must be a floating point"),
    "no inputs": (FeatureAblationScene, {"inputs": {}}, "give inputs="),
    "at baseline": (
        FeatureAblationScene,
        {"inputs": {"lamp": torch.zeros(())}},
        "all 1 inputs are already at their baselines",
    ),
    "no players": (ShapleyValueScene, {"inputs": {"lamp": torch.zeros(())}}, "nothing to attribute to"),
    "samples": (ShapleyValueScene, {"n_samples": 0}, "n_samples must be"),
    "samples text": (ShapleyValueScene, {"n_samples": "every"}, 'number of permutations or "all"'),
    "too many": (
        ShapleyValueScene,
        {"inputs": {f"x{i}": torch.ones(()) for i in range(11)}, "n_samples": "all"},
        "at most 10 players, and there are 11",
    ),
    "no texture": (OcclusionScene, {"inputs": {"lamp": torch.ones(())}}, r"'lamp' has shape \(\)"),
    "by name": (
        OcclusionScene,
        {"sliding_window_shapes": {"lamp": 2}},
        "'lamp', which is none of the textures",
    ),
    "window": (OcclusionScene, {"sliding_window_shapes": (6, 2)}, r"\(6, 2\), larger than"),
    "no window": (OcclusionScene, {"sliding_window_shapes": (0, 2)}, "whole number of at least 1"),
    "channels": (OcclusionScene, {"sliding_window_shapes": (2, 2, 3)}, "must have 2 numbers.* it has 3"),
    "gaps": (OcclusionScene, {"sliding_window_shapes": 2, "strides": 3}, "larger than the window"),
}


@pytest.mark.parametrize(("method", "settings", "message"), BAD_CALLS.values(), ids=BAD_CALLS)
def test_bad_calls_are_refused_with_the_fix(method, settings, message):
    with pytest.raises(SceneCaptumError, match=message):
        run(method, **settings)


def test_occlusion_without_any_texture_is_refused(two_lamps):
    with pytest.raises(SceneCaptumError, match="None of the 2 inputs is a texture"):
        run(OcclusionScene, renderer=two_lamps)


def test_a_uniform_texture_is_refused():
    renderer = PartsRenderer()
    with pytest.raises(SceneCaptumError, match="nothing to occlude"):
        run(OcclusionScene, renderer=renderer, inputs={"paper": torch.full((5, 7, 3), 0.5)})


@pytest.mark.parametrize("stride", [None, 2], ids=["apart", "overlapping"])
def test_the_effect_of_a_texture_adds_up_its_patches_under_a_linear_metric(stride):
    """It is the effect of replacing all of them, whatever the number of texels and channels."""
    renderer = PartsRenderer()
    large = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(shifted()))
    weight = torch.linspace(0, 1, 16)[:, None]

    def lit(inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return renderer({"lamp": (inputs["large"] * weight).mean()}, seed=seed, spp=spp)

    options = {"inputs": {"large": large}, "baselines": 0.0, "seed": shifted(2)}
    scenes, tolerance = (9, 1e-4) if stride is None else (22, 0.1)  # overlapping ones count the edges less
    patches = OcclusionScene(lit, torch.mean).attribute(
        **options, sliding_window_shapes=(4, 4), strides=stride, spp=64 * scenes
    )
    whole = FeatureAblationScene(lit, torch.mean).attribute(**options, groups={"all": "large"}, spp=64 * 2)
    assert patches.info["budget"]["arms"] == scenes
    assert patches.effects()["large"] == pytest.approx(whole.effects()["all"], rel=tolerance)
    assert patches.effects_error()["large"] == pytest.approx(whole.effects_error()["all"], rel=tolerance)
    text = str(patches)
    assert "Σ totals over the patches" in text
    assert "R, G, B" not in text


def test_default_patches_are_eight_by_eight():
    renderer = PartsRenderer()
    large = torch.rand(17, 32, 3, generator=torch.Generator().manual_seed(shifted()))

    def bent(inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return renderer({"lamp": inputs["large"].mean()}, seed=seed, spp=spp)

    one = OcclusionScene(bent, log_mean).attribute({"large": large}, spp=8)
    assert one.info["budget"]["arms"] == 1 + 6 * 8  # 17 texels are six patches of 3
    assert torch.equal(one["large"][0, 0], one["large"][2, 3])


def test_the_advised_groups_of_a_colour_work_with_a_renderer_of_ones_own() -> None:
    """It has no table and no surfaces, by which objects are grouped."""
    method = FeatureAblationScene(ToyRenderer(), torch.mean)
    (advice,) = re.findall(r"each alone: groups=(\{.*?\})", " ".join(str(method.attribute()).split()))
    together = method.attribute(groups=json.loads(advice))
    assert [row.name for row in together.ranking()] == ["x"]
    assert "each alone" not in str(together)
