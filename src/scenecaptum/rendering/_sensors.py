"""Select sensors of a scene and their common resolution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import SceneCaptumError, whole_number


def choose_sensor(scene: Any, which: int | str, resolution: tuple[int, int] | None) -> Any:
    """Return a sensor of the scene by its index, or a fisheye with the pose of the first."""
    sensors = scene.sensors()
    if isinstance(which, str):
        if which != "fisheye":
            raise SceneCaptumError(f'sensor must be the index of a sensor or "fisheye", not {which!r}.')
        from ._cameras import fisheye_at

        side = min(sensors[0].film().crop_size())
        return fisheye_at(sensors[0], _checked(resolution) if resolution else (side, side))
    index = whole_number("sensor", which, 0, len(sensors) - 1)
    if "pixel_format = rgb," not in str(sensors[index].film()):
        raise SceneCaptumError(
            f'The film of sensor {index} does not record linear RGB. Give it pixel_format="rgb" (hdrfilm), or '
            "pass the scene's file or dict, which is loaded with an RGB film."
        )
    return sensors[index]


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


def _resolution(sensor: Any, resolution: tuple[int, int] | None) -> tuple[int, int]:
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
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
