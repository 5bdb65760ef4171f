"""Maps of light that are left out beside their scale, since the effects of both are those of the same light."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from ..protocols import ResultKind

TEXTURE_NDIM = 3
# Quantities that add up: a change is divided among the parameters that make it together.
SHARES = {ResultKind.CONTRIBUTION, ResultKind.SHAPLEY_VALUE}


def light_maps_left_out(kind: ResultKind, attributions: Mapping[str, torch.Tensor]) -> dict[str, str]:
    """Return the maps of light whose scale is attributed, too, each with the name of its scale.

    There are none if the ``kind`` is of effects that share a change, as contributions do.
    """
    if kind in SHARES:
        return {}
    maps = [name for name, value in attributions.items() if value.ndim == TEXTURE_NDIM]
    scales = {name: f"{name.rpartition('.')[0]}.scale" for name in maps}
    return {name: scale for name, scale in scales.items() if scale in attributions}
