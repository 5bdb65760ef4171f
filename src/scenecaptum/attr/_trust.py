"""Detection of unreliable standard errors, and an estimate that is robust against rare bright paths."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeVar

import torch

from ..errors import SceneCaptumError
from ..estimation import (
    FALSE_ALARM_RATE,
    MIN_EFFECTIVE_SAMPLES,
    MIN_REPLICATES,
    has_dominating_replicate,
    rows_of_median,
)
from ._data import AttributionData, covariances

A = TypeVar("A", bound=AttributionData)

# Each reason is read after one name, after several, and after "all parameters".
NO_SAMPLES = "reached by no sample: the light is rare, or there is none"
FEW_SAMPLES = "too few samples contribute to the variance for a reliable error: the light is rare"
# Where a rare path is found by some parameters, it may reach the objects of others, whose samples have missed it.
ELSEWHERE = "; effects other than these may miss such light, too"


def untrusted_errors(attribution: AttributionData) -> dict[str, str]:
    """Return the parameters whose standard error is unreliable, each with the reason."""
    if attribution.covariance is None:
        return {}
    replicates = attribution.info.get("replicates", MIN_REPLICATES)
    degrees = attribution.info.get("degrees_of_freedom", replicates - 1)
    if degrees < MIN_REPLICATES - 1:
        uncertainty = 100 / math.sqrt(2 * degrees)
        counted = f"{replicates} replicates"
        if degrees != replicates - 1:  # as of points that contribute unequally to the variance
            counted = f"{degrees} degree{'' if degrees == 1 else 's'} of freedom"
        reason = f"with {counted} the standard error has about {uncertainty:.0f} % relative uncertainty"
        return dict.fromkeys(attribution, reason)
    # A difference is as unreliable as either of its sides.
    sides = attribution.info, attribution.info.get("minus", {})
    counts = [item for side in sides for item in side.get("effective_samples", {}).items()]
    reasons = {
        # The counts are those of a few paths: the samples themselves may have reached what these did not.
        name: FEW_SAMPLES if count or attribution[name].any() else NO_SAMPLES
        for name, count in counts
        if count < MIN_EFFECTIVE_SAMPLES
        and name in attribution
        # Exactly 0 in all samples is a result, if there are samples. That of a difference may be x − x.
        and not (count >= 1 and "minus" not in attribution.info and _is_exactly_zero(attribution, name))
    }
    for name, all_rows in attribution.replicates.items():
        kept = attribution.info.get("kept_directions", {}).get(name)
        rows = all_rows if kept is None else all_rows * all_rows.new_tensor(kept)
        if has_dominating_replicate(rows, FALSE_ALARM_RATE / len(attribution)):  # Bonferroni correction
            reasons[name] = (
                "one replicate has nearly all of the spread: a rare bright path, and others may be missing"
            )
    elsewhere = ELSEWHERE if len(reasons) < len(attribution) else ""
    return {name: f"{reason}{elsewhere}" for name, reason in reasons.items()}


def _is_exactly_zero(attribution: AttributionData, name: str) -> bool:
    """Whether an attribution is 0 in every replicate, so that its error is 0, too."""
    assert attribution.covariance is not None
    tensors = (attribution.attributions, attribution.standard_error or {}, attribution.replicates)
    return not any(bool(one[name].any()) for one in (*tensors, attribution.covariance) if name in one)


def median_of_means(attribution: A) -> A:
    """Return the result with the median over the replicates; see ``SceneAttribution.median_of_means``."""
    _check(attribution)
    rows = {name: rows_of_median(original) for name, original in attribution.replicates.items()}
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
        info={**attribution.info, "combination": "median of means", "proportional_errors": {}},
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


def _with_total(value: torch.Tensor, total: torch.Tensor) -> torch.Tensor:
    """Return a gradient with new channel totals; for a texture the change is distributed by gradient magnitude."""
    if value.ndim < 2:
        return total.reshape(value.shape).to(value)
    texels = value.reshape(-1, value.shape[-1]).double()
    size = texels.abs()
    fraction = size / size.sum(0).clamp_min(torch.finfo(torch.float64).tiny)
    return (texels + fraction * (total - texels.sum(0))).reshape(value.shape).to(value)
