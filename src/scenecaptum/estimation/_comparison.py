"""The effect of another render setting, such as longer paths, on gradients, with common random numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ..protocols import Renderer
from ._gradients import GradientEstimator, GradientSum, Point, sum_gradients
from ._metric import TargetedMetric
from ._metric_image import TransformSelector
from ._progress import Progress
from ._replicates import Budget

Tensors = Mapping[str, torch.Tensor]


class _RendererPair:
    """Two renderers of the same parameters as one; their images, which may differ in size, are concatenated.

    Both use the same seeds, so that most of the noise cancels in their difference. There is no ``seed_grad``: with
    importance sampling of pixels, the two backward passes would sample different pixels.
    """

    def __init__(self, first: Any, second: Any) -> None:
        self.renderers = (first, second)
        self.shapes: list[torch.Size] = []

    def __call__(self, inputs: Tensors, *, seed: int, spp: int | None) -> torch.Tensor:
        images = [renderer(inputs, seed=seed, spp=spp) for renderer in self.renderers]
        self.shapes = [image.shape for image in images]
        return torch.cat([image.flatten() for image in images])

    def difference(self, metric: TargetedMetric) -> TargetedMetric:
        """Return the metric of the second image minus that of the first."""

        def change(images: torch.Tensor) -> torch.Tensor:
            parts = images.split([shape.numel() for shape in self.shapes])
            first, second = (part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True))
            return metric.metric(second) - metric.metric(first)

        change.__name__ = metric.name
        return dataclasses.replace(metric, metric=change)


def differences(
    renderer: Renderer,
    other: Any,
    metrics: Sequence[TargetedMetric],
    point: Point,
    budget: Budget,
    bar: Progress,
) -> list[GradientSum]:
    """Return the gradient of each metric with the other renderer, minus that with the first.

    Raises KeyboardInterrupt if it is interrupted.
    """
    pair = _RendererPair(renderer, other)
    # No denoising: the bias that noise causes in the two metrics largely cancels.
    transform_selector = TransformSelector(False, pair, point.values, smoothed=False)
    changes = [pair.difference(metric) for metric in metrics]
    gradients = GradientEstimator(pair, changes, budget, transform_selector, bar)
    sums, interrupted = sum_gradients(gradients, [point])
    if interrupted:
        raise KeyboardInterrupt
    return sums
