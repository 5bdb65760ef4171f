"""Pictures for the page: without noise, at half precision."""

from __future__ import annotations

from typing import Any

import torch

from ..denoising import Guides, denoise
from ..projection import SurfaceMap, used_by_objects
from ..protocols import Attribution
from ..report import color_maps, encode_surfaces

_LARGEST = 32768.0  # half precision ends at 65504
_COMMON = 0.999  # of the pixels decide how far a derivative is below zero


def encode(image: torch.Tensor) -> tuple[float, bytes]:
    """Return a factor and an image divided by it as little-endian numbers of half precision."""
    peak = image.abs().max().item()
    scale = peak / _LARGEST if peak > 0 else 1.0
    return scale, (image / scale).half().numpy(force=True).astype("<f2").tobytes()


def denoise_derivative(image: torch.Tensor, guides: Guides) -> torch.Tensor:
    """Denoise an image that may be negative, which the denoiser clamps to 0: lift it above, then lower it again."""
    below = -image.amin(-1).flatten()
    lift = max(0.0, below.kthvalue(max(1, round(_COMMON * len(below)))).values.item())
    return denoise(image + lift, guides) - lift


def describe_objects(
    surfaces: SurfaceMap, names: list[str], attributions: list[Attribution]
) -> dict[str, Any]:
    """Return what each pixel shows, which parameters that depends on, and the signed effects of each object."""
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
        "parameters": [[n for n in surfaces.parameters[index] if n in names] for index in shown],
        "effects": effects,
        "maps": color_maps(),
    }
