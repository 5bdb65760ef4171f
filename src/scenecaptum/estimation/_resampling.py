"""Standard errors of any statistic by resampling."""

from __future__ import annotations

from collections.abc import Callable

import torch


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

    Parameters
    ----------
    statistic
        Function of the indices of samples, ``(n,)`` int64, that returns a tensor of any shape.
    count
        Number of samples, at least 2.

    Returns
    -------
    tuple
        The statistic of all samples, and its standard error, of the same shape.

    References
    ----------
    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9, 1981.
    """
    indices = torch.arange(count)
    leave_one_out = torch.stack([statistic(indices[indices != k]) for k in range(count)])
    squares = (leave_one_out - leave_one_out.mean(0)).square().sum(0)
    return statistic(indices), ((count - 1) / count * squares).sqrt()
