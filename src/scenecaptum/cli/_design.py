"""The options of a design: ``--set``, and a JSON or TOML file."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ..designs import CHANGES, design_of, read_design
from ..errors import SceneCaptumError
from ..rendering import SceneRenderer
from ..scene import pose_component, select
from ._once import Once, named_once


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
        "value, NAME*=VALUE multiplies it, within the physical bounds; desk.pose.translation=0.3,0,0 moves an "
        "object by units of the scene, desk.pose.rotation=0,0,0.5 turns it by radians; may be repeated",
    )
    parser.add_argument(
        "--design",
        action=Once,
        type=Path,
        metavar="FILE",
        help="JSON or TOML file with the values of parameters by name; --set takes precedence",
    )


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
    settings = design_settings(options)
    if not settings:
        return None
    values = whole_design(options, renderer, settings)
    return {name: values[name] for name in renderer.inputs}


def whole_design(
    options: argparse.Namespace, renderer: SceneRenderer, settings: Mapping[str, Any]
) -> dict[str, torch.Tensor]:
    """Return the renderer's inputs, and what a design names beside them, with the values of the settings."""
    return design_of(_Settable(renderer, designed_names(options)), settings)


def fixed_values(
    options: argparse.Namespace, renderer: SceneRenderer, settings: Mapping[str, Any]
) -> dict[str, torch.Tensor]:
    """Return what the settings change beside the renderer's inputs: values that stay fixed."""
    inputs, values = renderer.inputs, whole_design(options, renderer, settings)
    fixed = {
        name: value
        for name, value in values.items()
        if name not in inputs and not torch.equal(value, renderer.own_value(name))
    }
    _check_parts(renderer, fixed)
    return fixed


def _check_parts(renderer: SceneRenderer, fixed: Collection[str]) -> None:
    """Raise if a whole is turned for good, and a part of it is to move: the axes of a part turn with its whole."""
    shapes = {name: set(one.shapes) for name, one in renderer.parameters.items() if pose_component(name)}
    for whole in fixed:
        parts = [
            name for name in renderer.inputs if name in shapes and shapes[name] < shapes.get(whole, set())
        ]
        if parts and pose_component(whole) in ("rotation", "scale"):
            raise SceneCaptumError(
                f"The design sets {whole!r}, and {parts[0]!r} moves a part of it along axes that the whole turns: "
                f"select both, with --inputs {whole}."
            )


class _Settable:
    """What a design may set: the inputs of a renderer, and other parameters by name."""

    def __init__(self, renderer: SceneRenderer, names: Sequence[str]) -> None:
        beside = select(renderer.parameters, names) if names else ()
        self.parameters, self.clamp_ = renderer.parameters, renderer.clamp_
        self.inputs = {**{name: renderer.own_value(name) for name in beside}, **renderer.inputs}


def designed_names(options: argparse.Namespace) -> list[str]:
    """Return the parameters that a design may set without being inputs: it has to name them.

    These are the poses, and beside other ``--inputs`` all of them. Globs match what is selected.
    """
    origin, inputs = (getattr(options, name, None) for name in ("origin", "inputs"))
    settings = {**design_settings(options), **(read_design(origin) if origin else {})}
    names = [name.rstrip("".join(CHANGES)) for name in settings]
    return [
        name
        for name in dict.fromkeys(names)
        if pose_component(name) or (inputs and not set("*?[") & set(name))
    ]


def design_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the values of a design by name; none if the command has no options for them."""
    design = getattr(options, "design", None)
    settings: dict[str, Any] = dict(read_design(design)) if design else {}
    return settings | named_once(getattr(options, "settings", None), "--set")
