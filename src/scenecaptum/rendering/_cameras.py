"""Camera geometry, and a 180° fisheye sensor for glare.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import Camera
from ..errors import SceneCaptumError

FOV = 180.0


class FisheyeSensor(mi.Sensor):
    """An equidistant fisheye: distance from the image centre is proportional to the angle from the optical axis.

    The circle of ``fov`` degrees touches the nearer edges of the film. Pixels outside it are black.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.fov = float(props.get("fov", FOV))
        # Plain numbers, because frozen functions do not see arrays in a sensor written in Python.
        matrix = self.world_transform().matrix
        self._left, self._up, self._ahead, self._origin = (
            mi.ScalarVector3f(*(matrix[row, column][0] for row in range(3))) for column in range(4)
        )

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return rays through points of the film, ``sample2`` in [0, 1]², and their weights."""
        position = sample2
        width, height = self.film().crop_size()
        side = min(width, height)
        x, y = (position.x - 0.5) * (width / side), (position.y - 0.5) * (height / side)
        distance = dr.sqrt(x * x + y * y)
        angle = distance * math.radians(self.fov)
        # The film's x axis points right, the camera's left; the film's origin is a corner.
        radial = dr.select(distance > 0, dr.sin(angle) / distance, 0)
        direction = dr.cos(angle) * self._ahead - radial * (x * self._left + y * self._up)
        # Full width, because rays are gathered, which a field of width 1 cannot be.
        lanes = dr.zeros(mi.Float, dr.width(position))
        ray = mi.Ray3f(mi.Point3f(self._origin) + lanes, dr.normalize(direction), time + lanes)
        return ray, mi.Spectrum(dr.select(distance <= 0.5, 1, 0))

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return the same rays as ray differentials, without their differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        """Describe the sensor."""
        return f"FisheyeSensor[fov = {self.fov:g}, film = {self.film()}]"


mi.register_sensor("scenecaptum_fisheye", FisheyeSensor)


def fisheye_at(sensor: Any, resolution: tuple[int, int]) -> Any:
    """Create a fisheye with the pose of a sensor."""
    width, height = resolution
    matrix = sensor.world_transform().matrix
    rows = [[float(matrix[row, column][0]) for column in range(4)] for row in range(4)]
    return mi.load_dict(
        {
            "type": "scenecaptum_fisheye",
            "to_world": mi.ScalarTransform4f(rows),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": sensor.sampler().sample_count()},
        }
    )


def camera_of(sensor: Any) -> Camera:
    """Return the geometry of a sensor's pixels."""
    width, height = (int(n) for n in sensor.film().crop_size())
    if isinstance(sensor, FisheyeSensor):
        return Camera.fisheye(width, height, sensor.fov)
    kind = sensor.class_name()
    if kind not in ("PerspectiveCamera", "ThinLensCamera"):
        raise SceneCaptumError(
            f"The geometry of a {kind} is not known, only that of perspective, thinlens and fisheye cameras. "
            'Select another with sensor=: "fisheye" has the pose of the scene\'s first camera.'
        )
    # From rays, which include crops and shifted principal points.
    edges = mi.Point2f([0.0, 1.0, 0.5], [0.5, 0.5, 0.0])
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, edges, mi.Point2f(0.5))
    across, up, ahead = np.array(sensor.world_transform().inverse() @ ray.d)
    left, right, top = -across[0] / ahead[0], -across[1] / ahead[1], up[2] / ahead[2]
    extent = right - left
    offset = (-left / extent - 0.5, top / (extent * height / width) - 0.5)
    fov = 2 * math.degrees(math.atan(extent / 2))
    return Camera.perspective(width, height, fov, principal_point_offset=offset)
