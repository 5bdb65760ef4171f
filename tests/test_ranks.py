"""Rank correlations."""

from __future__ import annotations

import math

import pytest

from scenecaptum.ranks import kendall_tau


@pytest.mark.parametrize(
    ("a", "b", "tau"),
    [
        ([1, 2, 3, 4], [1, 2, 3, 4], 1.0),
        ([1, 2, 3, 4], [4, 3, 2, 1], -1.0),
        ([12, 2, 1, 12, 2], [1, 4, 7, 1, 0], -0.47140452079103173),  # scipy's own example
        ([1, 1, 2], [1, 2, 3], 2 / math.sqrt(6)),
    ],
)
def test_kendalls_tau(a: list[float], b: list[float], tau: float) -> None:
    assert kendall_tau(a, b) == pytest.approx(tau, abs=1e-12)


def test_kendalls_tau_of_equal_values_is_undefined() -> None:
    assert math.isnan(kendall_tau([1, 1], [1, 2]))
