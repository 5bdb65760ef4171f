"""Whether attributions add up to what they explain."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch

from ._attribution import SceneAttribution
from ._method import Result, Run
from ._metric import TargetedMetric
from ._passes import covariance_of_mean

CONSISTENT = 3.0  # standard errors

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


def convergence_delta(
    attribution: SceneAttribution, explained: tuple[float, float | None]
) -> tuple[float, float | None]:
    """Return by how much attributions exceed the difference that they explain, and the standard error of that."""
    total = sum_of(attribution).item()
    value, error = explained
    if attribution.covariance is None or error is None:
        return total - value, None
    rows = torch.stack([one.double().sum(1) for one in attribution.replicates.values()]).sum(0)
    bias = None if attribution.bias is None else sum_of(attribution.bias)[None]
    own = covariance_of_mean(rows[:, None], bias).item()
    return total - value, math.sqrt(own + error**2)


def sum_of(tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the sum of all elements of all tensors, 0-d."""
    return torch.stack([one.double().sum() for one in tensors.values()]).sum()


def completed(attribution: SceneAttribution, explained: tuple[float, float | None]) -> SceneAttribution:
    """Return an attribution that says how far it adds up to the difference that it explains."""
    delta, error = convergence_delta(attribution, explained)
    magnitude = sum(value.double().abs().sum().item() for value in attribution.values())
    statement = verdict(delta, error, ROUNDING * (magnitude + abs(explained[0])))
    info = {**attribution.info, "explained": explained[0], "convergence": statement}
    return dataclasses.replace(attribution, convergence_delta=delta, convergence_delta_error=error, info=info)


def verdict(delta: float, error: float | None, rounding: float = 0.0) -> str:
    """Say whether a delta is consistent with 0, given its standard error and what rounding may leave."""
    if not math.isfinite(delta):
        return "the metric is not finite at the baseline"
    if error is None:
        return "without error bars"
    if abs(delta) <= CONSISTENT * error + rounding:
        return "consistent with 0"
    if error <= rounding:
        return "not consistent with 0, and there is no noise that would explain it"
    return f"not consistent with 0, by {abs(delta) / error:.1f} standard errors"


def hand_over(run: Run, results: list[SceneAttribution], *, interrupted: bool, with_delta: bool) -> Result:
    """Return results as they were asked for: alone or with their deltas, as Captum does."""
    asked = run.hand_over(results, interrupted=interrupted)
    if not with_delta:
        return asked
    deltas = [torch.tensor(one.convergence_delta) for one in results]
    return asked, deltas if run.several else deltas[0]
