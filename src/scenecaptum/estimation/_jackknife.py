"""Jackknife estimates of a metric's value and adjoint images, with the noise and bias of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from ._metric import Draws, TargetedMetric
from ._metric_image import IDENTITY, ImageTransform, TransformSelector

# Drift is the metric at half of the samples minus the metric at all samples. From 2 standard errors it is
# significant, from 4 it is known well enough to extrapolate.
SIGNIFICANT_DRIFT = 2.0
_CLEAR_DRIFT = 4.0

_CONSISTENT_BIAS = 3.0  # standard errors from 0
_MIN_EXPONENT = 0.2  # of the decay of the bias with the number of samples
# Step from the denoised to the noisy image; small, because the two differ much in single bright pixels.
_PROBE_STEP = 0.03
# Differences between images are evaluated on one of so many draws of a smoothed metric, but at least on these.
_PART_OF_DRAWS, _MIN_DRAWS = 4, 4
_BIAS_SIGMAS = 2.0  # a bias of which only the magnitude is known counts as this many standard errors


@dataclass(frozen=True)
class Adjoints:
    """The metric's value and adjoint images, estimated from the primal images."""

    value: float  # of the metric at the mean image
    standard_error: float | None  # estimated by the jackknife; includes the bias; None for a single replicate
    bias: float | None  # the remaining one, due to the finite number of samples; None for a single replicate
    per_replicate: tuple[torch.Tensor, ...]  # the adjoint image for each backward pass
    # Of the adjoint, due to the finite number of samples or to the denoiser; None for a linear metric.
    bias_adjoint: torch.Tensor | None
    # The metric at half of the samples minus that at all samples, on average, and the standard error without the
    # bias; None for a linear metric or a single replicate.
    drift: tuple[float, float] | None = None
    # The metric at the denoised image, if that is estimated to be more accurate but denoising was switched off.
    # The difference is part of the standard error.
    denoised: float | None = None
    transform: ImageTransform = IDENTITY  # from the render to the metric image
    # The part of ``per_replicate`` that is due to the draws of noise of each replicate, for a smoothed metric.
    draw_noise: torch.Tensor | None = None

    @property
    def is_linear(self) -> bool:
        """Whether the metric was found to be linear."""
        return self.bias is not None and self.bias_adjoint is None


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
        return _jackknife_of_draws(metric, stack, fractions, draws)
    if draws is not None:
        metric = metric.with_draws(draws[0])
    value, adjoint = metric.value_and_adjoint(_mean(stack, fractions))
    if count == 1:
        return Adjoints(value, None, None, (adjoint,), None, transform=metric.transform)

    directions, step, coefficients = _steps(fractions)
    values, adjoints = _evaluate_at_means(metric, stack, fractions + step * directions)
    drift = _second_order(values, value, step).item()
    error = math.sqrt(values.var().item()) / step
    if not metric.transform.denoises and _is_rounding(adjoints - adjoint, adjoint):
        # The metric is linear: a bias of the size of rounding errors is not worth a backward pass.
        return Adjoints(value, error, drift, (adjoint,) * count, None)

    bias_adjoint = _second_order(adjoints, adjoint, step)
    _, half_step_adjoints = _evaluate_at_means(metric, stack, fractions + step / 2 * directions)
    bias_adjoint = (
        _shrinkage(bias_adjoint, _second_order(half_step_adjoints, adjoint, step / 2)) * bias_adjoint
    )
    curvature = (adjoints + adjoint) / 2 - half_step_adjoints
    is_consistent = _is_consistent(curvature, _mean(stack, fractions))
    removed = bias_adjoint if is_consistent else torch.zeros_like(adjoint)
    deviations = torch.tensordot(coefficients.to(adjoints), (adjoints - adjoints.mean(0)) / step, 1)
    single_values, single_adjoints = _evaluate_at_means(metric, stack, torch.eye(count, dtype=torch.float64))
    single_mean = torch.tensordot(fractions.to(single_adjoints), single_adjoints, 1)
    deviations = _larger(deviations, single_adjoints - single_mean)
    remaining = 1.0
    if abs(drift) > _CLEAR_DRIFT * error:
        single_drift = single_values.mean().item() - value
        remaining = _remaining_bias(drift, single_drift, 1 / fractions.square().sum().item())
    value_error, adjoint_error = _transform_errors(metric, stack, fractions, value, adjoint)
    return Adjoints(
        value=value,
        standard_error=math.hypot(error, remaining * drift, value_error),
        bias=remaining * drift,
        per_replicate=tuple(adjoint - removed + deviations),
        bias_adjoint=remaining * bias_adjoint + adjoint_error,
        drift=(drift, error),
        denoised=None if metric.transform.more_accurate is None else value + value_error,
        transform=metric.transform,
    )


def _steps(fractions: torch.Tensor) -> tuple[torch.Tensor, float, torch.Tensor]:
    """Return the changes of the weights for a step of 1, the step, and what turns steps into deviations."""
    roots = fractions.sqrt()
    directions, step = _directions(tuple(roots.tolist()))
    return roots * directions, step, (directions / roots).T


def _jackknife_of_draws(
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
    mean_image = _mean(images, fractions)
    directions, step, coefficients = _steps(fractions)
    centre = _Shares.evaluate(shares, fractions, mean_image)
    value, adjoint = centre.value, centre.adjoint
    draw_noise = centre.adjoints - adjoint
    parts = [metric.with_draws(_part(share)) for share in draws]
    start = _Shares.evaluate(parts, fractions, mean_image)
    values, changes, noise = [], [], 0.0
    sums = torch.zeros_like(centre.adjoints)
    for row in fractions + step * directions:
        stepped = _Shares.evaluate(parts, fractions, _mean(images, row))
        change = stepped.adjoints - start.adjoints
        values.append(stepped.value - start.value)
        changes.append(centre.mean(change))
        noise += centre.variance(change)
        sums += change
    count = len(images)
    by_direction = torch.stack(changes)
    differences = torch.tensor(values, dtype=torch.float64)
    drift = _second_order(differences, 0.0, step).item()
    error = math.sqrt(differences.var().item() / step**2 + centre.variance(centre.values))
    if not metric.transform.denoises and _is_rounding(by_direction, adjoint):
        return Adjoints(value, error, drift, tuple(centre.adjoints), None, draw_noise=draw_noise)

    by_direction -= by_direction.mean(0)
    by_direction *= math.sqrt(_signal(by_direction, noise - count * centre.variance(sums / count)))
    deviations = torch.tensordot(coefficients.to(by_direction), by_direction / step, 1)
    bias_by_share = sums / (step**2 * (count - 1))
    bias = centre.mean(bias_by_share)
    bias *= _signal(bias, centre.variance(bias_by_share))
    value_error, adjoint_error = 0.0, torch.zeros_like(adjoint)
    if metric.transform is not IDENTITY:
        merged = metric.with_draws({seed: n for share in draws for seed, n in share.items()})
        at_centre = merged.value_and_adjoint(mean_image)
        value_error, adjoint_error = _transform_errors(merged, images, fractions, *at_centre)
    return Adjoints(
        value=value,
        standard_error=math.hypot(error, drift, value_error),
        bias=drift,
        per_replicate=tuple(centre.adjoints + deviations),
        bias_adjoint=bias + adjoint_error,
        drift=(drift, error),
        denoised=None if metric.transform.more_accurate is None else value + value_error,
        transform=metric.transform,
        draw_noise=draw_noise,
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


def _transform_errors(
    metric: TargetedMetric, images: torch.Tensor, fractions: torch.Tensor, value: float, adjoint: torch.Tensor
) -> tuple[float, torch.Tensor]:
    """Return the errors of value and adjoint that are due to the choice of the image transform."""
    if metric.transform.more_accurate is not None:
        better = metric.with_transform(metric.transform.more_accurate)
        better_value, better_adjoint = better.value_and_adjoint(_mean(images, fractions))
        return better_value - value, better_adjoint - adjoint
    if metric.transform.denoises:
        value_bias, adjoint_bias = _denoiser_bias(metric, images, fractions, adjoint)
        return value_bias / _BIAS_SIGMAS, adjoint_bias
    return 0.0, torch.zeros_like(adjoint)


def _denoiser_bias(
    metric: TargetedMetric, images: torch.Tensor, fractions: torch.Tensor, adjoint: torch.Tensor
) -> tuple[float, torch.Tensor]:
    """Return the bias of the value and of the adjoint that is caused by the denoiser.

    Let T be the true image and S the denoised image. The value includes the term of first order in ``T − S`` but
    not that of second order, ``⟨T − S, H (T − S)⟩ / 2``. Two independent noisy images stand in for T on the two
    sides of the product, so that their noise averages out. ``H`` is estimated by finite differences whose step is
    the noise of the mean image. The adjoint lacks ``H (T − S)``.
    """
    mean = _mean(images, fractions)
    denoised = metric.transform(mean)
    value_bias = 0.0
    for fraction, image in zip(fractions.tolist(), images.clamp_min(0), strict=True):
        step = math.sqrt(fraction)
        _, stepped = metric.value_and_adjoint_at(torch.lerp(denoised, image, step))
        others = mean - denoised - fraction * (image - denoised)
        product = ((stepped - adjoint).double() * others.double()).sum().item()
        value_bias += fraction / step * product / 2
    _, stepped = metric.value_and_adjoint_at(torch.lerp(denoised, mean.clamp_min(0), _PROBE_STEP))
    return value_bias / (1 - fractions.square().sum().item()), (stepped - adjoint) / _PROBE_STEP


def _mean(images: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return a weighted mean that is exact for equal images, and never below their minimum despite rounding."""
    first = images[0]
    return (first + torch.einsum("r,r...->...", weights.to(images), images - first)).clamp_min(images.amin(0))


def _evaluate_at_means(
    metric: TargetedMetric, images: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the metric's values and adjoints at the weighted mean of the images for each row of weights."""
    values, adjoints = zip(*(metric.value_and_adjoint(_mean(images, row)) for row in weights), strict=True)
    return torch.tensor(values, dtype=torch.float64), torch.stack(adjoints)


def _second_order(stepped: torch.Tensor, centre: torch.Tensor | float, step: float) -> torch.Tensor:
    """Return the second-order effect of the noise of the mean image, from steps of ``step`` times that noise."""
    count = len(stepped)
    return (stepped.mean(0) - centre) / (step**2 * (count - 1) / count)


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


@lru_cache(maxsize=64)
def _directions(roots: tuple[float, ...]) -> tuple[torch.Tensor, float]:
    """Return ``V``, ``(n, n)`` with ``VᵀV = 1 − s sᵀ`` and rows that sum to 0, and the step ``t``.

    ``t`` is the largest step for which no element of ``s ± t·v`` is negative, for any row. If all elements of
    ``s`` are equal, the cyclic shifts of any sequence with a flat spectrum (except for the mean) are a solution; a
    reflection maps them to any other ``s``. Takes the best of many sequences with random phases.
    """
    count = len(roots)
    random = np.random.default_rng(0)
    tries = min(200, 1 + 10**6 // count**2)  # limits memory; many replicates need few tries
    spectra = np.exp(2j * np.pi * random.uniform(size=(tries, count // 2 + 1)))
    spectra[:, 0] = 0
    if count % 2 == 0:
        spectra[:, -1] = np.sign(spectra[:, -1].real)
    shifts = (np.arange(count) - np.arange(count)[:, None]) % count
    directions = np.fft.irfft(spectra, count)[:, shifts] @ _reflection(np.array(roots))
    steps = (roots / np.abs(directions).max(1)).min(1)
    best = steps.argmax()
    return torch.from_numpy(directions[best]), float(steps[best])


def _reflection(direction: np.ndarray) -> np.ndarray:
    """Return the Householder reflection that maps the unit vector with equal elements to ``direction``."""
    normal = len(direction) ** -0.5 - direction
    square = normal @ normal
    identity: np.ndarray = np.eye(len(direction))
    return identity if square < 1e-24 else identity - 2 / square * np.outer(normal, normal)


def adjoints_if_linear(metric: TargetedMetric, known: Adjoints, image: torch.Tensor) -> Adjoints | None:
    """Evaluate a metric at a single image if its adjoint equals that at another point, else return None."""
    value, adjoint = metric.value_and_adjoint(image)
    if not (known.is_linear and _is_rounding(adjoint - known.per_replicate[0], adjoint)):
        return None
    return Adjoints(value, None, 0.0, (adjoint,), None)


def is_linear(metric: TargetedMetric, images: Sequence[torch.Tensor]) -> bool:
    """Whether a metric has the same adjoint at two different images; the second may be derived from the first.

    A metric without a derivative counts as non-linear.
    """
    first = images[0]
    metric = metric.with_few_draws()  # noise is no reason for being linear or not
    darker = torch.lerp(first, first.roll(1, 0), 0.5) / 2
    other = next((image for image in images[1:] if not torch.equal(image, first)), darker)
    adjoint, other_adjoint = (metric.value_and_derivative(image)[1] for image in (first, other))
    if adjoint is None or other_adjoint is None:
        return False
    return _is_rounding(other_adjoint - adjoint, adjoint)


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


def _is_rounding(difference: torch.Tensor, of: torch.Tensor) -> bool:
    return bool(difference.double().norm() <= 1e-5 * of.double().norm())
