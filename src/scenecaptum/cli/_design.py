"""A design: values of parameters that replace the scene's own, from ``--set`` and from a JSON or TOML file."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses
from ..rendering import SceneRenderer


def add_design(parser: argparse.ArgumentParser) -> None:
    """Add the options for values that replace the scene's own."""
    parser.add_argument(
        "--set",
        action="append",
        type=assignment,
        dest="settings",
        metavar="NAME=VALUE",
        help="give a parameter another value, a number or one for each channel, such as "
        "--set desk.base_color.value=0.2,0.2,0.2; a texture gets it in every texel; NAME+=VALUE adds to the "
        "value, NAME*=VALUE multiplies it, within the physical bounds; may be repeated",
    )
    parser.add_argument(
        "--design",
        type=Path,
        metavar="FILE",
        help="JSON or TOML file with the values of parameters by name; --set takes precedence",
    )


# Operators: the last character of a name, as in NAME*=0.5 and in the JSON {"NAME*": 0.5}.
CHANGES: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "+": torch.Tensor.add,
    "*": torch.Tensor.mul,
}


def assignment(text: str) -> tuple[str, list[float]]:
    """Parse ``desk.base_color.value=0.2,0.2,0.2``."""
    name, separator, value = text.partition("=")
    try:
        numbers = [float(number) for number in value.split(",")]
    except ValueError:
        numbers = []
    if not (name and separator and numbers):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not NAME=VALUE, such as desk.roughness.value=0.3, or VALUE,VALUE,VALUE for a colour"
        )
    return name, numbers


def designed_values(options: argparse.Namespace, renderer: SceneRenderer) -> dict[str, torch.Tensor] | None:
    """Return the renderer's inputs with the values of the design, or None without one."""
    settings: dict[str, Any] = dict(read_design(options.design)) if options.design else {}
    settings |= dict(options.settings or ())
    return design_of(renderer, settings) if settings else None


def design_of(renderer: SceneRenderer, settings: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the renderer's inputs with other values by name, or with changes by name and operator."""
    values = renderer.inputs
    for key, value in settings.items():
        change = None if key in values else CHANGES.get(key[-1:])
        name = key if change is None else key[:-1]
        if name not in values:
            raise SceneCaptumError(
                f"The design sets {name!r}, which is not an input.{near_misses(name, values)} "
                "`scenecaptum parameters SCENE` lists them."
            )
        given = _like(name, value, values[name])
        values[name] = given if change is None else change(values[name], given)
        if change is not None:
            renderer.clamp_({name: values[name]})
    return values


def read_design(path: Path) -> Mapping[str, Any]:
    """Read a file of names and values; tables in TOML are parts of names."""
    parse = _toml_parser() if path.suffix == ".toml" else json.loads
    try:
        found = parse(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneCaptumError(f"The design {path} cannot be read: {error.strerror}.") from error
    except ValueError as error:  # of JSON and of TOML
        kind = "TOML" if path.suffix == ".toml" else "JSON"
        raise SceneCaptumError(f"The design {path} is not valid {kind}: {error}.") from error
    if not isinstance(found, dict):
        raise SceneCaptumError(
            f'The design {path} must be names with values, such as {{"desk.roughness.value": 0.3}}.'
        )
    return _flat(found)


def _toml_parser() -> Callable[[str], Any]:
    try:
        import tomllib
    except ImportError as error:
        raise SceneCaptumError(
            "Designs in TOML need Python 3.11 or newer: write the design as JSON."
        ) from error
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
