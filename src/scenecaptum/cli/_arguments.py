"""Arguments shared by several commands, and the renderer and metrics created from them."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import metrics
from ..errors import SceneCaptumError, near_misses
from ..estimation import Metric
from ..rendering import SceneRenderer

GLARE = {
    "ugr": metrics.UnifiedGlareRating,
    "dgp": metrics.DaylightGlareProbability,
    "dgi": metrics.DaylightGlareIndex,
}
METRICS = ("luminance", *GLARE)
METRIC_HELP = f"{', '.join(METRICS)}, or your own function as FILE.py:NAME or MODULE:NAME"


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene and the render options."""
    parser.add_argument("scene", help="a Mitsuba XML file, or a bundled scene: office, cornell-box")
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        type=definition,
        dest="parameters",
        metavar="NAME=VALUE",
        help="set the parameter $NAME of the scene file, such as -D spp=64; may be repeated",
    )
    parser.add_argument(
        "--inputs",
        action="append",
        metavar="SELECTION",
        help="parameters to differentiate: materials, reflectance, roughness, ior, opacity, textures, emitters, "
        "media, all, a glob or a name; may be repeated (default: all)",
    )
    parser.add_argument(
        "--sensor",
        default="0",
        metavar="SENSOR",
        help="index of the sensor in the scene, or fisheye for a 180° fisheye at its position (default: 0)",
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
        help="maximum path depth in segments, -1 for no limit (default: 6)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="DIR",
        help="folder that stores every finished replicate; rerun the same command to resume a killed job",
    )


def add_metric(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the metric as ``metric``, or several metrics as ``metrics``, and their options."""
    if several:
        parser.add_argument(
            "--metric",
            action="append",
            dest="metrics",
            metavar="METRIC",
            help=f"{METRIC_HELP}; may be repeated (default: luminance)",
        )
    else:
        parser.add_argument(
            "--metric", default="luminance", metavar="METRIC", help=f"{METRIC_HELP} (default: luminance)"
        )
    parser.add_argument(
        "--threshold-factor",
        type=float,
        metavar="X",
        help="for glare ratings: sources are brighter than X times the mean luminance (default: 2000 cd/m²)",
    )
    parser.add_argument(
        "--target",
        type=int,
        help="element of the metric to attribute, if it returns a vector",
        metavar="INDEX",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options for results and progress."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        metavar="DIR",
        help="output folder (default: out)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--no-progress", action="store_true", help="disable the progress bar")


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


def shows_progress(options: argparse.Namespace) -> bool:
    """Whether to show a progress bar: on a terminal, unless disabled."""
    return sys.stderr.isatty() and not options.no_progress


def make_renderer(options: argparse.Namespace) -> SceneRenderer:
    """Create the renderer from the arguments."""
    return SceneRenderer(
        options.scene,
        options.inputs or "all",
        resolution=options.resolution,
        spp=options.spp,
        max_depth=options.max_depth,
        sensor=int(options.sensor) if options.sensor.isdigit() else options.sensor,
        parameters=dict(options.parameters or ()),
    ).with_checkpoint(options.checkpoint)


def print_resumed(renderer: SceneRenderer) -> None:
    """Print how many replicates came from the checkpoint, if there is one."""
    if (checkpoint := renderer.checkpoint) is not None:
        count = checkpoint.reused + checkpoint.rendered
        print(f"resumed: {checkpoint.reused} of {count} passes from {checkpoint.folder}")


def find_metrics(
    names: list[str], threshold_factor: float | None
) -> dict[str, Callable[[SceneRenderer], Metric]]:
    """Return a function for each metric that creates it for a renderer; raise for names that are unknown."""
    if threshold_factor is not None and not GLARE.keys() & set(names):
        raise SceneCaptumError(
            f"--threshold-factor needs a glare rating: add --metric {' or '.join(GLARE)}, or remove it."
        )
    return {name: _metric(name, threshold_factor) for name in names}


def _metric(name: str, threshold_factor: float | None) -> Callable[[SceneRenderer], Metric]:
    """Return a function that creates the named metric, or the user's function, for a renderer."""
    if name in GLARE:
        return lambda renderer: GLARE[name](renderer.camera, threshold_factor=threshold_factor)
    if name == "luminance":
        return lambda _: metrics.MeanLuminance()
    module, separator, attribute = name.rpartition(":")
    if not separator:
        raise SceneCaptumError(
            f"There is no metric {name!r}.{near_misses(name, METRICS)} "
            f"Use {', '.join(METRICS)}, or your own function as FILE.py:NAME or MODULE:NAME."
        )
    try:
        imported = getattr(_import(module), attribute)
    except Exception as error:  # the user's code may raise anything
        raise SceneCaptumError(
            f"The metric {name!r} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    metric: Metric = imported() if isinstance(imported, type) else imported
    if not callable(metric):
        raise SceneCaptumError(f"The metric {name!r} is {type(metric).__name__}, not a function of an image.")
    return lambda _: metric


def _import(name: str) -> Any:
    """Import a module by its name, or by its path if it ends in ``.py``."""
    if not name.endswith(".py"):
        return importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(Path(name).stem, name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
