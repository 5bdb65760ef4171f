"""Cells of a study, and recipes: everything that the numbers of a cell depend on, for any process."""

from __future__ import annotations

import dataclasses
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..checkpoint import digest
from ..errors import SceneCaptumError, near_misses
from ..scene import BUNDLED, hashable_source


class Cell(NamedTuple):
    """One cell of a study: a name from each axis, and a seed.

    Attributes
    ----------
    scene, camera, metric, design, method
        Names of entries of the study's axes.
    seed
        The random seed.
    """

    scene: str
    camera: str
    metric: str
    design: str
    method: str
    seed: int

    def __str__(self) -> str:
        return " · ".join(map(str, self))


AXES = Cell._fields[:-1]


@dataclass(frozen=True)
class Recipe:
    """How to compute a cell: plain values that can be pickled, never a live scene.

    ``key`` names the cell's file. It is a hash of everything else, and of the contents of the scene's file.
    """

    cell: Cell
    scene: Any
    sensor: Any
    metric: Any  # a name, or a picklable function
    metric_options: Mapping[str, Any]
    design: Mapping[str, Any]
    method: str
    method_options: Mapping[str, Any]
    renderer_options: Mapping[str, Any]
    key: str = ""

    def with_key(self, scene_digest: str) -> Recipe:
        """Return the recipe with its key, given the digest of its scene."""
        parts = {
            field.name: hashable(getattr(self, field.name), field.name) for field in dataclasses.fields(self)
        }
        return dataclasses.replace(self, key=digest({**parts, "scene": scene_digest}))


def digest_of_scene(scene: Any) -> str:
    """Return a hash of a scene's file or dict."""
    return digest((hashable_source(scene),))


def hashable(value: Any, owner: str) -> Any:
    """Return a value as numbers, strings and tensors; raise if it cannot be sent to another process."""
    if value is None or isinstance(value, (str, int, float, torch.Tensor, np.ndarray)):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(name): hashable(item, owner) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [hashable(item, owner) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return [type(value).__name__, hashable(fields, owner)]
    try:
        return pickle.dumps(value, protocol=4).hex()
    except Exception as error:  # pickle raises what the object raises
        raise SceneCaptumError(
            f"The {owner} of a study must be sent to other processes, and {value!r} cannot be: {error}. Define it "
            "at the top level of a module."
        ) from error


@dataclass(frozen=True)
class _Matrix:
    """A transform of a Mitsuba dict, which itself cannot be sent to a process without a variant."""

    rows: list[list[float]]


def portable(scene: Any) -> Any:
    """Return a scene that can be pickled: an absolute path, a bundled name, or a dict of plain values."""
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
            f"A scene of a study is a path, the name of a bundled scene or a Mitsuba dict, not a "
            f"{type(scene).__name__}: its cells are computed in other processes, which load it themselves."
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
    if type(value).__module__.startswith(("mitsuba", "drjit")) and hasattr(value, "__len__"):
        return [float(number) for number in value]  # a colour or a point
    raise SceneCaptumError(
        f"{name!r} of the scene dict is a {type(value).__name__}, which cannot be sent to other processes. Use "
        "numbers, lists, arrays, strings and transforms, or a scene file."
    )


def restored(scene: Any) -> Any:
    """Return the scene of ``portable`` as ``SceneRenderer`` takes it, under an active variant."""
    if isinstance(scene, Mapping):
        return {name: restored(value) for name, value in scene.items()}
    if not isinstance(scene, _Matrix):
        return scene
    import mitsuba as mi

    return mi.ScalarTransform4f(scene.rows)
