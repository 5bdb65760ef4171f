"""From a path, a Mitsuba dict, a bundled name or an ``mi.Scene`` to a scene that can be differentiated."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..backend import activate
from ..errors import SceneCaptumError, near_misses
from ._files import Placeholders, check_dict, check_named, check_xml, is_file
from ._naming import name_nodes, name_objects, without_addresses
from .bundled import BUNDLED

SceneLike: TypeAlias = "str | os.PathLike[str] | Mapping[str, Any] | Any"
XmlParameters: TypeAlias = "Mapping[str, str | float]"


def load_scene(scene: SceneLike, parameters: XmlParameters | None = None) -> Any:
    """Return an ``mi.Scene`` in which every object has a name of its own and every bitmap carries derivatives.

    Parameters
    ----------
    scene
        A path to a Mitsuba XML file, a Mitsuba scene dict, the name of a bundled scene (``"office"``,
        ``"cornell-box"``) or an ``mi.Scene``, which is returned as it is, but that its objects without an id
        have got one.
    parameters
        Values for the ``$name`` placeholders of an XML file.

    Raises
    ------
    SceneCaptumError
        Where the file is missing or cannot be parsed, a plugin refuses its properties, there is no sensor, or
        ``parameters`` are not those of the file.
    """
    mi = activate()
    if parameters and (not isinstance(scene, (str, os.PathLike)) or _is_bundled(scene)):
        raise SceneCaptumError(
            f"parameters= gives values to the $names of an XML file, and {describe(scene)} is none. Leave it out."
        )
    if isinstance(scene, mi.Scene):
        loaded = scene
    elif isinstance(scene, Mapping):
        check_dict(scene)
        loaded = _instantiate("the scene dict", lambda config: mi.parser.parse_dict(config, dict(scene)))
    elif isinstance(scene, (str, os.PathLike)):
        loaded = _load_named(scene, as_text(parameters))
    else:
        raise SceneCaptumError(
            f"scene must be a path, a Mitsuba scene dict, the name of a bundled scene or an mi.Scene, "
            f"not {type(scene).__name__}."
        )
    name_objects(loaded)
    if not loaded.sensors():
        raise SceneCaptumError(
            f"{describe(scene)} has no sensor, so there is nothing to render it with. "
            'Add one, for example <sensor type="perspective">…</sensor>.'
        )
    return loaded


def describe(scene: SceneLike) -> str:
    """Name a scene in an error message or a result: its file or bundled name, else what it is."""
    if isinstance(scene, (str, os.PathLike)):
        return os.fspath(scene)
    return "the scene dict" if isinstance(scene, Mapping) else "the mi.Scene"


def source_of(scene: SceneLike) -> Any:
    """Return what a scene was described by, in strings and arrays, of which Mitsuba prints only a part later.

    None for an ``mi.Scene``; what XML files include is not part of it.
    """
    if isinstance(scene, (str, os.PathLike)):
        return Path(scene).read_bytes().hex() if Path(scene).is_file() else os.fspath(scene)
    return _plain(scene) if isinstance(scene, Mapping) else None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return value
    try:
        return without_addresses(str(value))
    except RuntimeError:  # Dr.Jit cannot print an array that does not have the shape it claims
        return type(value).__name__


def _load_named(scene: str | os.PathLike[str], parameters: Mapping[str, str]) -> Any:
    mi = activate()
    path = Path(scene)
    if is_file(path):
        check_xml(path, parameters)
        # Textures and meshes are named relative to the file.
        with _search_path(path.resolve().parent):
            return _instantiate(str(path), lambda config: _parse_file(config, path, parameters))
    name = os.fspath(scene)
    if _is_bundled(scene):
        return _instantiate(name, lambda config: mi.parser.parse_dict(config, BUNDLED[name]()))
    if os.path.isdir(path):
        raise SceneCaptumError(f"{path} is a folder, not a scene file.{_xml_inside(path)}")
    raise SceneCaptumError(
        f"There is no scene file {name!r}, and no bundled scene of that name "
        f"(bundled: {', '.join(BUNDLED)}).{near_misses(name, BUNDLED)}"
    )


def as_text(parameters: XmlParameters | None) -> dict[str, str]:
    """Return the values of ``$names`` as they are to stand in the file.

    Raises
    ------
    SceneCaptumError
        Where a name or a value is none.
    """
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
            raise SceneCaptumError(f"Mitsuba's parser keeps the name {name!r} to itself: rename ${name}.")
        if not isinstance(value, (str, Real)):
            raise SceneCaptumError(
                f"parameters= gives ${name} a {type(value).__name__}; values are numbers and strings."
            )
    # XML writes true and false in small letters.
    return {n: str(v).lower() if isinstance(v, bool) else str(v) for n, v in (parameters or {}).items()}


def _parse_file(config: Any, path: Path, parameters: Mapping[str, str]) -> Any:
    """Parse an XML file, or say which of its ``$names`` has no value, or which value has no ``$name``."""
    try:
        return activate().parser.parse_file(config, str(path), **parameters)
    except RuntimeError as error:
        missing = re.search(r"undefined parameter: \$(\w*)", str(error))
        unknown = re.search(r"unused parameters:\s+- \$(\w+)=", str(error))
        if missing:
            raise SceneCaptumError(_missing(path, missing[1], parameters)) from error
        if unknown:
            raise SceneCaptumError(_unknown(path, unknown[1], parameters)) from error
        raise


def _missing(path: Path, name: str, parameters: Mapping[str, str]) -> str:
    found = Placeholders.of(path, parameters)
    names = sorted({name, *(found.used - found.defaults - parameters.keys())})
    return (
        f"{path} has no value for {', '.join(f'${one}' for one in names)}: give parameters="
        f"{{{', '.join(f'{one!r}: …' for one in names)}}}, or {' '.join(f'-D {one}=…' for one in names)} on the "
        "command line."
    )


def _unknown(path: Path, name: str, parameters: Mapping[str, str]) -> str:
    known = sorted(Placeholders.of(path, parameters).used)
    listed = f"It has {', '.join(f'${one}' for one in known)}." if known else "It has no $name at all."
    return f"{path} has no ${name} that a value could be given to.{near_misses(name, known)} {listed}"


def _is_bundled(scene: str | os.PathLike[str]) -> bool:
    return not is_file(Path(scene)) and os.fspath(scene) in BUNDLED


def _xml_inside(folder: Path) -> str:
    inside = sorted(folder.glob("*.xml"))
    return f" Did you mean {inside[0]}?" if inside else " It holds no .xml file either."


@contextlib.contextmanager
def _search_path(folder: Path) -> Iterator[None]:
    """Let Mitsuba find the files a scene names beside ``folder``, and forget the folder afterwards."""
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
    # Merging would rename shapes to object_<address> and fuse materials that the user tells apart.
    config.merge_equivalent = False
    config.merge_meshes = False
    # An error in a thread of its own, such as that of a damaged picture, would end the process.
    config.parallel = False
    state = None
    try:
        state = parse(config)
        mi.parser.transform_all(config, state)
        check_named(mi.file_resolver().resolve, state.nodes)
        name_nodes(state.nodes)
        _make_differentiable(state)
        loaded = mi.parser.instantiate(config, state)
    except (RuntimeError, ValueError, TypeError) as error:
        raise SceneCaptumError(f"{name} cannot be loaded: {_reason(error)}") from error
    finally:
        # A traceback would keep what was made before the error: a lamp without its shape, which the next render
        # of any scene reaches, and that ends the process.
        state = None
    if isinstance(loaded, list) and len(loaded) == 1:
        loaded = loaded[0]
    if not isinstance(loaded, mi.Scene):
        raise SceneCaptumError(
            f"{name} describes {type(loaded).__name__}, not a scene. Wrap it in a scene: "
            '<scene version="3.0.0">…</scene>, or {"type": "scene", …}.'
        )
    _check_meshes(name, loaded)
    return loaded


def _check_meshes(name: str, scene: Any) -> None:
    """Raise where a mesh has no faces, or faces without their vertices: tracing it reads foreign memory."""
    import drjit as dr

    for mesh in (shape for shape in scene.shapes() if shape.is_mesh()):
        faces = mesh.faces_buffer()
        if not mesh.face_count() or not mesh.vertex_count():
            fault = "has no faces"
        elif dr.max(faces)[0] >= mesh.vertex_count():
            fault = f"has {mesh.vertex_count()} vertices, and faces with vertex {dr.max(faces)[0]}"
        else:
            continue
        raise SceneCaptumError(f"{name} cannot be loaded: the mesh {mesh.id()!r} {fault}. Export it again.")


def _make_differentiable(state: Any) -> None:
    """Store texels as floats, since 8 bits carry no derivatives, record linear RGB, and take our own plastics."""
    for props in (node.props for node in state.nodes):
        if props.plugin_name() == "bitmap" and props.get("format", "auto") == "auto":
            props["format"] = "variant"
        if props.plugin_name() == "hdrfilm":
            props["pixel_format"] = "rgb"
        if props.plugin_name() in ("plastic", "roughplastic"):
            from . import _plastics  # noqa: F401 -- registers the plugins

            props.set_plugin_name(f"scenecaptum_{props.plugin_name()}")


def _reason(error: Exception) -> str:
    """Mitsuba's message on one line, without positions in source code, about the plugin that the user named."""
    text = " ".join(str(error).split()).replace('type "scenecaptum_', 'type "')
    text = re.sub(r"Traceback \(most recent call last\):.*?\w+Error: ", "", text)
    return text.split("] ", 1)[1] if text.startswith("[") and "] " in text else text
