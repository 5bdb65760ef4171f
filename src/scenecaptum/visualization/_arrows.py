"""Arrows on a picture: where moving an object raises the metric most."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..protocols import Attribution
from ..student import clear_from

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_ARROWS = 8
_LONGEST = 0.15  # of the picture's width, for the largest effect
_MOST_FORESHORTENED = 0.25  # of its length across the line of sight: a shorter arrow is not drawn


class Arrow(NamedTuple):
    """An arrow from a point of the picture, in pixels."""

    name: str
    x: float
    y: float
    dx: float
    dy: float


def arrows(attribution: Attribution) -> list[Arrow]:
    """Return an arrow for each translation with a clear effect.

    It points to where the metric rises, as far as the picture shows that direction. Its length is proportional to
    the root of the effect, as the colours of the map.
    """
    shown, image = attribution.info.get("shown_moves") or {}, attribution.image
    allowed = clear_from(attribution.info)
    rows = [
        row
        for row in attribution.ranking()
        if row.name in shown and row.effect > allowed * (row.effect_error or 0.0)
    ]
    if not rows or image is None:
        return []
    longest = _LONGEST * image.shape[1]
    found, weights = [], attribution.weights("range")
    for row in rows[:_MAX_ARROWS]:
        (x, y), jacobian = shown[row.name]
        towards = weights[row.name].double().cpu()
        direction = torch.tensor(jacobian, dtype=torch.float64) @ (towards / towards.norm())
        # In a unit of the scene across the line of sight.
        unit = torch.linalg.matrix_norm(torch.tensor(jacobian, dtype=torch.float64), 2)
        length = longest * math.sqrt(row.effect / rows[0].effect)
        dx, dy = (length * direction / unit).tolist()
        if math.hypot(dx, dy) >= _MOST_FORESHORTENED * length:
            found.append(Arrow(row.name, x, y, dx, dy))
    return found


def draw_arrows(ax: Axes, attribution: Attribution) -> None:
    """Draw the arrows, dark with a bright edge so that they show on any map."""
    from matplotlib.patheffects import withStroke

    for arrow in arrows(attribution):
        line = {"arrowstyle": "->", "color": "black", "linewidth": 1.5, "mutation_scale": 9}
        ax.annotate(
            "",
            xy=(arrow.x + arrow.dx, arrow.y + arrow.dy),
            xytext=(arrow.x, arrow.y),
            arrowprops={
                **line,
                "shrinkA": 0,
                "shrinkB": 0,
                "path_effects": [withStroke(linewidth=3.5, foreground="white")],
            },
            annotation_clip=False,
        )
