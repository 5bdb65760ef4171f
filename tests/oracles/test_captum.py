"""Captum's classes through the bridge against ours, on the Cornell box: the same numbers within their errors.

Captum has no error bars. Its classes run many times, each time with independent samples, noise and permutations,
and the spread of the runs is their error; ours run once and state theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

import scenecaptum as sc
from scenecaptum import SceneAttribution, SceneRenderer, metrics

captum = pytest.importorskip("captum.attr", reason="captum is not installed")

pytestmark = pytest.mark.filterwarnings("ignore:Input Tensor .* did not already require gradients")

WALL, FLOOR, LIGHT = "right_wall.reflectance.value", "floor.reflectance.value", "light.emitter.radiance.value"

# The spread of 20 runs is known to 16 %. The three channels of a colour are nearly equal.
RUNS = 20
ALLOWED = allowed(RUNS)

# One wall becomes darker, a floor and a light become brighter: contributions of both signs.
BASELINES = {WALL: 0.5, FLOOR: 0.5, LIGHT: 3.0}

# Ours are fractions of a parameter's range, which for a light is its brightest channel. All values are five
# deviations from their bounds: reflection there changes the sign of Captum's gradient, and not of ours.
OUR_STDEVS = {WALL: 0.015, FLOOR: 0.015, LIGHT: 0.07}
CAPTUMS_STDEVS = {WALL: 0.015, FLOOR: 0.015, LIGHT: 0.07 * 18.387}

PLAYERS = {name: torch.full((1, 3), number) for number, name in enumerate((WALL, FLOOR, LIGHT))}

# Of the lower half, which does not show the light, whose edges would dominate the noise.
SIDE = 16
mean_luminance = metrics.MeanLuminance(mask=torch.arange(SIDE)[:, None].expand(SIDE, SIDE) >= SIDE // 2)


def log_luminance(image: torch.Tensor) -> torch.Tensor:
    return torch.log(mean_luminance(image) + 0.01)


METRICS = {"mean": mean_luminance, "log": log_luminance}


def smooth_saliency(forward: Callable[..., torch.Tensor]) -> Any:
    return captum.NoiseTunnel(captum.Saliency(forward))


@dataclass(frozen=True)
class Pair:
    """A class of Captum's and the corresponding one of ours, with equivalent settings.

    ``scenes`` is the number of scenes over which ours splits its samples; Captum's renders each with all of them.
    With ``fresh``, each row of a run of Captum's has independent samples, which makes differences noisier.
    """

    captums: Callable[..., Any]
    ours: Callable[..., Any]
    captums_settings: dict[str, Any] = field(default_factory=dict)
    our_settings: dict[str, Any] = field(default_factory=dict)
    metrics: tuple[str, ...] = ("mean", "log")
    scenes: int = 1
    fresh: bool = True


PAIRS = {
    "saliency": Pair(captum.Saliency, sc.VanillaSceneGradient, {"abs": False}),
    "input x gradient": Pair(captum.InputXGradient, sc.InputXGradientScene),
    "integrated gradients": Pair(
        captum.IntegratedGradients,
        sc.IntegratedGradientsScene,
        {"baselines": BASELINES, "n_steps": 3},
        {"baselines": BASELINES, "n_steps": 3},
    ),
    "noise tunnel": Pair(
        smooth_saliency,
        sc.SmoothGradScene,
        {"stdevs": CAPTUMS_STDEVS, "nt_samples": 4, "abs": False},
        {"stdevs": OUR_STDEVS, "nt_samples": 40, "noise_free_last": False},
        metrics=("mean",),
    ),
    "feature ablation": Pair(
        captum.FeatureAblation,
        sc.FeatureAblationScene,
        {"baselines": BASELINES},
        {"baselines": BASELINES},
        scenes=10,
        fresh=False,
    ),
    "shapley value sampling": Pair(
        captum.ShapleyValueSampling,
        sc.ShapleyValueScene,
        {"baselines": BASELINES, "feature_mask": PLAYERS, "n_samples": 3},
        {"baselines": BASELINES, "n_samples": 2 * RUNS},
        scenes=8,
        fresh=False,
    ),
}


# The logarithm tells more wrong factors than the mean does.
LONG = {("input x gradient", "mean"), ("feature ablation", "mean"), ("shapley value sampling", "mean")}


@pytest.fixture(scope="module")
def box(mi: Any) -> SceneRenderer:
    return SceneRenderer("cornell-box", [WALL, FLOOR, LIGHT], resolution=(SIDE, SIDE), spp=16, max_depth=4)


def run_captums(pair: Pair, box: SceneRenderer, metric: Any, first_seed: int) -> dict[str, torch.Tensor]:
    """Return the result of Captum's class in each run, ``(RUNS, 3)`` by name."""
    settings = {
        setting: tuple(value[name] for name in box.inputs) if isinstance(value, dict) else value
        for setting, value in pair.captums_settings.items()
    }
    runs = []
    for seed in seeds(first_seed, first_seed + RUNS):
        torch.manual_seed(seed)
        forward, inputs = box.as_captum(metric, seed=None if pair.fresh else seed)
        runs.append(pair.captums(forward).attribute(inputs, **settings))
    return {
        name: torch.cat(one).detach() for name, one in zip(box.inputs, zip(*runs, strict=True), strict=True)
    }


def deviations(
    ours: SceneAttribution, runs: dict[str, torch.Tensor], factor: float = 1.0
) -> dict[str, torch.Tensor]:
    """Return the deviation of ours, times a factor, from the mean of Captum's runs, in standard errors."""
    found = {}
    for name, value in ours.items():
        # Captum gives every element of a player the player's value; ours has one value.
        rows = runs[name].mean(1) if value.ndim == 0 else runs[name]
        own = ours.standard_error[name]
        if ours.quadrature_error is not None:  # Captum's is the same
            own = (own.square() - ours.quadrature_error[name].square()).clamp_min(0).sqrt()
        error = torch.hypot(factor * own, rows.std(0) / math.sqrt(RUNS))
        found[name] = (factor * value - rows.mean(0)) / error
    return found


@pytest.mark.parametrize(
    ("method", "metric"),
    [
        pytest.param(method, metric, marks=pytest.mark.long if (method, metric) in LONG else ())
        for method, pair in PAIRS.items()
        for metric in pair.metrics
    ],
)
def test_captums_classes_and_ours_agree(box, method, metric):
    pair, number = PAIRS[method], list(PAIRS).index(method)
    # Ours has twice Captum's samples: its error, known from few replicates, has little weight in the sum.
    ours = pair.ours(box, METRICS[metric]).attribute(
        **pair.our_settings,
        seed=shifted(number),
        spp=2 * RUNS * box.spp * pair.scenes,
        replicates=RUNS // 2,
    )
    runs = run_captums(pair, box, METRICS[metric], first_seed=RUNS * number)
    for name, z in deviations(ours, runs).items():
        both = f"{ours[name]} ± {ours.standard_error[name]} against {runs[name].mean(0)}"
        assert z.abs().max() < ALLOWED, f"{name}: {both}, z = {z}"

    # The largest attributions are so accurate that a wrong factor would show.
    leading = max(ours, key=lambda name: ours[name].abs().max())
    for wrong in (1.2, 1 / 1.2):
        z = deviations(ours, runs, wrong)[leading].abs().max()
        assert z > 1.5 * ALLOWED, f"{leading}: a factor of {wrong:.2f} would be {z:.1f} standard errors"


@pytest.mark.long
def test_the_variance_of_gradients_shows_that_the_noise_is_the_same(box):
    """The variance depends on the width of the noise; the mean of the gradients hardly does."""
    theirs, ours = 10, 160
    # The scenes of a run share samples: else Captum's variance would include that of rendering.
    pair = Pair(
        smooth_saliency,
        sc.SmoothGradScene,
        {"stdevs": CAPTUMS_STDEVS, "nt_samples": theirs, "nt_type": "vargrad", "abs": False},
        fresh=False,
    )
    # Both divide by their number of scenes, which differs.
    runs = run_captums(pair, box, mean_luminance, first_seed=1000)
    runs = {name: value * theirs / (theirs - 1) for name, value in runs.items()}
    found = pair.ours(box, mean_luminance).attribute(
        stdevs=OUR_STDEVS, nt_samples=ours, nt_type="vargrad", noise_free_last=False, spp=ours * 16
    )
    factor = ours / (ours - 1)
    for name, z in deviations(found, runs, factor).items():
        assert z.abs().max() < ALLOWED, f"{name}: {found[name]} against {runs[name].mean(0)}, z = {z}"
    for wrong in (4, 1 / 4):  # as it would be with noise of twice or half the width
        z = deviations(found, runs, wrong * factor)[WALL].abs().max()
        assert z > ALLOWED, f"a factor of {wrong} would be {z:.1f} standard errors"
