"""Maps and images as files: ``export``, and the formats by their suffixes."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SceneCaptumError, near_misses
from ..files import atomic_write
from ..protocols import Attribution
from ._projection import IMAGE, heatmap, surfaces_of


def export(
    what: Attribution | torch.Tensor,
    path: str | os.PathLike[str],
    *,
    colours: str | None = None,
    limits: tuple[float, float] | None = None,
    **options: Any,
) -> None:
    """Write a map to a file: ``.png``, ``.exr`` or ``.npy``.

    - ``.png``: 8 bits, greyscale or with a colour map.
    - ``.exr``: 32-bit floats. For an attribution the render is in R, G and B, the map in ``saliency``, and the
      objects are a Cryptomatte, with which compositing software selects them; a map is in Y.
    - ``.npy``: the array, for ``numpy.load``.

    Parameters
    ----------
    what
        An attribution, whose heatmap is written; or a map ``(H, W)`` or an image ``(H, W, 3)``, such as
        ``renderer.derivative_image`` returns.
    path
        Output path; its suffix selects the format.
    colours
        Name of a matplotlib colour map for a PNG; greyscale by default.
    limits
        Values that a PNG shows as black and white, or as the ends of the colour map. By default 0 and 1, or -1 and
        1 for a signed map.
    **options
        Options of ``heatmap``, if ``what`` is an attribution.

    Raises
    ------
    SceneCaptumError
        If the format or colour map is unknown, the shape is not that of an image, or the file cannot be written.
    """
    path = Path(path)
    attribution = what if isinstance(what, Mapping) else None
    if attribution is not None:
        values = heatmap(attribution, **options).numpy(force=True)
    elif options:
        raise SceneCaptumError(f"{', '.join(options)}: only for an attribution; a map is written unchanged.")
    else:
        values = _to_array(what)
    if path.suffix not in _ENCODERS:
        *suffixes, last = _ENCODERS
        raise SceneCaptumError(f"{path} must end in {', '.join(suffixes)} or {last}.")
    exported = _Map(values, attribution, colours, limits, options)
    with atomic_write(path) as partial:
        partial.write_bytes(_ENCODERS[path.suffix](exported))


@dataclass
class _Map:
    """What ``export`` writes: a map or an image, the attribution that it shows, and the options."""

    values: NDArray[np.float32]
    attribution: Attribution | None
    colours: str | None
    limits: tuple[float, float] | None
    options: Mapping[str, Any]


def _to_array(values: Any) -> NDArray[np.float32]:
    is_tensor = isinstance(values, torch.Tensor)
    if not is_tensor or values.ndim not in (2, IMAGE) or values.shape[2:] not in ((), (3,)):
        shape = tuple(values.shape) if is_tensor else type(values).__name__
        raise SceneCaptumError(
            f"Only an attribution, a map (H, W) or an image (H, W, 3) can be written, not {shape}."
        )
    array: NDArray[np.float32] = values.float().numpy(force=True)
    return array


def _encode_png(exported: _Map) -> bytes:
    from matplotlib import colormaps
    from PIL import Image

    values, colours = exported.values, exported.colours
    signed = exported.options.get("signed", values.min() < 0)
    limits = exported.limits or ((-1.0, 1.0) if signed else (0.0, 1.0))
    low, high = limits
    if not low < high:
        raise SceneCaptumError(f"limits must be two numbers, the lower first, not {limits!r}.")
    normalized = np.clip((values - low) / (high - low), 0, 1)
    if colours is not None:
        if colours not in colormaps or values.ndim == IMAGE:
            raise SceneCaptumError(
                f"colours must name a matplotlib colour map and be used with a map (H, W), not {colours!r} with "
                f"{values.shape}.{near_misses(str(colours), colormaps)}"
            )
        normalized = colormaps[colours](normalized)[..., :3]
    buffer = io.BytesIO()
    Image.fromarray(np.round(normalized * 255).astype(np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


def _encode_exr(exported: _Map) -> bytes:
    from ..backend import exclusively
    from ._cryptomatte import layers

    attribution, values = exported.attribution, exported.values
    if attribution is None:
        with exclusively() as mi:
            return _exr_bytes(mi, mi.Bitmap(np.ascontiguousarray(values)))
    channels, metadata = layers(surfaces_of(attribution, exported.options.get("surfaces")))
    channels = {"saliency": values, **channels}
    if attribution.image is not None:
        image = attribution.image.numpy(force=True)
        channels = {**dict(zip("RGB", np.moveaxis(image, -1, 0), strict=True)), **channels}
    stack = np.stack([channel.astype(np.float32) for channel in channels.values()], axis=-1)
    with exclusively() as mi:
        bitmap = mi.Bitmap(stack, channel_names=list(channels))
        for key, value in metadata.items():
            bitmap.metadata()[key] = value
        return _exr_bytes(mi, bitmap)


def _exr_bytes(mi: Any, bitmap: Any) -> bytes:
    from ..backend import at_least_two_threads

    # Encode in memory, since Mitsuba does not report every file error.
    stream = mi.MemoryStream()
    with at_least_two_threads():
        bitmap.write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())


def _encode_npy(exported: _Map) -> bytes:
    # numpy.save to a path does not report why writing failed.
    content = io.BytesIO()
    np.save(content, exported.values)
    return content.getvalue()


_ENCODERS = {".png": _encode_png, ".exr": _encode_exr, ".npy": _encode_npy}
