"""Cells of a study, and recipes: everything that the numbers of a cell depend on, for any process."""

from __future__ import annotations

import dataclasses
import os
import pickle
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from ..checkpoint import digest
from ..errors import SceneCaptumError
from ..scene import hashable_source


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
        """Return the names; a number says what it is of."""
        return self.on(self._fields)

    def on(self, axes: Container[str]) -> str:
        """Return the names on some axes, in the order of all."""
        names = {**self._asdict(), "camera": camera_name(self.camera), "seed": f"seed {self.seed}"}
        return " · ".join(name for axis, name in names.items() if axis in axes)


def camera_name(camera: str) -> str:
    """Return the name of a camera: ``"camera 0"`` of one that has only a number."""
    return f"camera {camera}" if camera.isdecimal() else camera


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
