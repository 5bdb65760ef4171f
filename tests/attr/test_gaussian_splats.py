"""Every method on a renderer that knows nothing of Mitsuba (examples/), against autograd and plain renders."""

from __future__ import annotations

import doctest
import importlib.util
import math
import subprocess
import sys
from itertools import permutations, product
from pathlib import Path

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import (
    FeatureAblationScene,
    GradientShapScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    OcclusionScene,
    ShapleyValueScene,
    SmoothGradScene,
    VanillaSceneGradient,
)
from scenecaptum.estimation import channel_totals

EXAMPLE = Path(__file__).parents[2] / "examples" / "gaussian_splats.py"
THINGS = {name: f"{name}.*" for name in ("apple", "leaf", "glass", "wall")}
WALL = "wall.colour"


def imported():
    spec = importlib.util.spec_from_file_location("gaussian_splats", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


splats = imported()


def bright(image: torch.Tensor) -> torch.Tensor:
    """Return about which share of the image is bright: far from linear."""
    return torch.sigmoid((image - 0.4) / 0.1).mean()


every_metric = pytest.mark.parametrize(
    "metric", [pytest.param(splats.redness, marks=pytest.mark.long), bright]
)


@pytest.fixture(scope="module")
def renderer():
    return splats.SplatRenderer(16)


class Recorded(splats.SplatRenderer):
    """Records the scenes at which gradients are taken."""

    def __init__(self) -> None:
        super().__init__(16)
        self.scenes = {}

    def __call__(self, inputs, *, seed, spp):
        if any(value.requires_grad for value in inputs.values()):
            scene = {name: value.detach().clone() for name, value in inputs.items()}
            # All replicates of a scene are equal here.
            self.scenes[torch.cat([v.reshape(-1) for v in scene.values()]).numpy().tobytes()] = scene
        return super().__call__(inputs, seed=seed, spp=spp)

    def gradients(self, metric):
        """Return the gradients at all scenes, ``(scenes, …)`` by name."""
        each = [gradient(self, metric, scene) for scene in list(self.scenes.values())]
        return {name: torch.stack([one[name] for one in each]) for name in self.inputs}


def measured(renderer, metric, values) -> float:
    return metric(renderer({**renderer.inputs, **values}, seed=shifted(), spp=None)).item()


def gradient(renderer, metric, values):
    leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    value = metric(splats.SplatRenderer.__call__(renderer, leaves, seed=shifted(), spp=None))
    return dict(zip(leaves, torch.autograd.grad(value, list(leaves.values())), strict=True))


def nothing(renderer):
    return {name: torch.zeros_like(value) for name, value in renderer.inputs.items()}


def assert_same(found, expected, rtol: float = 1e-4) -> None:
    """Compare up to a fraction of the largest number."""
    assert set(found) == set(expected)
    scale = max(value.abs().max().item() for value in expected.values())
    for name, right in expected.items():
        assert found[name].shape == right.shape
        error = (found[name] - right).abs().max().item()
        assert error <= rtol * scale, f"{name}: off by {error:.2g} of {scale:.2g}"


# ----------------------------------------------------------------------------------------------- the example


def test_it_runs_as_a_script_without_mitsuba():
    code = (
        f"import runpy, sys; runpy.run_path({str(EXAMPLE)!r}, run_name='__main__'); "
        "sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    renderer = splats.SplatRenderer()
    shown = f"redness = {measured(renderer, splats.redness, {}):.4}"
    for method, part in zip(
        ("VanillaSceneGradient", "IntegratedGradientsScene"), done.stdout.split("Compared"), strict=True
    ):
        assert shown in part
        assert method in part
        assert all(name in part for name in renderer.inputs)


def test_its_docstrings_run():
    failed, attempted = doctest.testmod(splats)
    assert attempted
    assert not failed


def test_a_picture_blends_the_gaussians_from_back_to_front(renderer):
    """From the back to the front, against the closed form that the renderer has."""
    image = torch.zeros(16, 16, 3)
    owners = [name for name, count in renderer.counts.items() for _ in range(count)]
    colours = torch.cat(
        [
            renderer.inputs[f"{n}.colour"].reshape(-1, 3).expand(count, 3)
            for n, count in renderer.counts.items()
        ]
    )
    for index, footprint in zip(renderer.nearest_first.flip(0), renderer.footprints.flip(0), strict=True):
        alpha = renderer.inputs[f"{owners[index]}.opacity"] * footprint[..., None]
        image = alpha * colours[index] + (1 - alpha) * image
    torch.testing.assert_close(renderer(renderer.inputs, seed=shifted(), spp=None), image)


# ------------------------------------------------------------------------------------------------- gradients


@every_metric
def test_plain_gradients_are_autograds(renderer, metric):
    found = VanillaSceneGradient(renderer, metric).attribute()
    expected = gradient(renderer, metric, renderer.inputs)
    assert_same(found, expected, rtol=1e-5)
    for name, effect in found.effects().items():
        value = renderer.inputs[name]
        # A colour has no upper bound: its mean over the texels replaces the range.
        extent = value.reshape(-1, value.shape[-1]).mean(0) if name.endswith(".colour") else 1.0
        assert effect == pytest.approx((extent * expected[name]).sum().item(), rel=1e-4), name


@every_metric
def test_inputs_times_gradients_are_autograds(renderer, metric):
    expected = gradient(renderer, metric, renderer.inputs)
    found = InputXGradientScene(renderer, metric).attribute()
    assert_same(found, {n: renderer.inputs[n] * value for n, value in expected.items()}, rtol=1e-5)


@every_metric
def test_integrated_gradients_are_the_integral_of_autograds(renderer, metric):
    recorded, count = Recorded(), 400
    for step in range(count):
        recorded(
            {n: ((step + 0.5) / count * v).requires_grad_() for n, v in renderer.inputs.items()},
            seed=shifted(),
            spp=None,
        )
    means = {name: values.mean(0) for name, values in recorded.gradients(metric).items()}
    found = IntegratedGradientsScene(renderer, metric).attribute()
    assert_same(found, {name: renderer.inputs[name] * mean for name, mean in means.items()})


@every_metric
@pytest.mark.parametrize("baselines", [None, {"*.colour": 0.2, "*.opacity": 0.5}])
def test_integrated_gradients_add_up(renderer, metric, baselines):
    found, delta = IntegratedGradientsScene(renderer, metric).attribute(
        baselines=baselines, return_convergence_delta=True
    )
    start = nothing(renderer)
    if baselines:
        start = {n: torch.full_like(v, 0.2 if n.endswith(".colour") else 0.5) for n, v in start.items()}
    change = measured(renderer, metric, {}) - measured(renderer, metric, start)
    assert abs(change) > 0.01
    assert sum(value.double().sum().item() for value in found.values()) == pytest.approx(change, abs=1e-6)
    assert abs(delta) < 1e-6


@every_metric
@pytest.mark.parametrize("nt_type", ["smoothgrad", "smoothgrad_sq", "vargrad"])
def test_smoothgrad_is_a_moment_of_the_gradients_at_its_samples(metric, nt_type):
    recorded, count = Recorded(), 40
    found = SmoothGradScene(recorded, metric).attribute(nt_type=nt_type, nt_samples=count)
    gradients = recorded.gradients(metric)
    moments = {
        "smoothgrad": gradients,
        "smoothgrad_sq": {name: g**2 for name, g in gradients.items()},
        "vargrad": {name: (g - g.mean(0)) ** 2 for name, g in gradients.items()},
    }[nt_type]
    assert all(len(moment) == count for moment in moments.values())
    assert_same(found, {name: moment.mean(0) for name, moment in moments.items()})
    assert_same(found.standard_error, {n: m.std(0) / math.sqrt(count) for n, m in moments.items()}, rtol=1e-3)


def test_the_noise_of_smoothgrad_is_a_fraction_of_the_range_and_reflected(renderer):
    spreads = {}
    for stdev in (0.05, 1.0):
        recorded = Recorded()
        SmoothGradScene(recorded, bright).attribute(nt_samples=60, stdevs=stdev, noise_free_last=False)
        drawn = {n: torch.stack([s[n] for s in recorded.scenes.values()]) for n in renderer.inputs}
        for name, values in drawn.items():
            low, high = renderer.bounds[name]
            assert low < values.min(), f"{name} is outside its bounds or was cut off there"
            assert values.max() < high, f"{name} is outside its bounds or was cut off there"
        spreads[stdev] = {n: (v - renderer.inputs[n]).square().mean().sqrt() for n, v in drawn.items()}
    # 4 320 numbers: the relative error of their standard deviation is 1 %.
    assert spreads[0.05][WALL].item() == pytest.approx(0.05 * renderer.inputs[WALL].max().item(), rel=0.05)
    assert spreads[0.05]["wall.opacity"].item() == pytest.approx(0.05, rel=4 / math.sqrt(2 * 60))
    # Between bounds at 0 and 1, reflected noise of this width is uniform: it deviates by 1/√12 from the middle,
    # which is 0.2 away.
    assert spreads[1.0]["wall.opacity"].item() == pytest.approx(math.hypot(12**-0.5, 0.2), rel=0.3)


@every_metric
def test_gradient_shap_is_the_mean_over_points_of_the_path(renderer, metric):
    recorded, count = Recorded(), 100
    found = GradientShapScene(recorded, metric).attribute(n_samples=count)
    rows = {name: renderer.inputs[name] * g for name, g in recorded.gradients(metric).items()}
    assert_same(found, {name: row.mean(0) for name, row in rows.items()})
    assert_same(found.standard_error, {n: r.std(0) / math.sqrt(count) for n, r in rows.items()}, rtol=1e-3)

    apple = "apple.opacity"
    places = torch.stack([scene[apple] / renderer.inputs[apple] for scene in recorded.scenes.values()])
    for row, scene in zip(places, recorded.scenes.values(), strict=True):
        torch.testing.assert_close(scene[WALL], row * renderer.inputs[WALL])
    # The Kolmogorov–Smirnov distance of 100 uniform numbers exceeds 0.19 once in a thousand times.
    steps = torch.arange(count) / count
    assert (places.sort().values - steps).abs().max() < 0.2

    change = measured(renderer, metric, {}) - measured(renderer, metric, nothing(renderer))
    total = sum(value.double().sum().item() for value in found.values())
    assert found.convergence_delta == pytest.approx(total - change, abs=1e-6)
    assert abs(total - change) < 4 * found.convergence_delta_error


# ----------------------------------------------------------------------------------------- taking things away


def changed(value: torch.Tensor, index, to: torch.Tensor | float) -> torch.Tensor:
    copy = value.clone()
    copy[index] = to
    return copy


@every_metric
def test_ablation_is_the_difference_of_two_renders(renderer, metric):
    found = FeatureAblationScene(renderer, metric).attribute()
    full, expected = measured(renderer, metric, {}), {}
    for name, value in renderer.inputs.items():
        expected[name] = torch.zeros_like(value)
        for place in [(..., channel) for channel in range(value.shape[-1])] if value.ndim else [...]:
            effect = full - measured(renderer, metric, {name: changed(value, place, 0.0)})
            # The effect of a channel of the wall is spread over its texels.
            expected[name][place] = effect / (24 if name == WALL else 1)
    assert_same(found, expected, rtol=1e-5)


@every_metric
def test_ablation_of_a_group_is_the_difference_of_two_renders(renderer, metric):
    found = FeatureAblationScene(renderer, metric).attribute(groups=THINGS)
    full, absent = measured(renderer, metric, {}), nothing(renderer)
    without = {thing: {n: v for n, v in absent.items() if n.startswith(thing)} for thing in THINGS}
    effects = {thing: full - measured(renderer, metric, values) for thing, values in without.items()}
    assert_same(found, {thing: torch.tensor(effect) for thing, effect in effects.items()}, rtol=1e-5)


@every_metric
def test_shapley_values_are_the_mean_over_all_orders(renderer, metric):
    found = ShapleyValueScene(renderer, metric).attribute(groups=THINGS, n_samples="all")
    shares = dict.fromkeys(THINGS, 0.0)
    orders = list(permutations(THINGS))
    for order in orders:
        here = nothing(renderer)
        for thing in order:
            before = measured(renderer, metric, here)
            here |= {n: v for n, v in renderer.inputs.items() if n.startswith(thing)}
            shares[thing] += (measured(renderer, metric, here) - before) / len(orders)
    assert_same(found, {thing: torch.tensor(share) for thing, share in shares.items()}, rtol=1e-5)


@every_metric
def test_sampled_shapley_values_add_up_and_agree_within_their_errors(renderer, metric):
    method = ShapleyValueScene(renderer, metric)
    found = method.attribute(n_samples=100, replicates=2)
    exact = method.attribute(n_samples="all", replicates=1)
    change = measured(renderer, metric, {}) - measured(renderer, metric, nothing(renderer))
    for one in (found, exact):
        assert sum(value.item() for value in one.values()) == pytest.approx(change, abs=1e-6)
    for name, value in exact.items():
        z = (found[name] - value) / found.standard_error[name]
        assert abs(z) < allowed(50, len(exact)), f"{name}: {found[name]} against {value}, z = {z}"
    leading = max(exact, key=lambda name: exact[name].abs())
    assert found.standard_error[leading] < 0.05 * exact[leading].abs()


@every_metric
def test_occlusion_is_the_difference_of_two_renders(renderer, metric):
    found = OcclusionScene(renderer, metric).attribute(sliding_window_shapes=2)
    wall, full = renderer.inputs[WALL], measured(renderer, metric, {})
    expected = torch.zeros_like(wall)
    for row, column in product((0, 2), (0, 2, 4)):
        patch = (slice(row, row + 2), slice(column, column + 2))
        hidden = changed(wall, patch, wall.mean((0, 1)))
        expected[patch] = full - measured(renderer, metric, {WALL: hidden})
    assert_same(found, {WALL: expected}, rtol=1e-5)


# ---------------------------------------------------------------------------------------------------- errors


@every_metric
@pytest.mark.parametrize(
    ("method", "settings"),
    [
        (VanillaSceneGradient, {}),
        (InputXGradientScene, {}),
        (IntegratedGradientsScene, {}),
        (SmoothGradScene, {"stdevs": 0.0}),
        (FeatureAblationScene, {}),
        (ShapleyValueScene, {"groups": THINGS, "n_samples": "all"}),
        (OcclusionScene, {"sliding_window_shapes": 2}),
    ],
)
def test_without_noise_errors_are_zero(renderer, metric, method, settings):
    found, other = (method(renderer, metric).attribute(**settings, seed=seed) for seed in seeds(2))
    assert max(found.saliency().values()) > 0
    assert found.metric_standard_error == 0
    for name, error in found.standard_error.items():
        if found.quadrature_error is None:
            assert not error.any()
            assert not found.saliency_error()[name]
        else:  # an integral has an error without noise
            torch.testing.assert_close(channel_totals(error).double(), found.quadrature_error[name])
    assert all(torch.equal(value, other[name]) for name, value in found.items())
