"""Standard errors of any statistic by resampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch


def mean_and_error(samples: torch.Tensor) -> tuple[float, float]:
    """Return the mean of independent samples and its standard error."""
    return samples.mean().item(), (samples.std() / math.sqrt(len(samples))).item()


def pseudo_values(statistic: Callable[[torch.Tensor], torch.Tensor], count: int) -> torch.Tensor:
    """Return the ``(count, …)`` pseudo-values of a statistic of at least 2 samples, given by their indices.

    By the delete-one jackknife they are ``n·T − (n − 1)·T₋ᵢ``, where ``T₋ᵢ`` leaves out sample ``i``. Their mean
    has no bias of order ``1/n``; its standard error is that of a mean of independent numbers.

    Example
    -------
    >>> samples = torch.tensor([1.0, 2.0, 4.0, 5.0])
    >>> pseudo_values(lambda kept: samples[kept].mean(), len(samples))
    tensor([1., 2., 4., 5.])

    References
    ----------
    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9, 1981.
    """
    indices = torch.arange(count)
    without = torch.stack([statistic(indices[indices != k]) for k in range(count)])
    return count * statistic(indices) - (count - 1) * without


def delete_one_jackknife(
    statistic: Callable[[torch.Tensor], torch.Tensor], count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a statistic of independent samples, and its standard error by the delete-one jackknife.

    Example
    -------
    >>> samples = torch.tensor([1.0, 2.0, 4.0, 5.0])
    >>> mean, error = delete_one_jackknife(lambda kept: samples[kept].mean(), len(samples))
    >>> mean.item(), round(error.item(), 4)  # the standard deviation over the square root of 4
    (3.0, 0.9129)

    The arguments are those of ``pseudo_values``.
    """
    values = pseudo_values(statistic, count)
    return statistic(torch.arange(count)), values.std(0) / math.sqrt(count)


def half_sample_error(statistic: Callable[[torch.Tensor], float], count: int) -> float | None:
    """Return the standard error of a statistic of samples, given by their indices; None of a single sample.

    The mean of half of the samples differs from that of all by as much as the latter from the truth. Where a value
    jumps, as a glare rating does when a source is joined to another, the small steps of a delete-one jackknife may
    miss the jump, or multiply it. The splits into halves are balanced: of the mean of a power of two of samples,
    this is the usual standard error. Halves are compared with all samples, not with each other, which would
    understate the error of a share of points that jump one by one.

    Example
    -------
    >>> samples = torch.tensor([1.0, 2.0, 4.0, 5.0])
    >>> round(half_sample_error(lambda kept: samples[kept].mean().item(), len(samples)), 4)
    0.9129

    References
    ----------
    McCarthy, "Pseudo-replication: half samples", Review of the International Statistical Institute 37(3), 1969.
    """
    return None if count < 2 else _half_sample_error(half_samples(statistic, count), count)


def half_samples(statistic: Callable[[torch.Tensor], float], count: int) -> torch.Tensor:
    """Return a statistic of at least 2 samples, given by their indices, then that of each half of balanced splits.

    What is linear in several statistics, such as a slope from two differences, is computed element by element.
    """
    halves = [kept for split in balanced_halves(count) for kept in split]
    return torch.tensor([statistic(kept) for kept in (torch.arange(count), *halves)], dtype=torch.float64)


def corrected_and_error(values: torch.Tensor, count: int) -> tuple[float, float]:
    """Return a statistic without its bias of order ``1/n``, and its standard error, of its ``half_samples``.

    A half has twice the bias of all samples, so their difference is removed once. The delete-one jackknife removes
    ``n − 1`` times a smaller difference. Where a statistic jumps, as a percentile of a denoised picture does, it
    multiplies a jump, or misses it and states an error of nearly 0.

    Example
    -------
    >>> samples = torch.tensor([1.0, 2.0, 4.0, 5.0])
    >>> square, error = corrected_and_error(half_samples(lambda kept: samples[kept].mean() ** 2, 4), 4)
    >>> round(square, 4)  # 3² − 0.9129²
    8.1667

    References
    ----------
    Quenouille, "Approximate tests of correlation in time-series", Journal of the Royal Statistical Society B 11,
    1949.
    """
    drift = (_half_weights(count) * (values[1:] - values[0])).sum()
    return (values[0] - drift).item(), _half_sample_error(values, count)


class HalvesOfSamples(NamedTuple):
    """A statistic of samples, and what its balanced half samples say of its error.

    Attributes
    ----------
    value
        Of all samples, ``(…)``.
    per_sample
        A ``(count, …)`` statistic of each sample, by least squares: those of a half have its value as their mean,
        as nearly as possible. Their mean has no bias of order ``1/count``; its error is that of the noise.
    drifts
        What is left of each half, ``(halves, …)``: the part that is not linear in the samples. Their norm is the
        error that it causes.
    """

    value: torch.Tensor
    per_sample: torch.Tensor
    drifts: torch.Tensor


def halves_of_samples(statistic: Callable[[torch.Tensor], torch.Tensor], count: int) -> HalvesOfSamples:
    """Evaluate a statistic of at least 2 samples, given by their indices, also at the halves of balanced splits.

    Of ``count = 2ᵏ`` samples, noise and drifts together are the standard error of ``half_sample_error``. A
    statistic that is linear in the samples has no drifts.

    Example
    -------
    >>> samples = torch.tensor([1.0, 2.0, 4.0, 5.0], dtype=torch.float64)
    >>> mean = halves_of_samples(lambda kept: samples[kept].mean(), len(samples))
    >>> [round(one, 4) for one in mean.per_sample.tolist()], bool(mean.drifts.norm() < 1e-12)
    ([1.0, 2.0, 4.0, 5.0], True)
    """
    halves = [kept for split in balanced_halves(count) for kept in split]
    value = statistic(torch.arange(count))
    changes = torch.stack([statistic(kept) for kept in halves]) - value
    weights = _half_weights(count).to(changes)
    of_samples = changes.new_full((len(halves), count), -1 / count)
    for row, kept in zip(of_samples, halves, strict=True):
        row[kept] += 1 / len(kept)
    deviations = torch.tensordot(torch.linalg.pinv(of_samples), changes, 1)
    left = changes - torch.tensordot(of_samples, deviations, 1)
    return HalvesOfSamples(
        value,
        value - torch.tensordot(weights, changes, 1) + deviations,
        torch.sqrt(weights).reshape(-1, *[1] * value.ndim) * left,
    )


def _half_sample_error(values: torch.Tensor, count: int) -> float:
    return (_half_weights(count) * (values[1:] - values[0]).square()).sum().sqrt().item()


def _half_weights(count: int) -> torch.Tensor:
    """Return the share of each half in its split, divided by the number of splits."""
    splits = balanced_halves(count)
    return torch.tensor([len(kept) for split in splits for kept in split]).double() / (count * len(splits))


def balanced_halves(count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return splits of at least 2 samples into halves: rows of Sylvester's Hadamard matrix."""
    samples = torch.arange(count)
    splits = []
    for row in range(1, 1 << (count - 1).bit_length()):
        odd = torch.tensor([(sample & row).bit_count() % 2 == 1 for sample in range(count)])
        splits.append((samples[~odd], samples[odd]))
    return splits
