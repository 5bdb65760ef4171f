"""What a metric makes of several noisy pictures: its value, its adjoint images, and the noise and bias of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from ._metric import TargetedMetric
from ._view import RAW, View, Viewer

# Standard errors by which the metric at half of the samples may differ from that at all, and from which on the
# difference tells how fast it falls.
CHANCE, CLEAR = 2.0, 4.0

_AGREED = 3.0  # standard errors from 0

_SLOWEST = 0.2  # exponent of the slowest fall of a bias that is taken into account
_NEAR = 0.03  # of the way from the denoised picture to the noisy one: single bright pixels lie far beyond
_REACH = 2.0  # standard errors that a bias counts for which is known by its size only


@dataclass(frozen=True)
class Adjoints:
    """What the metric makes of the primal passes.

    Attributes
    ----------
    value, standard_error, bias
        The metric at the mean image, the jackknife's estimate of its standard error, and by how much the value may
        still be off for want of samples (None for a single pass). The standard error holds the bias.
    passes
        The adjoint image to be propagated by each backward pass.
    bias_adjoint
        By how much the adjoint may be off on average, for want of samples or by the denoiser, or None where the
        metric is linear.
    drift
        The metric at half of the samples minus that at all, on average, and the standard error without the bias:
        what is drifting and by how much chance; None where the metric is linear or there is a single pass.
    denoised
        The metric at the denoised picture, where that is nearer to the truth and was not wanted; the difference is
        part of the standard error.
    view
        How the metric saw the pictures.
    """

    value: float
    standard_error: float | None
    bias: float | None
    passes: tuple[torch.Tensor, ...]
    bias_adjoint: torch.Tensor | None
    drift: tuple[float, float] | None = None
    denoised: float | None = None
    view: View = RAW

    @property
    def is_linear(self) -> bool:
        """Whether the metric is linear, as far as can be seen here."""
        return self.bias is not None and self.bias_adjoint is None


def jackknife(
    metric: TargetedMetric, images: Sequence[torch.Tensor], samples: Sequence[float] | None = None
) -> Adjoints:
    """Evaluate a metric on the mean image, and on other weighted means of the images.

    Image ``i`` has the share ``s_i²`` of all ``samples`` (by default all have as many). In mean ``r`` it has the
    weight ``s_i² + t·s_i·v_ri``, with ``VᵀV = 1 − s sᵀ``. Then the noise of these means has ``t²`` times the
    covariance of that of the mean image, and to first order the spread of what the metric makes of them tells the
    metric's own. To leave out one image at a time is such a choice, with a small ``t``: where the metric jumps (a
    pixel that crosses a threshold, the kink of a network), dividing by it blows the jump up. Here weights differ
    by as much as they can without any below 0.

    Backward pass ``i`` gets the adjoint image ``a = ∂M/∂I`` of the mean, without the bias that its noise puts
    there as far as that can be told, and with what the means say of ``H (image i − mean)``, ``H`` being the
    metric's Hessian: the spread of the propagated gradients contains the noise of the image at its full size, and
    their mean is free of the bias of first order that a noisy image puts into the gradient of a metric that bends.
    How far the metric at half of the samples is from that at all tells what bias is left in either.

    References
    ----------
    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981.
    McCarthy, "Pseudo-replication: half samples", Review of the International Statistical Institute 37(3), 1969.
    """
    count = len(images)
    weights = [1.0] * count if samples is None else samples
    shares = torch.tensor([weight / sum(weights) for weight in weights], dtype=torch.float64)
    stack = torch.stack(tuple(images))
    value, adjoint = metric.value_and_adjoint(_mean(stack, shares))
    if count == 1:
        return Adjoints(value, None, None, (adjoint,), None, view=metric.view)

    roots = shares.sqrt()
    directions, step = _directions(tuple(roots.tolist()))
    changes = roots * directions
    values, moved = _at_means(metric, stack, shares + step * changes)
    drift = _excess(values, value, step).item()
    error = math.sqrt(values.var().item()) / step
    if not metric.view.denoises and _is_rounding(moved - adjoint, adjoint):
        # The metric is linear: rounding is not worth a pass.
        return Adjoints(value, error, drift, (adjoint,) * count, None)

    bias_adjoint = _excess(moved, adjoint, step)
    _, near = _at_means(metric, stack, shares + step / 2 * changes)
    bias_adjoint = _trust(bias_adjoint, _excess(near, adjoint, step / 2)) * bias_adjoint
    agreed = _is_agreed((moved + adjoint) / 2 - near, _mean(stack, shares))
    removed = bias_adjoint if agreed else torch.zeros_like(adjoint)
    deviations = torch.tensordot((directions / roots).T.to(moved), (moved - moved.mean(0)) / step, 1)
    singles, alone = _at_means(metric, stack, torch.eye(count, dtype=torch.float64))
    deviations = _larger(deviations, alone - torch.tensordot(shares.to(alone), alone, 1))
    left = 1.0
    if abs(drift) > CLEAR * error:
        left = _bias_left(drift, singles.mean().item() - value, 1 / shares.square().sum().item())
    moved_by, turned_by = _by_view(metric, stack, shares, value, adjoint)
    return Adjoints(
        value=value,
        standard_error=math.hypot(error, left * drift, moved_by),
        bias=left * drift,
        passes=tuple(adjoint - removed + deviations),
        bias_adjoint=left * bias_adjoint + turned_by,
        drift=(drift, error),
        denoised=None if metric.view.nearer is None else value + moved_by,
        view=metric.view,
    )


def _larger(near: torch.Tensor, far: torch.Tensor) -> torch.Tensor:
    """Return of two estimates of the same deviations the larger, for each pixel.

    ``near`` comes from means of the pictures, ``far`` from the pictures themselves, which have more noise. Where
    the metric bends evenly, both agree. A pixel just off a threshold shows only from afar what it may do.
    """
    return torch.where(near.square().sum(0) >= far.square().sum(0), near, far)


def _bias_left(doubled: float, single: float, count: float) -> float:
    """Return how large the bias at all samples is, in units of what half of the samples add to it.

    A bias that falls as ``N^−α`` rises by ``2^α − 1`` times itself at half of the samples (``doubled``), and by
    ``count^α − 1`` times at the samples of one of so many pictures (``single``). A smooth metric has ``α = 1``;
    one that rates single bright pixels may have much less, and more bias left than the first step shows.
    """
    if doubled == 0 or single / doubled >= count - 1 or count <= 2:
        return 1.0
    exponents = torch.linspace(_SLOWEST, 1.0, 100, dtype=torch.float64)
    ratios = (count**exponents - 1) / (2**exponents - 1)
    exponent = exponents[(ratios - single / doubled).abs().argmin()] if single / doubled > 0 else 1.0
    return float(1 / (2**exponent - 1))


def _by_view(
    metric: TargetedMetric,
    images: torch.Tensor,
    shares: torch.Tensor,
    value: float,
    adjoint: torch.Tensor,
) -> tuple[float, torch.Tensor]:
    """Return how far the view may put off the value and the adjoint: errors of their own size."""
    if metric.view.nearer is not None:
        better, there = metric.through(metric.view.nearer).value_and_adjoint(_mean(images, shares))
        return better - value, there - adjoint
    if metric.view.denoises:
        bent, turned = _by_denoiser(metric, images, shares, adjoint)
        return bent / _REACH, turned
    return 0.0, torch.zeros_like(adjoint)


def _by_denoiser(
    metric: TargetedMetric, images: torch.Tensor, shares: torch.Tensor, adjoint: torch.Tensor
) -> tuple[float, torch.Tensor]:
    """Return by how much what the denoiser has changed may move the value and the adjoint.

    Let T be the true picture. The value holds the first order of ``T − S`` and lacks the second,
    ``⟨T − S, H (T − S)⟩ / 2``. A noisy picture stands for T on either side, another on one than on the other, so
    that their noise has no part in it; ``H`` is told by going as far as the noise of the mean picture does. The
    adjoint lacks ``H (T − S)``.
    """
    mean = _mean(images, shares)
    seen = metric.view(mean)
    bent = 0.0
    for share, image in zip(shares.tolist(), images.clamp_min(0), strict=True):
        step = math.sqrt(share)
        _, moved = metric.value_and_adjoint_at(torch.lerp(seen, image, step))
        others = mean - seen - share * (image - seen)
        bent += share / step * ((moved - adjoint).double() * others.double()).sum().item() / 2
    _, near = metric.value_and_adjoint_at(torch.lerp(seen, mean.clamp_min(0), _NEAR))
    return bent / (1 - shares.square().sum().item()), (near - adjoint) / _NEAR


def _mean(images: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return a weighted mean: of equal images that image, and nowhere below all of them, in spite of rounding."""
    first = images[0]
    return (first + torch.einsum("r,r...->...", weights.to(images), images - first)).clamp_min(images.amin(0))


def _at_means(
    metric: TargetedMetric, images: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the metric's values and adjoints at weighted means of the images, one for each row of weights."""
    values, adjoints = zip(*(metric.value_and_adjoint(_mean(images, row)) for row in weights), strict=True)
    return torch.tensor(values, dtype=torch.float64), torch.stack(adjoints)


def _excess(moved: torch.Tensor, centre: torch.Tensor | float, step: float) -> torch.Tensor:
    """Return by how much the noise of the mean image lifts what is known at means with more noise by ``step``."""
    count = len(moved)
    return (moved.mean(0) - centre) / (step**2 * (count - 1) / count)


def _trust(far: torch.Tensor, near: torch.Tensor) -> float:
    """Return how much of a bias is bias and not noise, between 0 and 1, from two estimates.

    ``near`` was made with half the step. Where the metric bends smoothly, both are alike. Where its derivative
    jumps, as that of a network with ReLUs at every kink, they are mostly noise: the number of jumps on the way is
    proportional to the step ``t``, their signs are random, and the sum is divided by ``t²``, so that the square of
    the noise goes as ``t⁻³``: eight times as much at half the step.
    """
    square, nearer = (one.double().square().sum().item() for one in (far, near))
    noise = (nearer - square) / (8 - 1)
    return min(1.0, max(0.0, 1 - noise / square)) if square else 0.0


def _is_agreed(bends: torch.Tensor, image: torch.Tensor) -> bool:
    """Whether all means of the pictures say the same of a bias, so that it is worth taking out.

    Where a metric bends alike in many pixels, they agree. Where it bends in a few that happen to lie near a
    threshold, they do not: taking their mean out would add more noise than it removes bias.

    Parameters
    ----------
    bends
        ``(means, …)``: by how much the adjoint bends on the way to each.
    image
        Weighs the pixels by their light.
    """
    told = (bends * image).double().flatten(1).sum(1)
    return bool(told.mean().abs() > _AGREED * told.std() / math.sqrt(len(told)))


@lru_cache(maxsize=64)
def _directions(roots: tuple[float, ...]) -> tuple[torch.Tensor, float]:
    """Return ``V``, ``(n, n)`` with ``VᵀV = 1 − s sᵀ`` and rows that sum to 0, and the step ``t``.

    ``t`` is the largest with which no element of ``s ± t·v`` is below 0, for any row. Where ``s`` has equal
    elements, the shifts of any sequence whose spectrum is flat, but for the mean, will do; a reflection turns
    these into those of another ``s``. Of many sequences with random phases the best is taken.
    """
    count = len(roots)
    random = np.random.default_rng(0)
    tries = min(200, 1 + 10**6 // count**2)  # many passes take memory, and fit well enough
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
    """Return the reflection that turns the unit vector of equal elements into another one."""
    normal = len(direction) ** -0.5 - direction
    square = normal @ normal
    identity: np.ndarray = np.eye(len(direction))
    return identity if square < 1e-24 else identity - 2 / square * np.outer(normal, normal)


def still_linear(metric: TargetedMetric, elsewhere: Adjoints, image: torch.Tensor) -> Adjoints | None:
    """Let a metric that was linear elsewhere see one image; return None where it is linear no more.

    A linear metric has the same adjoint everywhere.
    """
    value, adjoint = metric.value_and_adjoint(image)
    if not (elsewhere.is_linear and _is_rounding(adjoint - elsewhere.passes[0], adjoint)):
        return None
    return Adjoints(value, None, 0.0, (adjoint,), None)


def is_linear(metric: TargetedMetric, images: Sequence[torch.Tensor]) -> bool:
    """Whether a metric has the same adjoint at two pictures: two that differ, or one and a darker one made of it.

    One that has no derivative is not linear, as far as can be told.
    """
    first = images[0]
    darker = torch.lerp(first, first.roll(1, 0), 0.5) / 2
    other = next((image for image in images[1:] if not torch.equal(image, first)), darker)
    adjoint, moved = (metric.value_and_derivative(image)[1] for image in (first, other))
    return adjoint is not None and moved is not None and _is_rounding(moved - adjoint, adjoint)


def through_view(
    metrics: Sequence[TargetedMetric],
    images: Sequence[torch.Tensor],
    viewer: Viewer,
    samples: Sequence[float] | None = None,
) -> list[TargetedMetric]:
    """Return the metrics, those that are not linear with the view that suits the pictures of a scene."""
    linear = [is_linear(metric, images) for metric in metrics]
    view = RAW if all(linear) else viewer.choose(images, samples)
    return [m if one else m.through(view) for m, one in zip(metrics, linear, strict=True)]


def _is_rounding(difference: torch.Tensor, of: torch.Tensor) -> bool:
    return bool(difference.double().norm() <= 1e-5 * of.double().norm())
