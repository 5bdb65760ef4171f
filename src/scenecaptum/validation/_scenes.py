"""Evaluating a metric on modified scenes with common random numbers, and how far a parameter may move."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import torch

from ..attr import SceneAttribution
from ..errors import whole_number
from ..estimation import (
    Denoise,
    Metric,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    at_values,
    channel_totals,
    derived_seeds,
    input_values,
    pseudo_values,
    require_memory,
    with_image_transform,
)
from ..protocols import Capabilities, Renderer, ResultKind

# Fractions of a parameter's range: the longest step, and the shortest before it is taken in the other direction.
MAX_STEP, MIN_STEP = 0.1, 0.01


class Scenes:
    """Evaluates a metric on modified scenes with common random numbers, so that noise cancels in differences.

    The parameters are those of ``VanillaSceneGradient``, with at least 2 ``replicates``. The image transform
    (``denoise``) is chosen once, on the unmodified scene, whose ``(replicates, H, W, 3)`` pictures are ``images``.
    """

    def __init__(
        self,
        renderer: Renderer,
        metric: Metric,
        target: Target,
        *,
        seed: int,
        spp: int | None,
        replicates: int,
        denoise: Denoise = "auto",
        values: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        self.renderer = renderer
        self.values = input_values(renderer, values)
        spp = Capabilities(renderer).spp if spp is None else whole_number("spp", spp)
        count = whole_number("replicates", replicates, 2)
        self.seeds = derived_seeds(seed, Stream.SCENES, count)
        self.spp = spp and math.ceil(spp / count)
        require_memory(renderer, [self.spp], count)
        targeted, self.images = TargetedMetric(metric, target), self.render({})
        selector = TransformSelector(denoise, renderer, self.values, smoothed=targeted.is_smoothed)
        (self.metric,) = with_image_transform([targeted], list(self.images), selector)
        self.unmodified = self._pseudo_values(
            self.images, self.metric
        )  # what ``measure`` returns for no changes

    def render(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the pictures of the scene with changes, ``(replicates, H, W, 3)``."""
        values = {**self.values, **changes}
        with torch.no_grad():
            return torch.stack([self.renderer(values, seed=seed, spp=self.spp) for seed in self.seeds])

    def measure(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the metric's jackknife pseudo-values, ``(replicates,)`` in float64."""
        return self.measure_in(self.render(changes), changes)

    def measure_in(self, images: torch.Tensor, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return what ``measure`` does, of the pictures that ``render`` has returned for the same changes."""
        metric = at_values(self.metric, self.renderer, {**self.values, **changes})
        return self._pseudo_values(images, metric)

    def difference(self, images: torch.Tensor, changes: Mapping[str, torch.Tensor]) -> tuple[float, float]:
        """Return by how much changes raise the metric, and the error, of the pictures that ``render`` returned.

        The error is of values of complementary halves of the pictures: where a value jumps, as a glare rating does
        when a source is joined to another, the small steps of a delete-one jackknife may miss the jump, or
        multiply it. For a linear metric, and a power of two of pictures, it is the usual standard error.

        References
        ----------
        McCarthy, "Pseudo-replication: half samples", Review of the International Statistical Institute
        37(3), 1969.
        """
        metric = at_values(self.metric, self.renderer, {**self.values, **changes})
        difference, *halves = (_of_halves(metric, images) - self._halves_unmodified).tolist()
        squares = [
            (first - second) ** 2 * len(kept) * len(others) / len(images) ** 2
            for (kept, others), first, second in zip(
                _halves(len(images)), halves[::2], halves[1::2], strict=True
            )
        ]
        return difference, math.sqrt(sum(squares) / len(squares))

    @cached_property
    def _halves_unmodified(self) -> torch.Tensor:
        return _of_halves(self.metric, self.images)

    @staticmethod
    def _pseudo_values(images: torch.Tensor, metric: TargetedMetric) -> torch.Tensor:
        def value(kept: torch.Tensor) -> torch.Tensor:
            return torch.tensor(metric.value(images[kept].mean(0)), dtype=torch.float64)

        return pseudo_values(value, len(images))


def _halves(count: int) -> list[tuple[list[int], list[int]]]:
    """Return balanced splits of at least 2 samples into halves: rows of Sylvester's Hadamard matrix."""
    rows = range(1, 1 << (count - 1).bit_length())
    odd = [[(sample & row).bit_count() % 2 for sample in range(count)] for row in rows]
    first, second = ([[s for s in range(count) if signs[s] == half] for signs in odd] for half in (0, 1))
    return list(zip(first, second, strict=True))


def _of_halves(metric: TargetedMetric, images: torch.Tensor) -> torch.Tensor:
    """Return the metric of the mean of all pictures, and of the means of the halves, in float64."""
    kept = [list(range(len(images))), *(half for halves in _halves(len(images)) for half in halves)]
    return torch.tensor([metric.value(images[indices].mean(0)) for indices in kept], dtype=torch.float64)


def denoise_of(attribution: SceneAttribution) -> Denoise:
    """Return the ``denoise=`` that reproduces how an attribution's metric image was made."""
    picture = attribution.info.get("picture")
    return "auto" if picture is None else bool(picture["denoised"])


def is_plain_gradient(attribution: SceneAttribution) -> bool:
    """Whether an attribution consists of the gradients of the parameters themselves."""
    return attribution.info.get("quantity") == ResultKind.GRADIENT.value and "groups" not in attribution.info


def unit_gradient(gradient: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Return a parameter's gradient direction, of unit length over its channels; it broadcasts to the value.

    All texels of a texture move together: the gradients of single texels are mostly noise.
    """
    totals = channel_totals(gradient)
    direction: torch.Tensor = (totals / totals.double().norm()).to(totals)
    return direction.reshape(gradient.shape if gradient.ndim < 2 else (-1,)).to(value)


def distances_to_bounds(
    value: torch.Tensor, direction: torch.Tensor, low: float, high: float
) -> torch.Tensor:
    """Return the step along a direction at which each element reaches a bound; infinite where it stays."""
    distance = torch.where(direction > 0, high - value, value - low)
    return torch.where(direction == 0, math.inf, distance / direction.abs())
