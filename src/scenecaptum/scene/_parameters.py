"""Every parameter of a scene: its kind, shape, physical bounds, owner, and whether it can be differentiated."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..backend import activate
from ..errors import UnknownNameError, near_misses
from ._bounds import Bounds
from ._extremes import fault_of
from ._graph import SceneGraph, mesh_places
from ._naming import lamp_on


@dataclass(frozen=True)
class Parameter:
    """One parameter of a scene.

    Attributes
    ----------
    name
        Its ``mi.traverse`` key under ``optimize=False``, which is its name everywhere.
    label
        A readable name for tables and figures.
    kind
        ``"reflectance"``, ``"roughness"``, ``"ior"``, ``"opacity"``, ``"surface"`` (any other property of a
        material), ``"emitters"``, ``"media"``, ``"geometry"``, ``"camera"`` or ``"scene"``.
    plugin
        The Mitsuba class of the material, light, medium, shape or sensor that uses it.
    role
        What that uses it as, in Mitsuba's words: ``"diffuse_reflectance"``, ``"eta"``, …
    shape
        Shape of its tensor: ``()`` for a scalar, ``(3,)`` for a colour, ``(H, W, C)`` for a texture. A colour that
        is looked up as one number, such as an opacity, is a scalar, and a texture of such ``(H, W, 1)``.
    bounds
        The values that are physically meaningful.
    owners
        The materials, lights or media that it belongs to.
    tracked
        Whether Mitsuba lets Dr.Jit track it; where not, a finite difference still can be taken.
    specular_inside
        Whether it belongs to a material with a perfectly specular lobe.
    fault
        What is wrong with the scene's own value, where it is not finite or physically impossible, or None.
    problem
        Why it cannot be differentiated, or None.
    caution
        What is known to be wrong with its derivative, or None.
    """

    name: str
    label: str
    kind: str
    plugin: str
    role: str
    shape: tuple[int, ...]
    bounds: Bounds
    owners: tuple[str, ...]
    tracked: bool = True
    specular_inside: bool = False
    fault: str | None = None
    problem: str | None = None
    caution: str | None = None

    @property
    def is_texture(self) -> bool:
        """Whether its value varies over a surface."""
        return len(self.shape) in (2, 3) and self.kind in SURFACE_KINDS

    @property
    def status(self) -> str:
        """One line: differentiable, differentiable with a caution, or why not."""
        if self.problem:
            return f"not differentiable: {self.problem}"
        return f"differentiable, but {self.caution}" if self.caution else "differentiable"


class SceneParameters(Mapping[str, Parameter]):
    """The parameters of a scene by name, in the scene's order; prints as a table.

    Parameters
    ----------
    parameters
        What to list, each with a name of its own.
    """

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._by_name = {parameter.name: parameter for parameter in parameters}

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._by_name[name]
        except KeyError:
            raise UnknownNameError(
                f"The scene has no parameter {name!r}.{near_misses(name, self._by_name)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __str__(self) -> str:
        """Lay out name, kind, shape, bounds, owner and status in columns."""
        from ..visualization import parameters_text

        return parameters_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from ..visualization import parameters_html

        return parameters_html(self)


SURFACE_KINDS = ("reflectance", "roughness", "ior", "opacity", "surface")

_UNIT = Bounds(0.0, 1.0)
_POSITIVE_UNIT = Bounds(0.0, 1.0, open_low=True)
_NON_NEGATIVE = Bounds(0.0)
_POSITIVE = Bounds(0.0, open_low=True)

# What a property of a material means, by its name in Mitsuba's plugins.
_SURFACE_ROLES: dict[str, tuple[str, Bounds]] = {
    **dict.fromkeys(
        (
            "reflectance",
            "diffuse_reflectance",
            "specular_reflectance",
            "specular_transmittance",
            "diffuse_transmittance",
            "base_color",
        ),
        ("reflectance", _UNIT),
    ),
    **dict.fromkeys(
        ("alpha", "alpha_u", "alpha_v", "roughness", "longitudinal_roughness", "azimuthal_roughness"),
        ("roughness", _POSITIVE_UNIT),
    ),
    "eta": ("ior", _POSITIVE),
    "k": ("ior", _NON_NEGATIVE),
    "specular": ("ior", _UNIT),
    "opacity": ("opacity", _UNIT),
    "weight": ("opacity", _UNIT),
    "diff_trans": ("surface", Bounds(0.0, 2.0)),
    **dict.fromkeys(("eumelanin", "pheomelanin", "sigma_a"), ("surface", _NON_NEGATIVE)),
    **dict.fromkeys(
        (
            "metallic",
            "anisotropic",
            "spec_tint",
            "sheen",
            "sheen_tint",
            "clearcoat",
            "clearcoat_gloss",
            "spec_trans",
            "flatness",
            "normalmap",
        ),
        ("surface", _UNIT),
    ),
}

# Properties that Mitsuba's materials look up as one number, whatever they are given as: of a colour they take the
# mean of its channels, of a bitmap the luminance.
_ONE_NUMBER = {"opacity", "weight", "alpha", "alpha_u", "alpha_v", "roughness", "metallic", "anisotropic"}
_ONE_NUMBER |= {"sheen", "sheen_tint", "spec_tint", "clearcoat", "clearcoat_gloss", "spec_trans", "flatness"}
_ONE_NUMBER |= {"diff_trans"}

_EMITTER_ROLES: dict[str, Bounds] = dict.fromkeys(("cutoff_angle", "beam_width"), Bounds(0.0, 180.0))

_MEDIUM_ROLES: dict[str, Bounds] = {"albedo": _UNIT, "g": Bounds(-1.0, 1.0)}

# What places a light in the scene or in time: like a pose, it moves the shadows.
_POSES = {"position", "direction", "sun_direction", "latitude", "longitude", "timezone"}
_POSES |= {"year", "month", "day", "hour", "minute", "second"}

_DROPPED_SEGMENTS = {"bsdf", "brdf_0", "nested_bsdf", "emitter", "value", "data", "interior_medium"}


def discover(graph: SceneGraph) -> SceneParameters:
    """Return every parameter that ``mi.traverse`` finds in a scene, described.

    It is what ``SceneRenderer.parameters_table`` returns.

    Example
    -------
    >>> from scenecaptum.scene import load_scene
    >>> discover(SceneGraph(load_scene("office")))["desk.base_color.value"].kind
    'reflectance'

    Parameters
    ----------
    graph
        The objects of a loaded scene and what refers to what.
    """
    mi = activate()
    # Writing is none of its business, but reading through mi.traverse is what fixes the names.
    properties = mi.traverse(graph.scene).properties
    labels = _labels({name: _label(graph, name, node) for name, (_, _, node, _) in properties.items()})
    return SceneParameters(
        _describe(graph, name, labels[name], node, _value(pointer, cpptype, node), flags)
        for name, (pointer, cpptype, node, flags) in properties.items()
    )


def _value(pointer: Any, cpptype: Any, node: Any) -> Any:
    mi = activate()
    return pointer if cpptype is None else mi.get_property(pointer, cpptype, node)


def _describe(graph: SceneGraph, name: str, label: str, node: Any, value: Any, flags: int) -> Parameter:
    own_name = name.rsplit(".", 1)[-1]
    holder, role = graph.role(node, own_name)
    kind, bounds = _kind_and_bounds(holder, role)
    found = _shape(value, mesh_places(node, own_name))
    shape = _grey(found) if _is_one_number(graph, node, found) else found
    tracked = _is_array(value) and not flags & _untracked_flags() and not _leaves_tables(holder, role)
    problem = _problem(kind, role, holder, shape, value, tracked)
    fault = None if problem else fault_of(_numbers(value, found), kind, bounds)
    return Parameter(
        name=name,
        label=label,
        kind=kind,
        plugin=holder.class_name(),
        role=role,
        shape=shape,
        bounds=bounds,
        owners=graph.owners(node),
        tracked=tracked,
        specular_inside=_is_specular(holder),
        fault=fault,
        problem=problem or fault,
        caution=None if problem else _caution(role, holder, shape, value),
    )


def _kind_and_bounds(holder: Any, role: str) -> tuple[str, Bounds]:
    mi = activate()
    if isinstance(holder, mi.BSDF):
        # A perfect mirror without a named metal has eta = 0, k = 1.
        if role == "eta" and "Conductor" in holder.class_name():
            return "ior", _NON_NEGATIVE
        return _SURFACE_ROLES.get(role, ("surface", Bounds()))
    if isinstance(holder, mi.Emitter):
        return "emitters", _EMITTER_ROLES.get(role, _NON_NEGATIVE)
    if isinstance(holder, (mi.Medium, mi.PhaseFunction)):
        return "media", _MEDIUM_ROLES.get(role, _NON_NEGATIVE)
    if isinstance(holder, mi.Shape):
        # Attributes that no material looks up.
        return ("surface", Bounds()) if mesh_places(holder, role) else ("geometry", Bounds())
    if isinstance(holder, (mi.Sensor, mi.Film, mi.Sampler)):
        return "camera", Bounds()
    return "scene", Bounds()


def _problem(
    kind: str, role: str, holder: Any, shape: tuple[int, ...], value: Any, tracked: bool
) -> str | None:
    """Why the parameter cannot be differentiated, or None where it can."""
    type_name = type(value).__name__
    if kind == "geometry" and ("position" in role or "to_world" in role):
        return "it moves visibility, and a gradient without the boundary term would be silently wrong"
    if kind == "geometry":
        return "it belongs to the geometry, whose derivatives have no verified route"
    if kind == "camera":
        return "it belongs to the camera, which Mitsuba does not differentiate"
    if type_name == "TensorXu8":
        return (
            "its texels are stored in 8 bits, which carry no derivatives; load the scene from its file or "
            'dict, or give the bitmap format="variant"'
        )
    if role == "sampling_weight" or role.endswith("_sampling_rate"):
        return "it changes how samples are drawn, not what is rendered"
    if "Transform" in type_name:
        return "it is a transformation; only materials, lights and media are differentiated"
    if kind == "emitters" and role in _POSES:
        return "it places a light, which moves shadows as a pose does"
    if not (_is_array(value) or isinstance(value, float)):
        return f"it is a {type_name}, not a continuous quantity"
    if role == "S" and holder.class_name().startswith("SGGX"):
        return "Mitsuba's SGGX samples other directions than its own density describes"
    if role in ("normalmap", "nested_texture") and _is_specular(holder):
        return "it turns perfectly specular reflections, and path replay does not follow where they go"
    if not tracked and math.prod(shape) > 3:
        return "Mitsuba keeps it outside the derivative graph, and it has too many numbers for differences"
    return None


def _caution(role: str, holder: Any, shape: tuple[int, ...], value: Any) -> str | None:
    """Tell what is known to be wrong with a texture's derivative, which no difference can stand in for."""
    if _is_array(value) and len(shape) > 1 and _is_specular(holder) and role in ("opacity", "weight"):
        return "it weighs a perfectly specular lobe against others: its size is off"
    return None


def _is_specular(holder: Any) -> bool:
    """Whether a material has a perfectly specular lobe, beside what a mask lets pass."""
    mi = activate()
    if not isinstance(holder, mi.BSDF):
        return False
    lobes = (holder.flags(component) for component in range(holder.component_count()))
    specular = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return any(lobe & specular for lobe in lobes)


def _leaves_tables(holder: Any, role: str) -> bool:
    """Whether Mitsuba's plugin derives tables from it outside the derivative graph, as our own does not."""
    own = type(holder).__module__.startswith(__package__)
    return holder.class_name() == "RoughPlastic" and role in ("alpha", "eta") and not own


def _untracked_flags() -> int:
    flags = activate().ParamFlags
    return int(flags.NonDifferentiable.value | flags.ReadOnly.value)


def _is_array(value: Any) -> bool:
    """Whether it is an array, colour, vector or tensor of floats that Dr.Jit can track."""
    import drjit as dr

    return value is not None and bool(dr.is_jit_v(value) and dr.is_float_v(value))


def _is_one_number(graph: SceneGraph, node: Any, shape: tuple[int, ...]) -> bool:
    """Whether a colour, or a coloured picture, is looked up as one number by every material that uses it."""
    mi = activate()
    if not isinstance(node, mi.Texture) or len(shape) not in (1, 3) or shape[-1] != 3:
        return False
    uses = graph.uses(node)
    return bool(uses) and all(isinstance(one, mi.BSDF) and role in _ONE_NUMBER for one, role in uses)


def _grey(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a colour, or of a coloured picture, that counts as one number."""
    return (*shape[:-1], 1) if len(shape) > 1 else ()


def _numbers(value: Any, shape: tuple[int, ...]) -> torch.Tensor:
    """Return a float, or an array of Dr.Jit, as a tensor of that shape."""
    import drjit as dr

    if isinstance(value, float):
        return torch.tensor(value)
    value = dr.detach(value)
    flat: torch.Tensor = (value.array if dr.is_tensor_v(value) else dr.ravel(value)).torch()
    return flat.cpu().reshape(shape)


def _shape(value: Any, places: int | None) -> tuple[int, ...]:
    """Shape as a torch tensor: Dr.Jit gives a scalar shape (1,) and a uniform colour (3, 1).

    What a mesh has at so many ``places`` lies there one after the other; here these are rows.
    """
    if not hasattr(value, "shape"):
        return ()
    shape = tuple(int(n) for n in value.shape)
    if places:
        return places, shape[0] // places
    return shape if "Tensor" in type(value).__name__ or shape[-1:] != (1,) else shape[:-1]


def _labels(labels: Mapping[str, str]) -> dict[str, str]:
    """Keep the labels that are the only ones of their kind; of others the full name tells more."""
    counts = Counter(labels.values())
    return {name: label if counts[label] == 1 else name for name, label in labels.items()}


def _label(graph: SceneGraph, name: str, node: Any) -> str:
    """Return a readable name: the object that a parameter belongs to, whose id may have dots, and what it is."""
    path = graph.path(node)
    if not path:
        return name
    segments, rest = [], name
    for held_as, _ in path:
        # Mitsuba numbers what is held under one name: this is "" or "_1".
        number, _, rest = rest.removeprefix(held_as).partition(".")
        segments.append(held_as + number)
    owner, *inner = [*segments, rest]
    if lamp_on(owner) in (one.id() for _, one in path):
        owner = lamp_on(owner)
    words = [segment.replace("_", " ") for segment in inner if segment not in _DROPPED_SEGMENTS]
    if inner[-1] == "data":
        words.append("texture" if words else "map")
    return f"{owner}: {' '.join(words)}" if words else owner
