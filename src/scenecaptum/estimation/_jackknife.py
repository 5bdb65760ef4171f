"""Jackknife estimates of a metric's value and adjoint images, with the noise and bias of both."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch

from ..denoising import guides_of
from ..protocols import Renderer
from ._adjoints import Adjoints, error_parts
from ._jackknife_of_draws import jackknife_of_draws
from ._linearity import is_linear, is_rounding
from ._metric import Draws, TargetedMetric
from ._metric_image import IDENTITY, TransformSelector
from ._transform_errors import transform_errors
from ._weighted_means import deviations_of_mean, evaluate_at_means, second_order, steps, weighted_mean

# Drift is the metric at half of the samples minus the metric at all samples. From 2 standard errors it is
# significant, from 4 it is known well enough to extrapolate.
SIGNIFICANT_DRIFT = 2.0
_CLEAR_DRIFT = 4.0

_CONSISTENT_BIAS = 3.0  # standard errors from 0
_MIN_EXPONENT = 0.2  # of the decay of the bias with the number of samples


def jackknife(
    metric: TargetedMetric,
    images: Sequence[torch.Tensor],
    samples: Sequence[float] | None = None,
    draws: Sequence[Draws] | None = None,
) -> Adjoints:
    """Evaluate a metric at the mean image and at other weighted means of the images, a generalized jackknife.

    Image ``i`` has the fraction ``s_i²`` of all ``samples`` (by default equal). In weighted mean ``r`` it has the
    weight ``s_i² + t·s_i·v_ri``, with ``VᵀV = 1 − s sᵀ``. The noise of these means has ``t²`` times the covariance
    of the noise of the mean image, so to first order the variance of the metric over them, divided by ``t²``, is
    the variance of the metric. The delete-one jackknife is one such choice, with a small ``t``. If the metric has
    jumps (a pixel that crosses a threshold, the kink of a network), dividing by a small ``t`` amplifies them. This
    implementation uses the largest ``t`` for which all weights are non-negative.

    Backward pass ``i`` gets the adjoint image ``a = ∂M/∂I`` of the mean, minus its estimated bias, plus an
    estimate of ``H (image i − mean)``, where ``H`` is the Hessian of the metric. The variance of the propagated
    gradients then contains the full noise of the image, and their mean is free of the first-order bias that a
    noisy image causes in the gradient of a non-linear metric. The drift of the metric from half of the samples to
    all of them gives the remaining bias of value and adjoint.

    References
    ----------
    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981.
    McCarthy, "Pseudo-replication: half samples", Review of the International Statistical Institute 37(3), 1969.
    """
    count = len(images)
    weights = [1.0] * count if samples is None else samples
    fractions = torch.tensor([weight / sum(weights) for weight in weights], dtype=torch.float64)
    stack = torch.stack(tuple(images))
    if draws is not None and count > 1:
        return jackknife_of_draws(metric, stack, fractions, draws)
    if draws is not None:
        metric = metric.with_draws(draws[0])
    value, adjoint = metric.value_and_adjoint(weighted_mean(stack, fractions))
    if count == 1:
        return Adjoints(value, None, None, (adjoint,), (), transform=metric.transform)

    directions, step, coefficients = steps(fractions)
    values, adjoints = evaluate_at_means(metric, stack, fractions + step * directions)
    drift = second_order(values, value, step).item()
    noise_parts = deviations_of_mean(values) / step
    error = noise_parts.norm().item()
    if not metric.transform.denoises and is_rounding(adjoints - adjoint, adjoint):
        # The metric is linear: a bias of the size of rounding errors is not worth a backward pass.
        return Adjoints(
            value, error, drift, (adjoint,) * count, (), error_parts=error_parts(0.0, 0.0, noise_parts)
        )

    bias_adjoint = second_order(adjoints, adjoint, step)
    _, half_step_adjoints = evaluate_at_means(metric, stack, fractions + step / 2 * directions)
    bias_adjoint = (
        _shrinkage(bias_adjoint, second_order(half_step_adjoints, adjoint, step / 2)) * bias_adjoint
    )
    curvature = (adjoints + adjoint) / 2 - half_step_adjoints
    is_consistent = _is_consistent(curvature, weighted_mean(stack, fractions))
    removed = bias_adjoint if is_consistent else torch.zeros_like(adjoint)
    deviations = torch.tensordot(coefficients.to(adjoints), (adjoints - adjoints.mean(0)) / step, 1)
    single_values, single_adjoints = evaluate_at_means(metric, stack, torch.eye(count, dtype=torch.float64))
    single_mean = torch.tensordot(fractions.to(single_adjoints), single_adjoints, 1)
    deviations = _larger(deviations, single_adjoints - single_mean)
    remaining = 1.0
    if abs(drift) > _CLEAR_DRIFT * error:
        single_drift = single_values.mean().item() - value
        remaining = _remaining_bias(drift, single_drift, 1 / fractions.square().sum().item())
    value_error, transform_biases = transform_errors(metric, stack, fractions, value, adjoint)
    return Adjoints(
        value=value,
        standard_error=math.hypot(error, remaining * drift, value_error),
        bias=remaining * drift,
        per_replicate=tuple(adjoint - removed + deviations),
        bias_adjoints=(remaining * bias_adjoint, *transform_biases),
        drift=(drift, error),
        denoised=None if metric.transform.more_accurate is None else value + value_error,
        transform=metric.transform,
        error_parts=error_parts(remaining * drift, value_error, noise_parts),
    )


def _larger(near: torch.Tensor, far: torch.Tensor) -> torch.Tensor:
    """Return the larger of two estimates of the same deviations, per pixel.

    ``near`` comes from weighted means of the images, ``far`` from the single images, which are noisier. For a
    smoothly curved metric both agree. The effect of a pixel that is close to a threshold may show in ``far`` only.
    """
    return torch.where(near.square().sum(0) >= far.square().sum(0), near, far)


def _remaining_bias(half_drift: float, single_drift: float, count: float) -> float:
    """Return the bias at all samples in units of ``half_drift``, by a power law.

    A bias that decays as ``N^−α`` increases by ``2^α − 1`` times itself at half of the samples (``half_drift``),
    and by ``count^α − 1`` times itself at the samples of one of ``count`` images (``single_drift``). A smooth
    metric has ``α = 1``. For a metric that responds to single bright pixels α may be much smaller and the
    remaining bias larger.
    """
    if half_drift == 0 or single_drift / half_drift >= count - 1 or count <= 2:
        return 1.0
    ratio = single_drift / half_drift
    exponents = torch.linspace(_MIN_EXPONENT, 1.0, 100, dtype=torch.float64)
    ratios = (count**exponents - 1) / (2**exponents - 1)
    exponent = exponents[(ratios - ratio).abs().argmin()] if ratio > 0 else 1.0
    return float(1 / (2**exponent - 1))


def _shrinkage(full_step: torch.Tensor, half_step: torch.Tensor) -> float:
    """Return the estimated fraction of bias, as opposed to noise, in a bias estimate; between 0 and 1.

    For a smoothly curved metric the estimates at full and at half step agree. If the metric's derivative jumps,
    like that of a ReLU network at every kink, they are mostly noise: the number of jumps crossed is proportional
    to the step ``t``, their signs are random, and the sum is divided by ``t²``, so that the squared noise is
    proportional to ``t⁻³``, eight times larger at half the step.
    """
    full, half = (bias.double().square().sum().item() for bias in (full_step, half_step))
    noise = (half - full) / (8 - 1)
    return min(1.0, max(0.0, 1 - noise / full)) if full else 0.0


def _is_consistent(curvature: torch.Tensor, image: torch.Tensor) -> bool:
    """Whether a bias is consistent over all weighted means of the images, so that it is worth removing.

    It is if many pixels contribute similarly. If it comes from a few pixels that happen to be close to a
    threshold, removing it would add more noise than it removes bias. ``curvature``, ``(means, …)``, is the second
    difference of the adjoint towards each mean; ``image`` weights the pixels.
    """
    weighted = (curvature * image).double().flatten(1).sum(1)
    return bool(weighted.mean().abs() > _CONSISTENT_BIAS * weighted.std() / math.sqrt(len(weighted)))


def adjoints_if_linear(metric: TargetedMetric, known: Adjoints, image: torch.Tensor) -> Adjoints | None:
    """Evaluate a metric at a single image if its adjoint equals that at another point, else return None."""
    value, adjoint = metric.value_and_adjoint(image)
    if not (known.is_linear and is_rounding(adjoint - known.per_replicate[0], adjoint)):
        return None
    return Adjoints(value, None, 0.0, (adjoint,), ())


def at_values(
    metric: TargetedMetric, renderer: Renderer, values: Mapping[str, torch.Tensor]
) -> TargetedMetric:
    """Return a metric for images of a scene in which something may have moved, denoised as before."""
    if not metric.transform.denoises:
        return metric
    return metric.with_transform(dataclasses.replace(metric.transform, guides=guides_of(renderer, values)))


def with_image_transform(
    metrics: Sequence[TargetedMetric],
    images: Sequence[torch.Tensor],
    transform_selector: TransformSelector,
    samples: Sequence[float] | None = None,
) -> list[TargetedMetric]:
    """Return the metrics, the non-linear ones with the image transform that is selected for these images."""
    linear = [is_linear(metric, images) for metric in metrics]
    transform = IDENTITY if all(linear) else transform_selector.select(images, samples)
    return [
        metric if is_lin else metric.with_transform(transform)
        for metric, is_lin in zip(metrics, linear, strict=True)
    ]
