"""The objects of a scene as a graph: the children and all parents of each object."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

from ..backend import activate


class SceneGraph:
    """Parent and child edges between the objects of a scene.

    ``mi.traverse`` visits an object once, under its first parent. Materials can be shared, nested and two-sided,
    so all parents are needed to find every surface that uses a parameter. The scene is not among them: it only
    lists what has an id of its own.
    """

    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self._children: dict[Any, list[tuple[str, Any]]] = {}
        self._parents: dict[Any, list[tuple[Any, str]]] = {}
        self._visited_under: dict[Any, tuple[Any, str]] = {}
        self._traverse(scene)
        self._link_instances()

    def _traverse(self, node: Any) -> None:
        self._children[node] = children(node)
        for name, child in self._children[node]:
            self._visited_under.setdefault(child, (node, name))
            if node is not self.scene:
                self._parents.setdefault(child, []).append((node, name))
            if child not in self._children:
                self._traverse(child)

    def _link_instances(self) -> None:
        """Add each shape group as a child of its instances, which mention it only in their description."""
        groups = {node.id(): node for node in self._children if node.class_name().startswith("ShapeGroup")}
        for node in self._children:
            if node.class_name() != "Instance":
                continue
            named = re.search(r'shapegroup = ShapeGroup\[\s*name = "([^"]*)"', str(node))
            if named and named.group(1) in groups:
                self._children[node].append(("shapegroup", groups[named.group(1)]))

    def role(self, node: Any, attribute: str) -> tuple[Any, str]:
        """Return the material, emitter, medium, shape or sensor that uses a value, and for which property.

        The value of a texture, or a mesh attribute that a texture reads, has the role of the texture in its
        parent: ``reflectance``, for example.
        """
        mi = activate()
        if mesh_attribute_size(node, attribute):
            description = f'name = "{attribute}"'
            textures = [child for child in self._descendants(node) if child.class_name() == "MeshAttribute"]
            node = next((texture for texture in textures if description in str(texture)), node)
        while isinstance(node, (mi.Texture, mi.Volume)) and self._parents.get(node):
            node, attribute = self._parents[node][0]
        return node, attribute

    def uses(self, texture: Any) -> list[tuple[Any, str]]:
        """Return the objects that use a texture, directly or through other textures, and for which property."""
        mi = activate()
        found, pending = [], [texture]
        while pending:
            for parent, name in self._parents.get(pending.pop(), []):
                if isinstance(parent, (mi.Texture, mi.Volume)):
                    pending.append(parent)
                else:
                    found.append((parent, name))
        return found

    def path(self, node: Any) -> list[tuple[str, Any]]:
        """Return the objects from the scene (excluded) to ``node``, each with its name in ``mi.traverse``."""
        found: list[tuple[str, Any]] = []
        while node is not self.scene:
            parent, name = self._visited_under[node]
            found.insert(0, (name, node))
            node = parent
        return found

    def owners(self, node: Any) -> tuple[str, ...]:
        """Return the names of the outermost materials, emitters and media that use a value."""
        mi = activate()
        found: dict[str, None] = {}
        pending = [node]
        while pending:
            current = pending.pop()
            parents = [parent for parent, _ in self._parents.get(current, [])]
            # A material is outermost if a shape uses it; an emitter or medium belongs to its shape.
            shapes = [parent for parent in parents if isinstance(parent, mi.Shape)]
            if isinstance(current, mi.BSDF):
                if shapes or not any(isinstance(parent, mi.BSDF) for parent in parents):
                    found[_name(current, shapes)] = None
            elif isinstance(current, (mi.Emitter, mi.Medium)):
                found[_name(shapes[0] if shapes else current)] = None
            elif isinstance(current, (mi.Shape, mi.Sensor)):
                found[_name(current)] = None
            pending += [parent for parent in parents if isinstance(parent, (mi.BSDF, mi.Texture, mi.Volume))]
            if isinstance(current, (mi.Texture, mi.Volume, mi.PhaseFunction, mi.Film, mi.Sampler)):
                pending += [p for p in parents if isinstance(p, (mi.Emitter, mi.Medium, mi.Sensor))]
        return tuple(found)

    def shapes(self) -> list[tuple[str, Any, set[Any]]]:
        """Return every shape with its name and the set of objects that its appearance directly depends on."""
        shapes = list(self.scene.shapes())
        names = _unique([shape.id() or f"shape_{i}" for i, shape in enumerate(shapes)])
        return [
            (name, shape, set(self._descendants(shape))) for name, shape in zip(names, shapes, strict=True)
        ]

    def shapes_using(self, node: Any) -> list[Any]:
        """Return every shape, in shape groups too, whose appearance directly depends on an object."""
        shape = activate().Shape

        def users(node: Any) -> Iterator[Any]:
            return (parent for parent, _ in self._parents.get(node, []) if not isinstance(node, shape))

        return [user for user in _reachable(node, users) if isinstance(user, shape)]

    def background(self) -> set[Any]:
        """Return the environment emitter and its descendants; empty without an environment."""
        environment = self.scene.environment()
        return set(self._descendants(environment)) if environment is not None else set()

    def emitters(self) -> list[tuple[Any, set[Any]]]:
        """Return every emitter with the set of objects that its radiance depends on."""
        return [(emitter, set(self._descendants(emitter))) for emitter in self.scene.emitters()]

    def has(self, object_class: type) -> bool:
        """Whether any object of the scene is an instance of a Mitsuba class."""
        return any(isinstance(node, object_class) for node in self._children)

    def class_names(self) -> set[str]:
        """Return the names of the Mitsuba classes of all objects of the scene."""
        return {node.class_name() for node in self._children}

    def _descendants(self, node: Any) -> Iterator[Any]:
        """Yield ``node`` and everything below it, each object once."""
        return _reachable(node, lambda parent: (child for _, child in self._children.get(parent, [])))


def _reachable(start: Any, neighbours: Callable[[Any], Iterator[Any]]) -> Iterator[Any]:
    """Yield an object and all that its neighbours lead to, each once."""
    seen, pending = {start}, [start]
    while pending:
        current = pending.pop()
        yield current
        new = [node for node in neighbours(current) if node not in seen]
        seen.update(new)
        pending += new


def mesh_attribute_size(node: Any, name: str) -> int | None:
    """Return the number of vertices or faces of a mesh that a mesh attribute covers; None for other values."""
    if name in _GEOMETRY or not isinstance(node, activate().Mesh):
        return None
    counts = {"vertex": node.vertex_count, "face": node.face_count}
    count = counts.get(name.partition("_")[0])
    return None if count is None else int(count())


_GEOMETRY = {"vertex_positions", "vertex_normals", "vertex_texcoords"}


def is_unnamed(identifier: str) -> bool:
    """Whether an id is empty, or was generated by Mitsuba when it wrote the file."""
    return not identifier or identifier.startswith("_unnamed_")


def children(node: Any) -> list[tuple[str, Any]]:
    """Return the child objects that a Mitsuba object reports when it is traversed, with their names."""
    found: list[tuple[str, Any]] = []
    node.traverse(_collector()(found))
    return found


@cache
def _collector() -> Any:
    """Return the callback class that collects child objects; its base class exists only once a variant is set."""
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


def _name(node: Any, shapes: Sequence[Any] = ()) -> str:
    """Return an object's id; a material defined inside its shape is named after the shape."""
    identifier = node.id()
    if shapes and (is_unnamed(identifier) or identifier == "bsdf"):
        identifier = shapes[0].id()
    return str(identifier or node.class_name())


def _unique(names: list[str]) -> list[str]:
    seen: Counter[str] = Counter()
    result = []
    for name in names:
        result.append(f"{name}_{seen[name]}" if seen[name] else name)
        seen[name] += 1
    return result
