"""The jackknife estimates of a metric's noise and bias, against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from chance import allowed, check_error_bars
from seeds import seeds, shifted
from toy import ToyRenderer, log_mean

from scenecaptum.daylight import SkyMatrix, SpatialDaylightAutonomy
from scenecaptum.estimation import TargetedMetric
from scenecaptum.estimation._jackknife import _shrinkage, jackknife
from scenecaptum.estimation._weighted_means import orthogonal_directions

SHARES = [[1.0] * 2, [1.0] * 8, [1.0] * 13, [8.0, 8.0, 4.0, 2.0, 1.0], [16.0] * 4 + [3.0] * 12]


def noisy(count: int, *shape: int, noise: float, seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [1 + noise * torch.randn(*shape, 3, generator=generator) for _ in range(count)]


def kinked(image: torch.Tensor) -> torch.Tensor:
    """A layer of ReLUs, whose derivative is piecewise constant."""
    generator = torch.Generator().manual_seed(shifted())
    weights = torch.randn(2000, image.numel(), generator=generator) / math.sqrt(image.numel())
    signs = torch.randn(2000, generator=generator)
    return (signs * (weights @ (image.flatten() - 1)).relu()).sum()


@pytest.mark.parametrize("samples", SHARES, ids=lambda one: f"{len(one)} of {sum(one):g}")
def test_weighted_means_have_the_covariance_of_the_mean_and_no_negative_weights(samples):
    shares = torch.tensor(samples, dtype=torch.float64) / sum(samples)
    roots = shares.sqrt()
    directions, step = orthogonal_directions(tuple(roots.tolist()))
    projection = torch.eye(len(roots), dtype=torch.float64) - roots[:, None] * roots
    torch.testing.assert_close(directions.T @ directions, projection)
    torch.testing.assert_close(directions.sum(0), torch.zeros_like(roots))
    assert (shares + step * roots * directions > -1e-12).all()
    leaving_one_out = (roots / (1 - shares)).min().item()
    assert step > leaving_one_out - 1e-9  # each of two images has a weight of one half


@pytest.mark.parametrize("samples", SHARES, ids=lambda one: f"{len(one)} of {sum(one):g}")
def test_each_replicate_of_a_quadratic_metric_gets_the_adjoint_of_its_own_image(samples):
    images = noisy(len(samples), 2, 2, noise=0.3, seed=shifted(1))
    seen = jackknife(TargetedMetric(lambda image: image.square().sum()), images, samples)
    for image, adjoint in zip(images, seen.per_replicate, strict=True):
        torch.testing.assert_close(adjoint, 2 * image, rtol=1e-4, atol=1e-4)
    assert not seen.is_linear


def test_a_linear_metric_has_one_adjoint_without_rounding():
    seen = jackknife(TargetedMetric(torch.mean), noisy(8, 2, 2, noise=0.3, seed=shifted(1)))
    assert seen.is_linear
    assert all(torch.equal(one, seen.per_replicate[0]) for one in seen.per_replicate)


def test_bias_is_trusted_for_smooth_metrics_and_not_for_jumps():
    images = noisy(8, 4, 4, noise=0.05, seed=shifted(2))

    def trust(metric) -> float:
        stack, roots = torch.stack(images), torch.full((8,), 8**-0.5, dtype=torch.float64)
        directions, step = orthogonal_directions(tuple(roots.tolist()))
        _, centre = TargetedMetric(metric).value_and_adjoint(stack.mean(0))

        def bias(step: float) -> torch.Tensor:
            means = torch.einsum(
                "rn,n...->r...", (roots**2 + step * roots * directions).clamp_min(0).float(), stack
            )
            moved = torch.stack([TargetedMetric(metric).value_and_adjoint(one)[1] for one in means])
            return (moved.mean(0) - centre) / step**2

        return _shrinkage(bias(step), bias(step / 2))

    assert trust(lambda image: image.mean().log()) > 0.9
    assert trust(lambda image: image.log().mean()) > 0.9
    assert trust(kinked) < 0.3


def test_the_correction_adds_no_noise_for_a_metric_with_kinks():
    """The true adjoint is that of the image without noise; the uncorrected one is that of the mean image."""
    metric = TargetedMetric(kinked)
    _, truth = metric.value_and_adjoint(torch.ones(4, 4, 3))
    plain, corrected = 0.0, 0.0
    for seed in seeds(20):
        images = noisy(8, 4, 4, noise=0.05, seed=100 + seed)
        _, adjoint = metric.value_and_adjoint(torch.stack(images).mean(0))
        mean = torch.stack(jackknife(metric, images).per_replicate).mean(0)
        plain += (adjoint - truth).square().sum().item()
        corrected += (mean - truth).square().sum().item()
    assert corrected < 1.2 * plain, f"{corrected / plain:.2f} times the error of the plain adjoint, squared"


def test_bias_of_the_metric_matches_the_delta_method():
    renderer, repeats = ToyRenderer(noise=0.3), 150
    images = [renderer(renderer.inputs, seed=seed, spp=2) for seed in seeds(8 * repeats)]
    sets = [images[i : i + 8] for i in range(0, len(images), 8)]
    biases = torch.tensor([jackknife(TargetedMetric(log_mean), one).bias for one in sets])
    means = torch.stack([image.mean() for image in images])
    expected = -means.var() / means.mean() ** 2 / 2 / 8
    z = (biases.mean() - expected) / (biases.std() / math.sqrt(repeats))
    assert abs(z) < allowed(repeats), f"mean estimate {biases.mean():.2e}, not {expected:.2e}, z = {z:.1f}"


def test_error_bars_hold_for_a_share_of_points_of_which_few_are_near_the_limit():
    """Of the derivatives by the radiance of the whole sky, and of a third of its patches."""
    generator = torch.Generator().manual_seed(shifted(3))
    levels = torch.linspace(0.2, 2.0, 12).exp()[:, None, None]
    brightness = 10 ** torch.rand(1, 12, 1, generator=generator)
    sky = SkyMatrix.from_radiance(brightness * torch.rand(146, 12, 3, generator=generator))
    metric = TargetedMetric(SpatialDaylightAutonomy(sky, 110_000.0, during="all"))
    third = (torch.arange(146) % 3 == 0).float()[:, None].expand(146, 3)
    directions = torch.stack([torch.ones(146, 3), third], -1).double()

    def coefficients() -> torch.Tensor:
        """Return those of eight replicates; all patches of a point share its paths."""
        paths = torch.rand(8, 12, 1, 1, generator=generator).clamp_min(1e-6).log()
        patches = torch.rand(8, 12, 146, 1, generator=generator).clamp_min(1e-6).log()
        return (levels * (0.75 + 0.25 * paths * patches)).expand(8, 12, 146, 3)

    runs = torch.stack(
        [
            torch.einsum(
                "rpsc,rpsc,sck->rk",
                torch.stack(jackknife(metric, list(coefficients())).per_replicate).double(),
                coefficients().double(),
                directions,
            )
            for _ in range(30)
        ]
    )
    check_error_bars(runs.mean(1), runs.std(1) / math.sqrt(8))
