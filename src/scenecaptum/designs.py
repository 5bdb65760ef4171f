"""Designs: values of parameters that replace a scene's own, by name or by glob, and files of them."""

from __future__ import annotations

import json
import math
import reprlib
import warnings
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import torch

from .errors import SceneCaptumError, near_misses
from .protocols import Adjustable

# Operators: the last character of a name, as in NAME*=0.5 and in the JSON {"NAME*": 0.5}.
CHANGES: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "+": torch.Tensor.add,
    "*": torch.Tensor.mul,
}


def design_of(renderer: Adjustable, settings: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the renderer's inputs with other values by name, or with changes by name and operator.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(8, 8))
    >>> design_of(renderer, {"*_wall.reflectance.value*": 0.5})["left_wall.reflectance.value"].tolist()
    [0.285..., 0.021..., 0.022...]

    Parameters
    ----------
    renderer
        Has the inputs, and their bounds.
    settings
        A number, one for each channel, or one for each texel and channel, by the name of an input or by a glob
        that several of them match. A last ``+`` or ``*`` adds to the value or multiplies it, within the physical
        bounds.

    Returns
    -------
    dict of str to Tensor
        All inputs, each in its own shape.

    Raises
    ------
    SceneCaptumError
        If a name matches no input, or a value does not have its shape.
    """
    values, parameters = dict(renderer.inputs), getattr(renderer, "parameters", {})
    for key, value in settings.items():
        change = None if key in values else CHANGES.get(key[-1:])
        pattern = key if change is None else key[:-1]
        for name in _matching(pattern, key, values, parameters):
            given = _like(name, value, values[name])
            values[name] = given if change is None else change(values[name], given)
            if change is not None:
                renderer.clamp_({name: values[name]})
            if getattr(parameters.get(name), "unit", "") == "rad" and values[name].norm() > 2 * math.pi:
                warnings.warn(
                    f"{name!r} turns by {values[name].norm():.3g} rad, more than once around: rotations are in "
                    "radians.",
                    stacklevel=2,
                )
    return values


def _matching(pattern: str, key: str, values: Mapping[str, Any], parameters: Mapping[str, Any]) -> list[str]:
    """Return the names that are or match a pattern; ``parameters`` of the scene may not be selected as inputs."""
    if pattern in values:
        return [pattern]
    found = [name for name in values if fnmatchcase(name, pattern)]
    if not found:
        change = "" if pattern == key else f" (its last {key[-1]} is an operator)"
        if unselected := next((name for name in parameters if fnmatchcase(name, pattern)), None):
            matched = f"The design sets {key!r}{change}, which matches {unselected!r}, but that"
            kind, problem = parameters[unselected].kind, getattr(parameters[unselected], "problem", None)
            if problem:
                raise SceneCaptumError(f"{matched} cannot be an input: {problem}.")
            raise SceneCaptumError(f'{matched} is not selected as an input: inputs="{kind}" selects it.')
        hint = parameters.hint(pattern) if hasattr(parameters, "hint") else ""  # of what the scene has
        raise SceneCaptumError(
            f"The design sets {key!r}{change}, which is not an input.{hint or near_misses(pattern, values)} "
            "`scenecaptum parameters SCENE` lists them."
        )
    return found


def settings_of(renderer: Adjustable, values: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    """Return what ``design_of`` turns into these values: those that are not the scene's own, as plain numbers.

    Those of parameters that are no inputs are all written. A texture that has moved as a whole is written as the
    change of each channel (``NAME+``), one that is brighter or darker as a whole as a factor (``NAME*``), and any
    other with all its texels.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(8, 8))
    >>> settings_of(renderer, {"floor.reflectance.value": torch.tensor([0.5, 0.25, 0.25])})
    {'floor.reflectance.value': [0.5, 0.25, 0.25]}
    """
    own = renderer.inputs
    moved = {
        name: value.detach()
        for name, value in values.items()
        if name not in own or not torch.equal(value, own[name])
    }
    return dict(_setting(renderer, name, own.get(name), value) for name, value in moved.items())


def _setting(
    renderer: Adjustable, name: str, own: torch.Tensor | None, value: torch.Tensor
) -> tuple[str, Any]:
    if value.ndim <= 1 or own is None:
        return name, _plain(value)
    return change_of_texture(renderer, name, own, value) or (name, _plain(value))


def change_of_texture(
    renderer: Adjustable, name: str, before: torch.Tensor, after: torch.Tensor
) -> tuple[str, Any] | None:
    """Return what changes all texels alike, a name with ``+`` or ``*`` and numbers; None if nothing does."""
    old, new = before.double(), after.double()
    offset = (new - old).mean(tuple(range(old.ndim - 1)))
    factor = (old * new).sum() / old.square().sum().clamp_min(torch.finfo(torch.float64).tiny)
    for operator, change in (("+", offset), ("*", factor)):
        changed = {name: CHANGES[operator](before, change.to(before))}
        renderer.clamp_(changed)
        # Bounds of a search are narrower than the physical ones, so what it has clamped is neither.
        if torch.allclose(changed[name], after, rtol=1e-6, atol=1e-6):
            return f"{name}{operator}", _plain(change)
    return None


def _plain(value: torch.Tensor) -> Any:
    """Return numbers with the digits that single precision needs: a texture has many."""
    if value.ndim:
        return [_plain(entry) for entry in value]
    return float(f"{value.item():.9g}")


def read_design(path: Path) -> Mapping[str, Any]:
    """Read a JSON or TOML file of names and values; tables in TOML are parts of names.

    Raises
    ------
    SceneCaptumError
        If the file cannot be read, or is something else.
    """
    return _flat(read_table(path, "design"))


def read_table(path: Path, what: str) -> Mapping[str, Any]:
    """Read a JSON or TOML file, called ``what`` in errors, which are as for ``read_design``."""
    parse = _toml_parser() if path.suffix == ".toml" else json.loads
    try:
        found = parse(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneCaptumError(f"The {what} {path} cannot be read: {error.strerror}.") from error
    except ValueError as error:  # of JSON and of TOML
        kind = "TOML" if path.suffix == ".toml" else "JSON"
        raise SceneCaptumError(f"The {what} {path} is not valid {kind}: {error}.") from error
    if not isinstance(found, dict):
        raise SceneCaptumError(
            f'The {what} {path} must be names with values, such as {{"desk.roughness.value": 0.3}}.'
        )
    return found


def _toml_parser() -> Callable[[str], Any]:
    try:
        import tomllib
    except ImportError as error:
        raise SceneCaptumError("TOML needs Python 3.11 or newer: write the file as JSON.") from error
    return tomllib.loads


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def _like(name: str, value: Any, current: torch.Tensor) -> torch.Tensor:
    """Return a value with the shape of the current one: a number, one for each channel, or a whole texture."""
    try:
        given = torch.tensor(value, dtype=current.dtype)
        return given if given.shape == current.shape else given.squeeze().expand(current.shape).clone()
    except (TypeError, ValueError, RuntimeError):
        channels = current.shape[-1] if current.ndim else 1
        texels = f", or {' x '.join(map(str, current.shape))} in nested lists" if current.ndim > 1 else ""
        raise SceneCaptumError(
            f"{name!r} needs one number{f' or {channels}' if channels > 1 else ''}{texels}, not "
            f"{reprlib.repr(value)}."
        ) from None
