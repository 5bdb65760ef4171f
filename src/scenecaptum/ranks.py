"""Ranks, and rank correlations: Spearman's, and Kendall's τ of all pairs and of chosen pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import torch

Values: TypeAlias = "Sequence[float] | torch.Tensor"


def mean_ranks(values: Values) -> torch.Tensor:
    """Return the ranks from 1 in float64, the smallest value first; ties get their mean rank."""
    tensor = torch.as_tensor(values, dtype=torch.float64)
    below = (tensor[:, None] > tensor).sum(1)
    return below + ((tensor[:, None] == tensor).double().sum(1) + 1) / 2


def spearman(a: Values, b: Values) -> float:
    """Return Spearman's rank correlation, with mean ranks for ties; NaN if all values of one are tied."""
    centred_a, centred_b = (mean_ranks(values) - (len(values) + 1) / 2 for values in (a, b))
    size = float(centred_a.norm() * centred_b.norm())
    return float(centred_a @ centred_b) / size if size else math.nan


def kendall_tau(a: Values, b: Values) -> float:
    """Return Kendall's rank correlation τ-b, which accounts for ties; NaN if all values of one are tied.

    Example
    -------
    >>> kendall_tau([1, 2, 3], [1, 3, 2])
    0.3333333333333333

    References
    ----------
    Kendall, "The treatment of ties in ranking problems", Biometrika 33, 1945.
    """
    signs_a, signs_b = _pair_signs(a), _pair_signs(b)
    untied = float((signs_a != 0).sum()) * float((signs_b != 0).sum())
    return float((signs_a * signs_b).sum()) / math.sqrt(untied) if untied else math.nan


def kendall_tau_of_pairs(a: Values, b: Values, pairs: torch.Tensor) -> float:
    """Return the mean agreement, from −1 to 1, of the order of the chosen ``(n, n)`` pairs; NaN for none.

    A pair that is tied in one of the rankings counts as 0.
    """
    return float((_pair_signs(a) * _pair_signs(b))[pairs].mean())


def _pair_signs(values: Values) -> torch.Tensor:
    """Return the signs of all differences, ``(n, n)``."""
    tensor = torch.as_tensor(values, dtype=torch.float64)
    return torch.sign(tensor[:, None] - tensor[None, :])
