"""A 180° fisheye for glare, which Mitsuba does not have."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from ...camera import Camera
from .._sensors import film_size
from .base import PointSensor

FOV = 180.0


class FisheyeSensor(PointSensor):
    """An equidistant fisheye: distance from the image centre is proportional to the angle from the optical axis.

    The circle of ``fov`` degrees touches the nearer edges of the film. Pixels outside it are black.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.fov = float(props.get("fov", FOV))

    def look(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the direction of a point of the film, and whether it is inside the circle."""
        distance = dr.sqrt(x * x + y * y)
        angle = distance * math.radians(self.fov)
        radial = dr.select(distance > 0, dr.sin(angle) / distance, 0)
        return mi.Vector3f(radial * x, -radial * y, dr.cos(angle)), distance <= 0.5

    def to_string(self) -> str:
        """Describe the sensor."""
        return f"FisheyeSensor[fov = {self.fov:g}, film = {self.film()}]"


mi.register_sensor("scenecaptum_fisheye", FisheyeSensor)


def camera_of(sensor: FisheyeSensor) -> Camera:
    """Return the geometry of a sensor's pixels."""
    return Camera.fisheye(*film_size(sensor), sensor.fov)
