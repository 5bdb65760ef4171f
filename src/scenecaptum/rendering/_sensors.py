"""Which sensors of a scene a renderer looks through, and how large their pictures are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import SceneCaptumError, whole_number


def choose_sensor(scene: Any, which: int | str, resolution: tuple[int, int] | None) -> Any:
    """Return a sensor of the scene by its index, or a fisheye in the place of the first."""
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
            "hand in the scene's file or dict, which is loaded so."
        )
    return sensors[index]


def common_resolution(sensors: Sequence[Any], resolution: tuple[int, int] | None) -> tuple[int, int]:
    """Return the ``(width, height)`` of all sensors' pictures: the films' own where none is asked for."""
    if not sensors:
        raise SceneCaptumError("sensor is an empty list: name at least one sensor.")
    found = {_resolution(sensor, resolution) for sensor in sensors}
    if len(found) > 1:
        sizes = ", ".join(f"{width}×{height}" for width, height in sorted(found))
        raise SceneCaptumError(
            f"The sensors have pictures of different sizes ({sizes}): give resolution= for all of them."
        )
    return found.pop()


def _resolution(sensor: Any, resolution: tuple[int, int] | None) -> tuple[int, int]:
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    if resolution is None:
        return width, height
    if list(film.crop_size()) != list(film.size()):
        raise SceneCaptumError(
            f"The film shows a crop of {width}×{height} pixels, so resolution= would be ambiguous: "
            "leave it out, or take the crop out of the scene."
        )
    return _checked(resolution)


def _checked(resolution: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise SceneCaptumError(f"resolution must be (width, height) in pixels, not {resolution!r}.") from None
    return whole_number("the width", width), whole_number("the height", height)
