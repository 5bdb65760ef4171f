"""Errors of the metric that are due to the image transform: denoising, or its absence."""

from __future__ import annotations

import math

import torch

from ._metric import TargetedMetric
from ._weighted_means import weighted_mean

# Step from the denoised to the noisy image; small, because the two differ much in single bright pixels.
_PROBE_STEP = 0.03
_BIAS_SIGMAS = 2.0  # a bias of which only the magnitude is known counts as this many standard errors


def transform_errors(
    metric: TargetedMetric, images: torch.Tensor, fractions: torch.Tensor, value: float, adjoint: torch.Tensor
) -> tuple[float, tuple[torch.Tensor, ...]]:
    """Return the error of the value and the biases of the adjoint that the choice of the image transform causes.

    A bias is the adjoint minus the true one, as that of the jackknife.
    """
    if metric.transform.more_accurate is not None:
        better = metric.with_transform(metric.transform.more_accurate)
        better_value, better_adjoint = better.value_and_adjoint(weighted_mean(images, fractions))
        return better_value - value, (adjoint - better_adjoint,)
    if metric.transform.denoises:
        value_bias, adjoint_bias = denoiser_bias(metric, images, fractions, adjoint)
        return value_bias / _BIAS_SIGMAS, (adjoint_bias,)
    return 0.0, ()


def denoiser_bias(
    metric: TargetedMetric, images: torch.Tensor, fractions: torch.Tensor, adjoint: torch.Tensor
) -> tuple[float, torch.Tensor]:
    """Return the bias of the value and of the adjoint that is caused by the denoiser.

    Let T be the true image and S the denoised image. The value includes the term of first order in ``T − S`` but
    not that of second order, ``⟨T − S, H (T − S)⟩ / 2``. Two independent noisy images stand in for T on the two
    sides of the product, so that their noise averages out. ``H`` is estimated by finite differences whose step is
    the noise of the mean image. The adjoint lacks ``H (T − S)``: its bias is minus this.
    """
    mean = weighted_mean(images, fractions)
    denoised = metric.transform(mean)
    value_bias = 0.0
    for fraction, image in zip(fractions.tolist(), images.clamp_min(0), strict=True):
        step = math.sqrt(fraction)
        _, stepped = metric.value_and_adjoint_at(torch.lerp(denoised, image, step))
        others = mean - denoised - fraction * (image - denoised)
        product = ((stepped - adjoint).double() * others.double()).sum().item()
        value_bias += fraction / step * product / 2
    _, stepped = metric.value_and_adjoint_at(torch.lerp(denoised, mean.clamp_min(0), _PROBE_STEP))
    return value_bias / (1 - fractions.square().sum().item()), (adjoint - stepped) / _PROBE_STEP
