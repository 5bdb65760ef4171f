"""Half-widths that hold for many parameters at once, and the samples that narrower ones would take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

LEVEL = 0.95

_DRAWS = 2000  # the quantile is then good to 1 %
_DEGREES = 40  # more change a quantile by less than 3 %
_LEAST_EFFECTIVE = 3.0  # samples, below which a spread is no reason to stop
_ROUNDING = 1e-5  # single precision says no more of a sum over many samples


@dataclass(frozen=True)
class Quantity:
    """A vector that is estimated, and how wide its interval may be.

    Attributes
    ----------
    names
        The parameter, or the two whose saliencies are compared.
    total
        ``(C,)``: the estimate.
    noise
        ``(passes, C)``: what each pass adds to the error; the sum of the squares is the variance. It falls as
        1/√samples.
    bias
        ``(C,)``: the bias that was taken out, an error of its own size. It falls as 1/samples.
    target
        The half-width that is wanted.
    effective
        How many samples make up its spread, in effect, where that is known: with few, most of what it may be has
        not been seen.
    """

    names: tuple[str, ...]
    total: torch.Tensor
    noise: torch.Tensor
    bias: torch.Tensor
    target: float
    effective: float | None = None

    @property
    def size(self) -> float:
        """The ℓ2 norm, without what noise adds to it on average."""
        square = self.total.square().sum() - self.noise.square().sum()
        return math.sqrt(max(square.item(), 0.0))

    @property
    def error(self) -> float:
        """The root of the expected square of the ℓ2 norm of its error."""
        return math.sqrt(self.noise.square().sum().item() + self.bias.square().sum().item())

    @property
    def is_exact(self) -> bool:
        """Whether its error is nothing but rounding."""
        return self.error <= _ROUNDING * self.size

    def upper(self, quantile: float) -> float:
        """Return the upper limit of its size."""
        return self.size + quantile * self.error if self.error else self.size

    def lower(self, quantile: float) -> float:
        """Return the lower limit of its size."""
        return max(0.0, self.size - quantile * self.error) if self.error else self.size

    def degrees(self, most: int) -> int:
        """Return the degrees of freedom of the variance: ``most``, or fewer where the rows have heavy tails.

        As many as a variance of normal rows that is as uncertain: ``2/u``, where ``u`` is the relative variance
        of this variance, ``κ/n + 2/(n − 1)`` with the excess kurtosis ``κ`` of the rows: an unbiased estimate, or
        what so few effective samples make of it where that is more. Of eight rows of which one has nearly all, it
        leaves two.

        References
        ----------
        Satterthwaite, "An approximate distribution of estimates of variance components", Biometrics Bulletin 2(6),
        1946. Joanes and Gill, "Comparing measures of sample skewness and kurtosis", The Statistician 47(1), 1998.
        """
        squares = self.noise.double().square().sum(1)
        count, variance = len(squares), squares.sum().item()
        if count < 2 or not variance:
            return most
        tails = [1 / self.effective] if self.effective else []
        if count >= 4:
            fourth = count * squares.square().sum().item() / variance**2
            excess = (count - 1) * ((count + 1) * fourth - 3 * (count - 1)) / ((count - 2) * (count - 3))
            tails.append(excess / count)
        uncertainty = max(tails, default=0.0) + 2 / (count - 1)
        return max(1, min(most, round(2 / uncertainty))) if uncertainty > 0 else most

    @property
    def is_rare(self) -> bool:
        """Whether so few samples make up its spread that this tells no error."""
        return self.effective is not None and self.effective < _LEAST_EFFECTIVE

    def is_reached(self, quantile: float) -> bool:
        """Whether its half-width is as small as wanted and can be trusted, or is nothing but rounding."""
        return self.is_exact or (quantile * self.error <= self.target and not self.is_rare)

    def growth(self, quantile: float) -> float:
        """Return by which factor the samples have to grow for the half-width that is wanted.

        It solves ``ρ v + ρ² b² = (target/quantile)²`` with variance ``v``, bias ``b`` and ``ρ = 1/growth``.
        """
        noise, bias = self.noise.square().sum().item(), self.bias.square().sum().item()
        allowed = (self.target / quantile) ** 2 if quantile > 0 else math.inf
        if noise + bias <= allowed:
            return _LEAST_EFFECTIVE / self.effective if self.effective and self.is_rare else 1.0
        return (noise + math.sqrt(noise**2 + 4 * bias * allowed)) / (2 * allowed) if allowed else math.inf


def simultaneous_quantile(quantities: Sequence[Quantity], degrees: int, level: float = LEVEL) -> float:
    """Return ``q`` such that with probability ``level`` no quantity's error is larger than ``q`` of its ``error``.

    The errors of all are drawn together from the covariance that the passes tell, and each is divided by a
    standard error as uncertain as one with these degrees of freedom, or fewer where its rows have heavy tails.
    Student's quantile is what this comes to for a single number; Bonferroni's inequality would make more of
    parameters that move together.

    References
    ----------
    Westfall and Young, "Resampling-Based Multiple Testing", 1993: the distribution of the largest |t|.
    Hothorn, Bretz and Westfall, "Simultaneous inference in general parametric models", Biometrical Journal 50(3),
    2008.
    """
    if degrees < 1:
        return math.inf
    live = [one for one in quantities if one.error > 0]
    if not live:
        return 0.0
    degrees = min(degrees, _DEGREES)
    factor = torch.cat([torch.cat([one.noise, one.bias[None]]) / one.error for one in live], 1)
    # The same covariance from as few random numbers as will do.
    factor = torch.linalg.qr(factor.cpu().float(), mode="r").R
    generator = torch.Generator().manual_seed(0)
    largest = torch.zeros(_DRAWS)
    drawn = torch.randn(_DRAWS * (degrees + 1), len(factor), generator=generator) @ factor
    for one, errors in zip(live, drawn.split([one.noise.shape[1] for one in live], 1), strict=True):
        squares = errors.square().sum(1).reshape(_DRAWS, degrees + 1)
        told = squares[:, 1 : one.degrees(degrees) + 1]
        largest = torch.maximum(largest, squares[:, 0] / told.mean(1))
    return largest.quantile(level).sqrt().item()
