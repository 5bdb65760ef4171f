"""Methods that sum gradients over scenes: against Captum, closed forms, and their own error bars."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import captum.attr
import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import (
    GradientShapScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    SceneAttribution,
    SceneCaptumError,
    SceneRenderer,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.attr import AttributionInterrupted
from scenecaptum.attr._quadrature_error import covariance_of_quadrature
from scenecaptum.estimation import Budget, channel_totals

# Captum warns when it sets requires_grad on detached inputs.
pytestmark = pytest.mark.filterwarnings("ignore:Input Tensor .* did not already require gradients")

WALL, LIGHT = "left_wall.reflectance.value", "light.emitter.radiance.value"


class Glowing:
    """``image = A·(x² + x·y)``, a colour, a scalar and noise that falls as 1/√spp."""

    spp = 64
    bounds = {"x": (0.0, 1.0), "y": (0.0, math.inf)}  # noqa: RUF012

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise
        self.matrix = torch.rand(4, 4, 3, 3, generator=torch.Generator().manual_seed(shifted(1))) + 0.1
        self.inputs = {"x": torch.tensor([0.5, 0.3, 0.8]), "y": torch.tensor(1.5)}
        self.calls = 0

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        self.calls += 1
        shape = self.matrix.shape
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed)) / math.sqrt(spp)
        x, y = inputs["x"], inputs["y"]
        return self.matrix * (1 + self.noise * noise) @ (x**2 + x * y)


def sigmoid(image: torch.Tensor) -> torch.Tensor:
    return torch.sigmoid((image - 3) / 2).mean()


def forward(renderer: Glowing, metric):
    """The same for Captum: from a batch of inputs to a batch of numbers."""

    def call(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        rows = zip(x, y, strict=True)
        return torch.stack([metric(renderer({"x": a, "y": b}, seed=shifted(), spp=1)) for a, b in rows])

    return call, tuple(value[None] for value in renderer.inputs.values())


def assert_same(ours: SceneAttribution, theirs: tuple[torch.Tensor, ...]) -> None:
    for name, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(ours[name], expected[0].to(ours[name]), rtol=1e-5, atol=1e-6)


# ------------------------------------------------------------------------------------------ against Captum


@pytest.mark.parametrize("metric", [torch.mean, sigmoid])
def test_saliency_is_captums(metric):
    renderer = Glowing()
    call, inputs = forward(renderer, metric)
    expected = captum.attr.Saliency(call).attribute(inputs, abs=False)
    assert_same(VanillaSceneGradient(renderer, metric).attribute(), expected)


@pytest.mark.parametrize("metric", [torch.mean, sigmoid])
def test_input_x_gradient_is_captums(metric):
    renderer = Glowing()
    call, inputs = forward(renderer, metric)
    expected = captum.attr.InputXGradient(call).attribute(inputs)
    assert_same(InputXGradientScene(renderer, metric).attribute(), expected)


@pytest.mark.parametrize("method", ["gausslegendre", "riemann_left", "riemann_middle", "riemann_right"])
@pytest.mark.parametrize("n_steps", [2, 5, 32])
def test_integrated_gradients_are_captums(method, n_steps):
    renderer = Glowing()
    call, inputs = forward(renderer, sigmoid)
    expected = captum.attr.IntegratedGradients(call).attribute(inputs, method=method, n_steps=n_steps)
    ours = IntegratedGradientsScene(renderer, sigmoid).attribute(method=method, n_steps=n_steps)
    assert_same(ours, expected)


def test_captums_delta_is_ours():
    renderer = Glowing()
    call, inputs = forward(renderer, sigmoid)
    _, theirs = captum.attr.IntegratedGradients(call).attribute(
        inputs, method="riemann_left", n_steps=6, return_convergence_delta=True
    )
    attribution, ours = IntegratedGradientsScene(renderer, sigmoid).attribute(
        method="riemann_left", n_steps=6, return_convergence_delta=True
    )
    assert ours.item() == pytest.approx(theirs.item(), abs=1e-5)
    assert attribution.convergence_delta == pytest.approx(theirs.item(), abs=1e-5)


@pytest.mark.parametrize(
    "nt_type",
    ["smoothgrad_sq", *(pytest.param(one, marks=pytest.mark.long) for one in ("smoothgrad", "vargrad"))],
)
def test_noise_tunnel_agrees_within_its_error(nt_type):
    """Inside the bounds, where reflection does nothing; both draw independent noise."""
    renderer, count = Glowing(), 400
    call, inputs = forward(renderer, sigmoid)
    ours = SmoothGradScene(renderer, sigmoid).attribute(
        nt_type=nt_type, nt_samples=count, stdevs={"x": 0.04}, noise_free_last=False
    )
    torch.manual_seed(shifted())
    theirs = captum.attr.NoiseTunnel(captum.attr.Saliency(call)).attribute(
        inputs, nt_type=nt_type, nt_samples=count, stdevs=(0.04, 0.0), abs=False
    )
    for name, expected in zip(ours, theirs, strict=True):
        # Captum's estimate is as noisy as ours.
        z = (ours[name] - expected[0]) / (math.sqrt(2) * ours.standard_error[name])
        assert z.abs().max() < allowed(400, 4), f"{name}: {ours[name]} against {expected[0]}, z = {z}"


def test_gradient_shap_agrees_within_its_error():
    renderer, count = Glowing(), 400
    call, inputs = forward(renderer, sigmoid)
    ours = GradientShapScene(renderer, sigmoid).attribute(baselines=[0.1], n_samples=count)
    torch.manual_seed(shifted())
    np.random.seed(shifted())
    starts = tuple(torch.full_like(value, 0.1) for value in inputs)
    theirs = captum.attr.GradientShap(call).attribute(inputs, starts, n_samples=count)
    for name, expected in zip(ours, theirs, strict=True):
        z = (ours[name] - expected[0]) / (math.sqrt(2) * ours.standard_error[name])
        assert z.abs().max() < allowed(400, 4), f"{name}: {ours[name]} against {expected[0]}, z = {z}"


def test_gradient_shap_is_the_mean_of_integrated_gradients_over_the_baselines():
    renderer, starts = Glowing(), [0.1, {"x": 0.6, "y": 3.0}]
    ours = GradientShapScene(renderer, sigmoid).attribute(baselines=starts, n_samples=400)
    each = [IntegratedGradientsScene(renderer, sigmoid).attribute(baselines=one) for one in starts]
    for name, value in ours.items():
        z = (value - sum(one[name] for one in each) / 2) / ours.standard_error[name]
        assert z.abs().max() < allowed(400, 4), f"{name}: z = {z}"


# ------------------------------------------------------------------------------------------ identities


def test_scales_are_factors():
    renderer = Glowing()
    found = VanillaSceneGradient(renderer, sigmoid).attribute()
    total = {name: channel_totals(value) for name, value in found.items()}
    of_range, of_value = found.effects("range"), found.effects("value")
    assert of_range["x"] == pytest.approx(total["x"].sum().item())
    # No upper bound: its value replaces the range.
    assert of_range["y"] == pytest.approx((1.5 * total["y"]).sum().item())
    assert of_value["x"] == pytest.approx((renderer.inputs["x"] * total["x"]).sum().item())


class LastGraph(torch.autograd.Function):
    """An image whose graph has a derivative until the next render, and only once, as one of ``dr.wrap``."""

    renders, used = 0, -1

    @staticmethod
    def forward(ctx, image):
        LastGraph.renders += 1
        ctx.number = LastGraph.renders
        return image.clone()

    @staticmethod
    def backward(ctx, adjoint):
        valid = ctx.number == LastGraph.renders != LastGraph.used
        LastGraph.used = ctx.number
        return adjoint if valid else torch.zeros_like(adjoint)


class Wrapped(Glowing):
    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return LastGraph.apply(super().__call__(inputs, seed=seed, spp=spp))


@pytest.mark.parametrize("method", [VanillaSceneGradient, SmoothGradScene])
def test_each_render_of_another_renderer_is_differentiated_before_the_next(method):
    lasting, wrapped = (
        method(kind(noise=0.3), lambda image: image.square().mean((0, 1))).attribute(target=[0, 2], seed=1)
        for kind in (Glowing, Wrapped)
    )
    for one, other in zip(lasting, wrapped, strict=True):
        assert one["x"].norm() > 0
        torch.testing.assert_close(dict(one), dict(other))
        torch.testing.assert_close(one.bias, other.bias)


def test_several_targets_come_from_the_same_images():
    renderer = Glowing(noise=0.3)

    def per_channel(image: torch.Tensor) -> torch.Tensor:
        return image.mean((0, 1))

    for method in (VanillaSceneGradient, IntegratedGradientsScene, SmoothGradScene, GradientShapScene):
        settings = {} if method is VanillaSceneGradient else {"baselines": 0.1}
        settings = {} if method is SmoothGradScene else settings
        alone = [method(renderer, per_channel).attribute(target=k, **settings) for k in (0, 2)]
        before = renderer.calls
        both = method(renderer, per_channel).attribute(target=[0, 2], **settings)
        together = renderer.calls - before
        assert [one.info["metric"] for one in both] == ["per_channel[0]", "per_channel[2]"]
        for one, other in zip(alone, both, strict=True):
            torch.testing.assert_close(dict(one), dict(other))
        before = renderer.calls
        method(renderer, per_channel).attribute(target=0, **settings)
        assert together < 2 * (renderer.calls - before)


def test_one_sample_of_smoothgrad_is_the_plain_gradient():
    renderer = Glowing(noise=0.3)
    plain = VanillaSceneGradient(renderer, sigmoid).attribute(seed=shifted(2))
    smooth = SmoothGradScene(renderer, sigmoid).attribute(nt_samples=1, seed=shifted(2))
    torch.testing.assert_close(dict(smooth), dict(plain))
    torch.testing.assert_close(smooth.standard_error["x"], plain.standard_error["x"])


@pytest.mark.parametrize("nt_type", [pytest.param("smoothgrad_sq", marks=pytest.mark.long), "vargrad"])
def test_render_noise_is_not_counted_as_variance_of_the_gradient(nt_type):
    renderer = Glowing(noise=0.5)
    repeats = [
        SmoothGradScene(renderer, torch.mean).attribute(nt_type=nt_type, nt_samples=6, stdevs=0.0, seed=seed)
        for seed in seeds(60)
    ]
    values = torch.stack([one["x"] for one in repeats])
    plain = VanillaSceneGradient(Glowing(), torch.mean).attribute()["x"]
    expected = plain**2 if nt_type == "smoothgrad_sq" else torch.zeros(3)
    z = (values.mean(0) - expected) / (values.std(0) / math.sqrt(len(values)))
    assert z.abs().max() < allowed(60, 3), f"z = {z}"


@pytest.mark.parametrize(
    ("n_steps", "metric"),
    [
        (8, sigmoid),
        pytest.param(24, torch.mean, marks=pytest.mark.long),
        pytest.param(8, torch.mean, marks=pytest.mark.long),
        pytest.param(24, sigmoid, marks=pytest.mark.long),
    ],
)
def test_error_bars_and_deltas_of_integrated_gradients_are_honest(n_steps, metric):
    """With 24 steps only every third has replicates to estimate its noise."""
    renderer, repeats = Glowing(noise=0.3), 50
    found = [
        IntegratedGradientsScene(renderer, metric).attribute(baselines=0.1, n_steps=n_steps, seed=seed)
        for seed in seeds(repeats)
    ]
    truth = IntegratedGradientsScene(Glowing(), metric).attribute(baselines=0.1, n_steps=n_steps)
    for name in renderer.inputs:
        values = torch.stack([one[name] for one in found])
        bars = torch.stack([one.standard_error[name] for one in found]).square().mean(0).sqrt()
        z = (values.mean(0) - truth[name]) / (values.std(0) / math.sqrt(repeats))
        assert z.abs().max() < allowed(repeats, 4), f"{name}: bias in standard errors {z}"
        # The quadrature adds little to them, although its estimate contains some noise.
        ratio, width = values.std(0) / bars, 4 / math.sqrt(2 * repeats)
        assert (ratio < 1 + width).all(), f"{name}: {ratio}"
        assert (ratio > 0.85 - width).all(), f"{name}: {ratio}"
    deltas = torch.tensor([one.convergence_delta for one in found])
    errors = torch.tensor([one.convergence_delta_error for one in found])
    ratio = (deltas.std() / errors.square().mean().sqrt()).item()
    assert 0.85 - width < ratio < 1 + width
    z = deltas.mean() / (deltas.std() / math.sqrt(repeats))
    assert abs(z) < allowed(repeats)


def test_the_delta_of_a_difference_is_the_difference_of_the_deltas():
    renderer = Glowing(noise=0.3)
    method = IntegratedGradientsScene(renderer, sigmoid)
    one, other = (method.attribute(baselines=base, n_steps=4) for base in (0.1, 0.2))
    both = one - other
    assert both.convergence_delta == pytest.approx(one.convergence_delta - other.convergence_delta)
    assert both.convergence_delta_error >= one.convergence_delta_error
    assert (one - dataclasses.replace(other, convergence_delta=None)).convergence_delta is None


@pytest.mark.parametrize(("points", "replicates"), [(32, 2), (25, 2), (3, 3), (100, 2)])
@pytest.mark.parametrize("pairs", [None, 1, 8])
def test_samples_are_split_over_the_points(points, replicates, pairs):
    spp, single = 64, 1 if points > 3 else replicates
    budget = Budget.split(spp, 8, seed=shifted(), points=points, pairs=pairs)
    paired = min(points, pairs or points)
    assert budget.replicates == (replicates,) * paired + (single,) * (points - paired)
    seen = [one * count for one, count in zip(budget.spp, budget.replicates, strict=True)]
    assert abs(budget.total - spp) <= replicates or min(budget.spp) == max(budget.spp) == 1
    assert max(seen) - min(seen) <= replicates
    # The metric is evaluated on equally many images at every point.
    assert {len(row) for row in budget.seeds} == {replicates}
    seeds = [seed for half in (budget.seeds, budget.gradient_seeds) for row in half for seed in row]
    assert len(set(seeds)) == len(seeds)


def test_a_non_linear_metric_gets_enough_samples_at_every_step():
    renderer = Glowing(noise=1.0)
    linear, bent = (
        IntegratedGradientsScene(renderer, m).attribute(baselines=0.5, n_steps=16, spp=32)
        for m in (torch.mean, sigmoid)
    )
    assert linear.info["budget"]["spp_added_for_the_metric"] == 0
    assert bent.info["budget"]["spp_added_for_the_metric"] == 16 * 16


def overexposed(image: torch.Tensor) -> torch.Tensor:
    return image.clamp(max=3.5).mean()


def test_non_linearity_later_on_the_path_is_detected():
    """Steps with a single replicate are compared with the first step, where the metric was linear."""
    renderer = Glowing(noise=1.0)
    found = IntegratedGradientsScene(renderer, overexposed).attribute(n_steps=24, replicates=2, spp=48)
    assert 0 < found.info["budget"]["spp_added_for_the_metric"] < 24 * 16


@pytest.mark.long
def test_non_linearity_later_on_the_path_causes_no_bias():
    renderer = Glowing(noise=1.0)
    exact = IntegratedGradientsScene(Glowing(), overexposed).attribute(n_steps=24)
    repeats = [
        IntegratedGradientsScene(renderer, overexposed).attribute(n_steps=24, seed=seed, spp=2400)
        for seed in seeds(60)
    ]
    values = torch.stack([one["x"] for one in repeats])
    z = (values.mean(0) - exact["x"]) / (values.std(0) / math.sqrt(len(values)))
    assert z.abs().max() < allowed(60, 3), f"z = {z}"


def test_rounding_does_not_count_against_completeness():
    found = IntegratedGradientsScene(Glowing(), sigmoid).attribute(n_steps=32, replicates=1)
    assert found.info["convergence"] == "adds up"
    assert found.convergence_delta_error is None
    coarse = IntegratedGradientsScene(Glowing(), sigmoid).attribute(n_steps=2, method="riemann_left")
    assert coarse.info["convergence"] == "inconclusive"
    assert coarse.convergence_delta_error > abs(coarse.convergence_delta)
    still = IntegratedGradientsScene(Glowing(), sigmoid).attribute(baselines=Glowing().inputs)
    assert (still.info["explained"], still.info["convergence"]) == (0.0, "adds up")


def test_an_interrupted_integral_estimates_the_whole():
    renderer = Glowing()
    stop_at = 40

    class Stopped(Glowing):
        def __call__(self, inputs, *, seed, spp):
            if self.calls == stop_at:
                self.calls += 1
                raise KeyboardInterrupt
            return super().__call__(inputs, seed=seed, spp=spp)

    whole = IntegratedGradientsScene(renderer, torch.mean).attribute(n_steps=16)
    with pytest.raises(AttributionInterrupted) as stopped:
        IntegratedGradientsScene(Stopped(), torch.mean).attribute(n_steps=16)
    partial = stopped.value.partial
    assert partial.info["interrupted"]
    torch.testing.assert_close(partial["x"], whole["x"], rtol=0.1, atol=0)


# ------------------------------------------------------------------------------------------ scenes


@pytest.fixture(scope="module")
def box() -> SceneRenderer:
    return SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=128)


def test_integrated_gradients_of_the_light_are_the_picture(box):
    attribution = IntegratedGradientsScene(box, metrics.MeanLuminance()).attribute(
        baselines="dark", n_steps=4, spp=8192, seed=shifted()
    )
    assert attribution.info["convergence"] == "adds up"
    assert not attribution[WALL].any()
    total = attribution[LIGHT].sum().item()
    z = (total - attribution.metric_value) / attribution.convergence_delta_error
    assert abs(z) < allowed(8)


def test_integrated_gradients_add_up(box):
    for metric in (metrics.MeanLuminance(), lambda image: torch.log(image.mean() + 0.01)):
        attribution = IntegratedGradientsScene(box, metric).attribute(n_steps=8)
        assert abs(attribution.convergence_delta) < allowed(8) * attribution.convergence_delta_error


def test_gradient_shap_adds_up(box):
    attribution, delta = GradientShapScene(box, metrics.MeanLuminance()).attribute(
        baselines=["black", "grey"], return_convergence_delta=True
    )
    assert abs(delta.item()) < allowed(8) * attribution.convergence_delta_error


def test_smoothgrad_stays_inside_the_bounds(box):
    attribution = SmoothGradScene(box, metrics.MeanLuminance()).attribute(nt_samples=4, stdevs=2.0)
    assert all(torch.isfinite(value).all() for value in attribution.values())


def test_groups_add_up_their_members_and_their_errors(box):
    method = IntegratedGradientsScene(box, metrics.MeanLuminance())
    alone = method.attribute(n_steps=4, seed=shifted(1))
    kinds = method.attribute(n_steps=4, seed=shifted(1), groups="kind")
    assert set(kinds) == {"emitters", "reflectance"}
    torch.testing.assert_close(kinds["emitters"], alone[LIGHT].sum(), rtol=1e-4, atol=0)
    assert sum(kinds.values()).item() == pytest.approx(sum(v.sum().item() for v in alone.values()), rel=1e-4)
    # Atomic additions repeat to 1e-6 of the sums, of which the delta is a difference.
    rounding = 1e-5 * abs(alone.metric_value)
    assert kinds.convergence_delta == pytest.approx(alone.convergence_delta, abs=rounding)
    # The channels of a colour share their paths: their errors add according to their covariance.
    # The error of a sum's quadrature is its own.
    spread, together = (
        (found.covariance[name] - covariance_of_quadrature(found.quadrature_error[name], found[name])).sum()
        for found, name in ((kinds, "emitters"), (alone, LIGHT))
    )
    torch.testing.assert_close(spread, together, rtol=1e-3, atol=0)
    assert kinds.heatmap().shape == (16, 16)


# ------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda r: VanillaSceneGradient(r, sigmoid).attribute().ranking(scale="log"),
            'scale must be "range"',
        ),
        (
            lambda r: IntegratedGradientsScene(r, sigmoid).attribute(method="gauss"),
            "Use one of gausslegendre",
        ),
        (lambda r: IntegratedGradientsScene(r, sigmoid).attribute(n_steps=0), "n_steps"),
        (lambda r: IntegratedGradientsScene(r, sigmoid).attribute(baselines="dark"), "parameters_table"),
        (lambda r: SmoothGradScene(r, sigmoid).attribute(nt_type="vanilla"), "nt_type must be one of"),
        (lambda r: SmoothGradScene(r, sigmoid).attribute(stdevs=-0.1), "stdevs must be a number"),
        (lambda r: SmoothGradScene(r, sigmoid).attribute(stdevs={"z": 0.1}), "no input matches"),
        (
            lambda r: SmoothGradScene(r, sigmoid).attribute(nt_type="vargrad", replicates=1),
            "replicates of 2 or more",
        ),
        (lambda r: GradientShapScene(r, sigmoid).attribute(baselines=[]), "empty list"),
        (lambda r: InputXGradientScene(r, sigmoid).attribute(groups="kind"), "parameters_table"),
        (lambda r: InputXGradientScene(r, sigmoid).attribute(target=[]), "empty list"),
    ],
)
def test_bad_input_is_refused_with_the_reason(call, message):
    with pytest.raises(SceneCaptumError, match=message):
        call(Glowing())


def test_a_range_takes_bounds():
    class Boundless(Glowing):
        bounds = None

    with pytest.raises(SceneCaptumError, match="require physical bounds"):
        SmoothGradScene(Boundless(), sigmoid).attribute()
    found = VanillaSceneGradient(Boundless(), sigmoid).attribute()
    with pytest.raises(SceneCaptumError, match="needs the range"):
        found.ranking(scale="range")


# --- Where the caller has disabled gradients ------------------------------------------------------

GRADIENT_METHODS = [
    VanillaSceneGradient,
    InputXGradientScene,
    IntegratedGradientsScene,
    SmoothGradScene,
    GradientShapScene,
]


FEW_SCENES = {
    IntegratedGradientsScene: {"baselines": "dark", "n_steps": 2},
    SmoothGradScene: {"nt_samples": 2},
    GradientShapScene: {"baselines": "dark", "n_samples": 2},
}


def tone_mapped(image: torch.Tensor) -> torch.Tensor:
    return (image / (1 + image)).mean()


@pytest.mark.parametrize("method", GRADIENT_METHODS)
def test_gradients_are_the_same_under_no_grad(box, method):
    settings = FEW_SCENES.get(method, {})
    attribution = method(box, tone_mapped)
    expected = attribution.attribute(spp=16, seed=shifted(), **settings)
    with torch.no_grad():
        found = attribution.attribute(spp=16, seed=shifted(), **settings)
        assert not torch.is_grad_enabled()
    assert expected[LIGHT].any()
    torch.testing.assert_close(dict(found), dict(expected))


def test_a_goal_is_reached_under_no_grad():
    attribution = VanillaSceneGradient(Glowing(noise=0.3), metrics.Smoothed(sigmoid))
    with torch.no_grad():
        found = attribution.attribute(tolerance=0.5, seed=shifted())
    assert found.info["planner"]["reached"]


def test_inference_mode_is_refused_before_anything_is_rendered():
    renderer = Glowing()
    attribution = VanillaSceneGradient(renderer, sigmoid)
    with torch.inference_mode(), pytest.raises(SceneCaptumError, match=r"use torch\.no_grad\(\)"):
        attribution.attribute()
    assert not renderer.calls
