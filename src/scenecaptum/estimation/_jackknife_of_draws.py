"""The jackknife of a smoothed metric, a mean over draws of noise: each image has a share of the draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ._adjoints import Adjoints, error_parts
from ._linearity import is_rounding
from ._metric import Draws, TargetedMetric
from ._metric_image import IDENTITY
from ._transform_errors import transform_errors
from ._weighted_means import deviations_of_mean, second_order, steps, weighted_mean

# Differences between images are evaluated on one of so many draws of each share, but at least on these.
_PART_OF_DRAWS, _MIN_DRAWS = 4, 4


def jackknife_of_draws(
    metric: TargetedMetric, images: torch.Tensor, fractions: torch.Tensor, draws: Sequence[Draws]
) -> Adjoints:
    """Evaluate a metric that is a mean over draws of noise; each image has a share of the draws.

    Every share is evaluated for itself at the mean image. Backward pass ``i`` gets the adjoint image of share
    ``i``, so that the variance of the propagated gradients contains that of the draws. The effect of the noise of
    the images is estimated from a part of each share, at the mean image and at the other weighted means.

    The gradient of a network jumps between any two images, for each draw by itself. The differences between the
    weighted means contain this noise although it does not depend on the render. The spread over the shares shows
    how much of the squared differences it is; they are scaled down by it. The bias is treated in the same way. A
    mean over noise has no thresholds that only single images could show.
    """
    shares = [metric.with_draws(share) for share in draws]
    mean_image = weighted_mean(images, fractions)
    directions, step, coefficients = steps(fractions)
    centre = _Shares.evaluate(shares, fractions, mean_image)
    value, adjoint = centre.value, centre.adjoint
    draw_noise = centre.adjoints - adjoint
    parts = [metric.with_draws(_part(share)) for share in draws]
    start = _Shares.evaluate(parts, fractions, mean_image)
    values, changes, noise = [], [], 0.0
    sums = torch.zeros_like(centre.adjoints)
    for row in fractions + step * directions:
        stepped = _Shares.evaluate(parts, fractions, weighted_mean(images, row))
        change = stepped.adjoints - start.adjoints
        values.append(stepped.value - start.value)
        changes.append(centre.mean(change))
        noise += centre.variance(change)
        sums += change
    count = len(images)
    by_direction = torch.stack(changes)
    differences = torch.tensor(values, dtype=torch.float64)
    drift = second_order(differences, 0.0, step).item()
    of_draws = (fractions / (count - 1)).sqrt() * (centre.values - value)
    noise_parts = torch.cat([deviations_of_mean(differences) / step, of_draws])
    error = noise_parts.norm().item()
    if not metric.transform.denoises and is_rounding(by_direction, adjoint):
        return Adjoints(
            value,
            error,
            drift,
            tuple(centre.adjoints),
            (),
            draw_noise=draw_noise,
            error_parts=error_parts(0.0, 0.0, noise_parts),
        )

    by_direction -= by_direction.mean(0)
    by_direction *= math.sqrt(_signal(by_direction, noise - count * centre.variance(sums / count)))
    deviations = torch.tensordot(coefficients.to(by_direction), by_direction / step, 1)
    bias_by_share = sums / (step**2 * (count - 1))
    bias = centre.mean(bias_by_share)
    bias *= _signal(bias, centre.variance(bias_by_share))
    value_error, transform_biases = 0.0, tuple[torch.Tensor, ...]()
    if metric.transform is not IDENTITY:
        merged = metric.with_draws({seed: n for share in draws for seed, n in share.items()})
        at_centre = merged.value_and_adjoint(mean_image)
        value_error, transform_biases = transform_errors(merged, images, fractions, *at_centre)
    return Adjoints(
        value=value,
        standard_error=math.hypot(error, drift, value_error),
        bias=drift,
        per_replicate=tuple(centre.adjoints + deviations),
        bias_adjoints=(bias, *transform_biases),
        drift=(drift, error),
        denoised=None if metric.transform.more_accurate is None else value + value_error,
        transform=metric.transform,
        draw_noise=draw_noise,
        error_parts=error_parts(drift, value_error, noise_parts),
    )


@dataclass(frozen=True)
class _Shares:
    """Values ``(shares,)`` and adjoints ``(shares, …)`` of the shares of draws at an image."""

    values: torch.Tensor
    adjoints: torch.Tensor
    fractions: torch.Tensor

    @classmethod
    def evaluate(
        cls, shares: Sequence[TargetedMetric], fractions: torch.Tensor, image: torch.Tensor
    ) -> _Shares:
        """Evaluate the shares one after the other, so that the activations of one are in memory."""
        values, adjoints = zip(*(share.value_and_adjoint(image) for share in shares), strict=True)
        return cls(torch.tensor(values, dtype=torch.float64), torch.stack(adjoints), fractions)

    @property
    def value(self) -> float:
        """Mean of the values."""
        return self.mean(self.values).item()

    @property
    def adjoint(self) -> torch.Tensor:
        """Mean of the adjoints."""
        return self.mean(self.adjoints)

    def mean(self, by_share: torch.Tensor) -> torch.Tensor:
        """Return the weighted mean over the shares."""
        result: torch.Tensor = torch.tensordot(self.fractions.to(by_share), by_share, 1)
        return result

    def variance(self, by_share: torch.Tensor) -> float:
        """Return the variance of the weighted mean over the shares, summed over the elements."""
        squares = (by_share - self.mean(by_share)).double().square().flatten(1 if by_share.ndim > 1 else 0)
        return float(self.mean(squares.sum(1) if by_share.ndim > 1 else squares) / (len(by_share) - 1))


def _part(share: Draws) -> Draws:
    """Return a part of the draws of a share, enough for differences between images."""
    return {seed: min(count, max(_MIN_DRAWS, count // _PART_OF_DRAWS)) for seed, count in share.items()}


def _signal(estimate: torch.Tensor, noise: float) -> float:
    """Return the share of the squared norm of an estimate that is not noise, between 0 and 1."""
    total = estimate.double().square().sum().item()
    return min(1.0, max(0.0, 1 - noise / total)) if total else 0.0
