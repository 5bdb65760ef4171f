"""Base class of sensors that Mitsuba does not have."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


class PointSensor(mi.Sensor):
    """A sensor that sees from one point; a subclass says where each point of its film looks."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        # Plain numbers, because frozen functions do not see arrays in a sensor written in Python.
        matrix = self.world_transform().matrix
        self._left, self._up, self._ahead, self._origin = (
            mi.ScalarVector3f(*(matrix[row, column][0] for row in range(3))) for column in range(4)
        )

    def look(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the direction of a point of the film, x right, y up, z forward, and whether it sees anything.

        ``x`` and ``y`` are from the film's centre, right and down, in units of its shorter side.
        """
        raise NotImplementedError

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return rays through points of the film, ``sample2`` in [0, 1]², and their weights."""
        width, height = self.film().crop_size()
        side = min(width, height)
        local, seen = self.look((sample2.x - 0.5) * (width / side), (sample2.y - 0.5) * (height / side))
        # Mitsuba's x axis points left.
        direction = local.z * self._ahead + local.y * self._up - local.x * self._left
        # Full width, because rays are gathered, which a field of width 1 cannot be.
        lanes = dr.zeros(mi.Float, dr.width(sample2))
        ray = mi.Ray3f(mi.Point3f(self._origin) + lanes, dr.normalize(direction), time + lanes)
        return ray, mi.Spectrum(dr.select(seen, lanes + 1, 0))

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return the same rays as ray differentials, without their differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def class_name(self) -> str:
        """Return the name in ``SENSORS``."""
        return type(self).__name__

    def to_string(self) -> str:
        """Describe the sensor with all its settings; checkpoints are found by it."""
        return f"{self.class_name()}[film = {self.film()}]"
