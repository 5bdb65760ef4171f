"""Where the points of a sensor grid are in a scene, and which of them are inside objects."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import torch

from ..errors import SceneCaptumError, near_misses
from ..grid import GridPoints, SensorGrid, en_12464_spacing

Array = npt.NDArray[np.float64]

MOST_MARGIN = 0.25  # of the shorter side of a floor: a small room would have no points otherwise
FACES_UP = 0.99  # cosine of the largest tilt of a floor
LISTED = 5  # shapes in a message
SAME_LEVEL = 0.01  # of the root of the area of a floor: its other pieces differ in height by less
LARGE = 0.5  # of the largest level shape: the lowest of those is the floor
FACING = math.cos(math.radians(45))
RAY_OFFSET = (
    1500 * 2.0**-24
)  # of a point from its surface, relative to 1 + its largest coordinate, as in Mitsuba
PROBES = 64  # rays from each point that tell whether it is inside an object
MOST_BACK_FACES = 0.9  # of the probes of a point in the open
RAISED_BY = 0.05  # m, from one height to the next that is tried above a table top
LEAST_ROOM = 0.15  # above a point, relative to its height: under a table top, say, nobody works


def place_grid(grid: SensorGrid, scene: Any) -> GridPoints:
    """Return the points of a grid in a scene.

    Raises
    ------
    SceneCaptumError
        If a shape does not exist or is no floor, no point is in the room, or points that are given are outside it
        or inside an object.
    """
    shapes = {shape.id(): shape for shape in scene.shapes()}
    if grid.points is not None and grid.normals is not None:
        return _given_points(grid.points, grid.normals, scene)
    if grid.surface is not None:
        return _surface_points(grid, _shape_of(shapes, grid.surface, "surface"))
    return _floor_points(grid, shapes, scene)


def _shape_of(shapes: Mapping[str, Any], name: str, option: str) -> Any:
    if name not in shapes:
        raise SceneCaptumError(
            f"SensorGrid({option}={name!r}): the scene has no shape of this name.{near_misses(name, shapes)}"
        )
    return shapes[name]


# --- Points on and above surfaces -----------------------------------------------------------------


def _given_points(points: torch.Tensor, normals: torch.Tensor, scene: Any) -> GridPoints:
    rows = (1, -1, 3) if points.ndim == 2 else points.shape
    positions = points.detach().cpu().double().reshape(rows)
    directions = torch.nn.functional.normalize(normals.detach().cpu().double().reshape(rows), dim=-1)
    outside = ~_within(scene, positions)
    if outside.any():
        raise SceneCaptumError(
            f"{_count(outside)} of the grid lie outside the scene's bounds, the first at "
            f"{_place(positions, outside)}. Move them into the room."
        )
    hidden = _hidden(scene, positions)
    if hidden.any():
        raise SceneCaptumError(
            f"{_count(hidden)} of the grid lie inside an object, the first at {_place(positions, hidden)}: every "
            "ray from there meets the back of a surface. Move them, or leave them out."
        )
    return GridPoints(
        positions, directions, torch.ones(positions.shape[:2], dtype=torch.bool), positions[..., :2]
    )


def _surface_points(grid: SensorGrid, shape: Any) -> GridPoints:
    """Return points that are spread over the area of a shape."""
    # Some are dropped where only one direction counts.
    tried = grid.count if grid.facing is None else 64 * grid.count
    samples = torch.quasirandom.SobolEngine(2, scramble=True, seed=0).draw(tried).T
    found = shape.sample_position(0.0, mi.Point2f(*(mi.Float(row.contiguous()) for row in samples)))
    positions, normals = (np.array(values, dtype=np.float64).T for values in (found.p, found.n))
    positions = positions + RAY_OFFSET * (1 + np.abs(positions).max(1, keepdims=True)) * normals
    if grid.facing is not None:
        wanted = np.asarray(grid.facing, dtype=np.float64)
        chosen = np.flatnonzero(normals @ wanted > FACING * np.linalg.norm(wanted))[: grid.count]
        if not chosen.size:
            raise SceneCaptumError(
                f"SensorGrid(surface={grid.surface!r}): no part of it faces {grid.facing}. Leave facing out, or "
                "give the opposite direction."
            )
        positions, normals = positions[chosen], normals[chosen]
    points, directions = (torch.from_numpy(values)[None] for values in (positions, normals))
    return GridPoints(points, directions, torch.ones(points.shape[:2], dtype=torch.bool), points[..., :2])


def _floor_points(grid: SensorGrid, shapes: Mapping[str, Any], scene: Any) -> GridPoints:
    up = up_axis(scene)
    across, along = _plan_axes(up)
    name, triangles = _floor(grid, shapes, up)
    level = float(triangles[..., up].max())
    outline = triangles[..., [across, along]]
    if grid.rectangle is not None:
        (x0, y0), (x1, y1) = grid.rectangle
        low, high = np.minimum((x0, y0), (x1, y1)), np.maximum((x0, y0), (x1, y1))
        inside_outline: Callable[[Array], npt.NDArray[np.bool_]] = lambda points: np.ones(len(points), bool)  # noqa: E731
    else:
        low, high = outline.min((0, 1)), outline.max((0, 1))
        inside_outline = lambda points: _in_triangles(points, outline)  # noqa: E731
    sides = high - low
    if not sides.min() > 0:
        raise SceneCaptumError(f"The sensor grid over {name!r} has no area: its sides are {sides.tolist()}.")
    margin = min(grid.margin, MOST_MARGIN * float(sides.min()))
    centres = _centres(low + margin, high - margin, grid.spacing)
    plan = np.stack(np.meshgrid(centres[0], centres[1][::-1]), -1)  # the last row is the first along
    flat = plan.reshape(-1, 2)
    corners = [
        flat + margin * 0.999 * np.array(step) for step in ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0))
    ]
    inside = np.all([inside_outline(points) for points in corners], 0).reshape(plan.shape[:2])
    positions = np.empty((*plan.shape[:2], 3))
    positions[..., [across, along]], positions[..., up] = plan, level + grid.height
    # Where only the floor is, nothing but the sky is above the points; otherwise they would be above the ceiling.
    top = float(scene.bbox().max[up])
    if level < top < level + grid.height:
        inside[:] = False
    return _open_points(
        GridPoints(
            torch.from_numpy(positions),
            torch.eye(3, dtype=torch.float64)[up].expand(positions.shape),
            torch.from_numpy(inside),
            torch.from_numpy(plan),
            name,
            tuple(sides.tolist()),
            grid.height,
            _material(shapes[name]) if name in shapes else "",
        ),
        scene,
    )


def _open_points(points: GridPoints, scene: Any) -> GridPoints:
    """Return the points of a floor without those inside objects."""
    positions, inside = points.positions, points.inside
    if not (inside & _within(scene, positions)).any():
        raise SceneCaptumError(
            "No point of the sensor grid is in the room: check height=, margin= and rectangle= against the "
            f"bounds of the scene, {_box_text(scene)}."
        )
    hidden = _hidden(scene, positions) & inside
    if hidden.any():
        warnings.warn(
            f"{_count(hidden)} of the sensor grid lie inside objects, the first at {_place(positions, hidden)}, "
            "and are left out.",
            stacklevel=2,
        )
    inside = inside & ~hidden
    above, _ = _rays(scene, positions[inside], points.normals[inside])
    is_covered = np.array(above.is_valid())
    room = torch.full(inside.shape, math.inf, dtype=torch.float64)
    room[inside] = torch.from_numpy(np.where(is_covered, np.array(above.t), math.inf)).double()
    return dataclasses.replace(
        points,
        inside=inside,
        open_above=int((~is_covered).sum()),
        covered=_count_covered(scene, positions, points.normals, room, points.above),
    )


def _count_covered(
    scene: Any, positions: torch.Tensor, up: torch.Tensor, room: torch.Tensor, height: float
) -> int:
    """Return how many points are right below a surface, given the ``room`` above each, and warn of them."""
    below = room < LEAST_ROOM * height
    if not below.any():
        return 0
    steps = [step * RAISED_BY for step in range(1, 1 + int(height / RAISED_BY))]
    places, upward, least = positions[below], up[below], LEAST_ROOM * height
    above = (one for one in steps if _is_open(scene, places + one * upward, upward, least))
    step = next(above, None)
    better = "" if step is None else f", such as {height + step:.2f} m"
    warnings.warn(
        f"{_count(below)} of the sensor grid lie right below a surface that blocks their light, such as a table "
        f"top, and count: the first at {_place(positions, below)}, {float(room[below][0]):.2g} m below it. Choose "
        f"another height= than {height:g} m{better}.",
        stacklevel=2,
    )
    return int(below.sum())


def _is_open(scene: Any, positions: torch.Tensor, up: torch.Tensor, least: float) -> bool:
    """Whether no point, ``(N, 3)``, is inside an object or has less than this room above it."""
    above, _ = _rays(scene, positions, up)
    is_low = np.array(above.is_valid()) & (np.array(above.t) < least)
    return not is_low.any() and not _hidden(scene, positions[None]).any()


def _centres(low: Array, high: Array, spacing: float | None) -> list[Array]:
    """Return the coordinates of the points along both sides: the centres of equal intervals."""
    sides = high - low
    step = en_12464_spacing(float(sides.max()), float(sides.min())) if spacing is None else spacing
    found = []
    for start, side in zip(low, sides, strict=True):
        count = max(1, math.ceil(side / step - 1e-6))
        found.append(start + (np.arange(count) + 0.5) * side / count)
    return found


# --- Floors ---------------------------------------------------------------------------------------


def up_axis(scene: Any) -> int:
    """Return the axis that points up: the one nearest to that of the scene's first sensor."""
    up = scene.sensors()[0].world_transform() @ mi.Vector3f(0, 1, 0)
    return int(np.abs(np.array(up).ravel()).argmax())


def _plan_axes(up: int) -> tuple[int, int]:
    """Return the axes across and along the plan of a room."""
    across, along = (axis for axis in range(3) if axis != up)
    return across, along


def _floor(grid: SensorGrid, shapes: Mapping[str, Any], up: int) -> tuple[str, Array]:
    """Return the name of the floor and its level triangles, ``(N, 3, 3)``."""
    chosen = shapes if grid.floor is None else _named_floors(grid.floor, shapes, up)
    facing = {name: _level_triangles(shape, up) for name, shape in chosen.items()}
    areas = {name: _covered(triangles, up) for name, triangles in facing.items()}
    largest = max(areas.values(), default=0.0)
    # The ceiling is as large.
    large = [name for name, area in areas.items() if area > 0 and area >= LARGE * largest]
    if not large:
        which = f"{grid.floor!r} has no" if grid.floor else "no shape of the scene has a"
        raise SceneCaptumError(
            f"A sensor grid needs a floor, and {which} level part. Name another with "
            "floor=. The largest level shapes are "
            f"{_largest_level(shapes, up)}."
        )
    name = min(large, key=lambda name: facing[name][..., up].max())
    if grid.floor in (None, name):
        return name, facing[name]
    # A material: all its level parts at the height of this one, as of a floor in several pieces.
    parts = np.concatenate(list(facing.values()))
    heights = np.abs(parts[..., up] - facing[name][..., up].max()).max(1)
    return str(grid.floor), parts[heights <= SAME_LEVEL * math.sqrt(areas[name])]


def _named_floors(floor: str, shapes: Mapping[str, Any], up: int) -> Mapping[str, Any]:
    """Return the shape of a name, or those with the material of this name."""
    if floor in shapes:
        return {floor: shapes[floor]}
    materials = {name: shape.bsdf().id() for name, shape in shapes.items() if shape.bsdf() is not None}
    found = {name: shapes[name] for name, material in materials.items() if material == floor}
    if found:
        return found
    raise SceneCaptumError(
        f"SensorGrid(floor={floor!r}): the scene has no shape and no material of this name."
        f"{near_misses(floor, [*shapes, *materials.values()])} The largest level shapes are "
        f"{_largest_level(shapes, up)}."
    )


def _material(shape: Any) -> str:
    """Return the name of the material of a shape; empty if it has none of its own."""
    name = "" if shape.bsdf() is None else str(shape.bsdf().id())
    return "" if name == "bsdf" or name.startswith(("_", f"{shape.id()}.")) else name


def _largest_level(shapes: Mapping[str, Any], up: int) -> str:
    """Return the names of the largest level shapes with material and size, for a message."""
    level = {
        name: triangles for name, shape in shapes.items() if len(triangles := _level_triangles(shape, up))
    }
    largest = sorted(level, key=lambda name: -_covered(level[name], up))[:LISTED]
    across, along = _plan_axes(up)
    found = []
    for name in largest:
        corners = level[name][..., [across, along]].reshape(-1, 2)
        width, depth = corners.max(0) - corners.min(0)
        found.append(f"{name} ({shapes[name].bsdf().id()}, {width:.3g} × {depth:.3g} m)")
    return ", ".join(found) or "none"


def _level_triangles(shape: Any, up: int) -> Array:
    """Return the level triangles of a mesh; none for a shape that is no mesh."""
    if not shape.is_mesh():
        return np.zeros((0, 3, 3))
    vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    triangles = vertices[np.array(shape.faces_buffer()).reshape(-1, 3)]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1)
    level: Array = triangles[(np.abs(normals[:, up]) >= FACES_UP * length) & (length > 0)]
    return level


def _covered(triangles: Array, up: int) -> float:
    """Return the area of the plan that level triangles cover: that of a slab once, although it has two sides."""
    if not len(triangles):
        return 0.0
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    corners = triangles[..., list(_plan_axes(up))].reshape(-1, 2)
    outline = float((corners.max(0) - corners.min(0)).prod())
    return min(float(np.abs(np.cross(a, b)[:, up]).sum() / 2), outline)


def _in_triangles(points: Array, triangles: Array) -> npt.NDArray[np.bool_]:
    """Return which points ``(N, 2)`` lie in any of the triangles ``(M, 3, 2)``."""
    a, b, c = (triangles[None, :, corner] for corner in range(3))
    p = points[:, None]

    def side(start: Array, end: Array) -> Array:
        d, e = end - start, p - start
        return d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    inside: npt.NDArray[np.bool_] = np.all(sides >= -1e-9, 0) | np.all(sides <= 1e-9, 0)
    found: npt.NDArray[np.bool_] = np.any(inside, 1)
    return found


# --- Points inside objects ------------------------------------------------------------------------


def _within(scene: Any, positions: torch.Tensor) -> torch.Tensor:
    """Return which points are in the scene's bounds, or above them where there is a sky."""
    box = scene.bbox()
    low, high = (torch.tensor(list(corner), dtype=torch.float64) for corner in (box.min, box.max))
    if scene.environment() is not None:
        high[up_axis(scene)] = math.inf
    return ((positions >= low) & (positions <= high)).all(-1)


def _hidden(scene: Any, positions: torch.Tensor) -> torch.Tensor:
    """Return which points lie inside an object: nearly all rays upward from there meet the back of a surface.

    Where this is so at the scene's camera, the room itself is built from surfaces that face outward.
    """
    camera = scene.sensors()[0].world_transform() @ mi.Point3f(0, 0, 0)
    eye = torch.from_numpy(np.array(camera, dtype=np.float64).reshape(1, 1, 3))
    up = up_axis(scene)
    hidden: torch.Tensor = _back_faces_above(scene, positions, up) > MOST_BACK_FACES
    return hidden & (_back_faces_above(scene, eye, up) <= MOST_BACK_FACES)


def _back_faces_above(scene: Any, positions: torch.Tensor, up: int) -> torch.Tensor:
    """Return the fraction of rays upward from points ``(H, W, 3)`` that meet the back of a surface."""
    count = positions[..., 0].numel()
    directions = _upper_hemisphere(PROBES, up)
    origins = positions.reshape(-1, 1, 3).expand(-1, PROBES, 3)
    si, towards = _rays(scene, origins, directions.expand(count, PROBES, 3))
    back = dr.select(si.is_valid() & (dr.dot(si.n, towards) > 0), mi.Float(1), 0)
    return torch.from_numpy(np.array(back)).reshape(count, PROBES).mean(1).reshape(positions.shape[:2])


def _rays(scene: Any, origins: torch.Tensor, directions: torch.Tensor) -> tuple[Any, Any]:
    """Return what rays meet, and their directions as vectors of Mitsuba."""
    columns = (
        mi.Point3f(*(mi.Float(column.contiguous()) for column in rows.reshape(-1, 3).float().T))
        for rows in (origins, directions)
    )
    ray = mi.Ray3f(*columns)
    return scene.ray_intersect(ray), ray.d


def _upper_hemisphere(count: int, up: int) -> torch.Tensor:
    """Return directions that are spread over the hemisphere, ``(count, 3)``: a spiral."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height, angle = 1 - index / count, index * math.pi * (3 - math.sqrt(5))
    radius = (1 - height * height).sqrt()
    directions = torch.empty(count, 3, dtype=torch.float64)
    across, along = _plan_axes(up)
    directions[:, across], directions[:, along] = radius * angle.cos(), radius * angle.sin()
    directions[:, up] = height
    return directions


def _count(mask: torch.Tensor) -> str:
    return f"{int(mask.sum())} of {mask.numel()} points"


def _place(positions: torch.Tensor, mask: torch.Tensor) -> str:
    first = positions[mask][0].tolist()
    return f"({', '.join(f'{x:.3g}' for x in first)})"


def _box_text(scene: Any) -> str:
    box = scene.bbox()
    low, high = ([f"{float(x):.3g}" for x in corner] for corner in (box.min, box.max))
    return f"({', '.join(low)}) to ({', '.join(high)})"
