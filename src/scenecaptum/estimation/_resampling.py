"""Standard errors of any statistic by resampling."""

from __future__ import annotations

import math
from collections.abc import Callable

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
