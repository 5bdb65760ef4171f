"""The value of a relaxed metric by its definition."""

from __future__ import annotations

from typing import TypeGuard

import torch

from ..attr import Definition
from ..daylight import DaylightMetric
from ..estimation import Metric, half_sample_error
from ..metrics import Uniformity


def definition_of(metric: Metric, images: torch.Tensor) -> Definition | None:
    """Return the value of a relaxed metric of daylight, or of uniformity, without relaxation; None for others.

    ``images`` are independent daylight coefficients, ``(replicates, points, P, 3)``, or pictures of a grid, whose
    mean is rated. A single one has no error.
    """
    if not _is_relaxed(metric):
        return None
    value = metric.hard(images.mean(0)).item()
    error = half_sample_error(lambda kept: metric.hard(images[kept].mean(0)).item(), len(images))
    counts = isinstance(metric, DaylightMetric) and metric.counts_points
    return Definition(value, metric.measure.verdict(value), images.shape[1] if counts else None, error)


def _is_relaxed(metric: Metric) -> TypeGuard[DaylightMetric | Uniformity]:
    return isinstance(metric, DaylightMetric | Uniformity) and metric.relaxation > 0


def difference_by_definition(
    metric: Metric, before: torch.Tensor, after: torch.Tensor
) -> tuple[float, float | None] | None:
    """Return the change of the value of ``definition_of`` and its standard error; None for other metrics.

    Both are those of the same random numbers, most of whose noise cancels.
    """
    if not _is_relaxed(metric):
        return None

    def difference(kept: torch.Tensor) -> float:
        first, second = (metric.hard(images[kept].mean(0)).item() for images in (before, after))
        return second - first

    return difference(torch.arange(len(after))), half_sample_error(difference, len(after))
