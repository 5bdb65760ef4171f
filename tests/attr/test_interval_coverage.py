"""The coverage of 95 % intervals: takes minutes."""

from __future__ import annotations

import pytest
from interval_coverage import SPP, box, coverage, rated

REPEATS = 200


@pytest.mark.long
@pytest.mark.parametrize("metric", ["mean luminance", "unified glare rating"])
def test_95_percent_intervals_cover_the_reference(metric: str) -> None:
    renderer = box()
    shares = coverage(renderer, rated(renderer)[metric], SPP[metric], REPEATS)
    bad = {name: f"{one.covered:.1%}" for name, one in shares.items() if not 0.90 <= one.covered <= 0.98}
    assert not bad, f"allowed 90 to 98 %: {bad}"
