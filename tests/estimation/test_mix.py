"""The parts of the variance of a smoothed metric's gradient, and the mix of samples that follows from them."""

from __future__ import annotations

import math

import pytest
import torch
from seeds import seeds, shifted
from toy import ReplayingToyRenderer

from scenecaptum import VanillaSceneGradient, metrics
from scenecaptum.estimation import TargetedMetric
from scenecaptum.estimation._goal import Compared
from scenecaptum.estimation._gradients import Point
from scenecaptum.estimation._metric_image import TransformSelector
from scenecaptum.estimation._mix import Mix, Part, Pilot

SIGMA = 0.5
SPP = 16


def squares(image: torch.Tensor) -> torch.Tensor:
    return image.square().mean()


METRIC = metrics.Smoothed(squares, SIGMA, n=2)


def test_the_best_mix_has_the_smallest_variance_of_all_mixes_of_the_same_price():
    parts = Part(0.3, 0.02), Part(8.0, 0.005), Part(2.0, 0.04)
    best = Mix.best(*parts)

    def variance_times_seconds(picture: float, draws: float) -> float:
        numbers = (1.0, picture, draws)
        variance = sum(part.variance / n for part, n in zip(parts, numbers, strict=True))
        return variance * sum(part.seconds * n for part, n in zip(parts, numbers, strict=True))

    least = variance_times_seconds(best.picture, best.draws)
    for factor in (0.8, 1.25):
        assert variance_times_seconds(factor * best.picture, best.draws) > least
        assert variance_times_seconds(best.picture, factor * best.draws) > least


def test_a_part_without_variance_is_not_left_out():
    mix = Mix.best(Part(1.0, 1.0), Part(0.0, 1.0), Part(0.0, 1.0))
    assert mix.picture == 1.0
    assert mix.draws > 0
    assert mix.draws_of(1) == 2


def variance_of(vectors: list[torch.Tensor]) -> float:
    return torch.stack(vectors).double().var(0).sum().item()


def test_a_pilot_measures_the_variance_of_each_part():
    renderer = ReplayingToyRenderer(0.3)
    x = renderer.inputs["x"]
    exact = renderer.exact(renderer.inputs)
    count = 2000

    def gradient(matrix: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        return torch.einsum("hwcx,hwc->x", matrix, adjoint)

    curvature = 2 * math.exp(SIGMA**2) / exact.numel()
    samples = [renderer.sampled(seed, SPP) for seed in seeds(count)]
    backward = SPP * variance_of([gradient(sampled, curvature * exact) for sampled in samples])
    picture = SPP * variance_of([gradient(renderer.matrix, curvature * (sampled @ x)) for sampled in samples])
    pairs = [
        TargetedMetric(METRIC).with_draws({seed: 2}).value_and_adjoint(exact)[1] for seed in seeds(count)
    ]
    draws = 2 * variance_of([gradient(renderer.matrix, adjoint) for adjoint in pairs])

    selector = TransformSelector(False, renderer, {}, smoothed=True)
    measured = []
    for seed in seeds(60):
        pilot = Pilot(renderer, [TargetedMetric(METRIC)], selector, SPP, seed, 8)
        measured.append([part.variance for part in pilot.measure(Point(renderer.inputs), Compared())])
    found = torch.tensor(measured, dtype=torch.float64)
    error = found.std(0) / math.sqrt(len(found))
    # The variances that it is compared with are known to √(2 / count) times themselves, or a little worse.
    expected = torch.tensor([backward, picture, draws])
    assert ((found.mean(0) - expected).abs() < 4 * error.hypot(0.05 * expected)).all()


@pytest.mark.parametrize("picture_spp", [None, 320])
def test_a_time_limit_uses_the_mix(picture_spp):
    renderer = ReplayingToyRenderer(0.5)
    metric = metrics.Smoothed(squares, SIGMA, n=2)
    run = VanillaSceneGradient(renderer, metric).attribute(
        seed=shifted(0), spp=64, picture_spp=picture_spp, tolerance=0.05, time_limit=600.0
    )
    mix = run.info["planner"]["mix"]
    assert mix["draws"] > 0
    # Where the limit ends a run, there are pictures without a backward pass.
    assert run.info["planner"]["stopped"] == "goal"
    ratio = run.info["picture"]["spp"] / run.info["spp"]
    assert ratio == pytest.approx(5.0 if picture_spp else mix["picture"], rel=0.05)
