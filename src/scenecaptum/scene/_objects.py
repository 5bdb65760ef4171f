"""What can be moved in a scene: objects of one or more shapes, lights, and the camera."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..backend import activate
from ..errors import SceneCaptumError, near_misses
from ._graph import SceneGraph
from ._naming import plugin_name

Objects: TypeAlias = "Mapping[str, str | Sequence[str]]"

# What exporters begin the names of all shapes, or of all materials, with.
_EXPORTED = re.compile(r"(mat|mesh|elm|shape)[_\-. ]+(?=[^\W\d_])")
_ALL = ("translation", "rotation", "scale")
_NO_SIZE, _FAR = "it has no size", "its light comes from infinitely far away"
# By class name, what of a light's pose does not change its light, and why.
_LIGHTS = {
    "PointLight": {"rotation": "its light is the same in all directions", "scale": _NO_SIZE},
    "SpotLight": {"scale": _NO_SIZE},
    "Projector": {"scale": _NO_SIZE},
    "IesLamp": {"scale": _NO_SIZE},
    "DirectionalEmitter": {"translation": _FAR, "scale": _FAR},
    "EnvironmentMapEmitter": {"translation": _FAR, "scale": _FAR},
}

_POINT_LAMPS = ("PointLight", "SpotLight", "IesLamp")


@dataclass(frozen=True)
class SceneObject:
    """Something that moves as a whole.

    Attributes
    ----------
    name
        The first part of the names of its poses: ``"desk"`` of ``"desk.pose.translation"``.
    shapes
        The names of its shapes; none for a light without geometry.
    keys
        The ``mi.traverse`` names of their positions.
    components
        What of its pose changes the picture.
    box
        Its bounds, ``(2, 3)``; None where it has none.
    pivot
        The point about which it turns and grows: the centre of its bounds, or the place of a light.
    problem
        Why it cannot be moved, or None.
    fixed
        What of its pose does not change the picture, each with the reason.
    part_of
        The names of the objects that it is a part of, and moves with, the smallest first.
    """

    name: str
    shapes: tuple[str, ...]
    keys: tuple[str, ...]
    components: tuple[str, ...]
    box: npt.NDArray[np.float64] | None
    pivot: tuple[float, float, float]
    problem: str | None = None
    fixed: Mapping[str, str] = field(default_factory=dict)
    part_of: tuple[str, ...] = ()

    def is_related(self, other: SceneObject) -> bool:
        """Whether one is a part of the other."""
        return self.name in other.part_of or other.name in self.part_of


def find_objects(graph: SceneGraph, objects: Objects | None = None) -> list[SceneObject]:
    """Return what can be moved in a scene, in the order of its shapes, then its lights without geometry.

    ``objects`` are names or globs of shapes by the name of an object; one may be a part of another, such as
    the head of a lamp on a desk. Other shapes are grouped by their names, see ``stems``.

    Raises
    ------
    SceneCaptumError
        If a name in ``objects`` matches no shape, or two objects share some of their shapes only.
    """
    shapes = {name: node for name, node, _ in graph.shapes()}
    keys = _position_keys(graph)
    groups = _group(list(shapes), objects or {})
    found = [
        _shape_object(graph, name, {part: shapes[part] for part in parts}, keys, _wholes(name, groups))
        for name, parts in groups.items()
    ]
    taken = {one.name for one in found}
    mi = activate()
    lights = [one for one in graph.scene.emitters() if not mi.has_flag(one.flags(), mi.EmitterFlags.Surface)]
    return found + [_light(graph, node, keys, taken) for node in lights]


def has_point_lamps(scene: Any) -> bool:
    """Whether a scene has lamps without an area: no camera sees them."""
    return any(one.class_name() in _POINT_LAMPS for one in scene.emitters())


def camera_object(sensor: Any) -> SceneObject:
    """Return a sensor as an object, named ``"camera"``."""
    params = activate().traverse(sensor)
    keys = tuple(key for key in ("to_world", "x_fov") if key in params.properties)
    place = np.array(params["to_world"].matrix).reshape(4, 4)[:3, 3] if "to_world" in keys else np.zeros(3)
    return SceneObject(
        name="camera",
        shapes=(),
        keys=keys,
        components=("translation", "rotation", *(["fov"] if "x_fov" in keys else [])),
        box=None,
        pivot=(float(place[0]), float(place[1]), float(place[2])),
        problem=None
        if "to_world" in keys
        else f"a sensor of type {plugin_name(sensor)} has no pose of its own; place the camera in the scene file",
    )


def touching(objects: Iterable[SceneObject], mover: SceneObject, reach: float) -> list[str]:
    """Return the objects whose bounds come within a distance of those of another, the smallest first.

    Its own parts are left out.
    """
    if mover.box is None:
        return []
    low, high = mover.box[0] - reach, mover.box[1] + reach
    near = [
        one
        for one in objects
        if one.box is not None
        and one.name != mover.name
        and mover.name not in one.part_of
        and (one.box[0] <= high).all()
        and (one.box[1] >= low).all()
    ]
    return [one.name for one in sorted(near, key=_volume)]


def _volume(one: SceneObject) -> float:
    return 0.0 if one.box is None else float(np.prod(one.box[1] - one.box[0]))


def stems(names: Iterable[str]) -> dict[str, str]:
    """Return the object of each shape, from the names of all shapes.

    This is the first word of the name: ``chair_seat`` and ``chair_leg_2`` belong to ``chair``, ``mesh-chair_seat``
    to ``mesh-chair``. Shapes with the same first word are divided further where that works for all of them: into
    ``chair_1`` and ``chair_2``, or ``chair`` and ``chair_2``, if all have a number or nothing next, and into
    ``lamp_left`` and ``lamp_right`` if the name of each begins with that of one of them.
    """
    by_word: dict[str, list[str]] = {}
    for name in names:
        by_word.setdefault(_words(name)[0], []).append(name)
    return {name: stem for group in by_word.values() for name, stem in _divide(group).items()}


def _divide(names: Sequence[str]) -> dict[str, str]:
    """Return the object of shapes whose names have the same first word."""
    words = {name: _words(name) for name in names}
    first = {parts for parts in words.values() if any(_begins(other, parts) for other in words.values())}
    owners = {
        name: next((one for one in first if parts == one or _begins(parts, one)), None)
        for name, parts in words.items()
    }
    counts = dict.fromkeys(names, 1)
    if all(len(parts) == 1 or parts[1].isdigit() for parts in words.values()):
        counts = {name: min(2, len(parts)) for name, parts in words.items()}
    elif None not in owners.values():
        counts = {name: len(owner) for name, owner in owners.items() if owner is not None}
    spelled: dict[tuple[str, ...], str] = {}
    for name, parts in words.items():
        spelled.setdefault(parts[: counts[name]], _spelling(name, counts[name]))
    return {name: spelled[parts[: counts[name]]] for name, parts in words.items()}


def _begins(words: tuple[str, ...], beginning: tuple[str, ...]) -> bool:
    """Whether the words begin with others, and go on."""
    return len(words) > len(beginning) and words[: len(beginning)] == beginning


def _words(name: str) -> tuple[str, ...]:
    return tuple(_parts(name)[::2])


def _spelling(name: str, count: int) -> str:
    """Return the first words of a name with the separators between them."""
    return "".join(_parts(name)[: 2 * count - 1])


def _parts(name: str) -> list[str]:
    """Return the words of a name and the separators between; the prefix of an exporter is part of the first."""
    name = name.strip("_-. ")
    exported = _EXPORTED.match(name)
    begin = exported.end() if exported else 0
    first, *others = re.split(r"([_\-. ]+)", name[begin:])
    return [name[:begin] + first, *others]


def _group(names: Sequence[str], objects: Objects) -> dict[str, list[str]]:
    """Return the shapes of each object."""
    given = {title: _matched(title, patterns, names) for title, patterns in objects.items()}
    _check_nesting(given)
    taken = {name for parts in given.values() for name in parts}
    rest = stems(name for name in names if name not in taken)
    grouped: dict[str, list[str]] = {}
    for name, stem in rest.items():
        # A shape that was left out of an object of its own name stands for itself.
        grouped.setdefault(stem if stem not in objects else name, []).append(name)
    # A shape alone keeps its own name, unless that was given.
    alone = {stem if len(parts) > 1 else parts[0]: parts for stem, parts in grouped.items()}
    order = {name: place for place, name in enumerate(names)}
    return dict(sorted({**given, **alone}.items(), key=lambda item: (order[item[1][0]], len(item[1]))))


def _matched(title: str, patterns: str | Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the shapes of an object of the user's, in the order of the scene."""
    found: set[str] = set()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matched = [name for name in names if fnmatchcase(name, pattern)]
        if not matched:
            raise SceneCaptumError(
                f"objects[{title!r}] names {pattern!r}, which no shape matches.{near_misses(pattern, names)} "
                f"The shapes are {', '.join(names[:8])}{', …' if len(names) > 8 else ''}."
            )
        found.update(matched)
    return [name for name in names if name in found]


def _check_nesting(given: Mapping[str, Sequence[str]]) -> None:
    """Raise if two objects share shapes, and neither is a part of the other."""
    for (one, left), (other, right) in combinations(given.items(), 2):
        shared = set(left) & set(right)
        if shared and len(shared) in (len(left), len(right)) and len(left) != len(right):
            continue
        if shared:
            raise SceneCaptumError(
                f"The shape {min(shared, key=left.index)!r} belongs to the objects {one!r} and {other!r}: leave "
                "it out of one of them, or give one of them all shapes of the other and more."
            )


def _wholes(name: str, groups: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return the objects that an object is a part of, the smallest first."""
    parts = set(groups[name])
    return tuple(sorted((o for o in groups if parts < set(groups[o])), key=lambda other: len(groups[other])))


def _position_keys(graph: SceneGraph) -> dict[Any, tuple[str, ...]]:
    """Return for each Mitsuba object the names of its positions."""
    mi = activate()
    found: dict[Any, list[str]] = {}
    params = mi.traverse(graph.scene)
    for name, (_, _, node, _) in params.properties.items():
        kind = name.rpartition(".")[2]
        # A mesh with the normals of its faces has an empty buffer of vertex normals.
        if kind in POSITIONS and (kind != "vertex_normals" or len(params[name])):
            found.setdefault(node, []).append(name)
    return {node: tuple(names) for node, names in found.items()}


# The properties that hold where something is.
POSITIONS = ("to_world", "position", "vertex_positions", "vertex_normals")


def _shape_object(
    graph: SceneGraph,
    name: str,
    shapes: Mapping[str, Any],
    keys: Mapping[Any, tuple[str, ...]],
    part_of: tuple[str, ...],
) -> SceneObject:
    problems = [text for node in shapes.values() if (text := _problem(graph, node, keys))]
    boxes = [box for node in shapes.values() if (box := _box(node)) is not None]
    box = np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)]) if boxes else None
    centre = np.zeros(3) if box is None else box.mean(0)
    return SceneObject(
        name=name,
        shapes=tuple(shapes),
        keys=tuple(key for node in shapes.values() for key in keys.get(node, ())),
        components=_ALL,
        box=box,
        pivot=(float(centre[0]), float(centre[1]), float(centre[2])),
        problem=problems[0] if problems else None,
        part_of=part_of,
    )


def _problem(graph: SceneGraph, node: Any, keys: Mapping[Any, tuple[str, ...]]) -> str | None:
    """Return why a shape cannot be moved, or None."""
    held = [key.rpartition(".")[2] for key in keys.get(node, ())]
    if not {"to_world", "vertex_positions"} & set(held):
        return f"Mitsuba's {node.class_name()} has no position that can be changed"
    medium = node.interior_medium()
    if medium is not None and not medium.is_homogeneous():
        return "its medium varies in space and would not move with it"
    return None


def _box(node: Any) -> npt.NDArray[np.float64] | None:
    bounds = node.bbox()
    box = np.array([list(bounds.min), list(bounds.max)], dtype=np.float64)
    return box if np.isfinite(box).all() and (box[0] <= box[1]).all() else None


def _light(graph: SceneGraph, node: Any, keys: Mapping[Any, tuple[str, ...]], taken: set[str]) -> SceneObject:
    identifier = str(node.id()) or ".".join(name for name, _ in graph.path(node))
    name = f"{identifier}_light" if identifier in taken else identifier
    fixed = _LIGHTS.get(node.class_name(), {})
    return SceneObject(
        name=name,
        shapes=(),
        keys=keys.get(node, ()),
        components=tuple(component for component in _ALL if component not in fixed),
        box=None,
        pivot=_place(node, keys.get(node, ())),
        problem=problem_of_light(node),
        fixed=fixed,
    )


def problem_of_light(node: Any) -> str | None:
    """Return why a light without geometry cannot be moved at all, or None."""
    kind = node.class_name()
    if kind == "ConstantBackgroundEmitter":
        return "its light is the same from all directions"
    if kind in _LIGHTS:
        return None
    return f"Mitsuba's {kind} is placed in the scene file or dict alone: change that, and load it again"


def _place(node: Any, keys: Sequence[str]) -> tuple[float, float, float]:
    """Return where a light is; 0 for one without a place."""
    mi = activate()
    params: Any = mi.traverse(node)
    names = {key.rpartition(".")[2] for key in keys}
    if "position" in names:
        position = params["position"]
        return float(position.x[0]), float(position.y[0]), float(position.z[0])
    if "to_world" in names:
        matrix = params["to_world"].matrix
        return float(matrix[0, 3][0]), float(matrix[1, 3][0]), float(matrix[2, 3][0])
    return 0.0, 0.0, 0.0
