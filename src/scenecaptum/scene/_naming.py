"""Names for the objects of a scene that have none: readable, and the same in every process.

Mitsuba names an object without an id after its address in memory, which is another in every process.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count
from pathlib import PurePath
from typing import Any

from ..backend import activate
from ._graph import children, is_nameless

# What a scene holds goes by its id; what anything else holds, by what it is held as ("bsdf", "emitter"). A merge
# leaves to the scene what cannot be merged.
_COLLECTIONS = ("scene", "merge")

# What Mitsuba adds to a plugin's name to make that of its class.
_ADDED = r"^Smooth|(Camera|Sensor|Background|Emitter|Light|Integrator|Plugin|Mesh|BRDF|BSDF)+$"


def lamp_on(shape: str) -> str:
    """Return the id of a light on a shape that is named here."""
    return f"lamp on {shape}"


def name_nodes(nodes: Sequence[Any]) -> None:
    """Give ids to the parsed objects that ``mi.traverse`` would name after addresses; ids of the file stay.

    A shape goes by its file (``Mesh090``), else by its material and its kind (``Walls_rectangle``), anything else
    by its kind (``constant``); from the second of a name on they are numbered, in the order of the file.

    Parameters
    ----------
    nodes
        The nodes of a ``mi.parser.ParserState`` whose references are resolved.
    """
    kinds = activate().ObjectType
    unused = _numbering(node.props.id() for node in nodes)

    def held(node: Any, kind: Any = None) -> Iterator[Any]:
        return (one for one in _held(nodes, node) if kind is None or one.type == kind)

    for collection in (node for node in nodes if node.props.plugin_name() in _COLLECTIONS):
        for node in held(collection):
            props = node.props
            if not is_nameless(props.id()):
                continue
            name = props.plugin_name()
            if node.type == kinds.Shape:
                material = next((one.props.id() for one in held(node, kinds.BSDF)), "")
                name = _shape_name(str(props.get("filename", "")), material, name)
            props.set_id(unused(name))
            for light in held(node, kinds.Emitter):
                if is_nameless(light.props.id()):
                    light.props.set_id(lamp_on(props.id()))


def name_objects(scene: Any) -> None:
    """Give ids to those objects of a loaded scene that ``mi.traverse`` would name after addresses.

    As ``name_nodes`` does, from what is left to see. Meshes of one name are numbered by their place in space:
    those that Mitsuba has merged come in another order in every process.

    Parameters
    ----------
    scene
        An ``mi.Scene``.
    """
    mi = activate()
    objects = [one for _, one in children(scene)]
    unused = _numbering(one.id() for one in objects)
    for one in sorted((one for one in objects if is_nameless(one.id())), key=_place):
        is_shape = isinstance(one, mi.Shape)
        one.set_id(unused(_name_of_loaded(one) if is_shape else _kind(one)))
        light = one.emitter() if is_shape else None
        if light is not None and is_nameless(light.id()):
            light.set_id(lamp_on(one.id()))


def without_addresses(text: str) -> str:
    """Take the addresses out of a description: Mitsuba prints one where a plugin has nothing else to say.

    Example
    -------
    >>> without_addresses("DepthIntegrator[0x55ce56fd9260]")
    'DepthIntegrator[0x…]'
    """
    return re.sub(r"\b0x[0-9a-f]{6,}\b", "0x…", text)


def _held(nodes: Sequence[Any], node: Any) -> Iterator[Any]:
    """Return the nodes that a node refers to, in its order."""
    reference = activate().Properties.ResolvedReference
    values = (node.props[key] for key in node.props.keys())  # noqa: SIM118 -- not a dict
    return (nodes[value.index()] for value in values if isinstance(value, reference))


def _numbering(taken: Iterable[str]) -> Callable[[str], str]:
    """Return what makes names that are not taken yet: ``lamp``, ``lamp_2``, ``lamp_3``."""
    known = set(taken)

    def unused(name: str) -> str:
        numbered = (name if number == 1 else f"{name}_{number}" for number in count(1))
        known.add(found := next(one for one in numbered if one not in known))
        return found

    return unused


def _shape_name(file: str, material: str, kind: str) -> str:
    # A dot would read as the one before a property.
    words = PurePath(file).stem if file else material and f"{material}_{kind}"
    return re.sub(r"[^\w-]+", "_", words).strip("_") or kind


def _name_of_loaded(shape: Any) -> str:
    """Name a shape by the file or files that its description tells, else by its material and class."""
    found = re.search(r'name = "([^"]*)"', str(shape)) if shape.is_mesh() else None
    files = [part for part in (found[1].split(" + ") if found else ()) if PurePath(part).suffix]
    material = shape.bsdf().id() if shape.bsdf() is not None else ""
    name = _shape_name(files[0] if files else "", "" if material == "bsdf" else material, _kind(shape))
    return name if len(files) < 2 else f"{name}_and_{len(files) - 1}_more"


def _kind(one: Any) -> str:
    """Return the plugin that an object is made by, as far as its class tells: ``constant``, ``rectangle``."""
    name = str(one.class_name()).replace("EnvironmentMap", "Envmap")
    return re.sub(_ADDED, "", name).lower() or "mesh"


def _place(one: Any) -> tuple[float, ...]:
    if not (isinstance(one, activate().Shape) and one.is_mesh()):
        return ()
    box = one.bbox()
    return tuple(float(x) for corner in (box.min, box.max) for x in corner)
