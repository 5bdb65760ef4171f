"""Resolve ``inputs=`` to the names of the parameters to differentiate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from glob import escape
from typing import TypeAlias

from ..errors import SceneCaptumError, near_misses
from ._parameter_table import CAMERA, Parameter, SceneParameters

Selection: TypeAlias = "str | Sequence[str]"

KINDS = (
    "materials",
    "reflectance",
    "roughness",
    "ior",
    "opacity",
    "surface",
    "textures",
    "emitters",
    "media",
    "poses",
    "camera",
    "all",
)


def select(parameters: SceneParameters, inputs: Selection) -> tuple[str, ...]:
    """Return the names of the differentiable parameters that ``inputs`` selects, in the scene's order.

    Parameters
    ----------
    parameters
        The scene's parameters.
    inputs
        A kind (``"materials"``, ``"reflectance"``, …; ``"all"`` leaves out poses and camera), a glob
        (``"*.reflectance.*"``), an exact name, or a list of these. Kinds and globs skip parameters that cannot be
        differentiated, and parameters whose values are not finite or physically impossible. A glob selects poses
        only where it contains ``pose`` or ``fov``.

    Raises
    ------
    SceneCaptumError
        If an item matches nothing, or an exact name cannot be differentiated.
    """
    wanted = [inputs] if isinstance(inputs, str) else list(inputs)
    if not wanted:
        raise SceneCaptumError(f"inputs selects nothing: give a kind ({', '.join(KINDS)}), a glob or a name.")
    chosen = {name for item in wanted for name in _matches(parameters, item)}
    return tuple(name for name in parameters if name in chosen)


def _matches(parameters: SceneParameters, item: str) -> list[str]:
    if not isinstance(item, str):
        raise SceneCaptumError(f"inputs must contain names, globs or kinds, not {type(item).__name__}.")
    if item in parameters:
        if parameters[item].problem:
            fix = ". Correct it in the scene, or in its file" if parameters[item].fault else ""
            verb = "moved" if parameters[item].moves else "differentiated"
            raise SceneCaptumError(f"{item!r} cannot be {verb}: {parameters[item].problem}{fix}.")
        return [item]
    if item in KINDS:
        matched = [p for p in parameters.values() if is_of_kind(p, item)]
    else:
        # Each number of a pose takes renders of its own, so a glob selects poses only where it names them.
        names_poses = "pose" in item or "fov" in item
        matched = [
            p for p in parameters.values() if fnmatchcase(p.name, item) and (names_poses or not p.moves)
        ]
    differentiable = [p.name for p in matched if not p.problem]
    if not differentiable:
        raise SceneCaptumError(_no_match(parameters, item, matched))
    return differentiable


def is_of_kind(parameter: Parameter, kind: str) -> bool:
    """Whether a parameter belongs to a kind of ``inputs``."""
    if kind == "all":
        # Each number of a pose takes renders of its own, so poses are only differentiated on request.
        return not parameter.moves
    if kind == "materials":
        return parameter.is_of_surface
    return parameter.is_texture if kind == "textures" else parameter.kind == kind


def _no_match(parameters: SceneParameters, item: str, matched: list[Parameter]) -> str:
    known = [name for name, p in parameters.items() if not p.problem]
    if matched:
        # Rather a pose than a setting of Mitsuba's, which is never differentiated.
        first = next((p for p in matched if p.moves), matched[0])
        hint = _camera_hint(known) if all(p.kind == CAMERA for p in matched) else ""
        if len(matched) == 1:
            which = f"only {first.name}, which cannot be differentiated"
        else:
            which = (
                f"{len(matched)} parameters, none of which can be differentiated; {first.name}, for example"
            )
        return f"inputs={item!r} matches {which}: {first.problem}.{hint}"
    if poses := [name for name in known if fnmatchcase(name, item)]:
        return (
            f"inputs={item!r} matches only poses, such as {poses[0]!r}. A glob selects poses only where it "
            "contains 'pose' or 'fov', because each takes renders of its own: write "
            f"{_naming_poses(parameters, item, poses)!r}."
        )
    if item in KINDS:
        there = ", ".join(kind for kind in KINDS if any(is_of_kind(parameters[name], kind) for name in known))
        return f"inputs={item!r} selects nothing: the scene has no parameter of this kind. It has {there}."
    owner = item.partition(".")[0]
    hint = parameters.hint(item) or near_names(item, known, KINDS)
    if owner in ("sensor", "camera"):
        hint = _camera_hint(known)
    if re.match(r"object_\d", item):
        hint = " Names like object_… contain memory addresses; here objects without an id get stable names."
    return (
        f"inputs={item!r} matches no parameter of the scene.{hint} "
        f"Kinds are {', '.join(KINDS)}; `scenecaptum parameters SCENE`, in Python parameters_table(), lists every "
        "name."
    )


def _naming_poses(parameters: SceneParameters, item: str, poses: list[str]) -> str:
    """Return what selects the poses that a glob matches which does not name them."""
    if all(parameters[name].kind == CAMERA for name in poses):
        return CAMERA
    owner, _, rest = item.partition(".")
    glob = f"{owner}.pose.{rest or '*'}"
    return glob if any(fnmatchcase(name, glob) for name in parameters) else poses[0]


def near_names(item: str, known: Sequence[str], kinds: Sequence[str] = ()) -> str:
    """Return ``' Did you mean …?'`` for the names and kinds closest to a name.

    For a glob it suggests the globs with another owner that match something, and else the closest names; for the
    name of an object, a glob for all that it has.
    """
    if (kind := f"{item.lower()}s") in kinds:
        return f" Did you mean {kind!r}?"
    if any(name.startswith(f"{item}.") for name in known):
        return f" Did you mean '{escape(item)}.*'?"
    rest = item.partition(".")[2]
    globs = {f"{escape(name.partition('.')[0])}.{rest}" for name in known} if "*" in rest else set[str]()
    matching = [glob for glob in sorted(globs) if any(_selects(glob, name) for name in known)]
    return near_misses(item, matching, instead=near_misses(item, [*kinds, *known]))


def _selects(glob: str, name: str) -> bool:
    """Whether a glob selects the parameter of a name: poses only where it names them."""
    is_pose = ".pose." in name or name.startswith("camera.")
    return fnmatchcase(name, glob) and (not is_pose or "pose" in glob or "fov" in glob)


def _camera_hint(known: Sequence[str]) -> str:
    """Name the parameters that stand for the camera in place of those of Mitsuba's sensor."""
    names = [name for name in known if name.startswith("camera.")]
    return f" Select the camera as {', '.join(names)}, or all of these as 'camera'." if names else ""
