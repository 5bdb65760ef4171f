"""Moves the objects, lights and camera of a live Mitsuba scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import torch

from ..backend import device
from ..scene import SceneObject, camera_object, placement, pose_name
from ._dr_arrays import owned


class Moving(NamedTuple):
    """An object with the ``mi.traverse`` values that hold its place."""

    object: SceneObject
    params: Any


class Poses:
    """The poses of objects, by the names of their inputs.

    What belongs to several objects moves with each: first with the smallest, a part of the others.
    """

    def __init__(self, objects: Iterable[Moving]) -> None:
        moving = [one for one in objects if not one.object.problem]
        self._owners = {
            pose_name(one.object.name, component): one.object
            for one in moving
            for component in one.object.components
        }
        places: dict[tuple[int, str], _Place] = {}
        for one in sorted(moving, key=lambda one: len(one.object.part_of), reverse=True):
            for key in one.object.keys:
                place = places.setdefault((id(one.params), key), _Place(one.params, key))
                place.objects.append(one.object)
        self._places = list(places.values())
        self.remember()

    def __contains__(self, name: object) -> bool:
        return name in self._owners

    def __iter__(self) -> Iterator[str]:
        return iter(self._owners)

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The poses of the scene as it was loaded: 0, and the field of view of its camera."""
        fields_of_view = {place.fov_name: place.field_of_view for place in self._places if place.is_fov}
        return {
            name: fields_of_view.get(name, torch.zeros(() if name.endswith("scale") else 3)).to(device())
            for name in self._owners
        }

    def remember(self) -> None:
        """Read where everything is, as the scene's own places: its owner may have moved something."""
        for place in self._places:
            place.remember()

    def write(self, names: Iterable[str], values: Mapping[str, torch.Tensor]) -> None:
        """Move what the named inputs move, given the values of all of them."""
        moved = {self._owners[name].name for name in names if name in self._owners}
        changed = [place for place in self._places if any(one.name in moved for one in place.objects)]
        objects = {one.name: one for place in changed for one in place.objects}
        matrices = {name: placement(one, values) for name, one in objects.items()}
        for place in changed:
            place.write(matrices, values)
        for params in {id(place.params): place.params for place in changed}.values():
            params.update()


class _Place:
    """A value of a live scene that holds where something is, and the objects it belongs to, parts first."""

    def __init__(self, params: Any, key: str) -> None:
        self.params = params
        self.objects: list[SceneObject] = []
        self._key = key

    @property
    def is_fov(self) -> bool:
        """Whether it is the field of view of a camera, which no transform moves."""
        return self._key.endswith("x_fov")

    @property
    def fov_name(self) -> str:
        """The name of the input of a field of view."""
        return pose_name(self.objects[0].name, "fov")

    @property
    def field_of_view(self) -> torch.Tensor:
        """The field of view as loaded, in degrees."""
        return torch.tensor(float(self._base[0]))

    def remember(self) -> None:
        self._base = _copy(self.params[self._key])
        # Vertices are moved by torch.
        self._vertices: torch.Tensor | None = None

    def write(self, matrices: Mapping[str, torch.Tensor | None], values: Mapping[str, torch.Tensor]) -> None:
        if self.is_fov:
            self.params[self._key] = dr.opaque(mi.Float, values[self.fov_name].item())
            return
        moves = [matrix for one in self.objects if (matrix := matrices[one.name]) is not None]
        # Also where it is at rest: Mitsuba computes the normals again of a mesh whose vertices alone are written.
        self.params[self._key] = (
            self._moved(reduce(lambda inner, outer: outer @ inner, moves)) if moves else _copy(self._base)
        )

    def _moved(self, matrix: torch.Tensor) -> Any:
        """Return the value moved by a ``(4, 4)`` matrix."""
        base, kind = self._base, self._key.rpartition(".")[2]
        if kind == "to_world":
            return _transform(type(base), matrix @ _matrix(base))
        if kind == "position":
            place = torch.tensor([base.x[0], base.y[0], base.z[0], 1.0], dtype=torch.float64)
            return type(base)(*(dr.opaque(mi.Float, x) for x in (matrix @ place)[:3].tolist()))
        if self._vertices is None:
            self._vertices = base.torch().reshape(-1, 3).clone()
        linear, shift = matrix[:3, :3].to(self._vertices), matrix[:3, 3].to(self._vertices)
        if kind == "vertex_normals":
            moved = self._vertices @ linear.T / matrix[:3, :3].det().pow(1 / 3).to(self._vertices)
        else:
            moved = self._vertices @ linear.T + shift
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
