"""The objects of the picture that a metric depends on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from ..attr import Source
from ..estimation import TargetedMetric, delete_one_jackknife
from ..metrics import GlareRating
from ..projection import SurfaceMap

MIN_SHARE = 0.02


def find_sources(
    metric: TargetedMetric, images: torch.Tensor, surfaces: SurfaceMap | None, labels: Mapping[str, str]
) -> tuple[Source, ...]:
    """Return the objects that cause at least 2 % of a metric, the largest share first, with the errors.

    ``images`` are independent pictures, ``(replicates, H, W, 3)``; ``labels`` are those of the parameters. Without
    a map of the objects there are no sources.
    """
    if surfaces is None:
        return ()
    coverage = _coverage(surfaces, labels)
    names = list(coverage)
    covered = torch.stack([coverage[name] for name in names]).flatten(1)

    def shares(kept: torch.Tensor) -> torch.Tensor:
        parts = covered @ _weights(metric, images[kept].mean(0)).flatten()
        return parts / parts.sum().clamp_min(torch.finfo(parts.dtype).tiny)

    means, errors = delete_one_jackknife(shares, len(images))
    mean = images.mean(0)
    weights, luminance = _weights(metric, mean), _source_luminance(metric, mean)
    return tuple(
        Source(
            names[index],
            _place(weights * coverage[names[index]]),
            means[index].item(),
            errors[index].item(),
            None if luminance is None else (luminance * (coverage[names[index]] > 0)).max().item(),
        )
        for index in means.argsort(descending=True).tolist()
        if means[index] >= MIN_SHARE
    )


def _coverage(surfaces: SurfaceMap, labels: Mapping[str, str]) -> dict[str, torch.Tensor]:
    """Return the fraction of each pixel, ``(H, W)``, that the objects of each name cover."""
    shape, coverage = surfaces.shape, dict[str, torch.Tensor]()
    for index in np.unique(surfaces.object_index):
        fraction = surfaces.fraction * (surfaces.object_index == index)
        covered = np.bincount(surfaces.pixel, weights=fraction, minlength=shape[0] * shape[1])
        name = _name(surfaces, int(index), labels)
        coverage[name] = coverage.get(name, 0.0) + torch.from_numpy(covered.reshape(shape))
    return coverage


def _name(surfaces: SurfaceMap, index: int, labels: Mapping[str, str]) -> str:
    """Return the owner of all of an object's parameters, such as its material, or else the object's own name."""
    owners = {labels[name].rpartition(": ")[0] for name in surfaces.parameters[index] if name in labels}
    return owners.pop() if len(owners) == 1 else surfaces.objects[index]


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


def _place(weights: torch.Tensor) -> str:
    """Return the ninth of the picture that holds the centre of some weights."""
    (height, width), total = weights.shape, weights.sum()
    row = (weights.sum(1) @ torch.arange(height).double() / total + 0.5) / height
    column = (weights.sum(0) @ torch.arange(width).double() / total + 0.5) / width
    vertical = ("top", "", "bottom")[min(int(3 * row), 2)]
    horizontal = ("left", "", "right")[min(int(3 * column), 2)]
    return " ".join(filter(None, (vertical, horizontal))) or "centre"
