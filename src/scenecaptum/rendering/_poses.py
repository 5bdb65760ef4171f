"""Moves the objects, lights and camera of a live Mitsuba scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import torch

from ..scene import SceneObject, camera_object, pose_matrix, pose_name
from ._dr_arrays import owned

_AT_REST = {"translation": torch.zeros(3), "rotation": torch.zeros(3), "scale": torch.zeros(())}


class Moving(NamedTuple):
    """An object with the ``mi.traverse`` values that hold its place."""

    object: SceneObject
    params: Any


class Poses:
    """The poses of objects, by the names of their inputs."""

    def __init__(self, objects: Iterable[Moving]) -> None:
        self._moving = [_Pose(*moving) for moving in objects if not moving.object.problem]
        self._by_name = {name: moving for moving in self._moving for name in moving.names.values()}

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The poses of the scene as it was loaded: 0, and the field of view of its camera."""
        return {
            name: moving.original(component)
            for moving in self._moving
            for component, name in moving.names.items()
        }

    def remember(self) -> None:
        """Read where everything is, as the scene's own places: its owner may have moved something."""
        for moving in self._moving:
            moving.remember()

    def write(self, names: Iterable[str], values: Mapping[str, torch.Tensor]) -> None:
        """Move what the named inputs move, given the values of all of them."""
        changed = {id(moving): moving for name in names if (moving := self._by_name.get(name)) is not None}
        for moving in changed.values():
            moving.write({component: values[name] for component, name in moving.names.items()})
        for params in {id(moving.params): moving.params for moving in changed.values()}.values():
            params.update()


class _Pose:
    """An object of a live scene, with its places as loaded."""

    def __init__(self, one: SceneObject, params: Any) -> None:
        self.params = params
        self.names = {component: pose_name(one.name, component) for component in one.components}
        self._object = one
        self.remember()

    def remember(self) -> None:
        self._base = {key: _copy(self.params[key]) for key in self._object.keys}
        # Vertices are moved by torch.
        self._vertices: dict[str, torch.Tensor] = {}

    def original(self, component: str) -> torch.Tensor:
        if component == "fov":
            key = next(key for key in self._object.keys if key.endswith("x_fov"))
            return torch.tensor(float(self._base[key][0]))
        return _AT_REST[component].clone()

    def write(self, values: Mapping[str, torch.Tensor]) -> None:
        pose = {**_AT_REST, **{name: value for name, value in values.items() if name != "fov"}}
        is_at_rest = not any(bool(value.any()) for value in pose.values())
        matrix = pose_matrix(self._object.pivot, **pose)
        for key in self._object.keys:
            if key.endswith("x_fov"):
                self.params[key] = dr.opaque(mi.Float, values["fov"].item())
            else:
                # Also where it is at rest: Mitsuba computes the normals again of a mesh whose vertices alone are
                # written.
                self.params[key] = _copy(self._base[key]) if is_at_rest else self._moved(key, matrix)

    def _moved(self, key: str, matrix: torch.Tensor) -> Any:
        """Return the value of a place that is moved by a ``(4, 4)`` matrix."""
        base, kind = self._base[key], key.rpartition(".")[2]
        if kind == "to_world":
            return _transform(type(base), matrix @ _matrix(base))
        if kind == "position":
            place = torch.tensor([base.x[0], base.y[0], base.z[0], 1.0], dtype=torch.float64)
            return type(base)(*(dr.opaque(mi.Float, x) for x in (matrix @ place)[:3].tolist()))
        if key not in self._vertices:
            self._vertices[key] = base.torch().reshape(-1, 3).clone()
        vertices = self._vertices[key]
        linear, shift = matrix[:3, :3].to(vertices), matrix[:3, 3].to(vertices)
        if kind == "vertex_normals":
            moved = vertices @ linear.T / matrix[:3, :3].det().pow(1 / 3).to(vertices)
        else:
            moved = vertices @ linear.T + shift
        return owned(mi.Float(moved.reshape(-1).contiguous()))


def moving_objects(scene: Any, objects: Iterable[SceneObject]) -> list[Moving]:
    """Return the objects of a scene with their values."""
    params = mi.traverse(scene)
    return [Moving(one, params) for one in objects]


def moving_camera(sensors: Sequence[Any]) -> Moving:
    """Return the first sensor as an object; it cannot be moved if there are several."""
    camera = camera_object(sensors[0])
    if len(sensors) > 1:
        camera = dataclasses.replace(camera, problem="it needs a renderer with a single sensor")
    return Moving(camera, mi.traverse(sensors[0]))


def _copy(value: Any) -> Any:
    """Copy a transform, point or buffer: the scene's own is changed in place."""
    return type(value)(value)


def _matrix(transform: Any) -> torch.Tensor:
    rows = transform.matrix
    return torch.tensor([[rows[i, j][0] for j in range(4)] for i in range(4)], dtype=torch.float64)


def _transform(kind: type, matrix: torch.Tensor) -> Any:
    """Return a transform whose entries are not literals, which would be compiled into kernels."""
    rows = mi.Matrix4f(matrix.tolist())
    dr.make_opaque(rows)
    return kind(rows)
