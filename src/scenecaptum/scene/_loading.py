"""Load a differentiable scene from a path, a Mitsuba dict, a bundled name or an ``mi.Scene``."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np

from ..backend import activate, at_least_two_threads
from ..errors import SceneCaptumError, near_misses
from ._files import Placeholders, check_dict, check_referenced_files, check_xml, is_file
from ._naming import name_nodes, name_objects, restore_texture_ids, texture_ids, without_addresses
from ._portable import picture_of, with_copied_tensors
from .bundled import BUNDLED

SceneLike: TypeAlias = "str | os.PathLike[str] | Mapping[str, Any] | Any"
XmlParameters: TypeAlias = "Mapping[str, str | float]"

_BEFORE_XML = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"  # the marks of UTF-8 and UTF-16, and white space
_SENSOR_OF_A_FILE, _SENSOR_OF_A_DICT = (
    '<sensor type="perspective">…</sensor>',
    '"camera": {"type": "perspective"}',
)
_MESHES = frozenset({".obj", ".ply", ".serialized"})  # endings that are their plugins' names too

# Of loaded integrators that are written in Python, which do not know by which plugin a scene names them.
_INTEGRATOR_PLUGINS: WeakKeyDictionary[Any, str] = WeakKeyDictionary()


def load_scene(scene: SceneLike, parameters: XmlParameters | None = None) -> Any:
    """Return an ``mi.Scene`` in which every object has a unique name and every bitmap is differentiable.

    Parameters
    ----------
    scene
        A path to a Mitsuba XML file, a Mitsuba scene dict, the name of a bundled scene (``"office"``,
        ``"cornell-box"``) or an ``mi.Scene``. An ``mi.Scene`` is returned unchanged, except that objects without
        an id get one.
    parameters
        Values for the ``$name`` placeholders of an XML file.

    Raises
    ------
    SceneCaptumError
        If the file is missing or cannot be parsed, a plugin rejects its properties, there is no sensor, or
        ``parameters`` do not match the file's placeholders.
    """
    mi = activate()
    if parameters and (not isinstance(scene, (str, os.PathLike)) or _is_bundled(scene)):
        raise SceneCaptumError(
            f"parameters= gives values to the $names of an XML file, but {scene_name(scene)} is not an XML file. "
            "Leave it out."
        )
    if isinstance(scene, mi.Scene):
        loaded = scene
    elif isinstance(scene, Mapping):
        check_dict(scene)
        # Mitsuba takes tensors out of the dict.
        own = with_copied_tensors(scene)
        loaded = _instantiate("the scene dict", lambda config: mi.parser.parse_dict(config, own))
    elif isinstance(scene, (str, os.PathLike)):
        loaded = _load_path_or_bundled(scene, format_parameters(parameters))
    else:
        raise SceneCaptumError(
            f"scene must be a path, a Mitsuba scene dict, the name of a bundled scene or an mi.Scene, "
            f"not {type(scene).__name__}."
        )
    name_objects(loaded)
    if not loaded.sensors():
        raise SceneCaptumError(
            f"{scene_name(scene)} has no sensor, so it cannot be rendered. "
            f"Add one, for example {_SENSOR_OF_A_DICT if isinstance(scene, Mapping) else _SENSOR_OF_A_FILE}."
        )
    return loaded


def named_integrator(integrator: Any) -> str | None:
    """Return the plugin by which a loaded scene names an integrator written in Python; None if it is not known."""
    is_python = hasattr(integrator, "__weakref__")
    return _INTEGRATOR_PLUGINS.get(integrator) if is_python else None


def scene_name(scene: SceneLike) -> str:
    """Return the name of a scene for messages and results: its path or bundled name, otherwise its type."""
    if isinstance(scene, (str, os.PathLike)):
        return os.fspath(scene)
    return "the scene dict" if isinstance(scene, Mapping) else "the mi.Scene"


def scene_heading(name: str) -> str:
    """Return the name of a scene for people: of a path the file, or its folder where all files have that name.

    Example
    -------
    >>> scene_heading("rooms/kitchen/scene.xml"), scene_heading("rooms/hall.xml"), scene_heading("office")
    ('kitchen', 'hall', 'office')
    """
    *folders, file = name.replace("\\", "/").rstrip("/").split("/")
    stem = file.removesuffix(".xml")
    return folders[-1] if stem == "scene" and folders and folders[-1] else stem or name


def hashable_source(scene: SceneLike) -> Any:
    """Return the description of a scene as strings and arrays to be hashed; ``str(mi.Scene)`` omits some of it.

    None for an ``mi.Scene``. Files included by an XML file are not part of it.
    """
    if isinstance(scene, (str, os.PathLike)):
        return Path(scene).read_bytes().hex() if Path(scene).is_file() else os.fspath(scene)
    return _hashable(scene) if isinstance(scene, Mapping) else None


def _hashable(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _hashable(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_hashable(item) for item in value]
    if isinstance(value, np.ndarray):
        return value
    if (picture := picture_of(value)) is not None:  # printed, most of its numbers are left out
        return [picture.array, picture.pixel_format, picture.srgb_gamma]
    try:
        return without_addresses(str(value))
    except RuntimeError:  # Dr.Jit cannot print an array with an inconsistent shape
        return type(value).__name__


def _load_path_or_bundled(scene: str | os.PathLike[str], parameters: Mapping[str, str]) -> Any:
    mi = activate()
    path = Path(scene)
    if is_file(path):
        if path.suffix.lower() in _MESHES:
            raise SceneCaptumError(
                f"{path} is a mesh, not a scene: name it in a scene, with a camera and lights, for example "
                f'{{"type": "{path.suffix[1:].lower()}", "filename": "{path.name}"}} in a scene dict.'
            )
        if not path.read_bytes().lstrip(_BEFORE_XML).startswith(b"<"):
            raise SceneCaptumError(
                f"{path} is not a scene in Mitsuba's XML. Export one, from Blender with the add-on "
                "mitsuba-blender, or build a scene dict."
            )
        check_xml(path, parameters)
        # Paths of textures and meshes are relative to the scene file.
        with _search_path(path.resolve().parent):
            return _instantiate(str(path), lambda config: _parse_file(config, path, parameters))
    name = os.fspath(scene)
    if _is_bundled(scene):
        return _instantiate(name, lambda config: mi.parser.parse_dict(config, BUNDLED[name]()))
    if os.path.isdir(path):
        inside = sorted(path.glob("*.xml"))
        hint = f"Did you mean {inside[0]}?" if inside else "It contains no .xml file either."
        raise SceneCaptumError(f"{path} is a folder, not a scene file. {hint}")
    raise SceneCaptumError(
        f"There is no scene file {name!r}, and no bundled scene of that name "
        f"(bundled: {', '.join(BUNDLED)}).{near_misses(name, BUNDLED)}"
    )


def format_parameters(parameters: XmlParameters | None) -> dict[str, str]:
    """Convert the values of XML placeholders to strings; raise if a name or a value is invalid."""
    if parameters is not None and not isinstance(parameters, Mapping):
        raise SceneCaptumError(
            f"parameters= must be a mapping such as {{'spp': 64}}, not {type(parameters).__name__}."
        )
    for name, value in (parameters or {}).items():
        if not (isinstance(name, str) and re.fullmatch(r"\w+", name)):
            raise SceneCaptumError(
                f"parameters= has the key {name!r}; keys are the $names of the file without $, such as 'spp'."
            )
        if name in ("config", "filename"):
            raise SceneCaptumError(f"Mitsuba's parser reserves the name {name!r}: rename ${name}.")
        if not isinstance(value, (str, Real)):
            raise SceneCaptumError(
                f"parameters= gives ${name} a {type(value).__name__}; values are numbers and strings."
            )
    # Booleans are lowercase in XML.
    return {n: str(v).lower() if isinstance(v, bool) else str(v) for n, v in (parameters or {}).items()}


def _parse_file(config: Any, path: Path, parameters: Mapping[str, str]) -> Any:
    """Parse an XML file; raise if a placeholder has no value, or a value has no placeholder."""
    try:
        return activate().parser.parse_file(config, str(path), **parameters)
    except RuntimeError as error:
        missing = re.search(r"undefined parameter: \$(\w*)", str(error))
        unknown = re.search(r"unused parameters:\s+- \$(\w+)=", str(error))
        if missing:
            raise SceneCaptumError(_missing_value(path, missing[1], parameters)) from error
        if unknown:
            raise SceneCaptumError(_unknown_placeholder(path, unknown[1], parameters)) from error
        raise


def _missing_value(path: Path, name: str, parameters: Mapping[str, str]) -> str:
    found = Placeholders.find(path, parameters)
    names = sorted({name, *(found.used - found.defaults - parameters.keys())})
    placeholders = ", ".join(f"${n}" for n in names)
    argument = ", ".join(f"{n!r}: …" for n in names)
    options = " ".join(f"-D {n}=…" for n in names)
    return (
        f"{path} has no value for {placeholders}: give parameters={{{argument}}}, or {options} on the "
        "command line."
    )


def _unknown_placeholder(path: Path, name: str, parameters: Mapping[str, str]) -> str:
    known = sorted(Placeholders.find(path, parameters).used)
    listed = f"It has {', '.join(f'${n}' for n in known)}." if known else "It has no placeholders."
    return f"{path} has no placeholder ${name}.{near_misses(name, known)} {listed}"


def _is_bundled(scene: str | os.PathLike[str]) -> bool:
    return not is_file(Path(scene)) and os.fspath(scene) in BUNDLED


@contextlib.contextmanager
def _search_path(folder: Path) -> Iterator[None]:
    """Add ``folder`` to Mitsuba's search path for the duration of the context."""
    mi = activate()
    previous = mi.file_resolver()
    resolver = mi.FileResolver(previous)
    resolver.prepend(str(folder))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(previous)


def _instantiate(name: str, parse: Callable[[Any], Any]) -> Any:
    mi = activate()
    config = mi.parser.ParserConfig(mi.variant())
    # Merging would rename shapes to object_<address> and merge materials that have different names.
    config.merge_equivalent = False
    config.merge_meshes = False
    # An exception in a worker thread, for example for a damaged image, would terminate the process.
    config.parallel = False
    state = None
    try:
        state = parse(config)
        mi.parser.transform_all(config, state)
        check_referenced_files(mi.file_resolver().resolve, state.nodes)
        name_nodes(state.nodes)
        # Mitsuba does not know which kind of object a plugin written in Python is.
        plugins = {node.props.id(): node.props.plugin_name() for node in state.nodes}
        textures = texture_ids(state.nodes)
        _make_differentiable(state)
        with at_least_two_threads():
            loaded = mi.parser.instantiate(config, state)
    except (RuntimeError, ValueError, TypeError) as error:
        raise SceneCaptumError(f"{name} cannot be loaded: {_clean_message(error)}") from error
    finally:
        # The traceback would keep partially built objects alive: an emitter without its shape, which the next
        # render of any scene would access, terminating the process.
        state = None
    if isinstance(loaded, list) and len(loaded) == 1:
        loaded = loaded[0]
    if not isinstance(loaded, mi.Scene):
        raise SceneCaptumError(
            f"{name} describes {type(loaded).__name__}, not a scene. Wrap it in a scene: "
            '<scene version="3.0.0">…</scene>, or {"type": "scene", …}.'
        )
    _check_meshes(name, loaded)
    restore_texture_ids(loaded, textures)
    integrator = loaded.integrator()
    if hasattr(integrator, "__weakref__") and integrator.id() in plugins:
        _INTEGRATOR_PLUGINS[integrator] = plugins[integrator.id()]
    return loaded


def _check_meshes(name: str, scene: Any) -> None:
    """Raise if a mesh has no faces, or invalid vertex indices: tracing it would read out of bounds."""
    import drjit as dr

    for mesh in (shape for shape in scene.shapes() if shape.is_mesh()):
        faces = mesh.faces_buffer()
        if not mesh.face_count() or not mesh.vertex_count():
            fault = "has no faces"
        elif dr.max(faces)[0] >= mesh.vertex_count():
            fault = f"has {mesh.vertex_count()} vertices, but a face with vertex {dr.max(faces)[0]}"
        else:
            continue
        raise SceneCaptumError(f"{name} cannot be loaded: the mesh {mesh.id()!r} {fault}. Export it again.")


def _make_differentiable(state: Any) -> None:
    """Store texels as floats, since 8-bit texels are not differentiable; use RGB films and our own plugins."""
    for props in (node.props for node in state.nodes):
        if props.plugin_name() == "bitmap" and props.get("format", "auto") == "auto":
            props["format"] = "variant"
        if props.plugin_name() == "hdrfilm":
            props["pixel_format"] = "rgb"
        if props.plugin_name() in ("plastic", "roughplastic", "dielectric", "blendbsdf"):
            from . import _blend, _plastics, dielectric  # noqa: F401 -- registers the plugins

            props.set_plugin_name(f"scenecaptum_{props.plugin_name()}")
        if props.plugin_name() == "scenecaptum_ies":
            from .photometry import _emitter  # noqa: F401 -- registers the plugin


def _clean_message(error: Exception) -> str:
    """Return Mitsuba's message on one line, without source locations and internal plugin names."""
    text = " ".join(str(error).split()).replace('type "scenecaptum_', 'type "')
    text = re.sub(r"Traceback \(most recent call last\):.*?\w+Error: ", "", text)
    return text.split("] ", 1)[1] if text.startswith("[") and "] " in text else text
