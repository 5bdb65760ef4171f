"""The value of a relaxed metric by its definition."""

from __future__ import annotations

import torch

from ..attr import Definition
from ..daylight import DaylightMetric
from ..estimation import Metric


def definition_of(metric: Metric, image: torch.Tensor) -> Definition | None:
    """Return the value of a relaxed metric of daylight without relaxation; None for other metrics."""
    if not isinstance(metric, DaylightMetric) or not metric.relaxation:
        return None
    value = metric.hard(image).item()
    points = len(image) if metric.counts_points else None
    return Definition(value, metric.measure.verdict(value), points)
