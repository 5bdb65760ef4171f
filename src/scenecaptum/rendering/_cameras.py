"""The cameras of pictures: their geometry, and a fisheye that sees half of all directions, as a glare meter does.

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
    """An equidistant fisheye: the distance from the centre of the picture is the angle from the line of sight.

    The circle of ``fov`` degrees touches the nearer edges of the film; what lies outside is black.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.fov = float(props.get("fov", FOV))
        # Plain numbers: Dr.Jit cannot see what a sensor written in Python holds when it freezes a function.
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
        # The film's x runs to the right, the camera's to the left, and both its axes start at a corner.
        away = dr.select(distance > 0, dr.sin(angle) / distance, 0)
        direction = dr.cos(angle) * self._ahead - away * (x * self._left + y * self._up)
        # Of full width: rays are gathered, and a field of one number cannot be.
        lanes = dr.zeros(mi.Float, dr.width(position))
        ray = mi.Ray3f(mi.Point3f(self._origin) + lanes, dr.normalize(direction), time + lanes)
        return ray, mi.Spectrum(dr.select(distance <= 0.5, 1, 0))

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Return the same rays, without differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        """Describe the sensor."""
        return f"FisheyeSensor[fov = {self.fov:g}, film = {self.film()}]"


mi.register_sensor("scenecaptum_fisheye", FisheyeSensor)


def fisheye_at(sensor: Any, resolution: tuple[int, int]) -> Any:
    """Create a fisheye where a sensor is, looking where it looks."""
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
    """Return directions and solid angles of a sensor's pixels."""
    width, height = (int(n) for n in sensor.film().crop_size())
    if isinstance(sensor, FisheyeSensor):
        return Camera.fisheye(width, height, sensor.fov)
    kind = sensor.class_name()
    if kind not in ("PerspectiveCamera", "ThinLensCamera"):
        raise SceneCaptumError(
            f"The geometry of a {kind} is not known, only that of perspective, thinlens and fisheye cameras. "
            'Choose one with sensor=: "fisheye" stands where the scene\'s first camera does.'
        )
    # Read off the rays, which know of crops and shifted lenses.
    edges = mi.Point2f([0.0, 1.0, 0.5], [0.5, 0.5, 0.0])
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, edges, mi.Point2f(0.5))
    across, up, ahead = np.array(sensor.world_transform().inverse() @ ray.d)
    left, right, top = -across[0] / ahead[0], -across[1] / ahead[1], up[2] / ahead[2]
    reach = right - left
    offset = (-left / reach - 0.5, top / (reach * height / width) - 0.5)
    fov = 2 * math.degrees(math.atan(reach / 2))
    return Camera.perspective(width, height, fov, principal_point_offset=offset)
