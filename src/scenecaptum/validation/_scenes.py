"""Evaluating a metric on modified scenes with common random numbers, and how far a parameter may move."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from ..attr import SceneAttribution
from ..checkpoint import digest
from ..errors import SceneCaptumError, whole_number
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
    error_of_denoiser,
    half_sample_error,
    half_samples,
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
        self._values_unmodified: dict[tuple[int, ...], float] = {}  # by the indices of the pictures
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
        return self._pseudo_values(images, self._metric_at(changes))

    def difference(self, images: torch.Tensor, changes: Mapping[str, torch.Tensor]) -> tuple[float, float]:
        """Return by how much changes raise the metric, and the error, of the pictures that ``render`` returned."""
        return self.difference_to(images, self._metric_at(changes))

    def difference_to(self, images: torch.Tensor, after: TargetedMetric) -> tuple[float, float]:
        """Return by how much ``after`` of other pictures, of the same seeds, is above the metric, and the error.

        The error is that of half samples, because a rating may jump, and that of the denoiser.
        """
        difference = self._difference(images, after)
        error = half_sample_error(difference, len(images))
        assert error is not None, "there are at least 2 replicates"
        of_denoiser = error_of_denoiser(self.metric, after, (self.images, images))
        return difference(torch.arange(len(images))), math.hypot(error, of_denoiser)

    def half_differences(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return by how much changes raise the metric, as ``half_samples`` of the replicates."""
        images = self.render(changes)
        return half_samples(self._difference(images, self._metric_at(changes)), len(images))

    def _metric_at(self, changes: Mapping[str, torch.Tensor]) -> TargetedMetric:
        return at_values(self.metric, self.renderer, {**self.values, **changes})

    def _difference(self, images: torch.Tensor, after: TargetedMetric) -> Callable[[torch.Tensor], float]:
        """Return by how much the metric rises, as a function of the indices of the pictures."""
        return lambda kept: after.value(images[kept].mean(0)) - self._unmodified_of(kept)

    def _unmodified_of(self, kept: torch.Tensor) -> float:
        """Return the metric of the mean of some pictures of the unmodified scene, the same for all changes."""
        key = tuple(kept.tolist())
        if key not in self._values_unmodified:
            self._values_unmodified[key] = self.metric.value(self.images[kept].mean(0))
        return self._values_unmodified[key]

    @staticmethod
    def _pseudo_values(images: torch.Tensor, metric: TargetedMetric) -> torch.Tensor:
        def value(kept: torch.Tensor) -> torch.Tensor:
            return torch.tensor(metric.value(images[kept].mean(0)), dtype=torch.float64)

        return pseudo_values(value, len(images))


def scenes_of(
    attribution: SceneAttribution,
    renderer: Renderer,
    metric: Metric,
    target: Target,
    *,
    values: Mapping[str, torch.Tensor] | None = None,
    **options: Any,
) -> Scenes:
    """Return the scenes that check an attribution: at its values, with its metric image.

    ``values`` has the textures for which it was made, if these are not the renderer's own.
    """
    values = values_of(attribution, renderer, values)
    return Scenes(renderer, metric, target, **options, denoise=denoise_of(attribution), values=values)


def values_of(
    attribution: SceneAttribution, renderer: Renderer, values: Mapping[str, torch.Tensor] | None = None
) -> dict[str, torch.Tensor]:
    """Return ``values``, by default the renderer's inputs, with those at which an attribution was made.

    Raises if these are not known: results have only the mean and a hash of a texture.
    """
    values = input_values(renderer, values)
    digests = attribution.info.get("texture_digests", {})
    for name, given in attribution.parameter_values.items():
        if name not in values:
            continue
        if given.shape == values[name].shape:
            values[name] = given.to(values[name])
        elif name in digests and digests[name] != digest(values[name]):
            raise SceneCaptumError(
                f"The attribution was made for another {name!r} than that of the renderer, and results have only "
                "the mean of a texture. Create a renderer of the scene with this texture, and attribute its own "
                "inputs."
            )
    return values


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
