"""Readable names for objects without an id, the same in every process.

Mitsuba names an object without an id after its memory address, which differs between processes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count
from pathlib import PurePath
from typing import Any

from ..backend import activate
from ._graph import children, is_unnamed

# mi.traverse names the children of these plugins by their id, and those of other plugins by their role ("bsdf",
# "emitter"). A "merge" passes on what cannot be merged to the scene.
_COLLECTIONS = ("scene", "merge")

# Parts of Mitsuba's class names that are not in the plugin names.
_CLASS_AFFIXES = r"^Smooth|(Camera|Sensor|Background|Emitter|Light|Integrator|Plugin|Mesh|BRDF|BSDF)+$"


def area_emitter_id(shape: str) -> str:
    """Return the id given to an unnamed emitter on a shape."""
    return f"lamp on {shape}"


def name_nodes(nodes: Sequence[Any]) -> None:
    """Assign ids to the parsed objects that ``mi.traverse`` would name after addresses; existing ids stay.

    A shape is named after its file (``Mesh090``), otherwise after its material and plugin (``Walls_rectangle``),
    any other object after its plugin (``constant``). Duplicates are numbered from 2 in the order of the file. The
    ``nodes`` are those of a ``mi.parser.ParserState`` with resolved references.
    """
    kinds = activate().ObjectType
    unique = _unique_names(node.props.id() for node in nodes)

    def referenced(node: Any, kind: Any = None) -> Iterator[Any]:
        return (child for child in _referenced(nodes, node) if kind is None or child.type == kind)

    for collection in (node for node in nodes if node.props.plugin_name() in _COLLECTIONS):
        for node in referenced(collection):
            props = node.props
            if not is_unnamed(props.id()):
                continue
            name = props.plugin_name()
            if node.type == kinds.Shape:
                material = next((child.props.id() for child in referenced(node, kinds.BSDF)), "")
                name = _shape_name(str(props.get("filename", "")), material, name)
            props.set_id(unique(name))
            for emitter in referenced(node, kinds.Emitter):
                if is_unnamed(emitter.props.id()):
                    emitter.props.set_id(area_emitter_id(props.id()))


def name_objects(scene: Any) -> None:
    """Assign ids to those objects of a loaded scene that ``mi.traverse`` would name after addresses.

    Like ``name_nodes``, as far as a loaded scene has the information. Meshes with the same name are numbered by
    their bounding box, because the order of meshes that Mitsuba has merged differs between processes.
    """
    mi = activate()
    objects = [child for _, child in children(scene)]
    unique = _unique_names(child.id() for child in objects)
    for unnamed in sorted((child for child in objects if is_unnamed(child.id())), key=_mesh_bounds):
        is_shape = isinstance(unnamed, mi.Shape)
        unnamed.set_id(unique(_loaded_shape_name(unnamed) if is_shape else plugin_name(unnamed)))
        emitter = unnamed.emitter() if is_shape else None
        if emitter is not None and is_unnamed(emitter.id()):
            emitter.set_id(area_emitter_id(unnamed.id()))


def texture_ids(nodes: Sequence[Any]) -> list[str]:
    """Return the ids of the textures and volumes that the scene itself lists, in its order."""
    kinds = activate().ObjectType
    scene = next((node for node in nodes if node.props.plugin_name() == "scene"), None)
    listed = [] if scene is None else _referenced(nodes, scene)
    return [node.props.id() for node in listed if node.type in (kinds.Texture, kinds.Volume)]


def restore_texture_ids(scene: Any, ids: Sequence[str]) -> None:
    """Give the textures that a loaded scene lists the ids of its file, which Mitsuba's bitmaps have lost."""
    mi = activate()
    textures = [child for _, child in children(scene) if isinstance(child, (mi.Texture, mi.Volume))]
    if len(textures) == len(ids):
        for texture, identifier in zip(textures, ids, strict=True):
            texture.set_id(identifier)


def without_addresses(text: str) -> str:
    """Remove memory addresses from a description; Mitsuba prints them for plugins without their own description.

    Example
    -------
    >>> without_addresses("DepthIntegrator[0x55ce56fd9260]")
    'DepthIntegrator[0x…]'
    """
    return re.sub(r"\b0x[0-9a-f]{6,}\b", "0x…", text)


def _referenced(nodes: Sequence[Any], node: Any) -> Iterator[Any]:
    """Yield the nodes that a node references, in its order."""
    reference = activate().Properties.ResolvedReference
    values = (node.props[key] for key in node.props.keys())  # noqa: SIM118 -- not a dict
    return (nodes[value.index()] for value in values if isinstance(value, reference))


def _unique_names(taken: Iterable[str]) -> Callable[[str], str]:
    """Return a function that makes names unique by a number: ``lamp``, ``lamp_2``, ``lamp_3``."""
    used = set(taken)

    def unique(name: str) -> str:
        candidates = (name if number == 1 else f"{name}_{number}" for number in count(1))
        used.add(found := next(candidate for candidate in candidates if candidate not in used))
        return found

    return unique


def _shape_name(file: str, material: str, plugin: str) -> str:
    # A dot separates an object from its property.
    name = PurePath(file).stem if file else material and f"{material}_{plugin}"
    return re.sub(r"[^\w-]+", "_", name).strip("_") or plugin


def _loaded_shape_name(shape: Any) -> str:
    """Return a name from the file names in a shape's description, otherwise from its material and class."""
    found = re.search(r'name = "([^"]*)"', str(shape)) if shape.is_mesh() else None
    files = [part for part in (found[1].split(" + ") if found else ()) if PurePath(part).suffix]
    material = shape.bsdf().id() if shape.bsdf() is not None else ""
    name = _shape_name(files[0] if files else "", "" if material == "bsdf" else material, plugin_name(shape))
    return name if len(files) < 2 else f"{name}_and_{len(files) - 1}_more"


def plugin_name(scene_object: Any) -> str:
    """Guess the plugin name of an object from its class name: ``constant``, ``rectangle``."""
    # The class of a bitmap is BitmapTextureImpl[float32].
    name = re.sub(r"(Texture)?Impl(\[.*\])?$", "", scene_object.class_name())
    name = name.replace("EnvironmentMap", "Envmap")
    return re.sub(_CLASS_AFFIXES, "", name).lower() or "mesh"


def _mesh_bounds(scene_object: Any) -> tuple[float, ...]:
    """Return the bounding box of a mesh, and an empty tuple for other objects."""
    if not (isinstance(scene_object, activate().Shape) and scene_object.is_mesh()):
        return ()
    box = scene_object.bbox()
    return tuple(float(x) for corner in (box.min, box.max) for x in corner)
