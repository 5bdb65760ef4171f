"""The rows of points that decide a metric of daylight."""

from __future__ import annotations

import torch

from ..attr import Row
from ..daylight import DaylightMetric, PointMetric
from ..estimation import TargetedMetric, delete_one_jackknife
from ..grid import FROM_BELOW, GridPoints
from ..visualization import minus

MORE_LIGHT = 0.1  # the change of the illuminance at a row
MAX_ROWS = 12


def find_rows(
    metric: TargetedMetric, images: torch.Tensor, grid: GridPoints, of_value: torch.Tensor | None = None
) -> tuple[Row, ...]:
    """Return the rows of a grid and the effect of more light at each; none if the points are not in rows.

    ``images`` are independent daylight coefficients, ``(replicates, points, P, 3)``, and ``of_value`` those that
    the rows' values are of, by default their mean. The effect on the metric is ``0.1 Σ ∂M/∂C · C`` over the points
    of a row, to first order. Rows are those along which light changes less.
    """
    axis, rows = _rows(grid, images.mean((0, 2, 3)))
    upward = axis == grid.axes[1]
    towards = f"−{axis}" if upward and grid.axes == FROM_BELOW else axis
    if not 1 < len(rows) <= MAX_ROWS:
        return ()

    def effects(kept: torch.Tensor) -> torch.Tensor:
        mean = images[kept].mean(0)
        _, adjoint = metric.value_and_adjoint(mean)
        of_points = (adjoint.double() * mean.double()).sum((1, 2))
        return MORE_LIGHT * torch.stack([of_points[row].sum() for row in rows.values()])

    means, errors = delete_one_jackknife(effects, len(images))
    of_value = images.mean(0) if of_value is None else of_value
    values = metric.metric.hard_of_points(of_value) if isinstance(metric.metric, PointMetric) else None
    return tuple(
        Row(
            index + 1,
            f"{axis} = {minus(f'{place:g}')} m",
            "top" if upward else "left",
            len(row),
            None if values is None else values[row].mean().item(),
            means[index].item(),
            errors[index].item(),
            towards,
        )
        for index, (place, row) in enumerate(rows.items())
    )


def is_of_daylight(metric: TargetedMetric) -> bool:
    """Whether a metric is one of daylight coefficients."""
    return isinstance(metric.metric, DaylightMetric)


def _rows(grid: GridPoints, light: torch.Tensor) -> tuple[str, dict[float, torch.Tensor]]:
    """Return the axis across the rows, and the points of each row from the top or the left of the plan."""
    plan = grid.plan[grid.inside]
    found = []
    for axis in (0, 1):
        places = plan[:, axis].mul(100).round().div(100)
        rows = {
            place: torch.nonzero(places == place).flatten()
            for place in sorted(set(places.tolist()), reverse=axis == 1 and grid.axes != FROM_BELOW)
        }
        means = torch.stack([light[row].mean() for row in rows.values()])
        found.append((means.var(correction=0).item(), axis, rows))
    _, axis, rows = max(found, key=lambda one: one[:2])
    return grid.axes[axis], rows if len(rows) < len(plan) else {}
