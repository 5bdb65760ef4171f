"""The value of a relaxed metric by its definition."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeGuard

import torch

from ..attr import Definition
from ..daylight import DaylightMetric
from ..estimation import Metric
from ..metrics import Uniformity

SPLITS = 16  # of the replicates into halves


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


def half_sample_error(statistic: Callable[[torch.Tensor], float], count: int) -> float | None:
    """Return the standard error of a statistic of samples, given by their indices; None of a single sample.

    The mean of half of the samples differs from that of all by as much as the latter from the truth, which is
    what a value that jumps needs: it may not jump at all for the small steps of a delete-one jackknife.

    References
    ----------
    McCarthy, "Pseudo-replication: half samples", Review of the International Statistical Institute 37(3), 1969.
    """
    if count < 2:
        return None
    generator = torch.Generator().manual_seed(0)
    centre, half, squares = statistic(torch.arange(count)), count // 2, []
    for _ in range(SPLITS):
        for kept in torch.randperm(count, generator=generator).split([half, count - half]):
            # The variance of the mean of all, relative to that of the difference.
            scale = len(kept) / (count - len(kept))
            squares.append(scale * (statistic(kept) - centre) ** 2)
    return math.sqrt(sum(squares) / len(squares))
