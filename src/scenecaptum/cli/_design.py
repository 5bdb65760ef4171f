"""The options of a design: ``--set``, and a JSON or TOML file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from ..designs import CHANGES, design_of, read_design
from ..rendering import SceneRenderer
from ..scene import pose_component
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
    return design_of(renderer, settings) if settings else None


def designed_names(options: argparse.Namespace) -> list[str]:
    """Return the parameters that a design sets and that are inputs only if they are named.

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
