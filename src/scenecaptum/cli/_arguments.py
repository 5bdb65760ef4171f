"""Arguments shared by several commands, and the renderer created from them."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..rendering import SceneRenderer, named_sensors
from ..scene import BUNDLED


def add_file(parser: argparse.ArgumentParser) -> None:
    """Add the scene alone."""
    parser.add_argument("scene", help=f"a Mitsuba XML file, or a bundled scene: {', '.join(BUNDLED)}")
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        type=definition,
        dest="parameters",
        metavar="NAME=VALUE",
        help="set the parameter $NAME of the scene file, such as -D spp=64; may be repeated",
    )


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the scene and the render options."""
    add_file(parser)
    parser.add_argument(
        "--sensor",
        default="0",
        metavar="SENSOR",
        help="index of the sensor in the scene, or a sensor with the pose of the first: "
        f"{describe(named_sensors())} (default: %(default)s)",
    )
    parser.add_argument(
        "--resolution", type=resolution, metavar="WxH", help="for example 320x180 (default: the scene's own)"
    )
    parser.add_argument(
        "--spp", type=int, metavar="N", help="total samples per pixel (default: the scene's own)"
    )
    parser.add_argument(
        "--max-depth",
        type=int,
        default=6,
        metavar="N",
        help="maximum path depth in segments, -1 for no limit (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene, the render options, the parameters to differentiate and the checkpoint."""
    add_view(parser)
    add_inputs(parser)
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="DIR",
        help="folder that stores every finished replicate; rerun the same command to resume a killed job",
    )


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the parameters to differentiate."""
    parser.add_argument(
        "--inputs",
        action="append",
        metavar="SELECTION",
        help="parameters to differentiate: materials, reflectance, roughness, ior, opacity, textures, emitters, "
        "media, all, a glob or a name; may be repeated (default: all)",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options for results and progress."""
    parser.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="output folder (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--no-progress", action="store_true", help="disable the progress bar")


def describe(registry: Mapping[str, Any]) -> str:
    """Return the names of a registry and what they stand for, for a help text."""
    return ", ".join(f"{name} ({entry.description})" for name, entry in registry.items()).replace("%", "%%")


def default_of(function: Callable[..., Any], parameter: str) -> Any:
    """Return the default of a function's parameter, for the option that sets it."""
    return inspect.signature(function).parameters[parameter].default


def resolution(text: str) -> tuple[int, int]:
    """Parse ``320x180``."""
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 320x180")
    return int(width), int(height)


def sensor_of(options: argparse.Namespace) -> int | str:
    """Return the index or the type of the sensor."""
    chosen: str = options.sensor
    return int(chosen) if chosen.isdigit() else chosen


def definition(text: str) -> tuple[str, str]:
    """Parse ``spp=64``."""
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as spp=64")
    return name, value


def shows_progress(options: argparse.Namespace) -> bool:
    """Whether to show a progress bar: on a terminal, unless disabled."""
    return sys.stderr.isatty() and not options.no_progress


def make_renderer(options: argparse.Namespace) -> SceneRenderer:
    """Create the renderer from the arguments."""
    return SceneRenderer(
        options.scene,
        getattr(options, "inputs", None) or "all",
        resolution=options.resolution,
        spp=options.spp,
        max_depth=options.max_depth,
        sensor=sensor_of(options),
        parameters=dict(options.parameters or ()),
    ).with_checkpoint(getattr(options, "checkpoint", None))


def print_resumed(renderer: SceneRenderer) -> None:
    """Print how many replicates came from the checkpoint, if there is one."""
    if (checkpoint := renderer.checkpoint) is not None:
        count = checkpoint.reused + checkpoint.rendered
        print(f"resumed: {checkpoint.reused} of {count} passes from {checkpoint.folder}")
