"""Measuring changed scenes with the same seeds, and how far a parameter can be moved in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ..attr import SceneAttribution
from ..attr._gradients import input_values, require_memory
from ..attr._jackknife import through_view
from ..attr._metric import Metric, Target, TargetedMetric
from ..attr._passes import channel_totals
from ..attr._view import Denoise, Viewer
from ..errors import check_seed, whole_number

# Of a parameter's range: how far a step goes at most, and the room below which it turns round at a bound.
LONGEST, CRAMPED = 0.1, 0.01


class Scenes:
    """Measures changed scenes, always with the same seeds, so that most of their noise cancels in differences.

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``.
    values
        The unchanged scene.
    seeds
        A seed for each replicate.
    spp
        Samples per pixel of each, or None where the renderer decides.
    denoise
        As for ``VanillaSceneGradient``; the unchanged scene decides for all.

    Attributes
    ----------
    metric
        With its target, and its view of the pictures.
    still
        The measurement of the unchanged scene.
    """

    def __init__(
        self,
        renderer: Any,
        metric: Metric,
        target: Target,
        values: Mapping[str, torch.Tensor],
        seeds: Sequence[int],
        spp: int | None,
        *,
        denoise: Denoise = "auto",
    ) -> None:
        self.renderer = renderer
        self.values = values
        self.seeds = seeds
        self.spp = spp
        require_memory(renderer, [spp], len(seeds))
        targeted, images = TargetedMetric(metric, target), self._images({})
        (self.metric,) = through_view([targeted], list(images), Viewer(denoise, renderer))
        self.still = self._pseudo_values(images)

    @classmethod
    def split(
        cls,
        renderer: Any,
        metric: Metric,
        target: Target,
        *,
        seed: int,
        spp: int | None,
        replicates: int,
        denoise: Denoise = "auto",
    ) -> Scenes:
        """Split the samples per pixel of every scene, the renderer's by default, over so many replicates."""
        values = input_values(renderer, None)
        spp = getattr(renderer, "spp", None) if spp is None else whole_number("spp", spp)
        count = whole_number("replicates", replicates, 2)
        seeds = np.random.SeedSequence([check_seed("seed", seed), 4]).generate_state(count).tolist()
        return cls(renderer, metric, target, values, seeds, spp and math.ceil(spp / count), denoise=denoise)

    def _images(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        changed = {**self.values, **changes}
        with torch.no_grad():
            return torch.stack([self.renderer(changed, seed=seed, spp=self.spp) for seed in self.seeds])

    def measure(self, changes: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the metric's jackknife pseudo-values, ``(replicates,)`` in float64."""
        return self._pseudo_values(self._images(changes))

    def _pseudo_values(self, images: torch.Tensor) -> torch.Tensor:
        total, count = images.sum(0), len(images)
        whole = self.metric.value(total / count)
        without = [self.metric.value((total - image) / (count - 1)) for image in images]
        return count * whole - (count - 1) * torch.tensor(without, dtype=torch.float64)


def view_of(attribution: SceneAttribution) -> Denoise:
    """Return ``denoise=`` for scenes that a metric shall see as it saw that of an attribution."""
    picture = attribution.info.get("picture")
    return "auto" if picture is None else bool(picture["denoised"])


def unit_gradient(gradient: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Return the direction of a parameter's gradient, of length 1 over its channels; it broadcasts to the value.

    Of a texture, all texels move alike: what single texels are said to do is mostly noise.
    """
    totals = channel_totals(gradient)
    direction: torch.Tensor = (totals / totals.double().norm()).to(totals)
    return direction.reshape(gradient.shape if gradient.ndim < 2 else (-1,)).to(value)


def room(value: torch.Tensor, direction: torch.Tensor, low: float, high: float) -> float:
    """Return how far every element can go in a direction before one meets a bound."""
    direction = direction.expand_as(value)
    towards = torch.where(direction > 0, high - value, value - low)
    return (towards / direction.abs())[direction != 0].min().item()


def mean_and_error(replicates: torch.Tensor) -> tuple[float, float]:
    """Return the mean of independent replicates and its standard error."""
    return replicates.mean().item(), (replicates.std() / math.sqrt(len(replicates))).item()
