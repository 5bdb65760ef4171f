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
_SHORTEST = 0.25  # of its length across the line of sight: foreshortened or cut to less, it is not drawn


class Arrow(NamedTuple):
    """An arrow from a point of the picture, in pixels from its upper left corner."""

    name: str
    x: float
    y: float
    dx: float
    dy: float


def arrows(attribution: Attribution) -> list[Arrow]:
    """Return an arrow for each translation with a clear effect, but not for what ranks last.

    It points to where the metric rises, as far as the picture shows that direction. Its length is proportional to
    the root of the effect, as the colours of the map, unless it ends at the picture's edge.
    """
    shown, image = attribution.info.get("shown_moves") or {}, attribution.image
    allowed, last = clear_from(attribution.info), attribution.ranked_last()
    rows = [
        row
        for row in attribution.ranking()
        if row.name in shown and row.name not in last and row.effect > allowed * (row.effect_error or 0.0)
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
        kept = min(_inside(x, dx, image.shape[1]), _inside(y, dy, image.shape[0]))
        dx, dy = kept * dx, kept * dy
        if math.hypot(dx, dy) >= _SHORTEST * length:
            found.append(Arrow(row.name, x, y, dx, dy))
    return found


def _inside(start: float, step: float, size: int) -> float:
    """Return how much of a step from a place in the picture stays in it: 1 if all does."""
    room = size - start if step > 0 else start
    return min(1.0, room / abs(step)) if step else 1.0


def draw_arrows(ax: Axes, attribution: Attribution) -> None:
    """Draw the arrows, dark with a bright edge so that they show on any map."""
    from matplotlib.patheffects import withStroke

    for arrow in arrows(attribution):
        x, y = arrow.x - 0.5, arrow.y - 0.5  # in an image, 0 is the middle of the first pixel
        line = {"arrowstyle": "->", "color": "black", "linewidth": 1.5, "mutation_scale": 9}
        ax.annotate(
            "",
            xy=(x + arrow.dx, y + arrow.dy),
            xytext=(x, y),
            arrowprops={
                **line,
                "shrinkA": 0,
                "shrinkB": 0,
                "path_effects": [withStroke(linewidth=3.5, foreground="white")],
            },
            annotation_clip=False,
        )
