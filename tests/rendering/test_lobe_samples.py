"""Antithetic samples of a lobe are uniform points, in pairs with opposite derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from seeds import shifted

COUNT = 200_000


def points(mi: Any, strata: int) -> tuple[Any, Any]:
    """Return ``(2, COUNT)`` random points in the inner half of the square, and their partners."""
    from scenecaptum.rendering.integrators._lobe_samples import antithetic_point

    random = mi.PCG32(COUNT, shifted())
    uniform = mi.Point2f(random.next_float32(), random.next_float32())
    stratum = mi.UInt32(random.next_float32() * strata)
    return tuple(antithetic_point(uniform, stratum, strata, mi.Bool(outer)) for outer in (False, True))


@pytest.mark.parametrize("strata", [1, 2])
def test_points_are_uniform(mi: Any, strata: int) -> None:
    """A chi-squared test of a histogram of 16 × 16 cells."""
    drawn = np.concatenate([point.numpy() for point in points(mi, strata)], axis=1)
    counts, *_ = np.histogram2d(*drawn, bins=16, range=[[0, 1], [0, 1]])
    expected = drawn.shape[1] / counts.size
    assert counts.sum() == drawn.shape[1], "outside the square"
    statistic, freedom = ((counts - expected) ** 2 / expected).sum(), counts.size - 1
    assert statistic < freedom + 5 * np.sqrt(2 * freedom)


def test_the_derivatives_of_a_pair_are_opposite(mi: Any) -> None:
    """Those of the logarithm of a GGX distribution at normal incidence, with respect to that of its roughness."""
    alpha = 0.1
    straight = mi.Vector3f(0, 0, 1)
    scores = []
    for point in points(mi, 2):
        normal, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(straight, point)
        squared = np.square(normal.numpy())
        t = (squared[0] + squared[1]) / (squared[2] * alpha**2)
        scores.append(2 * (t - 1) / (t + 1))
    inner, outer = scores
    assert inner.max() < 1e-3 < -1e-3 + outer.max()
    assert np.abs(inner + outer).max() < 5e-3
