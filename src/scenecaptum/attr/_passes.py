"""Splitting a sample budget into independent passes, and what their spread says about the error."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from .._finite import check_image, located
from ..errors import SceneCaptumError, check_seed, whole_number

DEFAULT_PASSES = 8

# Samples that a metric which is not linear sees, for each sample of the backward pass. One sample in a picture
# costs a third of one in a backward pass; where both add as much variance, √3 of them for one is cheapest. A
# picture that needs a denoiser is noisier than that.
PICTURE_RATIO = 2.0
NOISY_PICTURE_RATIO = 4.0


@dataclass(frozen=True)
class Budget:
    """How samples are split: over points of parameter space, and at each of these over independent passes.

    Attributes
    ----------
    spp
        For each point, the samples per pixel of each of its passes, or None where the renderer decides.
    seeds
        For each point, a seed for each picture of it that a metric may see: for those of its passes, and at least
        as many as at any other point.
    gradient_seeds
        For each point, a seed for each backward pass, independent of the pictures': if a backward pass replayed
        their samples, their common noise would bias the gradient of a non-linear metric.
    picture_ratio
        How many samples a metric that is not linear sees for each sample of the backward pass, 1 or more. None: at
        a single point ``PICTURE_RATIO``, or ``NOISY_PICTURE_RATIO``, and at several no more than it must see.
    """

    spp: tuple[int | None, ...]
    seeds: tuple[tuple[int, ...], ...]
    gradient_seeds: tuple[tuple[int, ...], ...]
    picture_ratio: float | None = None

    @classmethod
    def split(
        cls, spp: int | None, passes: int, seed: int, points: int = 1, *, pairs: int | None = None
    ) -> Budget:
        """Split ``spp`` samples per pixel over the points, at each into passes of equal size.

        A single point gets the smallest number from ``passes`` to ``2·passes`` that divides ``spp``; where none
        does, the samples of each pass are rounded up. Fewer samples than passes give one pass a sample.

        Several points share the passes. The first ``pairs`` of them, all by default, have two each at least, whose
        differences tell the noise; the others may have one. Their samples are rounded so that the sum stays.
        """
        passes = whole_number("replicates", passes)
        spp = None if spp is None else whole_number("spp", spp)
        if points == 1:
            counts = [_passes_of_one_point(spp, passes)]
            samples = [None if spp is None else math.ceil(spp / counts[0])]
        else:
            each = math.ceil(passes / points)
            paired = points if pairs is None else pairs
            counts = [max(2, each) if passes > 1 and k < paired else each for k in range(points)]
            samples = [None] * points if spp is None else _shares(spp, counts)
        states = np.random.SeedSequence(check_seed("seed", seed)).generate_state(2 * max(counts) * points)
        seeds, gradient_seeds = states.reshape(2, points, max(counts)).tolist()
        return cls(
            tuple(samples),
            tuple(map(tuple, seeds)),
            tuple(tuple(row[:count]) for row, count in zip(gradient_seeds, counts, strict=True)),
        )

    def with_round(self, passes: int, spp: int, seed: int) -> Budget:
        """Return the same and one more round of passes, whose seeds are its own."""
        entropy = [check_seed("seed", seed), 2, len(self.spp)]
        seeds, gradient_seeds = (
            np.random.SeedSequence(entropy).generate_state(2 * passes).reshape(2, -1).tolist()
        )
        return dataclasses.replace(
            self,
            spp=(*self.spp, spp),
            seeds=(*self.seeds, tuple(seeds)),
            gradient_seeds=(*self.gradient_seeds, tuple(gradient_seeds)),
        )

    def with_pictures(self, picture_spp: int | None, spp: int | None) -> Budget:
        """Return the same with so many samples per pixel in the pictures where there are ``spp`` in all.

        Raises
        ------
        SceneCaptumError
            Where these are fewer than ``spp``, or the renderer decides how many there are.
        """
        if picture_spp is None:
            return self
        if spp is None:
            raise SceneCaptumError("picture_spp= needs a number of samples to begin with: give spp= as well.")
        if whole_number("picture_spp", picture_spp) < spp:
            raise SceneCaptumError(
                f"picture_spp={picture_spp} is less than spp={spp}, whose pictures are rendered in any case: give "
                f"{spp} or more."
            )
        return dataclasses.replace(self, picture_ratio=picture_spp / spp)

    @property
    def passes(self) -> tuple[int, ...]:
        """For each point, how many independent passes it has."""
        return tuple(map(len, self.gradient_seeds))

    @property
    def total(self) -> int | None:
        """Samples per pixel in all, or None where the renderer decides."""
        known = [one * count for one, count in zip(self.spp, self.passes, strict=True) if one is not None]
        return sum(known) if known else None


def picture_seeds(seeds: Sequence[int]) -> list[int]:
    """Return for each picture a seed for samples that are added to it."""
    return [int(np.random.SeedSequence([seed, 9]).generate_state(1)[0]) for seed in seeds]


def pictures(
    renderer: Any, values: Mapping[str, torch.Tensor], seeds: Sequence[int], spp: int | None
) -> list[torch.Tensor]:
    """Render a picture for each seed, without a graph; one that is not finite is refused."""
    images = []
    for number, seed in enumerate(seeds, 1):
        with torch.no_grad(), located(f"In pass {number} of {len(seeds)}"):
            images.append(renderer(values, seed=seed, spp=spp).detach())
            check_image(images[-1], f"The render with seed {seed}")
    return images


def _passes_of_one_point(spp: int | None, passes: int) -> int:
    if spp is None or passes == 1:
        return passes
    return next((n for n in range(passes, 2 * passes + 1) if spp % n == 0), min(passes, spp))


def _shares(spp: int, passes: Sequence[int]) -> list[int | None]:
    """Return the samples of each pass, so that every point has about as many: what is rounded is carried over."""
    shares: list[int | None] = []
    used = 0
    for number, count in enumerate(passes, 1):
        each = max(1, round((spp * number / len(passes) - used) / count))
        shares.append(each)
        used += each * count
    return shares


class Spread:
    """Running mean and variance of one parameter's gradient over the passes (Welford's algorithm).

    The channel totals of every pass are kept as well: the error of a norm or of a difference of two results
    needs their covariance. Squares of what float32 holds would overflow it, or vanish: none is formed in float32.
    """

    mean: torch.Tensor

    def __init__(self) -> None:
        self.totals: list[torch.Tensor] = []
        self._norm: torch.Tensor | None = None  # of the deviations from the mean

    def add(self, gradient: torch.Tensor) -> None:
        """Take in the gradient of one more pass. A texture's is large, so that few operations touch all of it."""
        self.totals.append(channel_totals(gradient).double())
        count = len(self.totals)
        if count == 1:
            self.mean = gradient
            return
        step = gradient - self.mean
        # The first gradient is the caller's.
        self.mean = self.mean.add_(step, alpha=1 / count) if count > 2 else self.mean.add(step, alpha=1 / 2)
        step.mul_(math.sqrt(1 - 1 / count))
        self._norm = step.abs_() if self._norm is None else self._norm.hypot_(step)

    def error(self) -> torch.Tensor:
        """Return the standard error of the mean, elementwise; it takes two passes."""
        assert self._norm is not None
        count = len(self.totals)
        return self._norm / math.sqrt(count * (count - 1))


def channel_totals(tensor: torch.Tensor) -> torch.Tensor:
    """Return what a parameter's attribution amounts to, a ``(C,)`` vector.

    A scalar or vector is itself. What has values at many places, a texture ``(H, W, C)``, a grid or the colours of
    a mesh's vertices ``(N, C)``, is summed over these: the effect of raising all of them alike, so that a texture
    of one colour counts like that colour.
    """
    return tensor.reshape(-1) if tensor.ndim < 2 else tensor.reshape(-1, tensor.shape[-1]).sum(0)


def covariance_of_mean(replicates: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Return the ``(C, C)`` covariance of the mean of ``(passes, C)`` independent replicates.

    A ``bias`` of ``(C,)`` that was taken out counts as an error of its own size: it is known to first order only,
    and where the metric bends within the noise of a pixel (a glare threshold), its own noise is that large.
    """
    # Equal replicates deviate by nothing at all: their mean may be rounded.
    replicates = replicates.double()
    deviations = replicates - replicates[0]
    deviations = deviations - deviations.mean(0)
    count = len(replicates)
    covariance = deviations.T @ deviations / (count * (count - 1))
    return covariance if bias is None else covariance + bias[:, None] * bias
