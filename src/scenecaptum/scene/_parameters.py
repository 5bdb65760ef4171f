"""The parameters of a scene: kind, shape, physical bounds, owners, and whether they can be differentiated."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from ..backend import activate, exclusively
from ._bounds import Bounds
from ._checks import find_fault
from ._graph import SceneGraph, mesh_attribute_size
from ._loading import SceneLike, XmlParameters, load_scene
from ._naming import area_emitter_id
from ._objects import SceneObject, camera_object, find_objects, problem_of_light
from ._parameter_table import IN_BYTES, SURFACE_KINDS, Parameter, SceneParameters
from ._poses import camera_parameters, pose_parameters
from ._roles import (
    BENDING,
    CAMERA_INPUTS,
    EMITTER_BOUNDS,
    EMITTER_POSES,
    EMITTER_RANGES,
    MATERIAL_ROLES,
    MEDIUM_BOUNDS,
    NON_NEGATIVE,
    MaterialRole,
)

MAX_DIFFERENCES = 3  # numbers of a parameter that finite differences are made of

# Parts of a parameter's name that its label leaves out.
_OMITTED_SEGMENTS = {"bsdf", "brdf_0", "nested_bsdf", "emitter", "value", "data"}
# The words of labels in place of Mitsuba's.
_LABEL_WORDS = {
    "alpha": "roughness",
    "alpha_u": "roughness u",
    "alpha_v": "roughness v",
    "interior_medium": "medium",
}
# Those of a bump map, whose scale is not that of its object.
_BUMP_WORDS = {"scale": "bump scale", "nested_texture": "bump"}


def discover(graph: SceneGraph, objects: Iterable[SceneObject] = ()) -> SceneParameters:
    """Return every parameter that ``mi.traverse`` finds in a scene, as ``SceneRenderer.parameters_table`` does.

    ``objects`` are those of the scene in ``graph``, by whose names lights are moved: they may have others than
    in Mitsuba.

    Example
    -------
    >>> from scenecaptum.scene import load_scene
    >>> discover(SceneGraph(load_scene("office")))["desk.base_color.value"].kind
    'reflectance'
    """
    mi = activate()
    # Only read here; mi.traverse defines the names.
    properties = mi.traverse(graph.scene).properties
    labels = _unique_labels({name: _label(graph, name, node) for name, (_, _, node, _) in properties.items()})
    lights = {key.rpartition(".")[0]: one.name for one in objects if not one.shapes for key in one.keys}
    return SceneParameters(
        _describe(graph, name, labels[name], node, _value(pointer, cpptype, node), flags, lights)
        for name, (pointer, cpptype, node, flags) in properties.items()
    )


def discover_in(scene: SceneLike, parameters: XmlParameters | None = None) -> SceneParameters:
    """Return every parameter of a scene that is not loaded yet, and the poses of its objects and its first camera.

    ``scene`` and ``parameters`` are those of a renderer.
    """
    with exclusively():
        graph = SceneGraph(load_scene(scene, parameters))
        objects = find_objects(graph)
        camera = [
            found
            for sensor in graph.scene.sensors()[:1]
            for found in camera_parameters(camera_object(sensor))
        ]
        return SceneParameters([*discover(graph, objects).values(), *pose_parameters(objects), *camera])


def _value(pointer: Any, cpptype: Any, node: Any) -> Any:
    mi = activate()
    return pointer if cpptype is None else mi.get_property(pointer, cpptype, node)


def _describe(
    graph: SceneGraph, name: str, label: str, node: Any, value: Any, flags: int, lights: Mapping[str, str]
) -> Parameter:
    mi = activate()
    owner, _, own_name = name.rpartition(".")
    user, role = graph.role(node, own_name)
    kind, bounds, effect_range = _kind_bounds_and_range(user, role)
    # The bounds are those of the values of the texture or light, not of where it is.
    if _is_transform(value) or role in EMITTER_POSES:
        bounds = effect_range = Bounds()
    shape = stored_shape = _shape(value, mesh_attribute_size(node, own_name))
    if _is_scalar(graph, node, shape):
        shape = (*shape[:-1], 1) if len(shape) > 1 else ()
    tracked = (
        _is_array(value)
        and not flags & _untracked_flags()
        and not _has_untracked_tables(user, role)
        # Differences are right whatever the plugin's sampling depends on, but only cheap for a few numbers.
        and not (_is_foreign_and_specular(user) and math.prod(shape) <= MAX_DIFFERENCES)
    )
    shapes = graph.shapes_using(node) if isinstance(user, mi.BSDF) else []
    problem = _problem(lights.get(owner, owner), kind, role, user, shape, value, tracked)
    fault = None if problem else find_fault(_as_in_file(user, _to_tensor(value, stored_shape)), kind, bounds)
    return Parameter(
        name=name,
        label=label,
        kind=kind,
        plugin=user.class_name(),
        role=role,
        shape=shape,
        bounds=bounds,
        range=effect_range,
        owners=graph.owners(node),
        tracked=tracked,
        mixes_specular=_mixes_specular(user, role),
        unknown_sampling=_is_foreign_and_specular(user),
        is_used=bool(shapes) or not isinstance(user, (mi.BSDF, mi.Texture, mi.Volume)),
        lobe_weight=kind in SURFACE_KINDS and _material_role(role).is_lobe_weight,
        shapes=tuple(shape.id() for shape in shapes),
        fault=fault,
        problem=problem or fault,
        caution=None if problem else _caution(graph, role, user, shape, value),
    )


def _kind_bounds_and_range(user: Any, role: str) -> tuple[str, Bounds, Bounds]:
    mi = activate()
    # A perfect mirror without a named metal has eta = 0, k = 1.
    is_metal = role == "eta" and "Conductor" in user.class_name()
    if isinstance(user, mi.BSDF) and not is_metal:
        own = _material_role(role)
        return own.kind, own.bounds, own.range or own.bounds
    kind, bounds = ("ior", NON_NEGATIVE) if is_metal else _kind_and_bounds(user, role)
    return kind, bounds, EMITTER_RANGES.get(role, bounds) if kind == "emitters" else bounds


def _kind_and_bounds(user: Any, role: str) -> tuple[str, Bounds]:
    """Return the kind and the bounds of a parameter that does not belong to a material."""
    mi = activate()
    if isinstance(user, mi.Emitter):
        return "emitters", EMITTER_BOUNDS.get(role, NON_NEGATIVE)
    if isinstance(user, (mi.Medium, mi.PhaseFunction)):
        return "media", MEDIUM_BOUNDS.get(role, NON_NEGATIVE)
    if isinstance(user, mi.Shape):
        # A mesh attribute that no material reads.
        return ("surface", Bounds()) if mesh_attribute_size(user, role) else ("geometry", Bounds())
    return "camera" if isinstance(user, (mi.Sensor, mi.Film, mi.Sampler)) else "scene", Bounds()


def _material_role(role: str) -> MaterialRole:
    return MATERIAL_ROLES.get(role, MaterialRole())


def _problem(
    owner: str, kind: str, role: str, user: Any, shape: tuple[int, ...], value: Any, tracked: bool
) -> str | None:
    """Return the reason why the parameter cannot be differentiated, or None."""
    type_name = type(value).__name__
    article = "an" if type_name[0] in "AEIOaeio" else "a"  # a UInt
    if role.endswith(("sampling_weight", "_sampling_rate")):
        return "it changes how samples are drawn, not what is rendered"
    if kind == "geometry" and ("position" in role or "to_world" in role):
        return "it changes visibility; move its object instead, such as by NAME.pose.translation"
    if kind == "geometry":
        return "it belongs to the geometry, whose entries are not differentiated"
    if kind == "camera":
        return CAMERA_INPUTS.get(role, "it is a setting of the camera, not a continuous part of the scene")
    if type_name == "TensorXu8":
        return IN_BYTES
    if kind == "emitters" and (role in EMITTER_POSES or role == "to_world"):
        instead = problem_of_light(user) or f"select {owner}.pose.* instead"
        return f"it positions a light; {instead}"
    if _is_transform(value):
        return "it is a transformation, whose entries are not differentiated"
    if _is_untracked_array(value):
        return (
            f"it is {article} {type_name}, whose numbers Dr.Jit does not track; make it an array of the variant "
            f'in the plugin, such as self.{role} = mi.Color3f(props["{role}"])'
        )
    if not (_is_array(value) or isinstance(value, float)):
        return f"it is {article} {type_name}, not a continuous quantity"
    if problem := _problem_of_plugin(user.class_name(), role, shape):
        return problem
    if role in ("normalmap", "nested_texture") and _is_specular(user):
        return (
            "it rotates perfectly specular reflections, whose directions path replay does not differentiate"
        )
    if not tracked and math.prod(shape) > MAX_DIFFERENCES:
        return "Mitsuba keeps it outside the derivative graph, and it has too many entries for finite differences"
    return None


def _problem_of_plugin(plugin: str, role: str, shape: tuple[int, ...]) -> str | None:
    """Return what is wrong with a parameter of one of Mitsuba's plugins alone, or None."""
    if plugin == "SpotLight" and role == "texture" and math.prod(shape) == 1:
        return "the spot has no texture, and Mitsuba does not use the constant that stands for it"
    if plugin.startswith("SGGX") and role == "S":
        return "Mitsuba's SGGX sampling does not match its own density"
    return None


def _caution(graph: SceneGraph, role: str, user: Any, shape: tuple[int, ...], value: Any) -> str | None:
    """Return a known error in a derivative that finite differences cannot replace."""
    if any(_is_wrong_blend(node) for _, node in graph.path(user)[:-1]):
        return (
            "Mitsuba renders a blend with a perfectly specular material wrongly, and the derivative is of the "
            "right image: load the scene from its file or dict, in which the blend is replaced"
        )
    if _is_foreign_and_specular(user) and math.prod(shape) > MAX_DIFFERENCES:
        return (
            "it belongs to a specular plugin of yours: its derivative is right only for what weights a lobe"
        )
    if isinstance(user, activate().BSDF) and role in BENDING and _is_array(value):
        return (
            "it bends normals: its derivative leaves out what appears or disappears where a bent normal turns "
            "away from the viewer, and is wrong for steep maps and at grazing views"
        )
    if not _is_array(value) or len(shape) == 1 or not shape:
        return None
    if _mixes_specular(user, role):
        return "it blends a perfectly specular lobe with others: its derivative is biased, also in its sign"
    return None


def _is_wrong_blend(node: Any) -> bool:
    """Whether it is Mitsuba's own blend with a perfectly specular material, which an ``mi.Scene`` may have."""
    return node.class_name() == "BlendBSDF" and _is_specular(node) and not _is_ours(node)


def _mixes_specular(user: Any, role: str) -> bool:
    """Whether it is the share of a perfectly specular lobe in one of Mitsuba's plugins.

    Path replay does not differentiate the choice of the lobe there, unlike in our own plugin.
    """
    mixes = user.class_name() in ("MaskBSDF", "BlendBSDF") and role in ("opacity", "weight")
    return mixes and _is_specular(user) and not _is_ours(user)


def _is_specular(user: Any) -> bool:
    """Whether a material has a perfectly specular lobe, not counting the null transmission of a mask."""
    mi = activate()
    if not isinstance(user, mi.BSDF):
        return False
    lobes = (user.flags(component) for component in range(user.component_count()))
    specular = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return any(lobe & specular for lobe in lobes)


def _is_foreign_and_specular(user: Any) -> bool:
    """Whether a material is neither Mitsuba's nor ours, and has lobes whose directions may depend on parameters.

    What is known of Mitsuba's own perfectly specular materials does not hold for others.
    """
    package = type(user).__module__.partition(".")[0]
    return package not in ("mitsuba", __package__.partition(".")[0]) and _is_specular(user)


def _has_untracked_tables(user: Any, role: str) -> bool:
    """Whether the plugin derives tables from it outside the derivative graph; our own plugin does not."""
    return user.class_name() == "RoughPlastic" and role in ("alpha", "eta") and not _is_ours(user)


def _is_ours(user: Any) -> bool:
    """Whether a plugin is one of this package that replaces one of Mitsuba's."""
    return type(user).__module__.startswith(__package__)


def _untracked_flags() -> int:
    flags = activate().ParamFlags
    return int(flags.NonDifferentiable.value | flags.ReadOnly.value)


def _is_array(value: Any) -> bool:
    """Whether ``value`` is an array, colour, vector or tensor of floats that Dr.Jit can track."""
    import drjit as dr

    return value is not None and bool(dr.is_jit_v(value) and dr.is_float_v(value))


def _is_untracked_array(value: Any) -> bool:
    """Whether ``value`` is an array or a colour of floats that Dr.Jit cannot track: of its scalar backend."""
    import drjit as dr

    return bool(dr.is_array_v(value) and dr.is_float_v(value) and not dr.is_jit_v(value))


def _is_scalar(graph: SceneGraph, node: Any, shape: tuple[int, ...]) -> bool:
    """Whether every material that uses a colour or colour bitmap reads it as one number."""
    mi = activate()
    if not isinstance(node, mi.Texture) or len(shape) not in (1, 3) or shape[-1] != 3:
        return False
    uses = graph.uses(node)
    return bool(uses) and all(
        isinstance(user, mi.BSDF) and _material_role(role).is_number for user, role in uses
    )


def _to_tensor(value: Any, shape: tuple[int, ...]) -> torch.Tensor:
    """Convert a float or a Dr.Jit array to a CPU tensor."""
    import drjit as dr

    if isinstance(value, float):
        return torch.tensor(value)
    value = dr.detach(value)
    flat: torch.Tensor = (value.array if dr.is_tensor_v(value) else dr.ravel(value)).torch()
    return flat.cpu().reshape(shape)


def _as_in_file(user: Any, value: torch.Tensor) -> torch.Tensor:
    """Return a value without the columns that Mitsuba adds to a sky map, so that places are those of its file."""
    is_sky_map = user.class_name() == "EnvironmentMapEmitter" and value.ndim == 3
    return value[:, 1:-1] if is_sky_map else value


def _shape(value: Any, mesh_size: int | None) -> tuple[int, ...]:
    """Return the shape as a torch tensor: Dr.Jit gives a scalar shape (1,) and a uniform colour (3, 1).

    A mesh attribute of ``mesh_size`` vertices or faces, which Mitsuba stores flat, gets ``(mesh_size, C)``.
    """
    if _is_transform(value):
        return len(value.matrix), len(value.matrix)
    if not hasattr(value, "shape"):
        return ()
    shape = tuple(int(n) for n in value.shape)
    if mesh_size:
        return mesh_size, shape[0] // mesh_size
    return shape if "Tensor" in type(value).__name__ or shape[-1:] != (1,) else shape[:-1]


def _is_transform(value: Any) -> bool:
    return "Transform" in type(value).__name__


def _unique_labels(labels: Mapping[str, str]) -> dict[str, str]:
    """Replace labels that occur more than once by the full names."""
    counts = Counter(labels.values())
    return {name: label if counts[label] == 1 else name for name, label in labels.items()}


def _label(graph: SceneGraph, name: str, node: Any) -> str:
    """Return a readable name: the id of the object that a parameter belongs to, and the property."""
    path = graph.path(node)
    if not path:
        return name
    segments, rest = [], name
    for child_name, _ in path:  # an id may contain dots
        # The suffix with which Mitsuba makes repeated child names unique: "" or "_1".
        suffix, _, rest = rest.removeprefix(child_name).partition(".")
        segments.append(child_name + suffix)
    owner, *inner = [*segments, rest]
    if area_emitter_id(owner) in (scene_object.id() for _, scene_object in path):
        owner = area_emitter_id(owner)
    if _is_shared_material(graph, path):
        owner = graph.owners(path[1][1])[0]  # its own name comes first
    words = [
        (_BUMP_WORDS if parent.class_name() == "BumpMap" else _LABEL_WORDS).get(
            segment, segment.replace("_", " ")
        )
        for (_, parent), segment in zip(path, inner, strict=True)
        if segment not in _OMITTED_SEGMENTS
    ]
    if _is_on_a_lamp(path):
        words.insert(0, "surface")  # the reflectance of a lamp is not that of its light
    user, role = graph.role(path[0][1], inner[0])
    if user is not path[0][1]:  # a texture of the scene itself, which materials read
        words.insert(0, _LABEL_WORDS.get(role, role.replace("_", " ")))
    if inner[-1] == "data":
        words.append("texture" if words else "map")
    return f"{owner}: {' '.join(words)}" if words else owner


def _is_shared_material(graph: SceneGraph, path: Sequence[tuple[str, Any]]) -> bool:
    """Whether a path leads through a shape to a material that other shapes use, too: the shape does not own it."""
    mi = activate()
    shape, *inner = (node for _, node in path)
    through = isinstance(shape, mi.Shape) and bool(inner) and isinstance(inner[0], mi.BSDF)
    return through and len(graph.shapes_using(inner[0])) > 1


def _is_on_a_lamp(path: Sequence[tuple[str, Any]]) -> bool:
    """Whether a path leads through the material of a shape that emits light."""
    mi = activate()
    shape, *inner = (node for _, node in path)
    return isinstance(shape, mi.Shape) and shape.is_emitter() and any(isinstance(n, mi.BSDF) for n in inner)
