"""Error, bias and rank agreement of several runs with respect to a reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from ..estimation import mean_and_error
from ..ranks import kendall_tau_of_pairs

SIGNIFICANT_Z = 3.0  # standard deviations of a normal distribution


class Estimate(NamedTuple):
    """A mean and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: torch.Tensor) -> Estimate:
        """Return the mean of independent values."""
        return cls(*mean_and_error(values))


@dataclass(frozen=True)
class Bias:
    """The systematic part of a deviation from the reference."""

    value: float  # corrected for noise; 0 if the deviation is explained by noise
    error: float  # upwards
    z: float  # significance of the deviation, in standard deviations of a normal distribution

    @property
    def significant(self) -> bool:
        """Whether the bias differs significantly from 0."""
        return self.z > SIGNIFICANT_Z

    @property
    def upper_limit(self) -> float:
        """Upper limit of the value, from two standard errors of its square."""
        variance = (self.value + self.error) ** 2 - self.value**2
        return math.sqrt(self.value**2 + 2 * variance)


def relative_error(deviations: torch.Tensor, size: float) -> Estimate:
    """Return the root mean square norm of ``(runs, P)`` deviations, relative to ``size``."""
    squares = Estimate.of(deviations.square().sum(1))
    root = math.sqrt(squares.value)
    return Estimate(root / size, squares.error / (2 * root * size) if root else 0.0)


def relative_spread(deviations: torch.Tensor, size: float) -> float:
    """Return the standard deviation of ``(runs, P)`` vectors, of all elements together, relative to ``size``."""
    return math.sqrt(deviations.var(0).sum().item()) / size


def relative_bias(deviations: torch.Tensor, reference_noise: torch.Tensor, size: float) -> Bias:
    """Return the norm of the mean of ``(runs, P)`` deviations, corrected for noise and relative to ``size``.

    Noise of covariance ``S`` adds ``tr S`` to the expected squared norm of a mean, with a variance of ``2 tr S²``,
    and more in the presence of a bias. The ratio of the squared norm to ``tr S`` approximately follows Fisher's F
    distribution with ``ν = (tr S)² / tr S²`` degrees of freedom (Box), which Paulson's formula maps to a normal
    one. ``S`` is estimated from the few runs and the replicates of the reference, each with degrees of freedom of
    its own (Welch and Satterthwaite): where the reference is noisier, few runs suffice. The covariance of the
    reference is ``reference_noise.T @ reference_noise``, with ``(rows, P)`` factors.

    References
    ----------
    Box, "Some theorems on quadratic forms", Annals of Mathematical Statistics 25, 1954.
    Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics Bulletin 2, 1946.
    Paulson, "An approximate normalization of the analysis of variance distribution", ibid. 13, 1942.
    Kelley, "Fundamentals of Statistics", 1947.
    """
    runs, mean = len(deviations), deviations.mean(0)
    noise = torch.cat([(deviations - mean) / math.sqrt(runs * (runs - 1)), reference_noise])
    products = noise @ noise.T
    trace, square = products.trace().item(), products.square().sum().item()
    observed = mean.square().sum().item()
    along_mean = (noise @ mean).square().sum().item()
    spread = math.sqrt(2 * square + 4 * max(along_mean - square, 0.0))
    unbiased = max(observed - trace, 0.0)
    value = math.sqrt(unbiased)
    freedom = trace**2 / square if square else 1.0
    z = math.inf if observed else 0.0
    if trace:
        # tr S² of each part over the number of its independent rows; a row of 0 adds no information.
        replicates = max(int(reference_noise.any(1).sum()) - 1, 1)
        parts = products[:runs, :runs].square().sum() / (runs - 1)
        parts += products[runs:, runs:].square().sum() / replicates
        z = _normal_deviate(observed / trace, freedom, trace**2 / parts.item())
    return Bias(value / size, (math.sqrt(unbiased + spread) - value) / size, z)


def _normal_deviate(ratio: float, numerator: float, denominator: float) -> float:
    """Return the normal deviate of an F ratio with these degrees of freedom (Paulson)."""
    root: float = ratio ** (1 / 3)
    first, second = 2 / (9 * numerator), 2 / (9 * denominator)
    z = ((1 - second) * root - (1 - first)) / math.sqrt(first + second * root**2)
    # Kelley's correction for few degrees of freedom in the denominator, where the formula saturates.
    return z * (1 + 0.08 * z**4 / denominator**3)


def kendall_of_resolved(values: torch.Tensor, reference: torch.Tensor, error: torch.Tensor) -> float:
    """Return Kendall's τ over the pairs that differ by over two standard errors in the reference; NaN for none."""
    differences = reference[:, None] - reference[None, :]
    resolved = differences > 2 * torch.hypot(error[:, None], error[None, :])
    return kendall_tau_of_pairs(values, reference, resolved)


def top_agreement(a: torch.Tensor, b: torch.Tensor, count: int) -> float:
    """Return the fraction of the ``count`` largest elements that both rankings have in common."""
    top_a, top_b = (set(values.argsort(descending=True, stable=True)[:count].tolist()) for values in (a, b))
    return len(top_a & top_b) / count
