"""Splitting a sample budget into independent passes, and what their spread says about the error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ..errors import check_seed, whole_number
from ._metric import TargetedMetric

DEFAULT_PASSES = 8


@dataclass(frozen=True)
class Budget:
    """How samples are split: over points of parameter space, and at each of these over independent passes.

    Attributes
    ----------
    spp
        For each point, the samples per pixel of each of its passes, or None where the renderer decides.
    seeds, gradient_seeds
        For each point, a seed for each primal and each backward pass, independent of each other: if the backward
        pass replayed the primal's samples, their common noise would bias the gradient of a non-linear metric.
    """

    spp: tuple[int | None, ...]
    seeds: tuple[tuple[int, ...], ...]
    gradient_seeds: tuple[tuple[int, ...], ...]

    @classmethod
    def split(cls, spp: int | None, passes: int, seed: int, points: int = 1) -> Budget:
        """Split ``spp`` samples per pixel over the points, at each into passes of equal size.

        A single point gets the smallest number from ``passes`` to ``2·passes`` that divides ``spp``; where none
        does, the samples of each pass are rounded up. Fewer samples than passes give one pass a sample. Several
        points share the passes, but have two each at least, and as many samples each as the others or one more.
        """
        passes = whole_number("replicates", passes)
        spp = None if spp is None else whole_number("spp", spp)
        if passes > 1 and points > 1:
            passes = max(2, math.ceil(passes / points))
        elif spp is not None and passes > 1:
            passes = next((n for n in range(passes, 2 * passes + 1) if spp % n == 0), min(passes, spp))
        states = np.random.SeedSequence(check_seed("seed", seed)).generate_state(2 * passes * points)
        drawn = states.reshape(2, points, passes).tolist()
        return cls(_shares(spp, passes, points), *(tuple(tuple(row) for row in half) for half in drawn))

    @property
    def passes(self) -> int:
        """Independent passes at each point."""
        return len(self.seeds[0])

    @property
    def total(self) -> int | None:
        """Samples per pixel in all, or None where the renderer decides."""
        counts = [one for one in self.spp if one is not None]
        return self.passes * sum(counts) if counts else None


def _shares(spp: int | None, passes: int, points: int) -> tuple[int | None, ...]:
    if spp is None:
        return (None,) * points
    rounds = max(points, math.ceil(spp / passes))
    return tuple(rounds * (k + 1) // points - rounds * k // points for k in range(points))


@dataclass(frozen=True)
class Adjoints:
    """What the metric makes of the primal passes.

    Attributes
    ----------
    value, standard_error, bias
        The metric at the mean image, and the jackknife's estimates of its standard error and of the bias that
        the image's noise puts into it (None for a single pass).
    passes
        The adjoint image to be propagated by each backward pass.
    bias_adjoint
        What the noise of the image puts into the adjoint on average, or None where the metric is linear.
    """

    value: float
    standard_error: float | None
    bias: float | None
    passes: tuple[torch.Tensor, ...]
    bias_adjoint: torch.Tensor | None

    @property
    def is_linear(self) -> bool:
        """Whether the metric is linear, as far as can be seen here."""
        return self.bias is not None and self.bias_adjoint is None


def jackknife(metric: TargetedMetric, images: Sequence[torch.Tensor]) -> Adjoints:
    """Evaluate a metric on the mean image, and on the mean of all images but one, for each one.

    Backward pass ``r`` gets the pseudo-value ``R·a(mean) − (R − 1)·a(mean without r)`` of the adjoint image
    ``a = ∂M/∂I``. To first order it is ``a + H (image r − mean)`` with ``H`` the metric's Hessian, so the spread
    of the propagated gradients contains the noise of the image at its full size (propagating ``a(mean without
    r)`` itself would show only the fraction ``1/(R − 1)`` of it), and their mean is free of the bias of order
    ``1/R`` that a noisy image puts into the adjoint of a non-linear metric.

    References
    ----------
    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981.
    """
    count = len(images)
    total = torch.stack(tuple(images)).sum(0)
    value, adjoint = metric.value_and_adjoint(total / count)
    if count == 1:
        return Adjoints(value, None, None, (adjoint,), None)

    values, adjoints = zip(
        *(metric.value_and_adjoint((total - image) / (count - 1)) for image in images), strict=True
    )
    mean_value = sum(values) / count
    spread = sum((one - mean_value) ** 2 for one in values)
    bias_adjoint = (count - 1) * (torch.stack(adjoints).mean(0) - adjoint)
    # A linear metric leaves rounding errors here, which are not worth a pass.
    linear = bias_adjoint.norm() <= 1e-5 * adjoint.norm()
    return Adjoints(
        value=value,
        standard_error=math.sqrt((count - 1) / count * spread),
        bias=(count - 1) * (mean_value - value),
        passes=tuple(count * adjoint - (count - 1) * one for one in adjoints),
        bias_adjoint=None if linear else bias_adjoint,
    )


@dataclass
class Spread:
    """Running mean and variance of one parameter's gradient over the passes (Welford's algorithm).

    The channel totals of every pass are kept as well: the error of a norm or of a difference of two results
    needs their covariance.
    """

    mean: torch.Tensor
    squares: torch.Tensor = field(init=False)
    totals: list[torch.Tensor] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.mean = torch.zeros_like(self.mean)
        self.squares = torch.zeros_like(self.mean)

    def add(self, gradient: torch.Tensor) -> None:
        """Take in the gradient of one more pass, in place: a texture's gradient is large."""
        self.totals.append(channel_totals(gradient))
        weight = 1 / len(self.totals)
        step = gradient - self.mean
        self.mean.add_(step, alpha=weight)
        self.squares.addcmul_(step, step, value=1 - weight)

    def standard_error(self) -> torch.Tensor:
        """Return the standard error of the mean, elementwise; it takes two passes."""
        count = len(self.totals)
        return (self.squares / (count * (count - 1))).sqrt_()


def channel_totals(tensor: torch.Tensor) -> torch.Tensor:
    """Return what a parameter's attribution amounts to, a ``(C,)`` vector.

    A scalar, vector or matrix is itself, flattened. A texture ``(H, W, C)`` or a grid is summed over its texels:
    the effect of raising all of them alike, so that a texture of one colour counts like that colour.
    """
    return tensor.reshape(-1) if tensor.ndim < 3 else tensor.reshape(-1, tensor.shape[-1]).sum(0)


def covariance_of_mean(replicates: torch.Tensor) -> torch.Tensor:
    """Return the ``(C, C)`` covariance of the mean of ``(passes, C)`` independent replicates."""
    deviations = replicates - replicates.mean(0)
    count = len(replicates)
    return deviations.T @ deviations / (count * (count - 1))
