"""Arrows on a picture: where moving an object raises the metric most."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..protocols import Attribution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_ARROWS = 8
_LONGEST = 0.15  # of the picture's width, for the largest effect
_SHORTEST = 0.25  # of that of the largest effect: a shorter arrow is not drawn


class Arrow(NamedTuple):
    """An arrow from a point of the picture, in pixels."""

    name: str
    x: float
    y: float
    dx: float
    dy: float


def arrows(attribution: Attribution) -> list[Arrow]:
    """Return an arrow for each translation with a clear effect: its direction, and its length by the effect.

    It points to where the metric rises, as far as the picture shows that direction.
    """
    shown, image = attribution.info.get("shown_moves") or {}, attribution.image
    rows = [
        row
        for row in attribution.ranking()
        if row.name in shown and row.effect > 2 * (row.effect_error or 0.0)
    ]
    if not rows or image is None:
        return []
    longest = _LONGEST * image.shape[1]
    found = []
    for row in rows[:_MAX_ARROWS]:
        (x, y), jacobian = shown[row.name]
        gradient = attribution[row.name].double().cpu()
        direction = torch.tensor(jacobian, dtype=torch.float64) @ (gradient / gradient.norm())
        # In a unit of the scene across the line of sight.
        unit = torch.linalg.matrix_norm(torch.tensor(jacobian, dtype=torch.float64), 2)
        dx, dy = (longest * row.effect / rows[0].effect * direction / unit).tolist()
        if math.hypot(dx, dy) >= _SHORTEST * longest * row.effect / rows[0].effect:
            found.append(Arrow(row.name, x, y, dx, dy))
    return found


def draw_arrows(ax: Axes, attribution: Attribution) -> None:
    """Draw the arrows, dark with a bright edge so that they show on any map."""
    for arrow in arrows(attribution):
        for color, width, head in (("white", 3.0, 9), ("black", 1.4, 7)):
            style = f"-|>,head_length={head / 10},head_width={head / 20}"
            ax.annotate(
                "",
                xy=(arrow.x + arrow.dx, arrow.y + arrow.dy),
                xytext=(arrow.x, arrow.y),
                arrowprops={
                    "arrowstyle": style,
                    "color": color,
                    "linewidth": width,
                    "shrinkA": 0,
                    "shrinkB": 0,
                },
                annotation_clip=False,
            )
