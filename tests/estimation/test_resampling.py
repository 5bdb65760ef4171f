"""Standard errors by resampling: of a mean, and of values that jump."""

from __future__ import annotations

import pytest
import torch
from seeds import shifted

from scenecaptum.estimation import (
    corrected_and_error,
    half_sample_error,
    half_samples,
    halves_of_samples,
    mean_and_error,
    pseudo_values,
)

RUNS = 200


@pytest.mark.parametrize("count", [2, 4, 8, 16])
def test_of_a_mean_of_a_power_of_two_it_is_the_usual_standard_error(count: int):
    samples = torch.randn(count, generator=torch.Generator().manual_seed(shifted()))
    error = half_sample_error(lambda kept: samples[kept].mean().item(), count)
    assert error == pytest.approx(mean_and_error(samples)[1], rel=1e-4)


def test_of_a_mean_it_is_the_standard_error_on_average():
    samples = torch.randn(RUNS, 9, generator=torch.Generator().manual_seed(shifted()))
    squares = [half_sample_error(lambda kept, one=one: one[kept].mean().item(), 9) ** 2 for one in samples]
    assert sum(squares) / RUNS == pytest.approx(1 / 9, rel=0.2)  # each is known to a half
    assert half_sample_error(lambda kept: 1.0, 1) is None


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_of_a_share_of_points_it_is_the_spread_between_runs_and_no_less(shared: float):
    """Points in a row across a threshold, with noise that is their own, or the same at all."""
    points, replicates, noise = 63, 8, 0.2
    generator = torch.Generator().manual_seed(shifted())
    light = torch.linspace(-1, 1, points)
    own = torch.randn(RUNS, replicates, points, generator=generator)
    common = torch.randn(RUNS, replicates, 1, generator=generator)
    images = light + noise * replicates**0.5 * (shared * common + (1 - shared) * own)

    def percent(mean: torch.Tensor) -> float:
        return 100 * (mean >= 0).double().mean().item()

    values = torch.tensor([percent(image.mean(0)) for image in images])
    squares = [
        half_sample_error(lambda kept, image=image: percent(image[kept].mean(0)), replicates) ** 2
        for image in images
    ]
    error = (sum(squares) / RUNS) ** 0.5
    assert 0.85 < error / values.std().item() < 1.4


@pytest.mark.parametrize("count", [2, 5, 8])
def test_the_bias_of_a_square_is_removed_as_by_the_jackknife(count: int):
    samples = torch.randn(RUNS, count, generator=torch.Generator().manual_seed(shifted())).double() + 1

    def square(kept: torch.Tensor, one: torch.Tensor) -> torch.Tensor:
        return one[kept].mean().square()

    of_halves, of_jackknife = [], []
    for one in samples:
        values = half_samples(lambda kept, one=one: square(kept, one).item(), count)
        corrected, error = corrected_and_error(values, count)
        of_halves.append(corrected)
        assert error == half_sample_error(lambda kept, one=one: square(kept, one).item(), count)
        of_jackknife.append(pseudo_values(lambda kept, one=one: square(kept, one), count).mean().item())
    biased = samples.mean(1).square().mean().item()
    unbiased = sum(of_jackknife) / RUNS
    assert sum(of_halves) / RUNS == pytest.approx(unbiased, abs=0.1 * (biased - unbiased))


@pytest.mark.parametrize("count", [2, 3, 5, 8, 12])
def test_what_is_linear_has_the_values_of_its_samples_and_no_drifts(count: int):
    samples = torch.randn(count, 2, generator=torch.Generator().manual_seed(shifted())).double()
    found = halves_of_samples(lambda kept: samples[kept].mean(0), count)
    assert torch.allclose(found.per_sample, samples)
    assert torch.allclose(found.value, samples.mean(0))
    assert found.drifts.abs().max() < 1e-12


@pytest.mark.parametrize("count", [2, 4, 8])
def test_noise_and_drifts_together_are_the_error_of_half_samples(count: int):
    samples = torch.randn(count, generator=torch.Generator().manual_seed(shifted())).double() + 1
    found = halves_of_samples(lambda kept: samples[kept].mean().exp(), count)
    noise = mean_and_error(found.per_sample)[1]
    together = (noise**2 + found.drifts.square().sum().item()) ** 0.5
    values = half_samples(lambda kept: samples[kept].mean().exp().item(), count)
    corrected, error = corrected_and_error(values, count)
    assert together == pytest.approx(error)
    assert found.per_sample.mean().item() == pytest.approx(corrected)


def test_halves_see_a_jump_that_leaving_one_sample_out_misses():
    """Two of eight samples meet a small lamp, and one is enough for it to count."""
    samples = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def counts(kept: torch.Tensor) -> torch.Tensor:
        return (samples[kept].max() > 0).double()

    assert pseudo_values(counts, len(samples)).std() == 0
    found = halves_of_samples(counts, len(samples))
    assert found.drifts.norm() > 0.3
