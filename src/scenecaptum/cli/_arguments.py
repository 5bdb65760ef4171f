"""The arguments that several commands share, and what is made of them: the renderer and the metrics."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import metrics
from ..attr._metric import Metric
from ..errors import SceneCaptumError, near_misses
from ..rendering import SceneRenderer

GLARE = {
    "ugr": metrics.UnifiedGlareRating,
    "dgp": metrics.DaylightGlareProbability,
    "dgi": metrics.DaylightGlareIndex,
}
METRICS = ("luminance", *GLARE)
METRIC_HELP = f"{', '.join(METRICS)}, or a function of yours as FILE.py:NAME or MODULE:NAME"


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene, and how it is rendered."""
    parser.add_argument("scene", help="a Mitsuba XML file, or a bundled scene: office, cornell-box")
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        type=definition,
        dest="parameters",
        metavar="NAME=VALUE",
        help="value of a $NAME in the scene file, such as -D spp=64; may be repeated",
    )
    parser.add_argument(
        "--inputs",
        action="append",
        metavar="SELECTION",
        help="what is differentiated: materials, reflectance, roughness, ior, opacity, textures, emitters, media, "
        "all, a glob or a name; may be repeated (default: all)",
    )
    parser.add_argument(
        "--sensor",
        default="0",
        metavar="SENSOR",
        help="index of the scene's sensor, or fisheye: a 180° fisheye in its place (default: 0)",
    )
    parser.add_argument(
        "--resolution", type=resolution, metavar="WxH", help="for example 320x180 (default: the scene's own)"
    )
    parser.add_argument(
        "--spp", type=int, metavar="N", help="samples per pixel in all (default: the scene's own)"
    )
    parser.add_argument(
        "--max-depth",
        type=int,
        default=6,
        metavar="N",
        help="longest path in segments, -1 for no limit (default: 6)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="(default: 0)")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="DIR",
        help="folder that keeps every finished pass: the same command resumes a job that was killed",
    )


def add_metric(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the metric as ``metric``, or several of them as ``metrics``, and what may be said about it."""
    if several:
        parser.add_argument(
            "--metric",
            action="append",
            dest="metrics",
            metavar="METRIC",
            help=f"{METRIC_HELP}; give it several times for several metrics (default: luminance)",
        )
    else:
        parser.add_argument(
            "--metric", default="luminance", metavar="METRIC", help=f"{METRIC_HELP} (default: luminance)"
        )
    parser.add_argument(
        "--threshold-factor",
        type=float,
        metavar="X",
        help="for glare ratings: a source is brighter than X times the mean luminance (default: than 2000 cd/m²)",
    )
    parser.add_argument(
        "--target", type=int, help="which element, where the metric returns a vector", metavar="INDEX"
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add where the results go, and what is shown meanwhile."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        metavar="DIR",
        help="folder for the results (default: out)",
    )
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON instead of a table")
    parser.add_argument("--no-progress", action="store_true", help="show no progress bar")


def resolution(text: str) -> tuple[int, int]:
    """Read ``320x180``."""
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 320x180")
    return int(width), int(height)


def definition(text: str) -> tuple[str, str]:
    """Read ``spp=64``."""
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as spp=64")
    return name, value


def shows_progress(options: argparse.Namespace) -> bool:
    """Whether there is somebody to watch a progress bar."""
    return sys.stderr.isatty() and not options.no_progress


def make_renderer(options: argparse.Namespace) -> SceneRenderer:
    """Load the scene as the arguments say."""
    return SceneRenderer(
        options.scene,
        options.inputs or "all",
        resolution=options.resolution,
        spp=options.spp,
        max_depth=options.max_depth,
        sensor=int(options.sensor) if options.sensor.isdigit() else options.sensor,
        parameters=dict(options.parameters or ()),
    ).with_checkpoint(options.checkpoint)


def say_resumed(renderer: SceneRenderer) -> None:
    """Print how many passes came from the checkpoint, where there is one."""
    if (kept := renderer.checkpoint) is not None:
        print(f"resumed: {kept.reused} of {kept.reused + kept.rendered} passes from {kept.folder}")


def find_metrics(
    names: list[str], threshold_factor: float | None
) -> dict[str, Callable[[SceneRenderer], Metric]]:
    """Return what creates each metric for a renderer, before any scene is loaded."""
    if threshold_factor is not None and not GLARE.keys() & set(names):
        raise SceneCaptumError(
            f"--threshold-factor belongs to a glare rating: add --metric {' or '.join(GLARE)}, or leave it out."
        )
    return {name: _metric(name, threshold_factor) for name in names}


def _metric(name: str, threshold_factor: float | None) -> Callable[[SceneRenderer], Metric]:
    """Return what creates a metric for a renderer, by the metric's name, or a function of the user's."""
    if name in GLARE:
        return lambda renderer: GLARE[name](renderer.camera, threshold_factor=threshold_factor)
    if name == "luminance":
        return lambda _: metrics.MeanLuminance()
    place, separator, attribute = name.rpartition(":")
    if not separator:
        raise SceneCaptumError(
            f"There is no metric {name!r}.{near_misses(name, METRICS)} "
            f"Metrics are {', '.join(METRICS)}; your own goes by FILE.py:NAME or MODULE:NAME."
        )
    try:
        found = getattr(_import(place), attribute)
    except Exception as error:  # whatever the user's file raises, it is the user's file that is named
        raise SceneCaptumError(
            f"The metric {name!r} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    metric: Metric = found() if isinstance(found, type) else found
    if not callable(metric):
        raise SceneCaptumError(f"The metric {name!r} is {type(metric).__name__}, not a function of an image.")
    return lambda _: metric


def _import(place: str) -> Any:
    if not place.endswith(".py"):
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    if spec is None or spec.loader is None:
        raise ImportError(place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
