"""Standard errors from few replicates or rare bright paths: how to detect them, and robust rows."""

from __future__ import annotations

import math

import torch

from ..student import student_t

MIN_REPLICATES = 4  # with fewer, the standard error has a relative uncertainty of 50 % or more

# Probability of reporting a dominating replicate for normally distributed replicates, over all parameters.
FALSE_ALARM_RATE = 0.01

# With fewer effective samples, 95 % intervals may contain the true value in less than 85 % of runs
# (benchmarks/interval_coverage.py).
MIN_EFFECTIVE_SAMPLES = 7.0

ROUNDING = 1e-5  # relative deviations below this are due to rounding

# Standard deviation of a normal distribution relative to its median absolute deviation.
MAD_TO_SIGMA = 1.4826
CLIP_SIGMAS = 3.0

# Variance of the median relative to that of the mean, for a normal distribution.
MEDIAN_VARIANCE_RATIO = math.pi / 2


def has_dominating_replicate(rows: torch.Tensor, level: float = FALSE_ALARM_RATE) -> bool:
    """Whether one of ``(replicates, C)`` rows has a significant fraction of the squared deviations.

    It is significant under a normal distribution at this level (Grubbs' test for one outlier). Such a replicate
    contains a rare bright path, and similar paths have probably been missed.

    References
    ----------
    Grubbs, "Sample criteria for testing outlying observations", Annals of Mathematical Statistics 21(1), 1950.
    """
    rows = rows.double()
    squares = (rows - rows.mean(0)).square().sum(1)
    if squares.sum() <= ROUNDING**2 * rows.square().sum():
        return False
    return float(squares.max() / squares.sum()) > _critical_fraction(len(rows), level)


def _critical_fraction(replicates: int, level: float) -> float:
    """Return the critical value of Grubbs' test, as a fraction of the squared deviations."""
    square = student_t(1 - level / replicates, replicates - 2) ** 2
    return (replicates - 1) / replicates * square / (replicates - 2 + square)


def rows_of_median(rows: torch.Tensor) -> torch.Tensor:
    """Return rows whose mean is the median of the given rows and whose variance gives its standard error.

    References
    ----------
    Huber and Ronchetti, "Robust Statistics", 2nd edition, 2009 (clipping by the median absolute deviation).
    """
    rows = rows.double()
    median = rows.quantile(0.5, dim=0)
    deviations = rows - median
    limit = CLIP_SIGMAS * MAD_TO_SIGMA * deviations.abs().quantile(0.5, dim=0)
    # If most replicates are equal, the others differ by rare paths: do not clip these.
    clipped = torch.where(limit > 0, deviations.clamp(-limit, limit), deviations)
    return median + math.sqrt(MEDIAN_VARIANCE_RATIO) * (clipped - clipped.mean(0))
