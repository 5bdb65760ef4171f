"""Options of sensor grids and of daylight: where the points are, and what light reaches them."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..attr import SceneAttribution
from ..daylight import BY_NAME, SkyPatches, Weather, synthetic_weather
from ..errors import SceneCaptumError
from ..estimation import Metric
from ..explanation import grid_size, sky_premises
from ..grid import SensorGrid
from ..rendering import SceneRenderer
from ._once import Once

GRID, WEATHER, SKY = (
    ("height", "spacing", "margin", "floor", "rectangle"),
    ("weather", "north"),
    ("subdivision",),
)
MOST_POINTS = 2000  # of a floor: more take hours


@dataclass(frozen=True)
class Coefficients:
    """The daylight coefficients that a metric needs of a renderer: their patches, and whether of direct light."""

    patches: SkyPatches
    direct: bool


def add_points(parser: argparse.ArgumentParser) -> None:
    """Add the options of sensor grids and of daylight."""
    group = parser.add_argument_group("sensor grids and metrics of daylight")
    group.add_argument(
        "--spacing",
        type=float,
        metavar="X",
        help="largest distance between points (default: that of EN 12464-1)",
    )
    for name, text in (
        ("height", "height of the points above the floor"),
        (
            "margin",
            "distance of the points from the outline of the floor, at most a quarter of its shorter side",
        ),
    ):
        default = SensorGrid.__dataclass_fields__[name].default
        group.add_argument(f"--{name}", type=float, metavar="X", help=f"{text} (default: {default})")
    group.add_argument(
        "--floor",
        action=Once,
        metavar="NAME",
        help="the shape that is the floor, or the material of its pieces (default: the lowest large level shape)",
    )
    group.add_argument(
        "--rectangle",
        type=float,
        nargs=4,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="two corners in place of the outline of the floor: x and y of each, or x and z if y is up",
    )
    group.add_argument(
        "--weather",
        action=Once,
        type=Path,
        metavar="FILE",
        help="EnergyPlus weather file (.epw) of the place (default: a made-up year of no real place)",
    )
    group.add_argument(
        "--north",
        type=float,
        metavar="DEGREES",
        help="where the y axis of the scene points, or −z if y is up, clockwise from north: 90 for east "
        "(default: 0)",
    )
    group.add_argument(
        "--subdivision",
        type=int,
        metavar="N",
        help="of the patches of the sky: 1 for Tregenza's 145, 2 or 4 for Reinhart's finer ones (default: 1, and "
        "2 for ase)",
    )


def chosen_sensor(options: argparse.Namespace, coefficients: Coefficients | None) -> int | str | SensorGrid:
    """Return the sensor: that of ``--sensor``, or a grid, which daylight coefficients need."""
    named: str | None = getattr(options, "sensor", None)
    given = _given(options, GRID)
    if coefficients is None and named != "grid":
        if given:
            raise SceneCaptumError(
                f"{_list(given)} has no effect on a view: add --sensor grid, or remove it."
            )
        return int(named) if named is not None and named.isdigit() else named or 0
    if named not in (None, "grid"):
        raise SceneCaptumError(
            f"Metrics of daylight are measured at the points of a sensor grid, not by --sensor {named}: remove it."
        )
    if getattr(options, "resolution", None) is not None:
        raise SceneCaptumError("--resolution has no effect on a sensor grid: choose --spacing, or remove it.")
    if "rectangle" in given:
        x0, y0, x1, y1 = given["rectangle"]
        given["rectangle"] = ((x0, y0), (x1, y1))
    return SensorGrid(**given)


def needed_coefficients(names: list[str], options: argparse.Namespace) -> Coefficients | None:
    """Return the coefficients that all of some metrics need; None if none is one of daylight.

    Raises
    ------
    SceneCaptumError
        If metrics need different renderers, or an option has no effect on any.
    """
    check_options(names, options)
    needed = {name: coefficients_of(name, options) for name in names}
    of_daylight = [name for name in names if needed[name] is not None]
    if 0 < len(of_daylight) < len(names):
        others = [name for name in names if needed[name] is None]
        raise SceneCaptumError(
            f"{', '.join(of_daylight)} needs daylight coefficients of a sensor grid, and {', '.join(others)} a "
            "picture of the scene: run the command once for each."
        )
    if len(set(needed.values())) > 1:
        raise SceneCaptumError(
            f"{', '.join(names)} need different daylight coefficients, of direct light or of all: run the command "
            "once for each, or `scenecaptum daylight` with all of them."
        )
    return needed[names[0]]


def coefficients_of(name: str, options: argparse.Namespace) -> Coefficients | None:
    """Return the coefficients that a metric needs; None if it is not one of daylight."""
    if name not in BY_NAME:
        return None
    metric, given = BY_NAME[name], options.subdivision
    return Coefficients(SkyPatches(metric.subdivision if given is None else given), metric.direct)


def check_options(names: list[str], options: argparse.Namespace) -> None:
    """Raise if an option of daylight has no effect on any of some metrics."""
    of_daylight = [name for name in names if name in BY_NAME]
    if not of_daylight and (unused := _given(options, WEATHER + SKY)):
        raise SceneCaptumError(
            f"{_list(unused)} has no effect on {', '.join(names)}: remove it, or add a metric of daylight "
            f"(--metric {', '.join(BY_NAME)})."
        )
    needs_weather = any(BY_NAME[name].needs_weather for name in of_daylight)
    if of_daylight and not needs_weather and (unused := _given(options, WEATHER)):
        raise SceneCaptumError(
            f"{_list(unused)} has no effect on {', '.join(of_daylight)}, under an overcast sky: remove it."
        )


def read_weather(options: argparse.Namespace) -> Weather:
    """Return the weather of ``--weather``, or a made-up year."""
    return synthetic_weather() if options.weather is None else Weather.from_epw(options.weather)


def check_grid(renderer: SceneRenderer) -> None:
    """Raise if a sensor grid on a floor has more than 2000 points, which take hours."""
    if not renderer.has_grid or not renderer.grid.sides or renderer.grid.inside.sum() <= MOST_POINTS:
        return
    raise SceneCaptumError(
        f"The sensor grid has {grid_size(renderer.grid)}: too many, more than {MOST_POINTS}. Choose a "
        "larger --spacing, the part of the floor that is the room with --rectangle, or another floor with --floor."
    )


def check_report(renderer: SceneRenderer) -> None:
    """Raise if a report has nothing to show: an irradiance meter has neither a picture nor a plan."""
    if not (renderer.shows_a_view or renderer.has_grid):
        raise SceneCaptumError(
            "A report shows a picture or a plan, and an irradiancemeter has neither: use scenecaptum attribute or "
            "explain without --report, or another --sensor."
        )


def with_settings(
    attribution: SceneAttribution, renderer: SceneRenderer, options: argparse.Namespace
) -> SceneAttribution:
    """Return a result whose ``info`` has the settings of the grid and of daylight, too."""
    if not renderer.has_grid:
        return attribution
    given = {name: str(value) for name, value in _given(options, (*GRID, *WEATHER, *SKY)).items()}
    if renderer.grid.sides:
        given["sensor grid"] = grid_size(renderer.grid)
    return dataclasses.replace(attribution, info={**attribution.info, **given})


def premises(metric: Metric, options: argparse.Namespace) -> tuple[str, ...]:
    """Return lines that say under which light a metric of daylight was computed; none for others."""
    return sky_premises(metric, made_up=options.weather is None)


def _given(options: argparse.Namespace, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the options that were given, of those of a command that has them."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}


def _list(names: dict[str, Any]) -> str:
    return ", ".join(f"--{name}" for name in names)
