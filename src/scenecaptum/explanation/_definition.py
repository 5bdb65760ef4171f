"""The value of a relaxed metric by its definition."""

from __future__ import annotations

from typing import Any

import torch

from ..attr import Definition
from ..daylight import DaylightMetric
from ..estimation import TargetedMetric, value_by_definition
from ..metrics import GlareRating
from ._threshold import is_near_threshold


def states_definition(metric: TargetedMetric, image: torch.Tensor) -> bool:
    """Whether the value by the definition is stated of a picture, or of daylight coefficients.

    It is of every relaxed metric; of a glare rating only where its main source is near the threshold, since
    elsewhere relaxation changes nothing.
    """
    if metric.by_definition() is None:
        return False
    rating = metric.metric
    return not isinstance(rating, GlareRating) or is_near_threshold(rating, metric.transform(image))


def definition_of(metric: TargetedMetric, images: torch.Tensor) -> Definition | None:
    """Return the value of a relaxed metric without relaxation; None for others.

    ``images`` are independent daylight coefficients, ``(replicates, points, P, 3)``, or pictures, whose mean is
    rated. A single one has no error.
    """
    stated = value_by_definition(metric, images)
    if stated is None:
        return None
    value, error = stated
    relaxed: Any = metric.metric
    is_of_daylight = isinstance(relaxed, DaylightMetric)
    counts = is_of_daylight and relaxed.counts_points
    one = relaxed.step_of_a_point(images.mean(0)) if is_of_daylight else None
    greatest = relaxed.greatest if is_of_daylight else None
    verdict = class_by_definition(metric, value, images.mean(0))
    return Definition(value, verdict, images.shape[1] if counts else None, error, one, greatest)


def class_by_definition(metric: TargetedMetric, value: float, image: torch.Tensor) -> str:
    """Return what a value by the definition means, of a metric whose value of the image is the relaxed one."""
    relaxed: Any = metric.metric
    unrated = relaxed.unrated(metric.transform(image), hard=True) if isinstance(relaxed, GlareRating) else ""
    return str(unrated or relaxed.measure.verdict(value))
