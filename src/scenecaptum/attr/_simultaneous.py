"""Half-widths that hold for many parameters at once, and the samples that narrower ones would take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

LEVEL = 0.95

_DRAWS = 2000  # the quantile is then good to 1 %
_DEGREES = 40  # more change a quantile by less than 3 %
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
    """

    names: tuple[str, ...]
    total: torch.Tensor
    noise: torch.Tensor
    bias: torch.Tensor
    target: float

    @property
    def size(self) -> float:
        """The ℓ2 norm, without what noise adds to it on average."""
        square = self.total.square().sum() - self.noise.square().sum()
        return math.sqrt(max(square.item(), 0.0))

    @property
    def error(self) -> float:
        """The root of the expected square of the ℓ2 norm of its error."""
        return math.sqrt(self.noise.square().sum().item() + self.bias.square().sum().item())

    def is_reached(self, quantile: float) -> bool:
        """Whether its half-width is as small as wanted, or nothing but rounding."""
        return quantile * self.error <= max(self.target, _ROUNDING * self.size)

    def growth(self, quantile: float) -> float:
        """Return by which factor the samples have to grow for the half-width that is wanted.

        It solves ``ρ v + ρ² b² = (target/quantile)²`` with variance ``v``, bias ``b`` and ``ρ = 1/growth``.
        """
        noise, bias = self.noise.square().sum().item(), self.bias.square().sum().item()
        allowed = (self.target / quantile) ** 2 if quantile > 0 else math.inf
        if noise + bias <= allowed:
            return 1.0
        return (noise + math.sqrt(noise**2 + 4 * bias * allowed)) / (2 * allowed) if allowed else math.inf


def simultaneous_quantile(quantities: Sequence[Quantity], degrees: int, level: float = LEVEL) -> float:
    """Return ``q`` such that with probability ``level`` no quantity's error is larger than ``q`` of its ``error``.

    The errors of all are drawn together from the covariance that the passes tell, and each is divided by a
    standard error that is as uncertain as one from so many degrees of freedom. Student's quantile is what this
    comes to for a single number; Bonferroni's inequality would make more of parameters that move together.

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
    for errors in drawn.split([one.noise.shape[1] for one in live], 1):
        squares = errors.square().sum(1).reshape(_DRAWS, degrees + 1)
        largest = torch.maximum(largest, squares[:, 0] / squares[:, 1:].mean(1))
    return largest.quantile(level).sqrt().item()
