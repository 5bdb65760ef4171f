"""What a name means that no parameter has: the pose of a part, or a material that has another name."""

from __future__ import annotations

from collections.abc import Mapping
from glob import escape
from typing import Any

from ..errors import near_misses

# The entries are ``Parameter``s, whose table imports this module.
Parameters = Mapping[str, Any]


def hint(parameters: Parameters, item: str) -> str:
    """Return in a sentence what a name means that no parameter has; empty if that is not known."""
    return (
        _part_hint(parameters, item)
        or _material_hint(parameters, item.partition(".")[0])
        or _shape_hint(parameters, item)
    )


def _part_hint(parameters: Parameters, item: str) -> str:
    """Say that the pose of a shape is that of the object that it is a part of, if it is one."""
    shape, separator, component = item.rpartition(".pose.")
    of = [p for p in parameters.values() if p.moves and shape in p.shapes and p.role == component]
    if not separator or not of:
        return ""
    smallest = min(of, key=lambda p: len(p.shapes))
    return (
        f" {shape!r} is part of the object {smallest.owners[0]!r}: select {smallest.name!r}, or list it in "
        "objects=, on the command line --object, to move it alone."
    )


def _material_hint(parameters: Parameters, owner: str) -> str:
    """Say how the parameters of a material begin whose id is in no name: that of a shape does."""
    wanted = owner.rstrip("*")
    names = [
        p.name for p in parameters.values() if wanted in p.owners and not p.name.startswith(f"{wanted}.")
    ]
    if not names:
        return ""
    first = names[0].rpartition(".")[0]
    while first and not all(name.startswith(f"{first}.") for name in names):
        first = first.rpartition(".")[0]
    return f" The parameters of {wanted!r} are '{escape(first)}.*'." if first else ""


def _shape_hint(parameters: Parameters, item: str) -> str:
    """Say what the material of a shape is called, where it has a name of its own, as shared ones have."""
    shape, _, rest = item.partition(".")
    found = [p.name for p in parameters.values() if p.is_of_surface and shape in p.shapes and not p.problem]
    materials = dict.fromkeys(name.partition(".")[0] for name in found)
    if not materials or shape in materials or not rest or "pose" in rest:
        return ""
    own = {part for name in parameters if name.startswith(f"{shape}.") for part in name.split(".")[1:-1]}
    if own.intersection(rest.split(".")):
        return ""  # a parameter of the shape itself, such as the radiance of its light
    listed = ", ".join(f"'{escape(material)}.*'" for material in materials)
    meant = f"{next(iter(materials))}.{rest.removeprefix('bsdf.')}"
    return f" The material of {shape!r} is {listed}.{near_misses(meant, found)}"
