"""Splitting a sample budget into independent replicates, and the statistics of these."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..errors import SceneCaptumError, whole_number
from ..finite import check_image, error_context
from ..protocols import Capabilities, Renderer, RenderPass
from ._seeds import Stream, derived_seeds

DEFAULT_REPLICATES = 8

# Samples of the metric image per sample of the backward pass, for non-linear metrics. A primal sample costs a
# third of a backward sample; if both contribute equally to the variance, a ratio of √3 is optimal. An image that
# needs denoising contributes more.
PICTURE_RATIO = 2.0
NOISY_PICTURE_RATIO = 4.0
# The gradient of a network still depends strongly on the picture, measured by benchmarks/network.py.
SMOOTHED_PICTURE_RATIO = 16.0


# Elements of a texture that are processed at once: few enough for the processor's cache, and for torch not to
# divide them among threads. These wait for each other after each operation, which takes a hundred times as long
# if another process has one of the cores.
BLOCK = 2**14
# Elements of a sum in float32, which is rounded more the longer it is.
SUM_BLOCK = 2**20


@dataclass(frozen=True)
class Sampling:
    """The sampling that a user asks for; see ``VanillaSceneGradient.attribute``."""

    seed: int
    spp: int | None
    replicates: int
    show_progress: bool = False
    picture_spp: int | None = None


@dataclass(frozen=True)
class Budget:
    """Samples and seeds for every point of parameter space and every independent replicate there."""

    spp: tuple[int | None, ...]  # of each replicate of a point, or None for the renderer's default
    # Of the primal images. All points have the same number of them, so some may have more seeds than replicates.
    seeds: tuple[tuple[int, ...], ...]
    # One per backward pass, independent of ``seeds``: replaying the primal samples would correlate adjoint and
    # gradient noise and bias the gradient of a non-linear metric.
    gradient_seeds: tuple[tuple[int, ...], ...]
    # Samples of the metric image per sample of the backward pass for non-linear metrics, at least 1. None selects
    # ``PICTURE_RATIO`` or ``NOISY_PICTURE_RATIO`` at a single point, and the minimum at several points.
    picture_ratio: float | None = None

    @classmethod
    def split(
        cls, spp: int | None, replicates: int, seed: int, points: int = 1, *, pairs: int | None = None
    ) -> Budget:
        """Split ``spp`` samples per pixel over the points, and at each point into replicates of equal size.

        A single point gets the smallest number of replicates from ``replicates`` to ``2·replicates`` that divides
        ``spp``; if none does, the samples of each replicate are rounded up. If ``spp < replicates``, there are
        ``spp`` replicates of one sample.

        Several points share the replicates. The first ``pairs`` points (default: all) have at least two each, to
        estimate the noise; the others may have one. Samples per replicate are rounded such that the total is kept.
        """
        replicates = whole_number("replicates", replicates)
        spp = None if spp is None else whole_number("spp", spp)
        if points == 1:
            counts = [_single_point_replicates(spp, replicates)]
            samples = [None if spp is None else math.ceil(spp / counts[0])]
        else:
            each = math.ceil(replicates / points)
            paired = points if pairs is None else pairs
            counts = [max(2, each) if replicates > 1 and k < paired else each for k in range(points)]
            samples = [None] * points if spp is None else _shares(spp, counts)
        states = derived_seeds(seed, Stream.REPLICATES, 2 * max(counts) * points)
        seeds, gradient_seeds = np.reshape(states, (2, points, max(counts))).tolist()
        return cls(
            tuple(samples),
            tuple(map(tuple, seeds)),
            tuple(tuple(row[:count]) for row, count in zip(gradient_seeds, counts, strict=True)),
        )

    @classmethod
    def with_common_seeds(cls, spp: int | None, replicates: int, seed: int, points: int) -> Budget:
        """Split samples evenly over points that are compared: ``⌈⌈spp / points⌉ / replicates⌉`` each.

        All points have the same seeds (common random numbers), so that noise cancels in differences.
        """
        replicates = whole_number("replicates", replicates)
        if spp is not None:
            spp = math.ceil(math.ceil(whole_number("spp", spp) / points) / replicates)
        seeds = tuple(derived_seeds(seed, Stream.REPLICATES, replicates))
        return cls((spp,) * points, (seeds,) * points, (seeds,) * points)

    def with_round(self, replicates: int, spp: int, seed: int) -> Budget:
        """Return the budget with another round of replicates, which has its own seeds."""
        states = derived_seeds(seed, Stream.ROUNDS, 2 * replicates, len(self.spp))
        seeds, gradient_seeds = states[:replicates], states[replicates:]
        return dataclasses.replace(
            self,
            spp=(*self.spp, spp),
            seeds=(*self.seeds, tuple(seeds)),
            gradient_seeds=(*self.gradient_seeds, tuple(gradient_seeds)),
        )

    def with_picture_spp(self, picture_spp: int | None, spp: int | None) -> Budget:
        """Return the budget with ``picture_spp`` samples per pixel for the metric image, given ``spp`` in total.

        Raises if ``picture_spp`` is less than ``spp``, or ``spp`` is None.
        """
        if picture_spp is None:
            return self
        if spp is None:
            raise SceneCaptumError("picture_spp= requires spp=: give both.")
        if whole_number("picture_spp", picture_spp) < spp:
            raise SceneCaptumError(
                f"picture_spp={picture_spp} is less than spp={spp}, which are rendered in any case: give {spp} or "
                "more."
            )
        return dataclasses.replace(self, picture_ratio=picture_spp / spp)

    @property
    def replicates(self) -> tuple[int, ...]:
        """Number of replicates at each point."""
        return tuple(map(len, self.gradient_seeds))

    @property
    def total(self) -> int | None:
        """Total samples per pixel, or None for the renderer's default."""
        known = [spp * count for spp, count in zip(self.spp, self.replicates, strict=True) if spp is not None]
        return sum(known) if known else None


def extra_image_seeds(seeds: Sequence[int]) -> list[int]:
    """Return a seed for the additional samples of each image."""
    return [derived_seeds(seed, Stream.EXTRA_IMAGE_SAMPLES, 1)[0] for seed in seeds]


def render_images(
    renderer: Renderer, values: Mapping[str, torch.Tensor], seeds: Sequence[int], spp: int | None
) -> list[torch.Tensor]:
    """Render an image for each seed without tracking gradients; raise if one is not finite."""
    images = []
    begun = begin_passes(renderer, values, [RenderPass({"seed": seed, "spp": spp}) for seed in seeds])
    for number, (seed, wait) in enumerate(zip(seeds, begun, strict=True), 1):
        with torch.no_grad(), error_context(f"In replicate {number} of {len(seeds)}"):
            wait()
            images.append(renderer(values, seed=seed, spp=spp).detach())
            check_image(images[-1], f"The render with seed {seed}")
    return images


def begin_passes(
    renderer: Renderer, values: Mapping[str, torch.Tensor], passes: Sequence[RenderPass]
) -> list[Callable[[], object]]:
    """Begin passes in other processes, where the renderer can; return a function for each that waits for it."""
    begin = Capabilities(renderer).begin
    return [_do_nothing] * len(passes) if begin is None else list(begin(values, passes))


def _do_nothing() -> None:
    pass


def _single_point_replicates(spp: int | None, replicates: int) -> int:
    if spp is None or replicates == 1:
        return replicates
    return next((n for n in range(replicates, 2 * replicates + 1) if spp % n == 0), min(replicates, spp))


def _shares(spp: int, counts: Sequence[int]) -> list[int | None]:
    """Return the samples of a replicate at each point; rounding errors carry over, so that the total is kept."""
    shares: list[int | None] = []
    used = 0
    for number, count in enumerate(counts, 1):
        each = max(1, round((spp * number / len(counts) - used) / count))
        shares.append(each)
        used += each * count
    return shares


class ReplicateStatistics:
    """Running mean and standard error of one parameter's gradient over the replicates (Welford's algorithm).

    Also stores the channel totals of every replicate, because the error of a norm or of a difference of results
    needs their covariance. Squares are never formed in float32, where they could overflow or underflow.
    """

    mean: torch.Tensor
    error: torch.Tensor  # elementwise standard error of the mean, from two replicates on

    def __init__(self) -> None:
        self.totals: list[torch.Tensor] = []
        # Of a texture: the sum of gradient × value of each replicate, if known.
        self.products: list[float] = []

    def add(self, gradient: torch.Tensor, totals: torch.Tensor | None = None) -> None:
        """Add the gradient of a replicate; its channel totals, if they are known, are not summed again.

        Textures are large, so they are passed through the processor's cache once, in blocks.
        """
        self.totals.append((channel_totals(gradient) if totals is None else totals).double())
        count = len(self.totals)
        if count == 1:
            self.mean = gradient
            return
        if count == 2:
            # The first gradient belongs to the caller: do not modify it in place.
            self.mean, self.error = self.mean.contiguous().clone(), torch.zeros_like(self.mean)
        blocks = (tensor.view(-1).split(BLOCK) for tensor in (gradient.contiguous(), self.mean, self.error))
        for new, mean, error in zip(*blocks, strict=True):
            step = torch.sub(new, mean).div_(count)
            mean.add_(step)
            error.mul_(math.sqrt(1 - 2 / count)).hypot_(step)


def channel_totals(tensor: torch.Tensor) -> torch.Tensor:
    """Return the sum of a parameter's attribution over everything but the channels, a ``(C,)`` vector.

    A scalar or vector is returned as it is. Textures ``(H, W, C)``, grids and vertex colours ``(N, C)`` are summed
    over their elements: the derivative with respect to a common offset, so that a uniform texture is equivalent to
    a constant colour.
    """
    return tensor.reshape(-1) if tensor.ndim < 2 else tensor.reshape(-1, tensor.shape[-1]).sum(0)


def dot(first: torch.Tensor, second: torch.Tensor) -> float:
    """Return the sum of the products of all elements."""
    blocks = (tensor.reshape(-1).split(SUM_BLOCK) for tensor in (first, second))
    return math.fsum(torch.dot(one, other).item() for one, other in zip(*blocks, strict=True))


def covariance_of_mean(replicates: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Return the ``(C, C)`` covariance of the mean of ``(replicates, C)`` independent rows.

    A ``bias`` of ``(C,)`` that has been subtracted is added as an error of its own size: it is known to first
    order only, and if the metric is strongly curved within the noise of a pixel (a glare threshold), it is as
    uncertain.
    """
    # Subtract the first row: the mean of equal rows may be rounded, which would give a spurious variance.
    replicates = replicates.double()
    deviations = replicates - replicates[0]
    deviations = deviations - deviations.mean(0)
    count = len(replicates)
    covariance = deviations.T @ deviations / (count * (count - 1))
    if bias is None:
        return covariance
    bias = bias.to(covariance)
    return covariance + bias[:, None] * bias
