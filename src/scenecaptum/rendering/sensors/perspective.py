"""Mitsuba's pinhole and thin-lens cameras."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from ...camera import Camera
from .._sensors import film_size


def camera_of(sensor: Any) -> Camera:
    """Return the geometry of a sensor's pixels."""
    width, height = film_size(sensor)
    # From rays, which include crops and shifted principal points.
    edges = mi.Point2f([0.0, 1.0, 0.5], [0.5, 0.5, 0.0])
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, edges, mi.Point2f(0.5))
    across, up, ahead = np.array(sensor.world_transform().inverse() @ ray.d)
    left, right, top = -across[0] / ahead[0], -across[1] / ahead[1], up[2] / ahead[2]
    extent = right - left
    offset = (-left / extent - 0.5, top / (extent * height / width) - 0.5)
    fov = 2 * math.degrees(math.atan(extent / 2))
    return Camera.perspective(width, height, fov, principal_point_offset=offset)
