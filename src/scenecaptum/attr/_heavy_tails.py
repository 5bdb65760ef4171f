"""Detection of unreliable standard errors, and an estimate that is robust against rare bright paths."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeVar

import torch

from ..errors import SceneCaptumError
from ..estimation import student_t
from ._data import AttributionData, covariances

A = TypeVar("A", bound=AttributionData)

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


def untrusted_errors(attribution: AttributionData) -> dict[str, str]:
    """Return the parameters whose standard error is unreliable, each with the reason.

    A replicate dominates if its fraction of the squared deviations is significant under a normal distribution
    (Grubbs' test for one outlier, with Bonferroni correction for all parameters). Such a replicate contains a rare
    bright path, and similar paths have probably been missed.

    References
    ----------
    Grubbs, "Sample criteria for testing outlying observations", Annals of Mathematical Statistics 21(1), 1950.
    """
    if attribution.covariance is None:
        return {}
    replicates = attribution.info.get("replicates", MIN_REPLICATES)
    degrees = attribution.info.get("degrees_of_freedom", replicates - 1)
    if degrees < MIN_REPLICATES - 1:
        uncertainty = 100 / math.sqrt(2 * degrees)
        reason = (
            f"with {degrees + 1} replicates the standard error has about {uncertainty:.0f} % relative "
            "uncertainty"
        )
        return dict.fromkeys(attribution, reason)
    # A difference is as unreliable as either of its sides.
    sides = attribution.info, attribution.info.get("minus", {})
    counts = [item for side in sides for item in side.get("effective_samples", {}).items()]
    reasons = {
        name: _few_samples_reason(count)
        for name, count in counts
        if count < MIN_EFFECTIVE_SAMPLES and name in attribution
    }
    for name, rows in attribution.replicates.items():
        if _largest_fraction(rows) > _critical_fraction(len(rows), FALSE_ALARM_RATE / len(attribution)):
            reasons[name] = (
                "one replicate has nearly all of the spread: a rare bright path, and others may be missing"
            )
    return reasons


def _few_samples_reason(effective_samples: float) -> str:
    if not effective_samples:
        return "no path of the pilot contributes to it: its light is rare, or there is none"
    return "too few samples contribute to its variance for a reliable error: its light is rare"


def _largest_fraction(rows: torch.Tensor) -> float:
    """Return the largest fraction of the squared deviations in one replicate; 0 if these are only rounding."""
    rows = rows.double()
    deviations = rows - rows.mean(0)
    squares = deviations.square().sum(1)
    if squares.sum() <= ROUNDING**2 * rows.square().sum():
        return 0.0
    return float(squares.max() / squares.sum())


def _critical_fraction(replicates: int, level: float) -> float:
    """Return the critical value of Grubbs' test, as a fraction of the squared deviations."""
    square = student_t(1 - level / replicates, replicates - 2) ** 2
    return (replicates - 1) / replicates * square / (replicates - 2 + square)


def median_of_means(attribution: A) -> A:
    """Return the result with the median over the replicates, each of which is a mean over its samples.

    References
    ----------
    Nemirovsky and Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983 (medians of means).
    Huber and Ronchetti, "Robust Statistics", 2nd edition, 2009 (clipping by the median absolute deviation).
    """
    _check(attribution)
    rows = {name: _robust_rows(original) for name, original in attribution.replicates.items()}
    covariance = covariances(rows, attribution.bias)
    for name, original in attribution.replicates.items():
        # The difference of median and mean may be real light: it counts as an error of its own size.
        difference = rows[name].mean(0) - original.double().mean(0)
        covariance[name] = covariance[name] + difference[:, None] * difference
    assert attribution.covariance is not None
    assert attribution.standard_error is not None
    errors = {}
    for name, error in attribution.standard_error.items():
        # Replicates of single texels are not stored: scale their errors like the error of the total.
        before, after = (matrix[name].diagonal().double() for matrix in (attribution.covariance, covariance))
        ratio = torch.where(before > 0, (after / before).sqrt(), 1.0).to(error)
        errors[name] = error * (ratio if error.ndim else ratio[0])
    return dataclasses.replace(
        attribution,
        attributions={n: _with_total(value, rows[n].mean(0)) for n, value in attribution.items()},
        standard_error=errors,
        replicates=rows,
        covariance=covariance,
        info={**attribution.info, "combination": "median of means"},
    )


def _check(attribution: AttributionData) -> None:
    """Raise if the replicates do not belong to a single scene."""
    info = attribution.info
    rounds = (info.get("planner") or {}).get("rounds", ())
    several = (info.get("budget") or {}).get("points", 1) > 1 or len(rounds) > 1
    if attribution.covariance is None or not attribution.replicates or several:
        few = "1 replicate" if info.get("replicates", 1) == 1 else "replicates that were not stored"
        raise SceneCaptumError(
            "The median requires independent replicates of one scene, but this result has "
            f"{'several scenes or rounds' if several else few}. Use VanillaSceneGradient or InputXGradientScene "
            "with 8 or more replicates, without tolerance= or top=."
        )


def _robust_rows(rows: torch.Tensor) -> torch.Tensor:
    """Return rows whose mean is the median of the given rows and whose variance gives its standard error."""
    rows = rows.double()
    median = rows.quantile(0.5, dim=0)
    deviations = rows - median
    limit = CLIP_SIGMAS * MAD_TO_SIGMA * deviations.abs().quantile(0.5, dim=0)
    # If most replicates are equal, the others differ by rare paths: do not clip these.
    clipped = torch.where(limit > 0, deviations.clamp(-limit, limit), deviations)
    return median + math.sqrt(MEDIAN_VARIANCE_RATIO) * (clipped - clipped.mean(0))


def _with_total(value: torch.Tensor, total: torch.Tensor) -> torch.Tensor:
    """Return a gradient with new channel totals; for a texture the change is distributed by gradient magnitude."""
    if value.ndim < 2:
        return total.reshape(value.shape).to(value)
    texels = value.reshape(-1, value.shape[-1]).double()
    size = texels.abs()
    fraction = size / size.sum(0).clamp_min(torch.finfo(torch.float64).tiny)
    return (texels + fraction * (total - texels.sum(0))).reshape(value.shape).to(value)
