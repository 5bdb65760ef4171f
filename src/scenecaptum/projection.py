"""Parameter space → image space: each pixel gets the saliency of what it shows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from .errors import SceneCaptumError

if TYPE_CHECKING:
    from .attr import SceneAttribution


def heatmap(attribution: SceneAttribution) -> torch.Tensor:
    """Paint each pixel with the saliency of the objects it shows, weighted by how much of it they cover.

    An object's saliency is the ℓ2 norm over all its parameters; where several materials, lights and media meet
    in one object, over all of theirs; and where the attribution is to groups, over those that have any of them.
    The scale is set by the most salient object, parameter or group, seen or not, so a map never exceeds 1, and its
    brightest pixel stays below 1 where what matters most is out of sight.

    Returns
    -------
    Tensor
        ``(H, W)`` in [0, 1].

    Raises
    ------
    SceneCaptumError
        Where the attribution does not know what its pixels show.
    """
    surfaces = attribution.surfaces
    if surfaces is None:
        raise SceneCaptumError(
            "This attribution does not know which object each pixel shows: only a SceneRenderer does."
        )
    saliency = attribution.saliency()
    groups = attribution.info.get("groups") or {name: [name] for name in saliency}
    group_of = {name: group for group, members in groups.items() for name in members if group in saliency}
    objects = [
        math.hypot(*(saliency[group] for group in {group_of[name] for name in below if name in group_of}))
        for below in surfaces.parameters
    ]
    brightest = max([*objects, *saliency.values()], default=0.0)

    height, width = surfaces.shape
    painted = torch.zeros(height * width)
    if brightest > 0:
        shown = torch.tensor(objects)[torch.from_numpy(surfaces.object_index).long()]
        painted.index_add_(
            0,
            torch.from_numpy(surfaces.pixel).long(),
            torch.from_numpy(surfaces.fraction) * shown / brightest,
        )
    # Fractions of a pixel sum to 1 up to rounding.
    return painted.clamp(0, 1).reshape(height, width)
