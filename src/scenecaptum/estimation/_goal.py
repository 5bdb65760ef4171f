"""When to stop sampling: a goal, and what is known about it after a round."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch

from ..errors import SceneCaptumError, whole_number
from ._gradients import GradientSum, Tensors
from ._replicates import channel_totals
from ._simultaneous import Quantity, simultaneous_quantile

DEFAULT_SHARE = 0.05
DEFAULT_TIE = 0.05  # relative difference below which two saliencies are tied

CLEARLY_SEPARATED = 6.0  # standard errors
MANY_EFFECTIVE_SAMPLES = 30.0  # from a pilot: rare paths are unlikely


@dataclass(frozen=True)
class Goal:
    """Stopping criterion; see ``VanillaSceneGradient.attribute``."""

    tolerance: float | None
    share: float
    top: int | None
    time_limit: float | None

    def __post_init__(self) -> None:
        for name in ("tolerance", "time_limit"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and 0 < value < math.inf):
                raise SceneCaptumError(f"{name} must be a positive number, not {value!r}.")
        if not (_is_number(self.share) and 0 <= self.share <= 1):
            raise SceneCaptumError(f"share must lie between 0 and 1, not {self.share!r}.")
        if self.top is not None:
            whole_number("top", self.top)

    @property
    def is_set(self) -> bool:
        """Whether there is any stopping criterion."""
        return not (self.tolerance is None and self.top is None and self.time_limit is None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class Assessment:
    """What is known about the gradients of one metric after a round."""

    significant: list[Quantity]  # the parameters that may have the share; they are reported
    criteria: list[
        Quantity
    ]  # what the goal requires to be accurate: parameters, or differences of neighbours
    quantiles: tuple[float, float]  # of ``significant`` and of ``criteria``
    order: list[str]  # all parameters by descending saliency
    degrees: int  # of freedom of the errors
    settled: frozenset[str] = frozenset()  # those that cannot matter for the goal

    @property
    def half_widths(self) -> dict[str, float]:
        """Simultaneous half-width (ℓ2 norm) of each significant parameter."""
        return {q.names[0]: self.quantiles[0] * q.error for q in self.significant if self.degrees}

    @property
    def is_exact(self) -> bool:
        """Whether all errors are only due to rounding, so that more rounds would not help."""
        return all(quantity.is_exact for quantity in self.significant)

    @property
    def has_many_samples(self) -> bool:
        """Whether all criteria have many effective samples, according to a pilot."""
        return all(
            quantity.effective_samples is not None and quantity.effective_samples >= MANY_EFFECTIVE_SAMPLES
            for quantity in self.criteria
        )

    @property
    def is_reached(self) -> bool:
        """Whether the goal is reached."""
        return all(quantity.meets_target(self.quantiles[1]) for quantity in self.criteria)

    @property
    def relative_half_width(self) -> float:
        """The largest half-width relative to the saliency of its parameter."""
        if not self.degrees or any(quantity.error and not quantity.size for quantity in self.significant):
            return math.inf
        ratios = (quantity.error / quantity.size for quantity in self.significant if quantity.error)
        return max((self.quantiles[0] * ratio for ratio in ratios), default=0.0)

    def tiers(self, top: int) -> list[list[str]]:
        """Return the first parameters in order; parameters that are tied or not separated share a tier."""
        unresolved = {q.names for q in self.criteria if self.quantiles[1] * q.error > q.total.item()}
        tiers = [[self.order[0]]] if self.order else []
        for above, below in pairwise(self.order[:top]):
            if (above, below) in unresolved:
                tiers[-1].append(below)
            else:
                tiers.append([below])
        last = self.order[min(top, len(self.order)) - 1]
        return [*tiers[:-1], [*tiers[-1], *(below for above, below in unresolved if above == last)]]

    def required_growth(self, replicates: int) -> float:
        """Return the factor by which the samples must grow, given this number of additional replicates."""
        quantile = simultaneous_quantile(self.criteria, self.degrees + replicates)
        return max((quantity.required_growth(quantile) for quantity in self.criteria), default=1.0)


@dataclass(frozen=True)
class Compared:
    """What the goal refers to: the effects of parameters, or of groups of them."""

    factors: Tensors | None = (
        None  # ``(C,)`` of each parameter: an effect is the sum of its channels times these
    )
    members: Mapping[str, tuple[str, ...]] | None = None  # of each group
    vectors: frozenset[str] = frozenset()  # the parameters whose effect is the length of a vector
    excluded: frozenset[str] = frozenset()  # the parameters that are not ranked: those without a derivative


def assess(
    gradients: GradientSum,
    goal: Goal,
    compared: Compared,
    effective_samples: Mapping[str, float] | None = None,
) -> Assessment:
    """Compare the errors with the goal; ``effective_samples`` are those behind the variance of each gradient.

    A parameter is accurate enough if its half-width is within the tolerance, or if the upper limit of its saliency
    is below the share of the lower limit of the total saliency. A small estimate alone does not suffice as long as
    its error is large.
    """
    quantities = totals(gradients, compared, effective_samples or {})
    degrees = gradients.degrees_of_freedom
    tolerance = goal.tolerance or 0.0
    total = _total_saliency(quantities)
    candidates = [
        quantity
        for quantity in quantities
        if quantity.upper(CLEARLY_SEPARATED) >= goal.share * total.lower(CLEARLY_SEPARATED)
    ]
    quantile = simultaneous_quantile([*candidates, total], degrees)
    threshold = goal.share * total.lower(quantile)
    significant = [quantity for quantity in candidates if quantity.upper(quantile) > threshold]
    significant = significant or quantities[:1]
    order = [quantity.names[0] for quantity in quantities]
    if goal.top is None:
        criteria = [
            dataclasses.replace(q, target=max(tolerance * q.size, threshold - q.size)) for q in candidates
        ]
        kept = {quantity.names[0] for quantity in candidates}
        settled = frozenset(order) - kept
        return Assessment(significant, criteria, (quantile, quantile), order, degrees, settled)
    criteria = _saliency_differences(quantities, goal.top, tolerance or DEFAULT_TIE)
    quantiles = quantile, simultaneous_quantile(criteria, degrees)
    settled = _out_of_reach(quantities, goal.top)
    return Assessment(significant, criteria, quantiles, order, degrees, settled)


def totals(
    gradients: GradientSum, compared: Compared, effective_samples: Mapping[str, float]
) -> list[Quantity]:
    """Return the effects of every parameter or group, by descending size; without factors, the channel totals."""
    scale = 1 / gradients.weight
    vectors = {}
    for name, mean in gradients.mean.items():
        if name in compared.excluded:
            continue
        total = scale * channel_totals(mean).double()
        zeros = torch.zeros_like(total)
        deviations = scale * gradients.deviations(name) if gradients.degrees_of_freedom else zeros[None]
        bias = zeros if gradients.bias is None else scale * channel_totals(gradients.bias[name]).double()
        vectors[name] = (total, deviations, bias)
        if compared.factors is not None:
            factors = compared.factors[name].double()
            # From channels to effects.
            change = factors.diag() if name in compared.vectors else factors[:, None]
            vectors[name] = (total @ change, deviations @ change, bias @ change)
    # 0 means that the pilot has found no path: nothing is known.
    counts = {name: count for name, count in effective_samples.items() if count > 0}
    if compared.members is not None:
        deviations_of = {n: vector[1] for n, vector in vectors.items()}
        counts = _group_effective_samples(counts, deviations_of, compared.members)
        vectors = {
            group: (
                torch.stack([vectors[name][0].sum() for name in names]).sum(0, keepdim=True),
                torch.stack([vectors[name][1].sum(1, keepdim=True) for name in names]).sum(0),
                torch.stack([vectors[name][2].sum() for name in names]).sum(0, keepdim=True),
            )
            for group, names in compared.members.items()
        }
    quantities = [
        Quantity((name,), *vector, target=0.0, effective_samples=counts.get(name))
        for name, vector in vectors.items()
    ]
    return sorted(quantities, key=lambda quantity: -quantity.size)


def _group_effective_samples(
    counts: Mapping[str, float],
    deviations: Mapping[str, torch.Tensor],
    members: Mapping[str, tuple[str, ...]],
) -> dict[str, float]:
    """Return the effective samples of the sums over groups, assuming independent members."""
    by_group = {}
    for group, names in members.items():
        variances = {name: deviations[name].square().sum().item() for name in names}
        fourth = sum(variances[name] ** 2 / counts[name] for name in names if name in counts)
        if fourth and all(name in counts for name in names if variances[name]):
            by_group[group] = sum(variances.values()) ** 2 / fourth
    return by_group


def _total_saliency(quantities: list[Quantity]) -> Quantity:
    """Return the sum of all saliencies."""
    errors = [_size_errors(quantity) for quantity in quantities]
    return Quantity(
        ("all saliency",),
        quantities[0].total.new_tensor([sum(quantity.size for quantity in quantities)]),
        torch.stack([deviations for deviations, _ in errors]).sum(0),
        torch.stack([bias for _, bias in errors]).sum(0),
        target=0.0,
    )


def _saliency_differences(quantities: list[Quantity], top: int, tie: float) -> list[Quantity]:
    """Return the differences that determine the first ``top``: between neighbours, and of the last to all others.

    A difference is accurate enough if its interval excludes 0, or if all of the interval is within a tie.
    """
    pairs = list(pairwise(quantities[: top + 1]))
    pairs += [(quantities[top - 1], other) for other in quantities[top + 1 :]]
    differences = []
    for above, below in pairs:
        difference = above.size - below.size
        (deviations, bias), (deviations_below, bias_below) = _size_errors(above), _size_errors(below)
        counts = [q.effective_samples for q in (above, below) if q.effective_samples is not None]
        quantity = Quantity(
            (above.names[0], below.names[0]),
            above.total.new_tensor([difference]),
            deviations - deviations_below,
            bias - bias_below,
            max(difference, tie * above.size - difference),
            min(counts, default=None),
        )
        if difference < CLEARLY_SEPARATED * quantity.error:
            differences.append(quantity)
    return differences


def _out_of_reach(quantities: list[Quantity], top: int) -> frozenset[str]:
    """Return the parameters that are clearly below the last of the first ``top``."""
    if len(quantities) <= top:
        return frozenset()
    last = quantities[top - 1].lower(CLEARLY_SEPARATED)
    return frozenset(q.names[0] for q in quantities[top:] if q.upper(CLEARLY_SEPARATED) < last)


def _size_errors(quantity: Quantity) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the deviations ``(replicates, 1)`` and the bias ``(1,)`` of the size.

    These are the components in the direction of the vector. If noise may have changed the direction, they are
    scaled to the full error.
    """
    norm = quantity.total.norm()
    direction = (quantity.total / norm if norm > 0 else quantity.total)[:, None]
    deviations, bias = quantity.deviations @ direction, quantity.bias @ direction
    error = math.sqrt(deviations.square().sum().item() + bias.square().sum().item())
    if quantity.size < CLEARLY_SEPARATED * quantity.error and error > 0:
        scale = quantity.error / error
        return scale * deviations, scale * bias
    return deviations, bias
