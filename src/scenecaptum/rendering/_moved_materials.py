"""Copies of materials with one parameter moved, for finite differences of paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..scene import SceneGraph, SceneParameters, children
from ..scene.dielectric import SmoothDielectric
from ._derivative_routes import FiniteDifference
from ._dr_arrays import owned
from ._registry import bsdf_index, index_table
from .integrators.path_differences import MAX_MATERIALS, POINTS, MovedMaterials

# Mitsuba's plugins whose textures are arguments under the names that ``mi.traverse`` reports.
_PRINCIPLED = {"Principled": "principled", "PrincipledThin": "principledthin"}


@dataclass(frozen=True)
class MovedParameter:
    """A parameter of a material, and the copies in which it has values of its own."""

    material: Any
    copies: tuple[MaterialCopy, ...]


class MaterialCopy:
    """A copy of a material that shares all its textures but one value."""

    def __init__(self, material: Any, role: str) -> None:
        if material.class_name() == "SmoothDielectric":
            self.bsdf = SmoothDielectric.with_textures_of(material)
            self._key = role
        else:
            numbers = mi.traverse(material)
            arguments = {name: float(numbers[name][0]) for name in ("eta", "specular") if name in numbers}
            shared = dict(children(material))
            ids = {texture: texture.id() for texture in shared.values()}
            arguments |= shared | {role: {"type": "uniform", "value": 0.5}}
            self.bsdf = mi.load_dict({"type": _PRINCIPLED[material.class_name()], **arguments})
            for texture, identifier in ids.items():  # Mitsuba has named them after their keys in the dict
                texture.set_id(identifier)
            self._key = f"{role}.value"
        self._parameters = mi.traverse(self.bsdf)

    def move_to(self, value: float) -> None:
        """Set the parameter of the copy."""
        self._parameters[self._key] = dr.opaque(mi.Float, value)
        self._parameters.update()


def can_be_moved(material: Any, role: str) -> bool:
    """Whether a copy of a material can have another value of a property."""
    if material.class_name() == "SmoothDielectric":
        return role == "eta"
    return material.class_name() in _PRINCIPLED and role in dict(children(material))


def copy_materials(materials: Mapping[str, tuple[Any, str]]) -> dict[str, MovedParameter]:
    """Copy the ``movable_materials``, once for each point of a parameter's difference."""
    return {
        name: MovedParameter(material, tuple(MaterialCopy(material, role) for _ in range(POINTS)))
        for name, (material, role) in materials.items()
    }


def movable_materials(
    graph: SceneGraph, parameters: SceneParameters, names: Iterable[str]
) -> dict[str, tuple[Any, str]]:
    """Return material and role of the named parameters whose materials can be copied.

    A material inside another, such as a mask, cannot: the paths meet the outer one.
    """
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    found = {}
    for name in [name for name in names if name in nodes]:
        material, role = graph.role(nodes[name], name.rsplit(".", 1)[-1])
        if parameters[name].shape or not isinstance(material, mi.BSDF) or not can_be_moved(material, role):
            continue
        if all(shape.bsdf() == material for shape in graph.shapes_using(material)):
            found[name] = material, role
    return found


def batches(names: Iterable[str], parameters: Mapping[str, MovedParameter]) -> Iterator[list[str]]:
    """Divide parameters into groups of at most ``MAX_MATERIALS`` materials, each sorted by material."""
    by_material: dict[Any, list[str]] = {}
    for name in names:
        by_material.setdefault(parameters[name].material, []).append(name)
    groups = list(by_material.values())
    for start in range(0, len(groups), MAX_MATERIALS):
        yield [name for group in groups[start : start + MAX_MATERIALS] for name in group]


def move(
    parameters: Sequence[MovedParameter],
    values: Sequence[torch.Tensor],
    differences: Sequence[FiniteDifference],
) -> MovedMaterials:
    """Move the copies to the points of each parameter's difference; the parameters are one of the ``batches``.

    A difference of two points leaves the third copy at the value, with a weight of 0.
    """
    weights = np.zeros((len(parameters), POINTS), np.float32)
    for row, (parameter, value, difference) in enumerate(zip(parameters, values, differences, strict=True)):
        points = [(float(shift), float(weight)) for shift, weight in difference.points]
        for column, (shift, weight) in enumerate([*points, (0.0, 0.0)][:POINTS]):
            parameter.copies[column].move_to(float(value) + shift)
            weights[row, column] = weight
    counts = Counter(parameter.material for parameter in parameters)
    count, indices = np.array(list(counts.values())), [bsdf_index(material) for material in counts]
    copies = [bsdf_index(copy.bsdf) for parameter in parameters for copy in parameter.copies]
    return MovedMaterials(
        position=index_table(dict(zip(indices, range(len(indices)), strict=True)), MAX_MATERIALS),
        first=owned(mi.UInt32(count.cumsum() - count)),
        count=owned(mi.UInt32(count)),
        index=owned(mi.UInt32(indices)),
        copies=owned(mi.UInt32(copies)),
        weights=owned(mi.Float(weights.ravel())),
    )
