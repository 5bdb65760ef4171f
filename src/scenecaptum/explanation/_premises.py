"""What values at points and values of daylight take for granted: where the points are, and the sky above them."""

from __future__ import annotations

import torch

from ..daylight import DaylightMetric
from ..estimation import Metric
from ..grid import GridPoints
from ..rendering import SceneRenderer
from ..visualization import advised, rounded

MADE_UP = "made-up, of no real place; the results hold for your place only with its own weather file"


def grid_premises(renderer: SceneRenderer) -> tuple[str, ...]:
    """Return a line that says where the points of a grid over a floor are; none of other sensors.

    Cautions say where points are right below a table top, or most of them below neither a ceiling nor glass.
    """
    if not renderer.has_grid or not renderer.grid.sides:
        return ()
    points = renderer.grid
    lines = [f"grid: {grid_size(points)}, if the scene's unit is the metre"]
    count = int(points.inside.sum())
    if points.covered:
        finding = (
            f"caution: {points.covered} of the {count} points lie right below a surface that blocks their light, "
            "such as a table top, and count"
        )
        lines.append(advised(finding, "choose another height of the grid", ": "))
    if 2 * points.open_above > count:
        finding = f"caution: {points.open_above} of the {count} points have nothing above them"
        finding += ", no ceiling and no glass"
        advice = "if they are to be in a room, choose a grid that is no larger than the room"
        lines.append(advised(finding, advice, ": "))
    return tuple(lines)


def depth_premises(renderer: SceneRenderer) -> tuple[str, ...]:
    """Return a line where paths are followed through more or fewer segments than the scene asks for."""
    own, used = renderer.plan.scene_depth, renderer.plan.max_depth
    if own is None or own == used:
        return ()
    if own != -1 and (used == -1 or own < used):
        return (f"light of paths of more than {own} segments is included, which the scene leaves out",)
    wanted = "any length" if own == -1 else f"up to {own}"
    return (f"light of paths of more than {used} segments is missing; the scene asks for {wanted}",)


def grid_size(points: GridPoints) -> str:
    """Return ``"63 points on floor_shape (parquet), 0.8 m above it, 7 × 5 m, 0.78 m apart"``, of two."""
    width, depth = (rounded(side) for side in points.sides)
    gaps = torch.cat([points.plan[0, :, 0].diff(), points.plan[:, 0, 1].diff()]).abs()
    apart = [f"{rounded(gaps.max().item(), 2)} m apart"] if len(gaps) else []
    size = [f"{rounded(points.above)} m above it", f"{width} × {depth} m", *apart]
    material = f" ({points.material})" if points.material else ""
    return f"{int(points.inside.sum())} points on {points.floor}{material}, {', '.join(size)}"


def sky_premises(metric: Metric, *, made_up: bool) -> tuple[str, ...]:
    """Return lines that say under which light a metric of daylight is computed; none for others.

    ``made_up`` says that the weather is the made-up year that stands for a file that was not given.
    """
    if not isinstance(metric, DaylightMetric):
        return ()
    weather = metric.sky.weather
    if weather is None:
        ground = f"the ground beyond the scene reflects {100 * metric.sky.ground_reflectance:.0f} %"
        return (
            f"sky: the CIE overcast sky; {ground}",
            "a daylight factor has no classes; the metric en17037 rates a room",
        )
    if made_up:
        return (f"weather: {MADE_UP}",)
    return (f"weather: {weather.place}, latitude {weather.latitude:g}°, longitude {weather.longitude:g}°",)
