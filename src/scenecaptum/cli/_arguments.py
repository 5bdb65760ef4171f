"""Arguments shared by several commands, and the renderer created from them."""

from __future__ import annotations

import argparse
import functools
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from .. import daylight
from ..explanation import depth_premises
from ..rendering import SceneRenderer, named_sensors
from ..scene import BUNDLED
from ._design import design_settings, fixed_values
from ._once import Once, named_once
from ._points import Coefficients, chosen_sensor

MAX_DEPTH = 6


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
        action=Once,
        metavar="SENSOR",
        help="index or id of the sensor in the scene, or a sensor with the pose of the first: "
        f"{describe(named_sensors())} (default: 0)",
    )
    parser.add_argument(
        "--resolution",
        type=resolution,
        metavar="WxH",
        help="for example 320x180; the horizontal field of view stays the scene's (default: the scene's own)",
    )
    add_objects(parser)
    add_samples(parser)


def add_objects(parser: argparse.ArgumentParser) -> None:
    """Add the objects that move as one."""
    parser.add_argument(
        "--object",
        action="append",
        type=moving_object,
        dest="objects",
        metavar="NAME=SHAPES",
        help="move these shapes together, such as --object 'lamp=lamp_*,bulb'; NAME.pose.translation, "
        "NAME.pose.rotation (in radians) and NAME.pose.scale are then parameters for --inputs and --set; may "
        "be repeated (default: the shapes whose names begin with the same word)",
    )


def add_samples(parser: argparse.ArgumentParser) -> None:
    """Add the number of samples, the depth and the seed."""
    parser.add_argument(
        "--spp",
        type=int,
        metavar="N",
        help="total samples per pixel, at least: rounded up for each scene and step of a method (default: the "
        "scene's own)",
    )
    parser.add_argument(
        "--max-depth",
        type=int,
        metavar="N",
        help=f"maximum path depth in segments, -1 for no limit (default: {MAX_DEPTH}, and {daylight.DEPTH} for "
        "daylight, which crosses panes and several surfaces)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene, the render options, the parameters to differentiate and the checkpoint."""
    add_view(parser)
    add_inputs(parser, "all")


def add_inputs(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the parameters to differentiate, with their default in words, and the checkpoint."""
    parser.add_argument(
        "--inputs",
        action="append",
        metavar="SELECTION",
        help="parameters to differentiate: materials, reflectance, roughness, ior, opacity, surface (metallic, "
        "sheen, clearcoat, …), textures, emitters, media, poses, camera, all (except the last two), a glob or a "
        f"name; may be repeated (default: {default})",
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="DIR",
        help="folder that stores every finished replicate; rerun the same command to resume a killed job",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options for results and progress."""
    parser.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="output folder (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--no-progress", action="store_true", help="disable the progress bar")


def add_report(parser: argparse.ArgumentParser, content: str) -> None:
    """Add the options for the interactive page."""
    parser.add_argument("--report", action="store_true", help=f"also write report.html, {content}")
    add_title(parser)


def add_title(parser: argparse.ArgumentParser) -> None:
    """Add the heading of the interactive page."""
    parser.add_argument(
        "--title", metavar="TEXT", help="heading of the interactive page (default: the name of the scene)"
    )


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


def definition(text: str) -> tuple[str, str]:
    """Parse ``spp=64``."""
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as spp=64")
    return name, value


def moving_object(text: str) -> tuple[str, list[str]]:
    """Parse ``lamp=lamp_*,bulb``."""
    name, separator, shapes = text.partition("=")
    if not (name and separator and all(shapes.split(","))):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=SHAPE,SHAPE, such as 'lamp=lamp_*,bulb'")
    return name, shapes.split(",")


def add_no_progress(parser: argparse.ArgumentParser) -> None:
    """Add the option for a command without a progress bar, so that scripts can give it to every command."""
    parser.add_argument(
        "--no-progress",
        action="store_true",
        help="accepted as by the other commands; there is no progress bar",
    )


def shows_progress(options: argparse.Namespace) -> bool:
    """Whether to show a progress bar: on a terminal, unless disabled."""
    return sys.stderr.isatty() and not options.no_progress


def selection(options: argparse.Namespace) -> list[str]:
    """Return the parameters to differentiate."""
    return getattr(options, "inputs", None) or ["all"]


def make_renderer(
    options: argparse.Namespace,
    coefficients: Coefficients | None = None,
    fixed: Mapping[str, torch.Tensor] | None = None,
) -> SceneRenderer:
    """Create the renderer from the arguments; that of daylight coefficients, if a metric needs these.

    The scene has the fixed values, by default those that the design sets beside the inputs.
    """
    default_depth = MAX_DEPTH if coefficients is None else daylight.DEPTH
    create = functools.partial(
        SceneRenderer,
        options.scene,
        selection(options),
        objects=named_once(options.objects, "--object") or None,
        resolution=getattr(options, "resolution", None),
        spp=options.spp,
        max_depth=default_depth if options.max_depth is None else options.max_depth,
        sensor=chosen_sensor(options, coefficients),
        parameters=named_once(options.parameters, "-D"),
        sky_patches=None if coefficients is None else coefficients.patches,
        direct_sky=coefficients is not None and coefficients.direct,
    )
    renderer = create(values=fixed)
    if fixed is None and (fixed := fixed_values(options, renderer, design_settings(options))):
        renderer = create(values=fixed)
    if options.max_depth is None and coefficients is None:
        _say_depth(renderer)
    return renderer.with_checkpoint(getattr(options, "checkpoint", None))


def _say_depth(renderer: SceneRenderer) -> None:
    """Warn that the scene asks for another depth than that of the command, if it does."""
    for line in depth_premises(renderer):
        advice = f"For its own light use --max-depth {renderer.plan.scene_depth}"
        warnings.warn(f"{Path(renderer.name).name}: {line}. {advice}", stacklevel=3)


def print_resumed(renderer: SceneRenderer) -> None:
    """Print how many replicates came from the checkpoint, if there is one."""
    if (checkpoint := renderer.checkpoint) is not None:
        count = checkpoint.reused + checkpoint.rendered
        print(f"resumed: {checkpoint.reused} of {count} passes from {checkpoint.folder}")
