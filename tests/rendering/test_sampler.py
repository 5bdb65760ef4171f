"""The Sobol' sampler: stratified points that are uniform random numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

LANES = 64


@pytest.fixture(scope="module")
def sampler(mi: Any) -> Any:
    from scenecaptum.rendering._sampler import SobolSampler

    return SobolSampler


def cells(points: np.ndarray, across: int, down: int) -> int:
    """The number of grid cells that contain a point."""
    return len({(int(x * across), int(y * down)) for x, y in points.T})


def test_every_elementary_interval_holds_one_point(mi: Any, sampler: Any) -> None:
    drawn = sampler.of(LANES, mi.UInt32(3))
    for _ in range(3):
        assert sorted((np.array(drawn.next_1d()) * LANES).astype(int)) == list(range(LANES))
        points = np.array(drawn.next_2d())
        for across in (1, 2, 4, 8, 16, 32, 64):
            assert cells(points, across, LANES // across) == LANES
        for block in np.split(points, 4, axis=1):
            assert [cells(block, 2**k, 2 ** (4 - k)) for k in range(5)] == [16] * 5


def test_a_clone_draws_the_same(mi: Any, sampler: Any) -> None:
    first = sampler.of(LANES, mi.UInt32(3))
    first.next_2d()
    second = first.clone()
    np.testing.assert_array_equal(np.array(first.next_2d()), np.array(second.next_2d()))


def test_one_lane_gets_independent_uniform_numbers(mi: Any, sampler: Any) -> None:
    """Over seeds, means, variances and correlations agree with independent numbers within four standard errors."""
    import drjit as dr

    seeds = 4000
    fifth = sampler(dr.brev(mi.UInt32(5)), dr.arange(mi.UInt32, seeds), dr.zeros(mi.UInt32, seeds))
    drawn = np.vstack([fifth.next_1d(), fifth.next_2d(), fifth.next_2d()]).T
    assert (abs(drawn.mean(0) - 1 / 2) < 4 * np.sqrt(1 / 12 / seeds)).all()
    assert (abs(drawn.var(0) - 1 / 12) < 4 * np.sqrt(1 / 180 / seeds)).all()
    correlation = np.corrcoef(drawn.T) - np.eye(5)
    assert abs(correlation).max() < 4 / np.sqrt(seeds)
