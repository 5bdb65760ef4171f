"""The scene as a graph of objects: who holds whom, and which parameters each visible object shows."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from typing import Any

from ..backend import activate


class SceneGraph:
    """Edges between the objects of a scene.

    ``mi.traverse`` visits an object once, under its first holder. Materials are shared, nested and used from
    two sides, so painting a parameter onto every surface that shows it needs all the holders.
    """

    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self._children: dict[Any, list[tuple[str, Any]]] = {}
        self._holders: dict[Any, list[tuple[Any, str]]] = {}
        self._walk(scene)
        self._link_instances()

    def _walk(self, node: Any) -> None:
        held = self._children[node] = children(node)
        for name, child in held:
            self._holders.setdefault(child, []).append((node, name))
            if child not in self._children:
                self._walk(child)

    def _link_instances(self) -> None:
        """Hang each shape group below its instances, which name it in their description only."""
        groups = {node.id(): node for node in self._children if node.class_name().startswith("ShapeGroup")}
        for node in self._children:
            if node.class_name() != "Instance":
                continue
            named = re.search(r'shapegroup = ShapeGroup\[\s*name = "([^"]*)"', str(node))
            if named and named.group(1) in groups:
                self._children[node].append(("shapegroup", groups[named.group(1)]))

    def role(self, node: Any, attribute: str) -> tuple[Any, str]:
        """Return the material, light, medium, shape or sensor that uses a value, and what it uses it as.

        The value of a texture has the role that its holder gives the texture: ``reflectance``, say; and so has a
        mesh attribute that a texture looks up.
        """
        mi = activate()
        if mesh_places(node, attribute):
            looks_up = f'name = "{attribute}"'
            textures = [one for one in self._below(node) if one.class_name() == "MeshAttribute"]
            node = next((one for one in textures if looks_up in str(one)), node)
        while isinstance(node, (mi.Texture, mi.Volume)) and self._holders.get(node):
            node, attribute = self._holders[node][0]
        return node, attribute

    def uses(self, texture: Any) -> list[tuple[Any, str]]:
        """Return all that look a texture up, through other textures too, each with what it uses it as."""
        mi = activate()
        found, pending = [], [texture]
        while pending:
            for holder, held_as in self._holders.get(pending.pop(), []):
                if isinstance(holder, (mi.Texture, mi.Volume)):
                    pending.append(holder)
                else:
                    found.append((holder, held_as))
        return found

    def path(self, node: Any) -> list[tuple[str, Any]]:
        """Return the objects from below the scene down to one, each with what ``mi.traverse`` finds it held as."""
        found: list[tuple[str, Any]] = []
        while node is not self.scene:
            holder, held_as = self._holders[node][0]
            found.insert(0, (held_as, node))
            node = holder
        return found

    def owners(self, node: Any) -> tuple[str, ...]:
        """Names of the outermost materials, lights and media through which a value reaches the picture."""
        mi = activate()
        found: dict[str, None] = {}
        pending = [node]
        while pending:
            current = pending.pop()
            holders = self._holders.get(current, [])
            # A material is outermost where a shape wears it; a light or medium belongs to its shape.
            worn = [holder for holder, _ in holders if isinstance(holder, mi.Shape)]
            if isinstance(current, mi.BSDF) and (worn or not _held_by_material(holders)):
                found[_name(current, worn)] = None
            elif isinstance(current, (mi.Emitter, mi.Medium)):
                found[_name(worn[0], []) if worn else _name(current, [])] = None
            elif isinstance(current, (mi.Shape, mi.Sensor)):
                found[_name(current, [])] = None
            pending += [
                holder for holder, _ in holders if isinstance(holder, (mi.BSDF, mi.Texture, mi.Volume))
            ]
            if isinstance(current, (mi.Texture, mi.Volume, mi.PhaseFunction, mi.Film, mi.Sampler)):
                pending += [h for h, _ in holders if isinstance(h, (mi.Emitter, mi.Medium, mi.Sensor))]
        return tuple(found)

    def shapes(self) -> list[tuple[str, Any, set[Any]]]:
        """Every shape with its name and the set of objects that its appearance depends on directly."""
        shapes = list(self.scene.shapes())
        names = _unique([shape.id() or f"shape_{i}" for i, shape in enumerate(shapes)])
        return [(name, shape, set(self._below(shape))) for name, shape in zip(names, shapes, strict=True)]

    def wearers(self, node: Any) -> list[Any]:
        """Return every shape whose appearance depends directly on an object, those of shape groups too."""
        mi = activate()
        found, pending = {node: None}, [node]
        while pending:
            fresh = [holder for holder, _ in self._holders.get(pending.pop(), []) if holder not in found]
            found.update(dict.fromkeys(fresh))
            pending += [holder for holder in fresh if not isinstance(holder, mi.Shape)]
        return [one for one in found if isinstance(one, mi.Shape)]

    def background(self) -> set[Any]:
        """Return the objects that a ray which leaves the scene shows: the environment and what it holds."""
        environment = self.scene.environment()
        return set(self._below(environment)) if environment is not None else set()

    def emitters(self) -> list[tuple[Any, set[Any]]]:
        """Every emitter with the set of objects that its light depends on."""
        return [(emitter, set(self._below(emitter))) for emitter in self.scene.emitters()]

    def has(self, object_class: type) -> bool:
        """Whether any object of the scene is of that Mitsuba class."""
        return any(isinstance(node, object_class) for node in self._children)

    def class_names(self) -> set[str]:
        """Return the names of the Mitsuba classes of all objects of the scene."""
        return {node.class_name() for node in self._children}

    def _below(self, node: Any) -> Iterator[Any]:
        seen, pending = {node}, [node]
        while pending:
            current = pending.pop()
            yield current
            fresh = [child for _, child in self._children.get(current, []) if child not in seen]
            seen.update(fresh)
            pending += fresh


def mesh_places(node: Any, name: str) -> int | None:
    """Return at how many vertices or faces a mesh has an attribute; None where it is not one."""
    if name in _GEOMETRY or not isinstance(node, activate().Mesh):
        return None
    counts = {"vertex": node.vertex_count, "face": node.face_count}
    count = counts.get(name.partition("_")[0])
    return None if count is None else int(count())


_GEOMETRY = {"vertex_positions", "vertex_normals", "vertex_texcoords"}


def is_nameless(identifier: str) -> bool:
    """Whether an id is none: empty, or one that Mitsuba made up when it wrote the file."""
    return not identifier or identifier.startswith("_unnamed_")


def children(node: Any) -> list[tuple[str, Any]]:
    """Objects that a Mitsuba object reports when it is traversed, by the name it gives them."""
    found: list[tuple[str, Any]] = []
    node.traverse(_collector()(found))
    return found


@cache
def _collector() -> Any:
    """Make the callback class that collects child objects (its base exists only once a variant is chosen)."""
    mi = activate()

    base: Any = mi.TraversalCallback

    class Collector(base):
        def __init__(self, found: list[tuple[str, Any]]) -> None:
            base.__init__(self)
            self.found = found

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            pass

        def put_object(self, name: str, value: Any, flags: int) -> None:
            if value is not None:
                self.found.append((name, value))

    return Collector


def _held_by_material(holders: list[tuple[Any, str]]) -> bool:
    mi = activate()
    return any(isinstance(holder, mi.BSDF) for holder, _ in holders)


def _name(node: Any, wearers: list[Any]) -> str:
    """Return an object's id; a material written inside its only shape goes by the shape's name."""
    identifier = node.id()
    if wearers and (is_nameless(identifier) or identifier == "bsdf"):
        identifier = wearers[0].id()
    return str(identifier or node.class_name())


def _unique(names: list[str]) -> list[str]:
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name}_{seen[name] - 1}")
    return result
