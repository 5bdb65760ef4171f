"""The metrics of a command: those of the registries of metrics and of daylight, and the user's own functions."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

from .. import daylight
from ..daylight import Weather
from ..errors import SceneCaptumError, near_misses
from ..estimation import Metric
from ..metrics import BY_NAME, import_metric
from ..rendering import SceneRenderer
from ._arguments import describe
from ._once import Once
from ._points import add_points, read_weather

DEFAULT = "luminance"
OPTIONS = ("threshold_factor", "smoothing")  # passed to the metrics that have a parameter of this name
OWN = "your own function as FILE.py:NAME or MODULE:NAME"


def add_metric(parser: argparse.ArgumentParser, *, several: bool = False, of_daylight: bool = False) -> None:
    """Add the metric as ``metric``, or several metrics as ``metrics``, and their options."""
    kind: dict[str, Any] = (
        {"action": "append", "dest": "metrics"} if several else {"action": Once, "default": DEFAULT}
    )
    known = (
        f"{describe(BY_NAME)}, of daylight {describe(daylight.BY_NAME)}" if of_daylight else describe(BY_NAME)
    )
    parser.add_argument(
        "--metric",
        metavar="METRIC",
        help=f"{known}, or {OWN}{'; may be repeated' if several else ''} (default: {DEFAULT})",
        **kind,
    )
    parser.add_argument(
        "--threshold-factor",
        type=float,
        metavar="X",
        help=f"for {_list_taking('threshold_factor', ' and ')}: glare sources are brighter than X times the mean "
        "luminance (default: 2000 cd/m²)",
    )
    parser.add_argument(
        "--smoothing",
        type=float,
        metavar="SIGMA",
        help=f"for {_list_taking('smoothing', ' and ')}: average over noise of the picture, whose gradient has "
        "smaller errors; 0.3 is usual (default: none)",
    )
    parser.add_argument(
        "--target",
        action=Once,
        type=_index_or_name,
        help="element of the metric to attribute, if it returns a vector: its index, or the name of a class",
        metavar="ELEMENT",
    )
    if of_daylight:
        add_points(parser)


def _index_or_name(text: str) -> int | str:
    try:
        return int(text)
    except ValueError:
        return text


def find_metrics(
    names: list[str], options: argparse.Namespace
) -> Mapping[str, Callable[[SceneRenderer], Metric]]:
    """Return a function for each metric that creates it for a renderer; raise for names that are unknown."""
    given = {name: value for name in OPTIONS if (value := getattr(options, name)) is not None}
    weather = cache(lambda: read_weather(options))  # once for all metrics, and before the scene
    found = {name: _creator(name, given, options, weather) for name in names}
    for option in given:
        if not any(name in BY_NAME and option in BY_NAME[name].parameters for name in names):
            own = (
                f", write ClassLogit(…, {option}=…) in the file of your metric"
                if option == "smoothing" and any(":" in name for name in names)
                else ""
            )
            raise SceneCaptumError(
                f"--{option.replace('_', '-')} has no effect on {', '.join(names)}: add "
                f"--metric {_list_taking(option, ' or ')}{own}, or remove it."
            )
    return found


def _list_taking(option: str, conjunction: str) -> str:
    """Return the names of the metrics that an option applies to, as in ``a, b and c``."""
    *names, last = (name for name, metric in BY_NAME.items() if option in metric.parameters)
    return conjunction.join(filter(None, [", ".join(names), last]))


def _creator(
    name: str, given: Mapping[str, Any], options: argparse.Namespace, weather: Callable[[], Weather]
) -> Callable[[SceneRenderer], Metric]:
    """Return a function that creates a metric for a renderer."""
    if name in BY_NAME:
        return partial(BY_NAME[name].create_for, options=given)
    if name in daylight.BY_NAME:
        if not hasattr(options, "weather"):
            raise SceneCaptumError(
                f"{name} is a metric of daylight: use daylight, explain, attribute, compare or validate."
            )
        return partial(create_of_daylight, name, weather(), options.north)
    return partial(_return, _import_metric(name))


def create_of_daylight(name: str, weather: Weather, north: float | None, renderer: SceneRenderer) -> Metric:
    """Return a metric of daylight for a renderer of coefficients."""
    assert renderer.sky_patches is not None, "needed_coefficients asks for them"
    metric = daylight.BY_NAME[name]
    return metric.create(metric.sky(weather, renderer.sky_patches, north or 0.0))


def _return(metric: Metric, _: SceneRenderer) -> Metric:
    return metric


def _import_metric(name: str) -> Metric:
    """Import the user's metric."""
    if ":" not in name:
        raise SceneCaptumError(
            f"There is no metric {name!r}.{near_misses(name, [*BY_NAME, *daylight.BY_NAME])} Use "
            f"{', '.join(BY_NAME)}, of daylight {', '.join(daylight.BY_NAME)}, or {OWN}."
        )
    return import_metric(name)
