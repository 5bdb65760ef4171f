"""The value of a metric at one point, from the metric image that a gradient there has."""

from __future__ import annotations

from typing import NamedTuple

import torch

from ..protocols import Renderer
from ._gradients import GradientEstimator, Point, Tensors, require_memory
from ._jackknife import jackknife
from ._metric import TargetedMetric
from ._metric_image import Denoise, TransformSelector
from ._progress import Progress
from ._replicates import Budget, Sampling
from ._resampling import half_sample_error


class MetricValue(NamedTuple):
    """The value of a metric, with its standard error (None for a single replicate) and the mean picture."""

    value: float
    error: float | None
    image: torch.Tensor
    metric: TargetedMetric  # with the image transform that was used


def metric_value(
    renderer: Renderer, metric: TargetedMetric, values: Tensors, sampling: Sampling, denoise: Denoise = "auto"
) -> MetricValue:
    """Return the value of a metric, that of ``VanillaSceneGradient`` with the same sampling, without its gradient.

    A metric without a derivative has the error of half samples.
    """
    budget = Budget.split(sampling.spp, sampling.replicates, sampling.seed)
    budget = budget.with_picture_spp(sampling.picture_spp, budget.total)
    require_memory(renderer, budget.spp, max(budget.replicates))
    selector = TransformSelector(denoise, renderer, values, smoothed=metric.is_smoothed)
    with Progress(metric.label, show=sampling.show_progress) as bar:
        estimator = GradientEstimator(renderer, [metric], budget, selector, bar)
        images, (transformed,) = estimator.pictures(0, Point(values))
    image = torch.stack(images).mean(0)
    value, derivative = transformed.value_and_derivative(transformed.transform(image))
    if derivative is not None:
        found = jackknife(transformed, images, draws=transformed.split_draws(budget.seeds[0]))
        return MetricValue(found.value, found.standard_error, image, transformed)
    stack = torch.stack(images)
    error = half_sample_error(lambda kept: transformed.value(stack[kept].mean(0)), len(images))
    return MetricValue(value, error, image, transformed)
