"""Changes of poses in words."""

from __future__ import annotations

import math

import torch

from ._numbers import rounded

MOVES = {"translation": "towards", "rotation": "about"}


def move(component: str, change: torch.Tensor, up: int | None = None) -> str:
    """Return a change of a pose in words: scene units and degrees.

    With the axis that points up it says of a translation that is nearer to the vertical than to the floor that it
    is one up or down: an object that stands on the floor cannot make it.
    """
    if component not in MOVES:
        return f"{rounded(change.sum().item())}{'°' if component == 'fov' else ' of its size'}"
    length = change.norm().item()
    size = f"{rounded(math.degrees(length))}°" if component == "rotation" else f"{rounded(length)} units"
    direction = ", ".join(
        f"{number:.1f}".replace("-0.0", "0.0").replace("-", "−")
        for number in (change / (length or 1.0)).tolist()
    )
    vertical = ""
    if component == "translation" and up is not None and abs(change[up].item()) > math.sqrt(0.5) * length:
        vertical = ", up" if change[up] > 0 else ", down"
    return f"{size} {MOVES[component]} ({direction}){vertical}"
