"""Whether attributions add up to what they explain."""

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

# The part of what they explain that attributions may miss, two standard errors included, and still add up.
MISSED = 0.05

ADDS_UP, DOES_NOT, UNKNOWN = "adds up", "does not add up", "cannot be told"

# What rounding may leave, relative to the sum of the magnitudes: single precision, some operations.
ROUNDING = 16 * torch.finfo(torch.float32).eps


def difference(
    metric: TargetedMetric, images: Sequence[torch.Tensor], references: Sequence[Sequence[torch.Tensor]]
) -> tuple[float, float | None]:
    """Return ``M(image) − mean of M(references)``, and its standard error where there are several passes.

    The passes of all scenes share their seeds. The jackknife takes out the bias that their noise puts into a
    metric that is not linear.
    """

    def rest(passes: Sequence[torch.Tensor], without: int | None) -> torch.Tensor:
        kept = [image for number, image in enumerate(passes) if number != without]
        return torch.stack(kept).mean(0)

    def at(without: int | None) -> float:
        others = [metric.value(rest(passes, without)) for passes in references]
        return metric.value(rest(images, without)) - sum(others) / len(others)

    count = len(images)
    if count == 1:
        return at(None), None
    whole = count * at(None)
    pseudo = [whole - (count - 1) * at(without) for without in range(count)]
    mean = sum(pseudo) / count
    return mean, math.sqrt(sum((one - mean) ** 2 for one in pseudo) / (count * (count - 1)))


def completed(
    attribution: SceneAttribution, explained: tuple[float, float | None], quadrature_error: float = 0.0
) -> SceneAttribution:
    """Return an attribution that says how far it adds up to the difference that it explains.

    ``quadrature_error`` is that of the integral of all attributions together.
    """
    value, error = explained
    delta = sum_of(attribution).item() - value
    if attribution.covariance is None or error is None:
        error = None
    else:
        rows = torch.stack([one.double().sum(1) for one in attribution.replicates.values()]).sum(0)
        bias = None if attribution.bias is None else sum_of(attribution.bias)[None]
        noise = covariance_of_mean(rows[:, None], bias).item()
        error = math.hypot(math.sqrt(noise), error, quadrature_error)
    magnitude = sum(one.double().abs().sum().item() for one in attribution.values())
    info = {
        **attribution.info,
        **convergence(delta, error, value, magnitude),
        "quadrature_error": None if error is None else quadrature_error,
    }
    return dataclasses.replace(attribution, convergence_delta=delta, convergence_delta_error=error, info=info)


def sum_of(tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the sum of all elements of all tensors, 0-d."""
    return torch.stack([one.double().sum() for one in tensors.values()]).sum()


def convergence(delta: float, error: float | None, explained: float, magnitude: float) -> dict[str, Any]:
    """Return what ``info`` says of attributions that miss a difference by ``delta``.

    Parameters
    ----------
    delta, error
        By how much they exceed it, and the standard error of that, None where it is not known.
    explained
        The difference.
    magnitude
        The sum of their magnitudes, of which single precision leaves a rounding error.
    """
    rounding = ROUNDING * (magnitude + abs(explained))
    return {
        "explained": explained if math.isfinite(explained) else None,  # JSON has no infinity
        "convergence": verdict(delta, error, explained, rounding),
    }


def verdict(delta: float, error: float | None, explained: float, rounding: float = 0.0) -> str:
    """Say whether attributions add up: within their errors, and those within a part of what they explain.

    A large error is no excuse: where it hides whether they add up, that cannot be told.

    Example
    -------
    >>> verdict(0.01, 0.01, 1.0), verdict(0.2, 0.01, 1.0), verdict(0.2, 1.0, 1.0)
    ('adds up', 'does not add up', 'cannot be told')
    """
    if error is None or not math.isfinite(delta):
        return ADDS_UP if abs(delta) <= rounding < math.inf else UNKNOWN
    allowed = MISSED * abs(explained) + rounding
    if abs(delta) + 2 * error <= allowed:
        return ADDS_UP
    return DOES_NOT if abs(delta) - 2 * error > allowed else UNKNOWN


def hand_over(run: Run, results: list[SceneAttribution], *, interrupted: bool, with_delta: bool) -> Result:
    """Return results as they were asked for: alone or with their deltas, as Captum does."""
    asked = run.hand_over(results, interrupted=interrupted)
    if not with_delta:
        return asked
    deltas = [torch.tensor(one.convergence_delta) for one in results]
    return asked, deltas if run.several else deltas[0]
