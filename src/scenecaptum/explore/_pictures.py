"""Pictures and objects as a page reads them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import torch

from ..projection import SurfaceMap, used_by_objects
from ..protocols import Attribution
from ..report import color_maps, encode_surfaces

_LARGEST = 32768.0  # half precision ends at 65504


def encode(image: torch.Tensor) -> tuple[float, bytes]:
    """Return a factor, and an image divided by it in half precision (little-endian)."""
    peak = image.abs().max().item()
    scale = peak / _LARGEST if peak > 0 else 1.0
    return scale, (image / scale).half().numpy(force=True).astype("<f2").tobytes()


def describe_objects(
    surfaces: SurfaceMap, movable: Collection[str], attributions: Sequence[Attribution]
) -> dict[str, Any]:
    """Return what each pixel shows, which parameters can change it, and the signed effects of each object."""
    planes, shown = encode_surfaces(surfaces)
    effects = []
    for attribution in attributions:
        by_name = attribution.effects()
        used = used_by_objects(attribution, surfaces, by_name)
        effects.append([sum(by_name[name] for name in used[index]) for index in shown])
    return {
        **planes,
        "width": surfaces.shape[1],
        "height": surfaces.shape[0],
        "names": [surfaces.objects[index] for index in shown],
        "parameters": [[name for name in surfaces.parameters[index] if name in movable] for index in shown],
        "effects": effects,
        "maps": color_maps(),
    }
