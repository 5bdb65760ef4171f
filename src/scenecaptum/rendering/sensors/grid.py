"""A sensor whose pixels are points of a room: each measures the irradiance there."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from ...grid import GridPoints


class GridSensor(mi.Sensor):
    """Rays from the points of a sensor grid, distributed as the cosine; their mean times π is the irradiance."""

    points: GridPoints

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.m_needs_sample_3 = True
        # Of each pixel. Frozen functions get them as an argument: they do not see those of a Python sensor.
        self.arrays: tuple[Any, ...] = ()

    def place(self, points: GridPoints, *, by_row: bool = False) -> None:
        """Set the points, one for each pixel, or one of those inside for each row of the picture."""
        self.points = points
        self._by_row = by_row
        placed = points.as_list() if by_row else points
        weight = math.pi * placed.inside.double()
        columns = (*placed.positions.unbind(-1), *placed.normals.unbind(-1), weight)
        self.arrays = tuple(mi.Float(column.flatten().float().contiguous()) for column in columns)
        dr.make_opaque(self.arrays)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return rays from the points of the pixels at ``sample2`` in [0, 1]², and their weights."""
        position, normal, weight = self._at(sample2 * mi.ScalarVector2f(self.film().crop_size()))
        towards = mi.warp.square_to_cosine_hemisphere(mi.Point2f(sample3))
        direction = mi.Frame3f(normal).to_world(towards)
        lanes = dr.zeros(mi.Float, dr.width(sample2))
        ray = mi.Ray3f(position + lanes, dr.normalize(direction) + lanes, time + lanes)
        return ray, mi.Spectrum(weight + lanes)

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return the same rays as ray differentials, without their differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def receiver(self, point: Any) -> Any:
        """Return the surfaces at points of the film, in pixels, from which rays start: interactions."""
        position, normal, weight = self._at(point)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(point))
        si.p, si.n, si.sh_frame = position, normal, mi.Frame3f(normal)
        si.t = dr.select(weight > 0, mi.Float(0), dr.inf)
        return si

    def _at(self, point: Any) -> tuple[Any, Any, Any]:
        """Return position, normal and weight of the pixels at points of the film, in pixels."""
        size = self.film().crop_size()
        column, row = (
            mi.UInt32(dr.clip(value, 0, count - 1)) for value, count in ((point.x, size.x), (point.y, size.y))
        )
        x, y, z, nx, ny, nz, weight = (
            dr.gather(mi.Float, array, row if self._by_row else row * size.x + column)
            for array in self.arrays
        )
        return mi.Point3f(x, y, z), mi.Normal3f(nx, ny, nz), weight

    def class_name(self) -> str:
        """Return the name in ``SENSORS``."""
        return type(self).__name__

    def to_string(self) -> str:
        """Describe the sensor with all its points; checkpoints are found by it."""
        described = [array.numpy().tolist() for array in self.arrays]
        return f"GridSensor[points = {described}, film = {self.film()}]"


mi.register_sensor("scenecaptum_grid", GridSensor)
