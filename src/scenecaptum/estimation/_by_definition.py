"""The value of a relaxed metric by its definition, which may jump, with its standard error."""

from __future__ import annotations

import math
from typing import Any

import torch

from ..protocols import takes_keyword
from ._metric import TargetedMetric
from ._resampling import balanced_halves, half_sample_error

# In errors of a pixel. Noise biases the value one way: with the largest, twice its error contains the value
# without noise, wherever the source lies. The smaller ones are for changes: a source before and after it may both
# cross the threshold at the largest, and only one of them at a smaller one.
_SHIFTS = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)
_SPLITS = 3  # into halves, for the noise of a pixel: each takes two more images to denoise


def value_by_definition(metric: TargetedMetric, images: torch.Tensor) -> tuple[float, float | None] | None:
    """Return the value of a relaxed metric without relaxation, and its standard error; None for others.

    ``images`` are independent, ``(replicates, …)``, and their mean is rated. A single one has no error.
    """
    exact = metric.by_definition()
    if exact is None:
        return None
    error = half_sample_error(lambda kept: exact.value(images[kept].mean(0)), len(images))
    return exact.value(images.mean(0)), _with_jumps(error, jumps(exact, images))


def difference_by_definition(
    before: TargetedMetric, after: TargetedMetric, images: tuple[torch.Tensor, torch.Tensor]
) -> tuple[float, float | None] | None:
    """Return the change of ``value_by_definition`` and its standard error; None for other metrics.

    Both are those of the same random numbers, most of whose noise cancels. The metrics differ by their image
    transforms, which follow what has moved.
    """
    first, second = before.by_definition(), after.by_definition()
    if first is None or second is None:
        return None

    def difference(kept: torch.Tensor) -> float:
        return second.value(images[1][kept].mean(0)) - first.value(images[0][kept].mean(0))

    count = len(images[1])
    pairs = zip(jumps(first, images[0]), jumps(second, images[1]), strict=True)
    error = _with_jumps(half_sample_error(difference, count), tuple(b - a for a, b in pairs))
    return difference(torch.arange(count)), error


def error_of_denoiser(
    before: TargetedMetric, after: TargetedMetric, images: tuple[torch.Tensor, torch.Tensor]
) -> float:
    """Return by how much a change of a metric is uncertain because the denoiser dims small bright sources.

    It is 0 of metrics that compare no pixel with a threshold.
    """
    if not _compares_pixels(before, images[0]):
        return 0.0
    sides = zip((before, after), images, strict=True)
    first, second = (_changes(metric, pictures, _biases(metric, pictures)) for metric, pictures in sides)
    return max(abs(b - a) for a, b in zip(first, second, strict=True))


def jumps(exact: TargetedMetric, images: torch.Tensor) -> tuple[float, ...]:
    """Return the changes of a value by the definition if pixels are darker by their errors, and brighter.

    They differ from 0 only where pixels are compared with a threshold. Noise takes a share of the pixels of a
    source close to it to the other side. That share is nearly the same in every render: no repeat shows its error.
    """
    if not _compares_pixels(exact, images):
        return (0.0,)
    return _changes(exact, images, torch.hypot(_noise(exact, images), _biases(exact, images)))


def _compares_pixels(metric: TargetedMetric, images: torch.Tensor) -> bool:
    """Whether a metric compares pixels with a threshold, and there are replicates to know their errors from."""
    return len(images) > 1 and takes_keyword(metric.metric, "compared")


def _changes(metric: TargetedMetric, images: torch.Tensor, errors: torch.Tensor) -> tuple[float, ...]:
    """Return the changes of a metric if what it compares with a threshold is off by multiples of its errors."""
    rating: Any = metric.metric
    image = metric.transform(images.mean(0))
    value = rating(image).item()
    shifted = [(image + shift * errors).clamp_min(0) for shift in _SHIFTS]
    return tuple(rating(image, compared=one).item() - value for one in shifted)


def _noise(metric: TargetedMetric, images: torch.Tensor) -> torch.Tensor:
    """Return the standard error of each pixel of the metric image of the mean."""
    squares = [
        ((metric.transform(images[a].mean(0)) - metric.transform(images[b].mean(0))) / 2).square()
        for a, b in balanced_halves(len(images))[:_SPLITS]
    ]
    return torch.stack(squares).mean(0).sqrt()


def _biases(metric: TargetedMetric, images: torch.Tensor) -> torch.Tensor:
    """Return how far the denoiser takes each pixel from the render, beyond the noise of the render.

    It spreads the light of a bulb of one pixel over its neighbours, in every half of the samples alike.
    """
    mean = images.mean(0)
    noise = images.var(0) / len(images)
    return ((mean - metric.transform(mean)).square() - noise).clamp_min(0).sqrt()


def _with_jumps(error: float | None, changes: tuple[float, ...]) -> float | None:
    return None if error is None else math.hypot(error, max(map(abs, changes)))
