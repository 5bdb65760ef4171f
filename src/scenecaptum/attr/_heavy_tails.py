"""When the spread of the passes does not tell the error, and a combination of passes that rare paths move less."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import torch

from ..errors import SceneCaptumError
from ._student import student_t

if TYPE_CHECKING:
    from ._attribution import SceneAttribution

FEW = 4  # passes; the error of fewer is itself unsure by 50 % and more

# How often a result whose passes are normally distributed may be called dominated, over all its parameters.
FALSE_ALARMS = 0.01

# Effective number of samples that make up a spread: where these are fewer, intervals may hold the truth in less
# than 85 % of runs (benchmarks/interval_coverage.py).
FEW_SAMPLES = 7.0

# A spread so small, relative to what spreads, is rounding.
ROUNDING = 1e-5

# The standard deviation of a normal distribution, in units of its median absolute deviation.
TO_SIGMA = 1.4826
CLIPPED = 3.0  # standard deviations

# By how much the variance of a median exceeds that of the mean, where all is normal.
MEDIAN_LOSS = math.pi / 2


def untrusted_errors(attribution: SceneAttribution) -> dict[str, str]:
    """Return the parameters whose standard error cannot be trusted, each with the reason.

    One pass dominates where its share of the squared deviations is more than chance allows among normally
    distributed passes: Grubbs' test for one outlier, at a level shared by all parameters. Such a pass holds a rare
    bright path, and as likely as not paths as bright have been missed.

    References
    ----------
    Grubbs, "Sample criteria for testing outlying observations", Annals of Mathematical Statistics 21(1), 1950.
    """
    if attribution.covariance is None:
        return {}
    free = attribution.info.get("degrees_of_freedom", attribution.info.get("passes", FEW) - 1)
    if free < FEW - 1:
        unsure = 100 / math.sqrt(2 * free)
        reason = f"an error told by {free + 1} passes is itself unsure by {unsure:.0f} %"
        return dict.fromkeys(attribution, reason)
    # A difference is no better than either of its sides.
    sides = attribution.info, attribution.info.get("minus", {})
    counts = [item for side in sides for item in side.get("effective_samples", {}).items()]
    found = {n: _rare(count) for n, count in counts if count < FEW_SAMPLES and n in attribution}
    for name, rows in attribution.replicates.items():
        most = _largest_share(rows)
        if most > _limit(len(rows), FALSE_ALARMS / len(attribution)):
            found[name] = (
                "one pass has nearly all of the spread: a rare bright path, and others may be missing"
            )
    return found


def _rare(samples: float) -> str:
    if not samples:
        return "no path of a pilot has met it: its light is rare, or there is none"
    return "so few samples make up its spread that it hardly tells the error: its light is rare"


def _largest_share(rows: torch.Tensor) -> float:
    """Return the largest share that one pass has of the squared deviations; 0 where these are rounding."""
    rows = rows.double()
    deviations = rows - rows.mean(0)
    squares = deviations.square().sum(1)
    if squares.sum() <= ROUNDING**2 * rows.square().sum():
        return 0.0
    return float(squares.max() / squares.sum())


def _limit(passes: int, level: float) -> float:
    """Return the share of the squared deviations that one of so many normal passes has by chance at a level."""
    square = student_t(1 - level / passes, passes - 2) ** 2
    return (passes - 1) / passes * square / (passes - 2 + square)


def median_of_means(attribution: SceneAttribution) -> SceneAttribution:
    """Return the same result with the median over the passes, each of which is a mean over its samples.

    References
    ----------
    Nemirovsky and Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983 (medians of means).
    Huber and Ronchetti, "Robust Statistics", 2nd edition, 2009 (clipping by the median absolute deviation).
    """
    from ._attribution import covariances

    _check(attribution)
    rows = {name: _robust_rows(one) for name, one in attribution.replicates.items()}
    covariance = covariances(rows, attribution.bias)
    for name, one in attribution.replicates.items():
        # What the median leaves out may be light that is there: it counts as an error of its own size.
        left_out = rows[name].mean(0) - one.double().mean(0)
        covariance[name] = covariance[name] + left_out[:, None] * left_out
    assert attribution.covariance is not None
    assert attribution.standard_error is not None
    errors = {}
    for name, one in attribution.standard_error.items():
        # The texels of a texture have no passes of their own: their errors change as that of their total.
        was, now = (kept[name].diagonal().double() for kept in (attribution.covariance, covariance))
        ratio = torch.where(was > 0, (now / was).sqrt(), 1.0).to(one)
        errors[name] = one * (ratio if one.ndim else ratio[0])
    return dataclasses.replace(
        attribution,
        attributions={n: _with_total(value, rows[n].mean(0)) for n, value in attribution.items()},
        standard_error=errors,
        replicates=rows,
        covariance=covariance,
        info={**attribution.info, "combination": "median of means"},
    )


def _check(attribution: SceneAttribution) -> None:
    """Refuse a result whose replicates are not passes over one and the same scene."""
    info = attribution.info
    rounds = (info.get("planner") or {}).get("rounds", ())
    several = (info.get("budget") or {}).get("points", 1) > 1 or len(rounds) > 1
    if attribution.covariance is None or not attribution.replicates or several:
        one = "1 pass" if info.get("passes", 1) == 1 else "passes that were not kept"
        why = "several scenes or rounds" if several else one
        raise SceneCaptumError(
            f"The median is taken over independent passes at one scene, and this result is of {why}. Attribute "
            "with VanillaSceneGradient or InputXGradientScene in 8 passes or more, without tolerance= or top=."
        )


def _robust_rows(rows: torch.Tensor) -> torch.Tensor:
    """Return rows whose mean is the median of the given, and whose spread tells its error."""
    rows = rows.double()
    median = rows.quantile(0.5, dim=0)
    deviations = rows - median
    reach = CLIPPED * TO_SIGMA * deviations.abs().quantile(0.5, dim=0)
    # Where most passes are equal, it is a rare path that tells them apart: no reason to be sure.
    clipped = torch.where(reach > 0, deviations.clamp(-reach, reach), deviations)
    return median + math.sqrt(MEDIAN_LOSS) * (clipped - clipped.mean(0))


def _with_total(value: torch.Tensor, total: torch.Tensor) -> torch.Tensor:
    """Return a gradient with other channel totals; what a texture lacks is added where its gradient is large."""
    if value.ndim < 2:
        return total.reshape(value.shape).to(value)
    texels = value.reshape(-1, value.shape[-1]).double()
    size = texels.abs()
    share = size / size.sum(0).clamp_min(torch.finfo(torch.float64).tiny)
    return (texels + share * (total - texels.sum(0))).reshape(value.shape).to(value)
