"""Simultaneous confidence intervals for many parameters, and the samples needed to reach a given half-width."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

LEVEL = 0.95

_DRAWS = 2000  # gives quantiles to 1 %
_MAX_DEGREES = 40  # more change a quantile by less than 3 %
_MIN_EFFECTIVE_SAMPLES = 3.0  # with fewer, an estimated error is not a reason to stop
_ROUNDING = 1e-5  # relative rounding error of a single-precision sum over many samples


@dataclass(frozen=True)
class Quantity:
    """An estimated vector with its error, and the target half-width of its interval."""

    names: tuple[str, ...]  # the parameter, or the two parameters whose saliencies are compared
    total: torch.Tensor  # (C,): the estimate
    deviations: torch.Tensor  # (replicates, C): their squares sum to its variance; proportional to 1/√samples
    bias: torch.Tensor  # (C,): counts as an error of its own size; proportional to 1/samples
    target: float
    effective_samples: float | None = None  # behind the variance, if known; with few, it is unreliable

    @property
    def size(self) -> float:
        """The ℓ2 norm, corrected for the expected contribution of noise."""
        square = self.total.square().sum() - self.deviations.square().sum()
        return math.sqrt(max(square.item(), 0.0))

    @property
    def error(self) -> float:
        """Root of the expected squared ℓ2 norm of the error."""
        return math.sqrt(self.deviations.square().sum().item() + self.bias.square().sum().item())

    @property
    def is_exact(self) -> bool:
        """Whether the error is only due to rounding."""
        return self.error <= _ROUNDING * self.size

    def upper(self, quantile: float) -> float:
        """Return the upper confidence limit of the size."""
        return self.size + quantile * self.error if self.error else self.size

    def lower(self, quantile: float) -> float:
        """Return the lower confidence limit of the size."""
        return max(0.0, self.size - quantile * self.error) if self.error else self.size

    def degrees_of_freedom(self, maximum: int) -> int:
        """Return the effective degrees of freedom of the variance: ``maximum``, or fewer for heavy-tailed rows.

        These are ``2/u``, as for normally distributed rows, where ``u`` is the relative variance of the variance,
        ``κ/n + 2/(n − 1)`` with the excess kurtosis ``κ`` of the rows. ``κ/n`` is estimated without bias from the
        rows, or is ``1/effective_samples`` if that is larger. If one of eight rows has nearly all of the variance,
        two degrees of freedom remain.

        References
        ----------
        Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics Bulletin 2(6),
        1946. Joanes and Gill, "Comparing measures of sample skewness and kurtosis", The Statistician 47(1), 1998.
        """
        squares = self.deviations.double().square().sum(1)
        count, variance = len(squares), squares.sum().item()
        if count < 2 or not variance:
            return maximum
        tails = [1 / self.effective_samples] if self.effective_samples else []
        if count >= 4:
            fourth = count * squares.square().sum().item() / variance**2
            excess = (count - 1) * ((count + 1) * fourth - 3 * (count - 1)) / ((count - 2) * (count - 3))
            tails.append(excess / count)
        uncertainty = max(tails, default=0.0) + 2 / (count - 1)
        return max(1, min(maximum, round(2 / uncertainty))) if uncertainty > 0 else maximum

    @property
    def has_too_few_samples(self) -> bool:
        """Whether the effective number of samples is too small for an error estimate."""
        return self.effective_samples is not None and self.effective_samples < _MIN_EFFECTIVE_SAMPLES

    def meets_target(self, quantile: float) -> bool:
        """Whether the half-width is within the target and reliable, or only due to rounding."""
        return self.is_exact or (quantile * self.error <= self.target and not self.has_too_few_samples)

    def required_growth(self, quantile: float) -> float:
        """Return the factor by which the number of samples must grow to reach the target half-width.

        It solves ``ρ v + ρ² b² = (target/quantile)²`` with variance ``v``, bias ``b`` and ``ρ = 1/growth``.
        """
        variance, bias = self.deviations.square().sum().item(), self.bias.square().sum().item()
        allowed = (self.target / quantile) ** 2 if quantile > 0 else math.inf
        if variance + bias <= allowed:
            if self.effective_samples and self.has_too_few_samples:
                return _MIN_EFFECTIVE_SAMPLES / self.effective_samples
            return 1.0
        if not allowed:
            return math.inf
        return (variance + math.sqrt(variance**2 + 4 * bias * allowed)) / (2 * allowed)


def simultaneous_quantile(quantities: Sequence[Quantity], degrees: int) -> float:
    """Return ``q`` such that, with probability ``LEVEL``, every quantity's error is at most ``q`` times ``error``.

    The errors of all quantities are sampled jointly from their covariance over the replicates. Each is divided by
    a standard error with the uncertainty of these degrees of freedom, or fewer for heavy-tailed rows. For a single
    number this is Student's quantile; the Bonferroni correction would be too wide for correlated parameters.

    References
    ----------
    Westfall and Young, "Resampling-Based Multiple Testing", 1993: the distribution of the largest |t|.
    Hothorn, Bretz and Westfall, "Simultaneous inference in general parametric models", Biometrical Journal 50(3),
    2008.
    """
    if degrees < 1:
        return math.inf
    noisy = [quantity for quantity in quantities if quantity.error > 0]
    if not noisy:
        return 0.0
    degrees = min(degrees, _MAX_DEGREES)
    factor = torch.cat([torch.cat([q.deviations, q.bias[None]]) / q.error for q in noisy], 1)
    # An equivalent factor of the covariance with fewer rows needs fewer random numbers.
    factor = torch.linalg.qr(factor.cpu().float(), mode="r").R
    generator = torch.Generator().manual_seed(0)
    largest = torch.zeros(_DRAWS)
    drawn = torch.randn(_DRAWS * (degrees + 1), len(factor), generator=generator) @ factor
    columns = drawn.split([quantity.deviations.shape[1] for quantity in noisy], 1)
    for quantity, errors in zip(noisy, columns, strict=True):
        squares = errors.square().sum(1).reshape(_DRAWS, degrees + 1)
        variance = squares[:, 1 : quantity.degrees_of_freedom(degrees) + 1].mean(1)
        largest = torch.maximum(largest, squares[:, 0] / variance)
    return largest.quantile(LEVEL).sqrt().item()
