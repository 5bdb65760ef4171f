"""The rows of points that decide a metric of daylight, against closed forms."""

from __future__ import annotations

import pytest
import torch
from seeds import shifted

from scenecaptum.daylight import (
    ContinuousDaylightAutonomy,
    DaylightFactor,
    SkyMatrix,
    SpatialDaylightAutonomy,
)
from scenecaptum.estimation import TargetedMetric
from scenecaptum.explanation._rows import find_rows
from scenecaptum.grid import GridPoints

SKY = SkyMatrix.cie_overcast()
DEPTHS, ACROSS = torch.tensor([4.0, 2.5, 1.0]).double(), torch.tensor([-1.0, 1.0]).double()


def grid(up: int = 2) -> GridPoints:
    """Return three rows of two points; the window is at the low end of the depths."""
    plan = torch.stack([ACROSS.expand(3, 2), DEPTHS[:, None].expand(3, 2)], -1)
    positions = torch.full((3, 2, 3), 0.8).double()
    positions[..., [axis for axis in range(3) if axis != up]] = plan
    return GridPoints(positions, torch.ones_like(positions), torch.ones(3, 2, dtype=torch.bool), plan)


def images(*factors: float) -> torch.Tensor:
    """Return 8 noisy coefficients whose daylight factors are those of the rows, in %."""
    noise = torch.Generator().manual_seed(shifted(1))
    share = torch.tensor(factors).repeat_interleave(2) / 100
    outdoors = SKY.horizontal_illuminance() / (179 * SKY.radiance[1:, 0, 0].sum())
    coefficients = share[:, None, None] * outdoors * torch.ones(6, 146, 3)
    coefficients[:, 0] = 0
    return coefficients * (1 + 0.01 * torch.randn(8, 6, 1, 1, generator=noise))


def test_more_light_at_a_row_adds_a_tenth_of_its_share_to_a_linear_metric() -> None:
    rows = find_rows(TargetedMetric(DaylightFactor(SKY), None), images(1.0, 2.0, 6.0), grid())
    assert [(row.number, row.name, row.side, row.count) for row in rows] == [
        (1, "y = 4 m", "top", 2),
        (2, "y = 2.5 m", "top", 2),
        (3, "y = 1 m", "top", 2),
    ]
    assert {row.towards for row in rows} == {"y"}
    for row, factor in zip(rows, (1.0, 2.0, 6.0), strict=True):
        assert row.value == pytest.approx(factor, abs=6 * 0.01 * factor / 4)
        assert abs(row.effect - 0.1 * factor / 3) < 6 * row.effect_error
        assert row.effect_error == pytest.approx(0.01 * 0.1 * factor / 3 / 4, rel=0.9)


def test_rows_with_enough_light_do_not_matter_and_rows_are_named_by_their_axis() -> None:
    metric = TargetedMetric(ContinuousDaylightAutonomy(SKY, threshold=300.0, during="all"), None)
    rows = find_rows(metric, images(1.0, 2.0, 6.0), grid(up=1))
    # 600 lx; and 100 and 200 lx of 300 lx. Where y is up, −z points to the top of the plan.
    assert [(row.number, row.name) for row in rows] == [(1, "z = 1 m"), (2, "z = 2.5 m"), (3, "z = 4 m")]
    assert {(row.side, row.towards) for row in rows} == {("top", "−z")}
    assert [row.value for row in rows] == pytest.approx([100.0, 66.7, 33.3], rel=0.03)
    assert [row.effect for row in rows] == pytest.approx([0.0, 20 / 9, 10 / 9], rel=0.03)


def test_the_value_of_a_row_is_that_by_the_definition_and_columns_are_counted_from_the_left() -> None:
    across = GridPoints(*(part.transpose(0, 1) for part in list(vars(grid()).values())[:4]))
    across = GridPoints(
        across.positions[..., [1, 0, 2]], across.normals, across.inside, across.plan[..., [1, 0]]
    )
    metric = TargetedMetric(SpatialDaylightAutonomy(SKY, during="all"), None)
    # From the right 290, 310 and 600 lx: the first two are within the relaxation of 300 lx.
    columns = images(2.9, 3.1, 6.0).unflatten(1, (3, 2)).transpose(1, 2).flatten(1, 2)
    rows = find_rows(metric, columns, across)
    assert [(row.name, row.side, row.towards) for row in rows] == [
        ("x = 1 m", "left", "x"),
        ("x = 2.5 m", "left", "x"),
        ("x = 4 m", "left", "x"),
    ]
    assert [row.value for row in rows] == [100.0, 100.0, 0.0]
    assert rows[2].effect > 0


def test_points_that_form_no_rows_have_none() -> None:
    places = torch.rand(6, 1, 2, generator=torch.Generator().manual_seed(shifted(2))).double()
    positions = torch.cat([places, torch.ones(6, 1, 1)], -1)
    scattered = GridPoints(positions, positions, torch.ones(6, 1, dtype=torch.bool), places)
    assert find_rows(TargetedMetric(DaylightFactor(SKY), None), images(1.0, 2.0, 6.0), scattered) == ()
