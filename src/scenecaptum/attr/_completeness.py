"""Completeness: whether attributions add up to the difference of the metric that they explain."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch

from ..estimation import TargetedMetric, covariance_of_mean, mean_and_error, pseudo_values
from ..student import degrees_of_freedom
from ._attribution import SceneAttribution
from ._convergence import convergence
from ._method import Result, Run


def metric_difference(
    metric: TargetedMetric, images: Sequence[torch.Tensor], references: Sequence[Sequence[torch.Tensor]]
) -> tuple[float, float | None]:
    """Return ``M(image) − mean of M(references)`` and its standard error, or None for a single replicate.

    The scenes are rendered with common random numbers. The delete-one jackknife removes the first-order bias that
    image noise causes in a non-linear metric.
    """
    scenes = [torch.stack(tuple(replicates)) for replicates in (images, *references)]

    def difference(kept: torch.Tensor) -> torch.Tensor:
        value, *others = (metric.value(replicates[kept].mean(0)) for replicates in scenes)
        return torch.tensor(value - sum(others) / len(others), dtype=torch.float64)

    if len(images) == 1:
        return difference(torch.arange(1)).item(), None
    return mean_and_error(pseudo_values(difference, len(images)))


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
        **convergence(delta, error, value, magnitude, degrees_of_freedom(attribution.info)),
        "quadrature_error": None if error is None else quadrature_error,
    }
    return dataclasses.replace(attribution, convergence_delta=delta, convergence_delta_error=error, info=info)


def sum_of(tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the sum of all elements of all tensors, 0-d."""
    return torch.stack([tensor.double().sum() for tensor in tensors.values()]).sum()


def return_with_delta(
    run: Run, results: list[SceneAttribution], *, interrupted: bool, with_delta: bool
) -> Result:
    """Return the results, with their convergence deltas if requested, as in Captum."""
    result = run.return_results(results, interrupted=interrupted)
    if not with_delta:
        return result
    deltas = [torch.tensor(attribution.convergence_delta) for attribution in results]
    return result, deltas if run.returns_list else deltas[0]
