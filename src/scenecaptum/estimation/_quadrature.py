"""Quadrature rules on [0, 1], with error estimates from the same points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch

from ..errors import SceneCaptumError, near_misses, whole_number

Method = Literal["gausslegendre", "riemann_left", "riemann_right", "riemann_middle", "riemann_trapezoid"]

SIGNIFICANT = 4.0  # standard deviations of a ratio of variances, whose distribution has a long tail


@dataclass(frozen=True)
class Quadrature:
    """Nodes and weights of a quadrature rule, with null rules for the error estimate.

    The first nodes, for any number, are spread over the whole interval, so that the rule can be interrupted. Nodes
    that are only used for the error estimate have weight 0 and come last. *Null rules* vanish for sufficiently
    smooth integrands and are otherwise of the size of the error.
    """

    nodes: tuple[float, ...]
    weights: tuple[float, ...]
    nulls: np.ndarray  # (K, points): weights of null rules
    structure: np.ndarray  # (M, points): of null rules, including those above, that tell structure from noise

    def error(self, integrand: Sequence[torch.Tensor]) -> torch.Tensor:
        """Estimate the quadrature error of integrals from the values of the integrand.

        The noise of the integrand is already part of the standard errors. Its contribution to the null rules is
        subtracted, and the error is 0 if the null rules are consistent with noise, so that noise does not count
        twice.

        The integrand has ``(replicates, C)`` values for each point, the error ``(C,)``. A point with a single
        replicate is assumed to be as noisy as the mean at the nearest node with several. If there are fewer points
        than nodes after an interruption, the error is the difference between all points and the first half of
        them.
        """
        integrand = [values.double().cpu() for values in integrand]
        nulls, structure = torch.from_numpy(self.nulls), torch.from_numpy(self.structure)
        if len(integrand) < len(self.nodes):
            nulls = structure = self._half_rule_difference(len(integrand))
        means = torch.stack([values.mean(0) for values in integrand])
        squares = (nulls @ means).square()
        replicated = [number for number, values in enumerate(integrand) if len(values) > 1]
        if not replicated:
            return squares.sum(0).sqrt()
        variances = torch.stack([integrand[n].var(0) / len(integrand[n]) for n in replicated])
        degrees = torch.tensor([len(integrand[n]) - 1.0 for n in replicated])[:, None]
        nearest = self._nearest(replicated, len(integrand))
        null_variances = nulls.square() @ nearest @ variances
        structure_weights = structure.square() @ nearest
        # Welch–Satterthwaite degrees of freedom of all rules together.
        contributions = structure_weights.sum(0)[:, None] * variances
        effective_degrees = contributions.sum(0).square() / (contributions.square() / degrees).sum(0)
        ratio = ((structure @ means).square() / (structure_weights @ variances)).mean(0)
        deviation = (2 / len(structure) + 2 / effective_degrees).sqrt()
        is_noise = ratio - 1 <= SIGNIFICANT * deviation  # False (inf or nan) without noise
        return torch.where(is_noise, 0, (squares - null_variances).sum(0).clamp_min(0).sqrt())

    def _nearest(self, replicated: list[int], count: int) -> torch.Tensor:
        """Return a ``(points, replicated)`` one-hot matrix with the nearest replicated node of each point."""
        nodes = torch.tensor(self.nodes, dtype=torch.float64)
        nearest = (nodes[:count, None] - nodes[replicated]).abs().argmin(1)
        return torch.nn.functional.one_hot(nearest, len(replicated)).double()

    def _half_rule_difference(self, count: int) -> torch.Tensor:
        """Return ``(1, points)`` weights of the difference between the first points and the first half of them."""
        weights = torch.tensor(self.weights[:count], dtype=torch.float64)
        half = torch.where(torch.arange(count) < (count + 1) // 2, weights, 0)
        full, half = (w / w.sum().clamp_min(torch.finfo(w.dtype).tiny) for w in (weights, half))
        return (full - half if count > 1 else full)[None]


def quadrature(method: str, n_steps: int) -> Quadrature:
    """Return a quadrature rule with ``n_steps`` points whose weights sum to 1.

    Raises if the rule is unknown, or requires more points.

    The error of a Gauss–Legendre rule is estimated by two *null rules* on the same points: the two highest
    coefficients of the integrand's expansion in Legendre polynomials, in the scale of the rule. They vanish for
    polynomials of lower degree, and for other integrands decay more slowly than the error. A Riemann sum is
    compared with the trapezoidal rule on its points and the ends of the interval, and this with the same rule on
    every second point, which requires one or two additional points at the ends.

    For ``c/(cα + 0.01)``, the derivative of ``log(mean + 0.01)`` from black, with c from 0.01 to 10 and 2 to 64
    points, the estimates are at least 0.9 times the error.

    References
    ----------
    Berntsen and Espelid, "Error estimation in automatic quadrature routines", ACM Transactions on Mathematical
    Software 17(2), 1991; Gonnet, "A review of error estimation in adaptive quadrature", ACM Computing Surveys
    44(4), 2012.
    """
    n = whole_number("n_steps", n_steps)
    if method == "gausslegendre":
        nodes, weights, nulls, structure = _gauss_legendre(n)
    elif method in (known := get_args(Method)):
        nodes, weights, nulls = _riemann(method, n)
        structure = nulls
    else:
        raise SceneCaptumError(
            f"method={method!r} is not a quadrature rule.{near_misses(method, known)} Use one of "
            f"{', '.join(known)}."
        )
    weighted, unweighted = (np.flatnonzero(mask).tolist() for mask in (weights, weights == 0))
    spread = sorted(range(n), key=lambda number: _reversed_bits(number, n))
    order = [*(weighted[number] for number in spread), *unweighted]
    return Quadrature(
        tuple(nodes[order].tolist()), tuple(weights[order].tolist()), nulls[:, order], structure[:, order]
    )


def _gauss_legendre(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes in ascending order, weights, and null rules: the two highest degrees, and the higher half."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    weights = weights / 2
    orthonormal = np.polynomial.legendre.legvander(nodes, n - 1) * np.sqrt(2 * np.arange(n) + 1)
    coefficients = weights * orthonormal.T
    # With a single point, the error may be as large as the integral; with two, half as large.
    nulls = coefficients[-2:] if n > 2 else n * coefficients[-1:]
    return (nodes + 1) / 2, weights, nulls, coefficients[n // 2 :] if n > 2 else nulls


def _riemann(method: str, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes in ascending order, including ends of weight 0, weights and null rules."""
    if method == "riemann_trapezoid":
        nodes = np.linspace(0, 1, whole_number("n_steps of a trapezoid", n, 2))
        weights = _trapezoid(nodes, range(n))
    elif method == "riemann_middle":
        nodes = np.concatenate([[0], (np.arange(n) + 0.5) / n, [1]])
        weights = np.pad(np.full(n, 1 / n), 1)
    else:
        nodes = np.linspace(0, 1, n + 1)
        weights = np.pad(np.full(n, 1 / n), (0, 1) if method == "riemann_left" else (1, 0))
    count = len(nodes)
    trapezoid = _trapezoid(nodes, range(count))
    # For an even number of nodes, one interval remains single: the last or the first.
    subsets = (
        [range(0, count, 2)] if count % 2 else [(*range(0, count, 2), count - 1), (0, *range(1, count, 2))]
    )
    coarser = [trapezoid - _trapezoid(nodes, subset) for subset in subsets]
    to_trapezoid = weights - trapezoid
    if method == "riemann_trapezoid":
        nulls = coarser if n > 2 else [np.array([-0.5, 0.5])]
    elif method == "riemann_middle":
        # The error of the midpoint rule is half that of the trapezoidal rule.
        nulls = [to_trapezoid, *(null / 2 for null in coarser)]
    else:
        # Both errors contribute and may add up.
        nulls = [math.sqrt(2) * null for null in (to_trapezoid, *coarser)]
    return nodes, weights, np.stack(nulls)


def _trapezoid(nodes: np.ndarray, subset: Sequence[int]) -> np.ndarray:
    """Return the weights of the trapezoidal rule on a subset of the ascending nodes."""
    weights = np.zeros(len(nodes))
    gaps = np.diff(nodes[list(subset)])
    weights[list(subset)] = (np.append(gaps, 0) + np.append(0, gaps)) / 2
    return weights


def _reversed_bits(number: int, count: int) -> int:
    return int(f"{number:0{max(1, (count - 1).bit_length())}b}"[::-1], 2)
