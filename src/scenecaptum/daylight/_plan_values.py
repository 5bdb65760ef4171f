"""What a map on the plan of a room shows of a metric of daylight."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class PlanValues:
    """A number at each point of a grid, for ``visualization.plot_plan``.

    Attributes
    ----------
    values
        ``(points,)``; ``renderer.grid.spread(values)`` places them on the grid.
    label
        Quantity and unit.
    levels
        Values at which a map has contours, such as the limit that the metric compares with.
    counts
        The meaning of such a limit, in a sentence; empty if there is none. ``"(line)"`` in it names the contour.
    """

    values: torch.Tensor
    label: str
    levels: tuple[float, ...] = ()
    counts: str = ""


def hours_with(threshold: float, period: str) -> str:
    """Return the label of the share of the hours of a period with at least an illuminance."""
    return f"{period} with at least {threshold:g} lx in %"
