"""Compact string encodings of images and of the objects that their pixels show."""

from __future__ import annotations

import base64
import io
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..projection import SurfaceMap
from ..visualization import display_image, diverging

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LAYERS = 3  # objects per pixel; the largest three are scaled to the total coverage
_FULL_COVERAGE = 255
_JPEG_QUALITY = 95
_FIGURE_DPI = 150
PLAN_DPI = 240  # of a plan, which may be narrow to be read on a phone


def encode_picture(image: torch.Tensor, exposure: float) -> str:
    """Return a render as a JPEG data URL; a PNG of a noisy render is four times as large."""
    from PIL import Image

    pixels = (display_image(image, exposure) * 255).round().to(torch.uint8).numpy(force=True)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def encode_figure(figure: Figure, dpi: int = _FIGURE_DPI) -> tuple[str, tuple[int, int]]:
    """Return a figure as a PNG data URL, and its height and width in pixels."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    width, height = Image.open(buffer).size
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", (height, width)


def encode_surfaces(surfaces: SurfaceMap) -> tuple[dict[str, str], NDArray[np.int64]]:
    """Return the objects that each pixel shows, and the indices of all visible objects in ``surfaces.objects``.

    ``objects`` are ``LAYERS`` planes of little-endian 16-bit indices into the visible objects, the largest first;
    ``weights`` as many planes of bytes, the fraction that each covers. Both are deflated and in base64.
    """
    shown, local = np.unique(surfaces.object_index.astype(np.int64), return_inverse=True)
    pixel, fraction = surfaces.pixel.astype(np.int64), surfaces.fraction.astype(np.float64)
    count = surfaces.shape[0] * surfaces.shape[1]
    order = np.lexsort((local, -fraction, pixel))
    pixel, local, fraction = pixel[order], local[order], fraction[order]
    layer = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)  # 0 for the largest object of a pixel
    kept = layer < LAYERS
    covered = np.bincount(pixel, fraction, count)
    scale = covered / np.maximum(np.bincount(pixel[kept], fraction[kept], count), 1e-9)

    objects = np.zeros((LAYERS, count), dtype="<u2")
    objects[layer[kept], pixel[kept]] = local[kept]
    exact = np.zeros((LAYERS, count))
    exact[layer[kept], pixel[kept]] = fraction[kept] * scale[pixel[kept]] * _FULL_COVERAGE
    weights = exact.round()
    # The largest absorbs the rounding, so that the weights of a pixel sum to its coverage.
    weights[0] = np.clip((covered * _FULL_COVERAGE).round(), 0, _FULL_COVERAGE) - weights[1:].sum(0)
    planes = {
        "objects": objects.tobytes(),
        "weights": weights.clip(0, _FULL_COVERAGE).astype(np.uint8).tobytes(),
    }
    return {name: _deflate(plane) for name, plane in planes.items()}, shown


def encode_map(painted: torch.Tensor, *, signed: bool) -> str:
    """Return a map with values from 0 (signed: −1) to 1 as bytes (signed: 0 at 128), deflated and in base64.

    The bytes store fourth roots, to keep the precision of small values for a logarithmic scale.
    """
    roots = painted.sign() * painted.abs().pow(0.25)
    levels = 128 + 127 * roots if signed else 255 * roots
    return _deflate(levels.round().to(torch.uint8).numpy(force=True).tobytes())


def color_maps() -> dict[str, str]:
    """Return the figures' sequential and diverging colour maps, 256 RGB triples of bytes in base64."""
    from matplotlib import colormaps

    def table(colormap: Any) -> str:
        triples = np.ascontiguousarray(colormap(np.linspace(0, 1, 256), bytes=True)[:, :3])
        return base64.b64encode(triples.tobytes()).decode()

    return {"magnitude": table(colormaps["inferno"]), "signed": table(diverging())}


def _deflate(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()
