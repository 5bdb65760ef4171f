"""Rays that are aimed at lamps: those of the pixels miss lamps that are much smaller than a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from ..camera import Camera
from ._backward import one_for_each
from ._registry import shape_index
from ._seen_lamps import SmallLamp
from ._visibility import RAYS, follow_specular

_SIDE = 4  # of the grid of points on a lamp, which has as many as a pixel has rays
_HALF_DIAGONAL = 0.75  # of a pixel, in square roots of its solid angle


class _Points(NamedTuple):
    """Points on a lamp as a camera sees them: directions ``(points, 3)``, and the solid angle of each."""

    towards: NDArray[Any]
    solid_angles: NDArray[Any]


def visible_lamps(scene: Any, sensor: Any, camera: Camera, lamps: Mapping[str, Any]) -> dict[str, SmallLamp]:
    """Return what a camera sees of small lamps, through panes too.

    ``lamps`` are shapes that emit light, by name. Those that are hidden or not in the picture are left out.
    """
    origin, directions = _rays_of_pixels(sensor, camera)
    points = {name: _points_on(shape, origin) for name, shape in lamps.items()}
    pixels = {name: _pixel_of(one.towards.mean(0), directions, camera) for name, one in points.items()}
    shown = {name: pixel for name, pixel in pixels.items() if pixel is not None}
    if not shown:
        return {}
    radiance, met = _trace(scene, origin, np.concatenate([points[name].towards for name in shown]))
    found = {}
    parts = zip(shown.items(), np.split(radiance, len(shown)), np.split(met, len(shown)), strict=True)
    for (name, pixel), of_points, shape in parts:
        if (is_lamp := shape == shape_index(lamps[name])).any():
            solid_angle = float(points[name].solid_angles[is_lamp].sum())
            found[name] = SmallLamp(torch.from_numpy(of_points[is_lamp].max(0)), solid_angle, pixel)
    return found


def _rays_of_pixels(sensor: Any, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where the rays of a camera start, and unit vectors through the centres of its pixels."""
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    position = mi.Point2f((column + 0.5) / camera.width, (row + 0.5) / camera.height)
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    ray = one_for_each(ray, position)
    return ray.o.numpy()[:, 0], ray.d.numpy().T


def _points_on(shape: Any, origin: NDArray[Any]) -> _Points:
    """Return points of a shape, uniform by area."""
    row, column = np.divmod(np.arange(_SIDE**2), _SIDE)
    sample = shape.sample_position(0.0, mi.Point2f((column + 0.5) / _SIDE, (row + 0.5) / _SIDE))
    ways = sample.p.numpy().T - origin
    distances = np.linalg.norm(ways, axis=1, keepdims=True)
    towards = ways / distances
    normals = np.broadcast_to(sample.n.numpy(), (3, _SIDE**2)).T
    facing = np.maximum(0, -(normals * towards).sum(1))
    area = shape.surface_area()[0] / _SIDE**2
    return _Points(towards, area * facing / distances[:, 0] ** 2)


def _pixel_of(direction: NDArray[Any], directions: NDArray[Any], camera: Camera) -> tuple[int, int] | None:
    """Return the row and the column that show a direction; None if it is not in the picture."""
    cosines = directions @ direction / np.linalg.norm(direction)
    nearest = int(cosines.argmax())
    row, column = divmod(nearest, camera.width)
    solid_angle = camera.solid_angles[row, column].item()  # 0 outside a fisheye's circle
    is_shown = np.arccos(min(1.0, cosines[nearest])) <= _HALF_DIAGONAL * solid_angle**0.5
    return (row, column) if is_shown else None


def _trace(scene: Any, origin: NDArray[Any], towards: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the radiance that comes along each ray, ``(rays, 3)``, and Dr.Jit's index of the shape it meets."""
    index = dr.arange(mi.UInt32, len(towards))
    with dr.suspend_grad():
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(towards.T))
        hit = scene.ray_intersect_preliminary(ray)
        # Of the points of a lamp behind a pane, as many rays are reflected as of the points in a pixel.
        followed = follow_specular(scene, ray, hit, index // RAYS, index % RAYS)
        si = followed.hit.compute_surface_interaction(followed.ray)
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        radiance = followed.throughput * si.emitter(scene).eval(si)
        dr.eval(shape, radiance)
    return np.broadcast_to(radiance.numpy(), (3, len(towards))).T, shape.numpy()
