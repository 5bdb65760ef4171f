"""Rays that are aimed at lamps: those of the pixels miss lamps that are much smaller than a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from ..camera import Camera
from ._backward import one_for_each
from ._registry import shape_index
from ._visibility import follow_specular

_SIDE = 4  # of the grid of points on a lamp
_HALF_DIAGONAL = 0.75  # of a pixel, in square roots of its solid angle


def visible_radiances(
    scene: Any, sensor: Any, camera: Camera, lamps: Mapping[str, Any]
) -> dict[str, torch.Tensor]:
    """Return the largest radiance, ``(3,)``, of each small lamp that a camera sees, through panes too.

    ``lamps`` are shapes that emit light, by name. Those that are hidden or not in the picture are left out.
    """
    origin, directions = _rays_of_pixels(sensor, camera)
    towards = {name: _unit(_points_on(shape) - origin) for name, shape in lamps.items()}
    shown = [
        name for name, rays in towards.items() if _is_in_picture(_unit(rays.mean(0)), directions, camera)
    ]
    if not shown:
        return {}
    radiance, met = _trace(scene, origin, np.concatenate([towards[name] for name in shown]))
    largest = {}
    for name, found, shape in zip(
        shown, np.split(radiance, len(shown)), np.split(met, len(shown)), strict=True
    ):
        if (is_lamp := shape == shape_index(lamps[name])).any():
            largest[name] = torch.from_numpy(found[is_lamp].max(0))
    return largest


def _rays_of_pixels(sensor: Any, camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where the rays of a camera start, and unit vectors through the centres of its pixels."""
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    position = mi.Point2f((column + 0.5) / camera.width, (row + 0.5) / camera.height)
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    ray = one_for_each(ray, position)
    return ray.o.numpy()[:, 0], ray.d.numpy().T


def _points_on(shape: Any) -> NDArray[Any]:
    """Return points of a shape, ``(points, 3)``, uniform by area."""
    row, column = np.divmod(np.arange(_SIDE**2), _SIDE)
    samples = mi.Point2f((column + 0.5) / _SIDE, (row + 0.5) / _SIDE)
    points: NDArray[Any] = shape.sample_position(0.0, samples).p.numpy().T
    return points


def _unit(vectors: NDArray[Any]) -> NDArray[Any]:
    lengths: NDArray[Any] = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: NDArray[Any] = vectors / lengths
    return unit


def _is_in_picture(direction: NDArray[Any], directions: NDArray[Any], camera: Camera) -> bool:
    cosines = directions @ direction
    nearest = int(cosines.argmax())
    solid_angle = camera.solid_angles.reshape(-1)[nearest].item()  # 0 outside a fisheye's circle
    return bool(np.arccos(min(1.0, cosines[nearest])) <= _HALF_DIAGONAL * solid_angle**0.5)


def _trace(scene: Any, origin: NDArray[Any], towards: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return for each ray the radiance of what it meets, ``(rays, 3)``, and Dr.Jit's index of that shape."""
    index = dr.arange(mi.UInt32, len(towards))
    with dr.suspend_grad():
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(towards.T))
        hit = scene.ray_intersect_preliminary(ray)
        ray, hit = follow_specular(scene, ray, hit, index, dr.zeros(mi.UInt32, len(towards)))
        si = hit.compute_surface_interaction(ray)
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        radiance = si.emitter(scene).eval(si)
        dr.eval(shape, radiance)
    return np.broadcast_to(radiance.numpy(), (3, len(towards))).T, shape.numpy()
