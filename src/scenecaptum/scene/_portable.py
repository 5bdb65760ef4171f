"""Scenes that can be sent to other processes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SceneCaptumError, near_misses
from .bundled import BUNDLED


@dataclass(frozen=True)
class _Matrix:
    """A transform of a Mitsuba dict, which itself cannot be sent to a process without a variant."""

    rows: list[list[float]]


@dataclass(frozen=True, eq=False)
class _Picture:
    """A tensor or a bitmap of a Mitsuba dict, as NumPy array."""

    array: np.ndarray[Any, Any]
    # Of a bitmap only: the name of its pixel format, and whether it is sRGB encoded.
    pixel_format: str = ""
    srgb_gamma: bool = False


def picture_of(value: Any) -> _Picture | None:
    """Return a tensor or a bitmap of Mitsuba as NumPy array; None for anything else."""
    kind = type(value)
    if kind.__module__.startswith("mitsuba") and kind.__name__ == "Bitmap":
        return _Picture(np.array(value), value.pixel_format().name, value.srgb_gamma())
    return _Picture(np.array(value)) if _is_tensor(value) else None


def with_copied_tensors(scene: Any) -> Any:
    """Return a Mitsuba dict whose tensors are copies."""
    if isinstance(scene, Mapping):
        return {name: with_copied_tensors(value) for name, value in scene.items()}
    return type(scene)(scene) if _is_tensor(scene) else scene


def _is_tensor(value: Any) -> bool:
    kind = type(value)
    return kind.__module__.startswith("drjit") and kind.__name__.startswith("Tensor")


def portable(scene: Any) -> Any:
    """Return a scene that can be pickled: an absolute path, a bundled name, or a dict of plain values.

    Raises
    ------
    SceneCaptumError
        If there is no such scene, or it is or has something else.
    """
    if isinstance(scene, (str, os.PathLike)):
        path = Path(scene)
        if path.is_file():
            return str(path.resolve())
        if os.fspath(scene) not in BUNDLED:
            raise SceneCaptumError(
                f"There is no scene file {os.fspath(scene)!r}, and no bundled scene of that name (bundled: "
                f"{', '.join(BUNDLED)}).{near_misses(os.fspath(scene), BUNDLED)}"
            )
        return os.fspath(scene)
    if not isinstance(scene, Mapping):
        raise SceneCaptumError(
            "A scene for other processes is a path, the name of a bundled scene or a Mitsuba dict, which they "
            f"load themselves, not a {type(scene).__name__}."
        )
    return {name: _portable(value, name) for name, value in scene.items()}


def _portable(value: Any, name: str) -> Any:
    if value is None or isinstance(value, (str, int, float, np.ndarray)):
        return value
    if isinstance(value, Mapping):
        return {key: _portable(item, key) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_portable(item, name) for item in value]
    if type(value).__name__.endswith("Transform4f"):
        return _Matrix(np.array(value.matrix, dtype=float).reshape(4, 4).tolist())
    if (picture := picture_of(value)) is not None:
        return picture
    if type(value).__module__.startswith(("mitsuba", "drjit")) and hasattr(value, "__len__"):
        return [float(number) for number in value]  # a colour or a point
    raise SceneCaptumError(
        f"{name!r} of the scene dict is a {type(value).__name__}, which cannot be sent to other processes. Use "
        "numbers, lists, strings, transforms, tensors and bitmaps, or a scene file."
    )


def restored(scene: Any) -> Any:
    """Return a scene of ``portable`` as it was before, under an active variant."""
    if isinstance(scene, Mapping):
        return {name: restored(value) for name, value in scene.items()}
    if isinstance(scene, list):
        return [restored(value) for value in scene]
    if not isinstance(scene, _Matrix | _Picture):
        return scene
    import mitsuba as mi

    if isinstance(scene, _Matrix):
        return mi.ScalarTransform4f(scene.rows)
    if not scene.pixel_format:
        return mi.TensorXf(scene.array)
    bitmap = mi.Bitmap(scene.array, getattr(mi.Bitmap.PixelFormat, scene.pixel_format))
    bitmap.set_srgb_gamma(scene.srgb_gamma)
    return bitmap
