"""The objects of the picture that a metric depends on."""

from __future__ import annotations

import numpy as np
import torch

from ..attr import Source
from ..estimation import TargetedMetric, delete_one_jackknife
from ..metrics import GlareRating
from ..projection import SurfaceMap

MIN_SHARE = 0.02


def find_sources(
    metric: TargetedMetric, images: torch.Tensor, surfaces: SurfaceMap | None
) -> tuple[Source, ...]:
    """Return the objects that cause at least 2 % of a metric, the largest share first, with the errors.

    ``images`` are independent pictures, ``(replicates, H, W, 3)``. Without a map of the objects there are none.
    """
    if surfaces is None:
        return ()
    shares, errors = delete_one_jackknife(
        lambda kept: _shares(_weights(metric, images[kept].mean(0)), surfaces), len(images)
    )
    mean = images.mean(0)
    weights, luminance = _weights(metric, mean), _source_luminance(metric, mean)
    order = [index for index in shares.argsort(descending=True).tolist() if shares[index] >= MIN_SHARE]
    return tuple(
        Source(
            surfaces.objects[index],
            _place(weights * _coverage(surfaces, index)),
            shares[index].item(),
            errors[index].item(),
            None if luminance is None else (luminance * (_coverage(surfaces, index) > 0)).max().item(),
        )
        for index in order
    )


def _weights(metric: TargetedMetric, image: torch.Tensor) -> torch.Tensor:
    """Return how much of the metric each pixel causes, ``(H, W)``, of at least 0 and in any unit.

    A glare source contributes ``L² ω / P²`` to the sum of the rating; it is spread evenly over its pixels.
    """
    if not isinstance(metric.metric, GlareRating):
        _, adjoint = metric.value_and_adjoint(image)
        return (adjoint.double() * image.double()).sum(-1).abs()
    weights = torch.zeros(image.shape[:2], dtype=torch.float64)
    for source in metric.metric.sources(metric.transform(image)):
        rows, columns = source.pixels.cpu().unbind(-1)
        part = source.luminance**2 * source.solid_angle / source.position_index**2
        weights[rows, columns] += part / len(rows)
    return weights


def _source_luminance(metric: TargetedMetric, image: torch.Tensor) -> torch.Tensor | None:
    """Return the luminance of the glare source at each pixel, ``(H, W)``; None for other metrics."""
    if not isinstance(metric.metric, GlareRating):
        return None
    luminance = torch.zeros(image.shape[:2], dtype=torch.float64)
    for source in metric.metric.sources(metric.transform(image)):
        rows, columns = source.pixels.cpu().unbind(-1)
        luminance[rows, columns] = source.luminance
    return luminance


def _shares(weights: torch.Tensor, surfaces: SurfaceMap) -> torch.Tensor:
    """Return each object's share of the weights."""
    parts = surfaces.fraction * weights.flatten().numpy(force=True)[surfaces.pixel]
    totals = np.bincount(surfaces.object_index, weights=parts, minlength=len(surfaces.objects))
    return torch.from_numpy(totals / (totals.sum() or 1.0))


def _coverage(surfaces: SurfaceMap, index: int) -> torch.Tensor:
    """Return the fraction of each pixel that an object covers, ``(H, W)``."""
    fraction = surfaces.fraction * (surfaces.object_index == index)
    covered = np.bincount(surfaces.pixel, weights=fraction, minlength=surfaces.shape[0] * surfaces.shape[1])
    return torch.from_numpy(covered.reshape(surfaces.shape))


def _place(weights: torch.Tensor) -> str:
    """Return the ninth of the picture that holds the centre of some weights."""
    (height, width), total = weights.shape, weights.sum()
    row = (weights.sum(1) @ torch.arange(height).double() / total + 0.5) / height
    column = (weights.sum(0) @ torch.arange(width).double() / total + 0.5) / width
    vertical = ("top", "", "bottom")[min(int(3 * row), 2)]
    horizontal = ("left", "", "right")[min(int(3 * column), 2)]
    return " ".join(filter(None, (vertical, horizontal))) or "centre"
