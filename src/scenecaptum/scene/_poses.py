"""Poses as parameters: how far an object, a light or the camera has moved since it was loaded."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import TypeAlias

import torch

from ._bounds import Bounds
from ._objects import SceneObject
from ._parameter_table import CAMERA, POSES, UNITS, Parameter

# The poses that differ from those of the scene as loaded, by the names of their inputs.
Moved: TypeAlias = "tuple[tuple[str, float | tuple[float, ...]], ...]"

# The change over which effects are compared: 0.1 scene units, 5°, a twentieth of the size.
RANGES = MappingProxyType(
    {"translation": 0.1, "rotation": math.radians(5), "scale": 0.05, "fov": 5.0},
)
_BOUNDS = {"scale": Bounds(-1.0, open_low=True), "fov": Bounds(0.0, 179.0, open_low=True)}
_SHAPES: dict[str, tuple[int, ...]] = {"translation": (3,), "rotation": (3,), "scale": (), "fov": ()}
_AT_REST = {"translation": torch.zeros(3), "rotation": torch.zeros(3), "scale": torch.zeros(())}


def pose_name(owner: str, component: str) -> str:
    """Return the name of an input, such as ``"desk.pose.translation"``."""
    return f"{owner}.fov" if component == "fov" else f"{owner}.pose.{component}"


def pose_component(name: str) -> str | None:
    """Return what an input moves, ``"translation"``, ``"rotation"``, ``"scale"`` or ``"fov"``, or None."""
    for component in RANGES:
        if name.endswith(pose_name("", component)):
            return component
    return None


def with_unit(label: str, name: str) -> str:
    """Return the label of a parameter with the unit of its values: ``"shade: rotation (rad)"``."""
    unit = UNITS.get(pose_component(name) or "")
    return f"{label} ({unit})" if unit else label


def pose_parameters(objects: Iterable[SceneObject], *, kind: str = POSES) -> list[Parameter]:
    """Return the parameters of the poses of objects, also those that change nothing, with the reason."""
    return [
        _parameter(one, component, kind) for one in objects for component in (*one.components, *one.fixed)
    ]


def camera_parameters(camera: SceneObject) -> list[Parameter]:
    """Return the parameters of the pose of the camera."""
    return pose_parameters([camera], kind=CAMERA)


def _parameter(one: SceneObject, component: str, kind: str) -> Parameter:
    half = RANGES[component] / 2
    return Parameter(
        name=pose_name(one.name, component),
        label=f"{one.name}: {component}",
        kind=kind,
        plugin="Pose",
        role=component,
        shape=_SHAPES[component],
        bounds=_BOUNDS.get(component, Bounds()),
        range=Bounds(-half, half),
        owners=(one.name,),
        tracked=False,
        shapes=one.shapes,
        problem=one.problem or one.fixed.get(component),
    )


def pose_matrix(
    pivot: tuple[float, float, float], translation: torch.Tensor, rotation: torch.Tensor, scale: torch.Tensor
) -> torch.Tensor:
    """Return the ``(4, 4)`` float64 matrix that grows and turns about the ``pivot``, then moves.

    ``rotation`` is axis–angle in radians, about the axes of the world; ``scale`` is 0 for the size as loaded.
    """
    about = torch.tensor(pivot, dtype=torch.float64)
    linear = (1 + scale.double().cpu()) * _rotation(rotation.double().cpu())
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = linear
    matrix[:3, 3] = about + translation.double().cpu() - linear @ about
    return matrix


def placement(one: SceneObject, values: Mapping[str, torch.Tensor]) -> torch.Tensor | None:
    """Return the ``pose_matrix`` of an object alone, given the values of poses by name; None if it is at rest."""
    pose = {name: values.get(pose_name(one.name, name), zero) for name, zero in _AT_REST.items()}
    if not any(bool(value.any()) for value in pose.values()):
        return None
    return pose_matrix(one.pivot, **pose)


def overlaps(
    objects: Iterable[SceneObject], values: Mapping[str, torch.Tensor], movers: Collection[str]
) -> list[tuple[str, str]]:
    """Return the pairs of movers and other objects whose bounds overlap, given the values of poses by name.

    An object and its parts do not count.
    """
    known = {one.name: one for one in objects}
    boxes = {name: box for name, one in known.items() if (box := _moved_box(one, known, values)) is not None}
    return [
        (mover, other)
        for mover in movers
        if mover in boxes
        for other, box in boxes.items()
        if other != mover and not known[mover].is_related(known[other]) and _overlap(boxes[mover], box)
    ]


def _moved_box(
    one: SceneObject, known: Mapping[str, SceneObject], values: Mapping[str, torch.Tensor]
) -> torch.Tensor | None:
    """Return the bounds of an object in its pose, ``(2, 3)``."""
    if one.box is None:
        return None
    corners = torch.cartesian_prod(*torch.from_numpy(one.box).T)
    corners = _moved(corners, (one.name, *one.part_of), known, values)
    return torch.stack([corners.amin(0), corners.amax(0)])


def moved_pivot(
    one: SceneObject, known: Mapping[str, SceneObject], values: Mapping[str, torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return where the pivot of an object is in its pose, ``(3,)``, and how its translation moves it, ``(3, 3)``.

    ``known`` has all objects by name, ``values`` the values of poses by name.
    """
    pivot = _moved(torch.tensor([one.pivot], dtype=torch.float64), (one.name,), known, values)
    steps = torch.cat([torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)])
    place, *ends = _moved(pivot + steps, one.part_of, known, values)
    return place, (torch.stack(ends) - place).T


def _moved(
    points: torch.Tensor,
    movers: Iterable[str],
    known: Mapping[str, SceneObject],
    values: Mapping[str, torch.Tensor],
) -> torch.Tensor:
    """Return points ``(N, 3)`` after the poses of objects, one after the other."""
    for name in movers:
        if (matrix := placement(known[name], values)) is not None:
            points = points @ matrix[:3, :3].T + matrix[:3, 3]
    return points


def _overlap(left: torch.Tensor, right: torch.Tensor) -> bool:
    """Whether two boxes overlap by more than rounding, or a flat one cuts the other."""
    rounding = 1e-6
    return bool(((left[0] + rounding < right[1]) & (left[1] - rounding > right[0])).all())


def _rotation(vector: torch.Tensor) -> torch.Tensor:
    x, y, z = vector.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    matrix: torch.Tensor = torch.linalg.matrix_exp(cross)
    return matrix
