"""The metrics of a study: by name with options, or functions of the user."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .. import daylight, metrics
from ..daylight import SkyPatches, Weather, synthetic_weather
from ..errors import SceneCaptumError, near_misses
from ..estimation import Metric, Target, TargetedMetric
from ..grid import SensorGrid
from ..rendering import SceneRenderer

# Options of metrics of daylight; those of others are parameters of their classes.
SKY_OPTIONS = ("weather", "north", "subdivision")
DEPTH = 6  # of paths, in segments
OWN_OPTIONS = ("target",)  # of the user's own functions


def check_metric(name: str, metric: Any, options: Mapping[str, Any]) -> None:
    """Raise if a metric is unknown, or an option has no effect on it."""
    if not isinstance(metric, str):
        if not callable(metric):
            raise SceneCaptumError(
                f"The metric {name!r} must be a name or a function of an image, not {metric!r}."
            )
        known: Any = OWN_OPTIONS
    elif metric in metrics.BY_NAME:
        known = set(metrics.BY_NAME[metric].parameters) - {"camera", "grid"}
    elif metric in daylight.BY_NAME:
        known = SKY_OPTIONS
    elif ":" in metric:
        known = OWN_OPTIONS
    else:
        names = [*metrics.BY_NAME, *daylight.BY_NAME]
        raise SceneCaptumError(
            f"There is no metric {metric!r}.{near_misses(metric, names)} Use {', '.join(names)}, or your own "
            "function as FILE.py:NAME or MODULE:NAME."
        )
    for option in options.keys() - set(known):
        raise SceneCaptumError(f"{option!r} has no effect on the metric {name!r}: remove it.")


def check_camera(name: str, metric: Any, camera: Any) -> None:
    """Raise if a metric of daylight is to be measured in a picture."""
    is_grid = isinstance(camera, SensorGrid) or camera == "grid"
    if isinstance(metric, str) and metric in daylight.BY_NAME and not is_grid:
        raise SceneCaptumError(
            f'The metric {name!r} is one of points, and a camera shows a picture: give cameras = ["grid"]. '
            "Metrics of pictures need a study of their own."
        )


def default_depth(metric: Any) -> int:
    """Return the depth of the cells of a metric: light of the sky takes longer paths to the points of a room."""
    return daylight.DEPTH if isinstance(metric, str) and metric in daylight.BY_NAME else DEPTH


def check_element(name: str, metric: Any, options: Mapping[str, Any]) -> None:
    """Create a metric that needs no renderer, and raise if that fails or its target has no element."""
    try:
        created = _create_alone(metric, options)
        if created is not None:
            TargetedMetric(created, target_of(metric, options))
    except SceneCaptumError as error:
        raise SceneCaptumError(f"The metric {name!r} of the study: {error}") from error
    except Exception as error:  # whatever the user's class raises
        raise SceneCaptumError(
            f"The metric {name!r} of the study: {type(error).__name__}: {error}"
        ) from error


def _create_alone(metric: Any, options: Mapping[str, Any]) -> Metric | None:
    """Return a metric without a renderer; None if it needs one."""
    if not isinstance(metric, str):
        created: Metric = metric
        return created
    if metric in daylight.BY_NAME:
        return None
    if metric not in metrics.BY_NAME:
        return metrics.import_metric(metric)
    named = metrics.BY_NAME[metric]
    return None if {"camera", "grid"} & set(named.parameters) else named.create(**options)


def renderer_options_for(metric: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of the renderer that a metric needs: the coefficients of metrics of daylight."""
    if not isinstance(metric, str) or metric not in daylight.BY_NAME:
        return {}
    named = daylight.BY_NAME[metric]
    patches = SkyPatches(options.get("subdivision", named.subdivision))
    return {"sky_patches": patches, "direct_sky": named.direct}


def target_of(metric: Any, options: Mapping[str, Any]) -> Target:
    """Return the element to attribute of the user's own metric; a named metric is created with its element."""
    if isinstance(metric, str) and ":" not in metric:
        return None
    target = options.get("target")
    return tuple(target) if isinstance(target, list) else target  # TOML has no tuples


def create_metric(metric: Any, options: Mapping[str, Any], renderer: SceneRenderer) -> Metric:
    """Return a metric for a renderer with the options of ``renderer_options_for``."""
    if not isinstance(metric, str):
        created: Metric = metric
        return created
    if metric in metrics.BY_NAME:
        return metrics.BY_NAME[metric].create_for(renderer, options)
    if metric not in daylight.BY_NAME:
        return metrics.import_metric(metric)
    assert renderer.sky_patches is not None, "renderer_options_for asks for them"
    named, file = daylight.BY_NAME[metric], options.get("weather")
    weather = synthetic_weather() if file is None else Weather.from_epw(file)
    return named.create(named.sky(weather, renderer.sky_patches, options.get("north", 0.0)))
