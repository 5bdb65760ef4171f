"""The types of sensors, and how to select sensors of a scene and their common resolution."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any, NamedTuple, TypeAlias

from ..camera import Camera, View
from ..daylight import SkyPatches
from ..errors import SceneCaptumError, whole_number
from ..grid import GridPoints, SensorGrid
from ..scene import SceneGraph, rgb_film


class SensorType(NamedTuple):
    """A type of sensor whose pixels have a known geometry.

    The module ``sensors.NAME`` has its ``camera_of(sensor)``, and its plugin if Mitsuba has none. A type that
    ``sensor=`` can name has a ``plugin``, which is created with the pose of the scene's first sensor.
    """

    description: str  # for the help text
    class_names: tuple[str, ...]  # in Mitsuba
    plugin: str | None = None
    has_camera: bool = True  # whether its pixels are directions from one point
    connectable: bool = False  # whether light tracing can use its ``sample_direction`` and ``near_clip``


SENSORS = {
    "perspective": SensorType(
        "pinhole or thin-lens camera", ("PerspectiveCamera", "ThinLensCamera"), connectable=True
    ),
    "fisheye": SensorType("180° equidistant fisheye", ("FisheyeSensor",), "scenecaptum_fisheye"),
    "grid": SensorType("irradiance on a sensor grid", ("GridSensor",), "scenecaptum_grid", has_camera=False),
}

# The class of Mitsuba's sensor on a shape, whose pixel collects the light from everywhere above it.
IRRADIANCE_METER = "IrradianceMeter"

SensorLike: TypeAlias = "int | str | SensorGrid | View"

GRID_SIZE = (
    "A sensor grid has a pixel for each point: leave resolution= out, and choose spacing= of the SensorGrid."
)


def named_sensors() -> dict[str, SensorType]:
    """Return the types that ``sensor=`` can name."""
    return {name: sensor for name, sensor in SENSORS.items() if sensor.plugin}


def is_connectable(sensor: Any) -> bool:
    """Whether light tracing can connect paths to a sensor."""
    name = _type_name(sensor)
    return name is not None and SENSORS[name].connectable


def allows_light_tracing(graph: SceneGraph, sensor: Any) -> bool:
    """Whether light paths can be connected to the camera, and scattering is reciprocal."""
    film = sensor.film()
    return (
        is_connectable(sensor)
        and list(film.size()) == list(film.crop_size())
        and not graph.class_names() & {"Instance", "BumpMap", "NormalMap"}
    )


def camera_of(sensor: Any) -> Camera:
    """Return the geometry of a sensor's pixels."""
    if sensor.class_name() == IRRADIANCE_METER:
        raise SceneCaptumError("An irradiancemeter has no camera: metrics of views need another sensor.")
    name = _type_name(sensor)
    if name is None:
        known = [name for name, one in SENSORS.items() if one.has_camera]
        named = [name for name in named_sensors() if name in known]
        raise SceneCaptumError(
            f"The geometry of {sensor.class_name()} sensors is not known, only that of {_list(known)}. Select "
            f"another with sensor=: {_list(named)} has the pose of the scene's first sensor."
        )
    if not SENSORS[name].has_camera:
        raise SceneCaptumError(
            "The pixels of a sensor grid are points, which have no camera: renderer.grid has their positions. "
            "Metrics of views need another sensor."
        )
    camera: Camera = _module(name).camera_of(sensor)
    return camera


def describe_sensor(sensor: Any) -> str:
    """Return ``"perspective, 75° wide, at 0 −2 1.2, towards 0 1 0"``, which tells cameras apart."""
    import mitsuba as mi

    kind, settings = _type_name(sensor), mi.traverse(sensor)
    if "aperture_radius" in settings:
        radius, distance = (
            _short(float(settings[name][0])) for name in ("aperture_radius", "focus_distance")
        )
        kind = f"thin lens of radius {radius}, focused at {distance}"
    fov = float(settings["x_fov"][0]) if "x_fov" in settings else getattr(sensor, "fov", None)
    pose = _pose_of(sensor)
    place, ahead = (" ".join(_short(pose[row][column]) for row in range(3)) for column in (3, 2))
    wide = [] if fov is None else [f"{_short(fov)}° wide"]
    return ", ".join([kind or str(sensor.class_name()), *wide, f"at {place}", f"towards {ahead}"])


def _short(number: float) -> str:
    """Return a number in four digits; what is rounded away from 0 in the arithmetic of a pose is 0."""
    return f"{round(number, 5) + 0.0:.4g}".replace("-", "−")


def _type_name(sensor: Any) -> str | None:
    return next((name for name, known in SENSORS.items() if sensor.class_name() in known.class_names), None)


def _module(name: str) -> Any:
    return import_module(f".sensors.{name}", __package__)  # needs an active variant


def _list(names: Iterable[str]) -> str:
    return " or ".join(f'"{name}"' for name in names)


def grid_of(sensor: Any) -> GridPoints:
    """Return the points of a sensor grid."""
    if not is_grid(sensor):
        raise SceneCaptumError('Only a renderer with sensor="grid" or a SensorGrid has a grid.')
    points: GridPoints = sensor.points
    return points


def is_grid(sensor: Any) -> bool:
    """Whether the pixels of a sensor are the points of a sensor grid."""
    return _type_name(sensor) == "grid"


def shows_a_view(sensor: Any) -> bool:
    """Whether neighbouring pixels show neighbouring directions: maps and denoisers need that."""
    name = _type_name(sensor)
    return sensor.class_name() != IRRADIANCE_METER if name is None else SENSORS[name].has_camera


def choose_sensor(
    scene: Any,
    which: SensorLike,
    resolution: tuple[int, int] | None,
    patches: SkyPatches | None = None,
) -> Any:
    """Return a sensor of the scene by index or id, a `View`, or one of a named type with the pose of the first.

    With ``patches``, the picture of a sensor grid has a row for each point and a column for each patch of the sky.
    """
    sensors = scene.sensors()
    if which == "grid" or isinstance(which, SensorGrid):
        grid = which if isinstance(which, SensorGrid) else SensorGrid()
        return _create_grid(scene, grid, resolution, patches)
    if patches is not None:
        raise SceneCaptumError(
            'sky_patches= needs the points of a sensor grid: give sensor="grid" or a SensorGrid.'
        )
    ids = [one.id() for one in sensors]
    if isinstance(which, str) and which not in named_sensors():
        if which not in ids:
            own = ", ".join(f"{index}: {name}" for index, name in enumerate(ids))
            raise SceneCaptumError(
                f"sensor must be the index or id of a sensor or {_list(named_sensors())}, not {which!r}. "
                f"The scene's own: {own}."
            )
        which = ids.index(which)
    if isinstance(which, str):
        side = min(sensors[0].film().crop_size())
        return _create(which, sensors[0], _checked(resolution) if resolution else (side, side))
    if isinstance(which, View):
        return _create_view(which, choose_sensor(scene, which.sensor, resolution), resolution)
    index = whole_number("sensor", which, 0, len(sensors) - 1)
    if "pixel_format = rgb," not in str(sensors[index].film()):
        raise SceneCaptumError(
            f'The film of sensor {index} does not record linear RGB. Give it pixel_format="rgb" (hdrfilm), or '
            "pass the scene's file or dict, which is loaded with an RGB film."
        )
    return sensors[index]


def _create_grid(
    scene: Any, grid: SensorGrid, resolution: tuple[int, int] | None, patches: SkyPatches | None
) -> Any:
    """Create the sensor of a grid, whose film has a pixel for each point, or for each point and patch."""
    import mitsuba as mi

    from ._grid import place_grid

    if resolution is not None:
        raise SceneCaptumError(GRID_SIZE)
    _module("grid")  # registers the plugin
    points = place_grid(grid, scene)
    count = scene.sensors()[0].sampler().sample_count()
    sampler = {"type": "independent", "sample_count": count}
    size = (points.width, points.height) if patches is None else (patches.count, int(points.inside.sum()))
    film = rgb_film(*size)
    sensor = mi.load_dict({"type": SENSORS["grid"].plugin, "film": film, "sampler": sampler})
    sensor.place(points, by_row=patches is not None)
    return sensor


def _create(name: str, pose: Any, resolution: tuple[int, int]) -> Any:
    """Create a sensor of a named type with the pose of another."""
    import mitsuba as mi

    _module(name)  # registers the plugin
    return mi.load_dict(
        {
            "type": SENSORS[name].plugin,
            "to_world": mi.ScalarTransform4f(_pose_of(pose)),
            "film": rgb_film(*resolution),
            "sampler": {"type": "independent", "sample_count": pose.sampler().sample_count()},
        }
    )


def _create_view(view: View, camera: Any, resolution: tuple[int, int] | None) -> Any:
    """Create a pinhole camera at a pose and with a field of view relative to another."""
    import mitsuba as mi
    import torch

    if camera.class_name() != "PerspectiveCamera":
        raise SceneCaptumError(
            f"A View needs a pinhole camera, and sensor {view.sensor} is a {camera.class_name()}: name another "
            "with View(sensor=)."
        )
    settings = mi.traverse(camera)
    fov = float(settings["x_fov"][0]) if view.fov is None else view.fov
    if not 0 < fov < 180:
        raise SceneCaptumError(f"fov of a View must be above 0 and below 180 degrees, not {fov!r}.")
    matrix = torch.tensor(_pose_of(camera), dtype=torch.float64) @ view.matrix()
    return mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(matrix.tolist()),
            "fov": fov,
            "fov_axis": "x",
            "near_clip": camera.near_clip(),
            "far_clip": camera.far_clip(),
            "principal_point_offset_x": float(settings["principal_point_offset_x"][0]),
            "principal_point_offset_y": float(settings["principal_point_offset_y"][0]),
            "film": rgb_film(*(_checked(resolution) if resolution else film_size(camera))),
            "sampler": {"type": "independent", "sample_count": camera.sampler().sample_count()},
        }
    )


def _pose_of(sensor: Any) -> list[list[float]]:
    """Return the matrix of a sensor's pose."""
    matrix = sensor.world_transform().matrix
    return [[float(matrix[row, column][0]) for column in range(4)] for row in range(4)]


def common_resolution(sensors: Sequence[Any], resolution: tuple[int, int] | None) -> tuple[int, int]:
    """Return the ``(width, height)`` of all sensors: ``resolution``, or that of their films."""
    if not sensors:
        raise SceneCaptumError("sensor is an empty list: name at least one sensor.")
    sizes = {_resolution(sensor, resolution) for sensor in sensors}
    if len(sizes) > 1:
        text = ", ".join(f"{width}×{height}" for width, height in sorted(sizes))
        raise SceneCaptumError(
            f"The sensors have films of different sizes ({text}): give resolution= for all of them."
        )
    return sizes.pop()


def film_corners(sensor: Any) -> Any:
    """Return the directions of the film's left top, right top and left bottom, and of its axis, ``(4, 3)``."""
    import drjit as dr
    import mitsuba as mi

    corner = mi.Point2f([0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    ray, _ = sensor.sample_ray(0.0, 0.5, corner, mi.Point2f(0.5))
    axis = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
    return mi.TensorXf(dr.concat([dr.ravel(ray.d), dr.ravel(axis)]), shape=(4, 3))


def film_size(sensor: Any) -> tuple[int, int]:
    """Return the ``(width, height)`` of a sensor's film."""
    width, height = sensor.film().crop_size()
    return int(width), int(height)


def _resolution(sensor: Any, resolution: tuple[int, int] | None) -> tuple[int, int]:
    film = sensor.film()
    width, height = film_size(sensor)
    if resolution is None:
        return width, height
    if list(film.crop_size()) != list(film.size()):
        raise SceneCaptumError(
            f"The film has a crop window of {width}×{height} pixels, so resolution= would be ambiguous: "
            "leave it out, or remove the crop from the scene."
        )
    return _checked(resolution)


def _checked(resolution: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise SceneCaptumError(f"resolution must be (width, height) in pixels, not {resolution!r}.") from None
    return whole_number("the width", width), whole_number("the height", height)
