"""Pictures and the objects that their pixels show, as short strings."""

from __future__ import annotations

import base64
import io
import zlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...scene import SurfaceMap
from .._maps import diverging
from .._tonemap import display_image

LAYERS = 3  # objects kept for each pixel; where more meet, the largest three share what they cover
_FULL = 255
_QUALITY = 95


def encode_picture(image: torch.Tensor) -> str:
    """Return a render as a data URL: a JPEG, for a PNG of a noisy render is four times as large."""
    from PIL import Image

    pixels = (display_image(image) * 255).round().to(torch.uint8).numpy(force=True)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=_QUALITY, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def encode_surfaces(surfaces: SurfaceMap) -> tuple[dict[str, str], NDArray[np.int64]]:
    """Return which objects each pixel shows, and the indices of those that any pixel shows.

    Returns
    -------
    dict
        ``objects``: ``LAYERS`` planes of little-endian 16-bit indices into the second element, the largest first;
        ``weights``: as many planes of bytes, the fraction that each covers. Both deflated, in base64.
    """
    shown, local = np.unique(surfaces.object_index.astype(np.int64), return_inverse=True)
    pixel, fraction = surfaces.pixel.astype(np.int64), surfaces.fraction.astype(np.float64)
    count = surfaces.shape[0] * surfaces.shape[1]
    order = np.lexsort((local, -fraction, pixel))
    pixel, local, fraction = pixel[order], local[order], fraction[order]
    place = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)  # 0 for the largest of its pixel
    kept = place < LAYERS
    covered = np.bincount(pixel, fraction, count)
    stretch = covered / np.maximum(np.bincount(pixel[kept], fraction[kept], count), 1e-9)

    objects = np.zeros((LAYERS, count), dtype="<u2")
    objects[place[kept], pixel[kept]] = local[kept]
    exact = np.zeros((LAYERS, count))
    exact[place[kept], pixel[kept]] = fraction[kept] * stretch[pixel[kept]] * _FULL
    weights = exact.round()
    # The largest takes up the rounding, so that a covered pixel is covered in whole.
    weights[0] = np.clip((covered * _FULL).round(), 0, _FULL) - weights[1:].sum(0)
    planes = {"objects": objects.tobytes(), "weights": weights.clip(0, _FULL).astype(np.uint8).tobytes()}
    return {name: _deflated(plane) for name, plane in planes.items()}, shown


def encode_map(painted: torch.Tensor, *, signed: bool) -> str:
    """Return a map from 0 or −1 to 1 as bytes, of which signed ones have 0 at 128; deflated, in base64.

    They hold fourth roots, so that what is small keeps its digits for a logarithmic scale.
    """
    roots = painted.sign() * painted.abs().pow(0.25)
    places = 128 + 127 * roots if signed else 255 * roots
    return _deflated(places.round().to(torch.uint8).numpy(force=True).tobytes())


def colour_maps() -> dict[str, str]:
    """Return the figures' sequential and diverging colour maps, 256 RGB triples of bytes in base64."""
    from matplotlib import colormaps

    def table(colours: Any) -> str:
        triples = np.ascontiguousarray(colours(np.linspace(0, 1, 256), bytes=True)[:, :3])
        return base64.b64encode(triples.tobytes()).decode()

    return {
        "magnitude": table(colormaps["inferno"]),
        "signed": table(diverging()),
    }


def _deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()
