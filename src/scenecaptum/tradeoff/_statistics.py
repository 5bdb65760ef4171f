"""How far several runs are from a reference, and how much of that is noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from ..visualization._ranks import kendall_tau

CLEAR = 3.0  # standard errors of a normal distribution


class Estimate(NamedTuple):
    """A mean and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: torch.Tensor) -> Estimate:
        """Take the mean of independent values."""
        return cls(values.mean().item(), (values.std() / math.sqrt(len(values))).item())


@dataclass(frozen=True)
class Bias:
    """The part of a deviation that does not average out.

    Attributes
    ----------
    value
        Its size, the noise taken out; 0 where the noise is all that is seen.
    error
        How much larger it may be: one standard error.
    z
        How far what is seen lies beyond what noise makes, in standard deviations of a normal distribution.
    """

    value: float
    error: float
    z: float

    @property
    def told(self) -> bool:
        """Whether it is told from 0."""
        return self.z > CLEAR

    @property
    def limit(self) -> float:
        """What it hardly exceeds: two standard errors."""
        variance = (self.value + self.error) ** 2 - self.value**2
        return math.sqrt(self.value**2 + 2 * variance)


def relative_error(deviations: torch.Tensor, size: float) -> Estimate:
    """Return the root mean square over runs of the length of ``(runs, P)`` deviations, relative to ``size``."""
    squares = Estimate.of(deviations.square().sum(1))
    root = math.sqrt(squares.value)
    return Estimate(root / size, squares.error / (2 * root * size) if root else 0.0)


def relative_bias(deviations: torch.Tensor, reference_noise: torch.Tensor, size: float) -> Bias:
    """Return the length of the mean of ``(runs, P)`` deviations without what noise adds to it, over ``size``.

    Noise of covariance ``S`` lengthens the square of a mean by ``tr S`` on average, with a variance of
    ``2 tr S²`` and more where there is a bias. The ratio of the square to ``tr S`` follows Fisher's F
    distribution with ``ν = (tr S)² / tr S²`` degrees of freedom (Box), which Paulson's formula makes normal.

    Parameters
    ----------
    deviations
        From the reference, one row for each run.
    reference_noise
        ``(rows, P)``: the sum of the outer products of its rows is the covariance of the reference.
    size
        What it is relative to.

    References
    ----------
    Box, "Some theorems on quadratic forms", Annals of Mathematical Statistics 25, 1954.
    Paulson, "An approximate normalization of the analysis of variance distribution", ibid. 13, 1942.
    Kelley, "Fundamentals of Statistics", 1947.
    """
    runs, mean = len(deviations), deviations.mean(0)
    noise = torch.cat([(deviations - mean) / math.sqrt(runs * (runs - 1)), reference_noise])
    products = noise @ noise.T
    trace, square = products.trace().item(), products.square().sum().item()
    seen = mean.square().sum().item()
    along = (noise @ mean).square().sum().item()
    spread = math.sqrt(2 * square + 4 * max(along - square, 0.0))
    unbiased = max(seen - trace, 0.0)
    value = math.sqrt(unbiased)
    freedom = trace**2 / square if square else 1.0
    return Bias(
        value / size,
        (math.sqrt(unbiased + spread) - value) / size,
        _normal(seen / trace, freedom, freedom * (runs - 1)) if trace else (math.inf if seen else 0.0),
    )


def _normal(ratio: float, above: float, below: float) -> float:
    """Return the normal deviate of a ratio of variances with these degrees of freedom (Paulson)."""
    root: float = ratio ** (1 / 3)
    first, second = 2 / (9 * above), 2 / (9 * below)
    z = ((1 - second) * root - (1 - first)) / math.sqrt(first + second * root**2)
    # Kelley's correction: with few degrees below, the formula levels off.
    return z * (1 + 0.08 * z**4 / below**3)


def spearman(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return Spearman's rank correlation, ties at their mean rank; NaN where all of one are tied."""
    one, other = (_ranks(values) - (len(values) - 1) / 2 for values in (a, b))
    size = float(one.norm() * other.norm())
    return float(one @ other) / size if size else math.nan


def kendall(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return Kendall's τ-b."""
    return kendall_tau(a.tolist(), b.tolist())


def kendall_of_resolved(values: torch.Tensor, reference: torch.Tensor, error: torch.Tensor) -> float:
    """Return Kendall's τ over the pairs that the reference tells apart by two standard errors; NaN for none."""
    ahead = reference[:, None] - reference[None, :]
    clear = ahead > 2 * torch.hypot(error[:, None], error[None, :])
    return float(torch.sign(values[:, None] - values[None, :])[clear].mean())


def top_agreement(a: torch.Tensor, b: torch.Tensor, count: int) -> float:
    """Return which part of the first ``count`` of one ranking is among the first of the other."""
    one, other = (set(values.argsort(descending=True, stable=True)[:count].tolist()) for values in (a, b))
    return len(one & other) / count


def _ranks(values: torch.Tensor) -> torch.Tensor:
    below = (values[:, None] > values[None, :]).sum(1)
    tied = (values[:, None] == values[None, :]).sum(1) - 1
    return below.double() + tied.double() / 2
