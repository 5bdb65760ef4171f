"""What a longer path or a finer picture would change: the effect of a setting, measured on shared seeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tqdm import tqdm

from ._gradients import Gradients, GradientSum, Point, sum_gradients
from ._metric import TargetedMetric
from ._passes import Budget
from ._view import Viewer

Tensors = Mapping[str, torch.Tensor]


class _Both:
    """Two renderers of the same parameters as one; their pictures, which may differ in size, are laid end to end.

    Both see the same seeds, so that most of their noise is gone from their difference. It has no ``seed_grad``: a
    backward pass that chooses its pixels by the adjoint would choose others for either.
    """

    def __init__(self, one: Any, other: Any) -> None:
        self.renderers = (one, other)
        self.shapes: list[torch.Size] = []

    def __call__(self, inputs: Tensors, *, seed: int, spp: int | None) -> torch.Tensor:
        pictures = [renderer(inputs, seed=seed, spp=spp) for renderer in self.renderers]
        self.shapes = [picture.shape for picture in pictures]
        return torch.cat([picture.flatten() for picture in pictures])

    def difference(self, metric: TargetedMetric) -> TargetedMetric:
        """Return the metric of the other's picture minus that of the one's."""

        def change(pictures: torch.Tensor) -> torch.Tensor:
            parts = pictures.split([shape.numel() for shape in self.shapes])
            one, other = (part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True))
            return metric.metric(other) - metric.metric(one)

        change.__name__ = metric.name
        return dataclasses.replace(metric, metric=change)


def differences(
    renderer: Any,
    other: Any,
    metrics: Sequence[TargetedMetric],
    point: Point,
    budget: Budget,
    bar: tqdm[Any],
) -> list[GradientSum]:
    """Return by how much the gradient of each metric is another with the other renderer.

    Raises
    ------
    KeyboardInterrupt
        Where it was not finished.
    """
    both = _Both(renderer, other)
    # Two pictures in one vector: what their noise puts into the two metrics is much the same.
    viewer = Viewer(False, both)
    gradients = Gradients(both, [both.difference(one) for one in metrics], budget, viewer, bar)
    found, interrupted = sum_gradients(gradients, [point])
    if interrupted:
        raise KeyboardInterrupt
    return found
