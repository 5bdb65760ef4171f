"""How far a random number may be from what is claimed, by its own standard error."""

from __future__ import annotations

import math

import torch

from scenecaptum.estimation import student_t

# Probability that a normal variable is more than 4 standard deviations from its mean.
RARE = 6.3e-5


def allowed(replicates: int, comparisons: int = 1) -> float:
    """Return the allowed number of standard errors, where these come from so many replicates: 4 for very many.

    Comparisons that share a claim share its false alarm rate of one in 16 000. With 8 replicates, the mean of
    normal variables is off by more than 4 of its standard errors in one of 200 cases.
    """
    return student_t(1 - RARE / comparisons, replicates - 1)


def binomial_margin(share: float, runs: int) -> float:
    """Return how far the share of so many runs may be from the claimed one: three binomial standard errors.

    Where 95 % are claimed, at least 25 of 30 runs have to succeed, as they do in 99.7 % of cases.
    """
    return 3 * math.sqrt(share * (1 - share) / runs)


def together(*errors: float) -> float:
    """Return the standard error of a sum or difference of independent numbers."""
    return math.hypot(*errors)


def check_error_bars(values: torch.Tensor, bars: torch.Tensor) -> None:
    """Check that the standard deviation of repeated values (first dimension) is what their error bars say.

    The relative error of either mean square comes from its own spread; that of a root is half as large.
    """
    squares = torch.stack([(values - values.mean(0)).square(), bars.square()])
    means, count = squares.mean(1), len(values)
    relative = (squares.std(1) / means / math.sqrt(count)).square().sum(0).sqrt() / 2
    z = (means[0] / means[1]).log() / 2 / relative
    most = allowed(count, z.numel())
    assert z.abs().max() < most, (
        f"deviation over error bar in standard errors: {z.tolist()}, allowed ±{most:.1f}"
    )
