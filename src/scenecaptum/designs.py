"""Designs: values of parameters that replace a scene's own, by name or by glob, and files of them."""

from __future__ import annotations

import json
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
        A number, or one for each channel, by the name of an input or by a glob that several of them match. A last
        ``+`` or ``*`` adds to the value or multiplies it, within the physical bounds.

    Returns
    -------
    dict of str to Tensor
        All inputs, each in its own shape.

    Raises
    ------
    SceneCaptumError
        If a name matches no input, or a value does not have its shape.
    """
    values = dict(renderer.inputs)
    for key, value in settings.items():
        change = None if key in values else CHANGES.get(key[-1:])
        pattern = key if change is None else key[:-1]
        for name in _matching(pattern, key, values):
            given = _like(name, value, values[name])
            values[name] = given if change is None else change(values[name], given)
            if change is not None:
                renderer.clamp_({name: values[name]})
    return values


def _matching(pattern: str, key: str, values: Mapping[str, Any]) -> list[str]:
    """Return the names that are or match a pattern."""
    if pattern in values:
        return [pattern]
    found = [name for name in values if fnmatchcase(name, pattern)]
    if not found:
        change = "" if pattern == key else f" (its last {key[-1]} is an operator)"
        raise SceneCaptumError(
            f"The design sets {key!r}{change}, which is not an input.{near_misses(pattern, values)} "
            "`scenecaptum parameters SCENE` lists them."
        )
    return found


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
    """Return a value with the shape of the current one: a number, or one for each channel."""
    try:
        given = torch.tensor(value, dtype=current.dtype).squeeze()
        return given.expand(current.shape).clone()
    except (TypeError, ValueError, RuntimeError):
        channels = current.shape[-1] if current.ndim else 1
        raise SceneCaptumError(
            f"{name!r} needs one number{f' or {channels}' if channels > 1 else ''}, not {value!r}."
        ) from None
