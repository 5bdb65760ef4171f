"""Completeness: whether attributions add up to the difference of the metric that they explain."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ._attribution import SceneAttribution
from ._method import Result, Run
from ._metric import TargetedMetric
from ._passes import covariance_of_mean

# Allowed deviation relative to the explained difference, including two standard errors.
TOLERANCE = 0.05

ADDS_UP, DOES_NOT_ADD_UP, INCONCLUSIVE = "adds up", "does not add up", "cannot be told"

# Rounding error of a sum in single precision, relative to the sum of the magnitudes.
ROUNDING = 16 * torch.finfo(torch.float32).eps


def metric_difference(
    metric: TargetedMetric, images: Sequence[torch.Tensor], references: Sequence[Sequence[torch.Tensor]]
) -> tuple[float, float | None]:
    """Return ``M(image) − mean of M(references)`` and its standard error, or None for a single replicate.

    The scenes are rendered with common random numbers. The delete-one jackknife removes the first-order bias that
    image noise causes in a non-linear metric.
    """

    def mean_without(replicates: Sequence[torch.Tensor], left_out: int | None) -> torch.Tensor:
        return torch.stack([image for number, image in enumerate(replicates) if number != left_out]).mean(0)

    def difference_without(left_out: int | None) -> float:
        values = [metric.value(mean_without(replicates, left_out)) for replicates in references]
        return metric.value(mean_without(images, left_out)) - sum(values) / len(values)

    count = len(images)
    if count == 1:
        return difference_without(None), None
    full = count * difference_without(None)
    pseudo_values = [full - (count - 1) * difference_without(left_out) for left_out in range(count)]
    mean = sum(pseudo_values) / count
    return mean, math.sqrt(sum((value - mean) ** 2 for value in pseudo_values) / (count * (count - 1)))


def with_convergence(
    attribution: SceneAttribution, explained: tuple[float, float | None], quadrature_error: float = 0.0
) -> SceneAttribution:
    """Return the attribution with its convergence delta, given the difference to explain and its standard error.

    ``quadrature_error`` is that of the sum of all attributions.
    """
    value, error = explained
    delta = sum_of(attribution).item() - value
    if attribution.covariance is None or error is None:
        error = None
    else:
        rows = torch.stack([totals.double().sum(1) for totals in attribution.replicates.values()]).sum(0)
        bias = None if attribution.bias is None else sum_of(attribution.bias)[None]
        variance = covariance_of_mean(rows[:, None], bias).item()
        error = math.hypot(math.sqrt(variance), error, quadrature_error)
    magnitude = sum(tensor.double().abs().sum().item() for tensor in attribution.values())
    info = {
        **attribution.info,
        **convergence(delta, error, value, magnitude),
        "quadrature_error": None if error is None else quadrature_error,
    }
    return dataclasses.replace(attribution, convergence_delta=delta, convergence_delta_error=error, info=info)


def sum_of(tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the sum of all elements of all tensors, 0-d."""
    return torch.stack([tensor.double().sum() for tensor in tensors.values()]).sum()


def convergence(delta: float, error: float | None, explained: float, magnitude: float) -> dict[str, Any]:
    """Return the entries of ``info`` about convergence.

    Parameters
    ----------
    delta, error
        The sum of the attributions minus the explained difference, and its standard error or None.
    explained
        The difference.
    magnitude
        The sum of the attributions' magnitudes, which determines the rounding error.
    """
    rounding = ROUNDING * (magnitude + abs(explained))
    return {
        "explained": explained if math.isfinite(explained) else None,  # JSON has no infinity
        "convergence": verdict(delta, error, explained, rounding),
    }


def verdict(delta: float, error: float | None, explained: float, rounding: float = 0.0) -> str:
    """Return whether attributions add up to what they explain, within 5 % including two standard errors.

    The verdict is ``"cannot be told"`` if the error is too large to decide.

    Example
    -------
    >>> verdict(0.01, 0.01, 1.0), verdict(0.2, 0.01, 1.0), verdict(0.2, 1.0, 1.0)
    ('adds up', 'does not add up', 'cannot be told')
    """
    if error is None or not math.isfinite(delta):
        return ADDS_UP if abs(delta) <= rounding < math.inf else INCONCLUSIVE
    allowed = TOLERANCE * abs(explained) + rounding
    if abs(delta) + 2 * error <= allowed:
        return ADDS_UP
    return DOES_NOT_ADD_UP if abs(delta) - 2 * error > allowed else INCONCLUSIVE


def return_with_delta(
    run: Run, results: list[SceneAttribution], *, interrupted: bool, with_delta: bool
) -> Result:
    """Return the results, with their convergence deltas if requested, as in Captum."""
    result = run.return_results(results, interrupted=interrupted)
    if not with_delta:
        return result
    deltas = [torch.tensor(attribution.convergence_delta) for attribution in results]
    return result, deltas if run.returns_list else deltas[0]
