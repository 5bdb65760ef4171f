"""Generated images with glare sources: flat, graded, merged, separate, near and far from the line of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenecaptum import Camera


@dataclass(frozen=True)
class Picture:
    name: str
    camera: Camera
    luminance: np.ndarray


def _angles(camera: Camera, centre: tuple[float, float]) -> np.ndarray:
    """Angle of each pixel from a direction given as (azimuth to the right, elevation), in radians."""
    azimuth, elevation = np.radians(centre)
    axis = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    return np.arccos(np.clip(camera.directions.numpy() @ axis, -1, 1))


def disc(camera, centre, radius, level, *, graded=False):
    """Luminance of a disc (degrees, cd/m²), 0 elsewhere; graded falls to a third of the level at the rim."""
    distance = _angles(camera, centre) / np.radians(radius)
    return np.where(distance <= 1, level * (1 - 2 / 3 * distance**2 if graded else 1), 0.0)


def window(camera, centre, half_width, half_height, level):
    """Luminance of a window: a range of azimuth and elevation, in degrees."""
    x, y, z = camera.directions.numpy().transpose(2, 0, 1)
    azimuth, elevation = np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(y))
    inside = (np.abs(azimuth - centre[0]) <= half_width) & (np.abs(elevation - centre[1]) <= half_height)
    return np.where(inside & (z > 0), level, 0.0)


def room(camera: Camera, level: float) -> np.ndarray:
    """A background that is brighter above than below, from half to one and a half times the level."""
    return level * (1 + 0.5 * camera.directions[..., 1].numpy())


def pictures() -> list[Picture]:
    fisheye, fine = Camera.fisheye(360, 360), Camera.fisheye(512, 512)
    made = []

    def add(name: str, camera: Camera, background: float, *sources: np.ndarray) -> None:
        made.append(Picture(name, camera, np.maximum.reduce([room(camera, background), *sources])))

    add("one-ahead", fisheye, 100, disc(fisheye, (3, 8), 4, 10_000))
    add("one-high", fisheye, 100, disc(fisheye, (0, 50), 6, 20_000))
    add("one-very-high", fisheye, 150, disc(fisheye, (20, 75), 8, 30_000))
    add("one-below", fisheye, 80, disc(fisheye, (10, -25), 5, 8_000))
    add("one-far-below", fisheye, 80, disc(fisheye, (-30, -55), 7, 25_000))
    add("one-to-the-side", fisheye, 120, disc(fisheye, (70, 5), 6, 15_000))
    add("one-to-the-left", fisheye, 120, disc(fisheye, (-60, 20), 5, 9_000))
    add("one-at-the-rim", fisheye, 120, disc(fisheye, (-84, 2), 5, 9_000))
    add("tiny", fine, 50, disc(fine, (12, 17), 0.8, 40_000))
    add("graded", fisheye, 100, disc(fisheye, (-15, 25), 9, 12_000, graded=True))
    add("graded-to-the-threshold", fisheye, 100, disc(fisheye, (15, 20), 12, 5_500, graded=True))
    add("merged", fisheye, 90, disc(fisheye, (10, 20), 5, 9_000), disc(fisheye, (23, 20), 5, 15_000))
    add("separate", fisheye, 90, disc(fisheye, (-10, 25), 4, 9_000), disc(fisheye, (18, 20), 4, 15_000))
    add("just-separate", fine, 90, disc(fine, (-8, 15.3), 4, 9_000), disc(fine, (7.2, 15), 4, 15_000))
    add("above-each-other", fine, 90, disc(fine, (5, 10), 3, 9_000), disc(fine, (5, 21), 3, 7_000))
    row = [disc(fisheye, (a, 35), 2.5, 18_000) for a in (-50, -18, 17, 51)]
    add("row-of-four", fisheye, 100, *row)
    grid = [disc(fisheye, (a, e), 2.3, 12_000) for a in (-42, -15, 14, 43) for e in (22, 48)]
    add("eight", fisheye, 100, *grid)
    chain = [disc(fisheye, (a, 30 + 0.1 * a), 2.5, 14_000) for a in (-30, -20, -10, 0, 10)]
    add("chain-of-five", fisheye, 100, *chain)
    add("window", fisheye, 200, window(fisheye, (-35, 12), 18, 14, 5_000))
    panes = [window(fisheye, (a, 12), 6, 12, level) for a, level in ((20, 4_000), (34, 6_000), (48, 9_000))]
    add("window-of-three-panes", fisheye, 200, *panes)
    add(
        "sun-in-a-window",
        fisheye,
        250,
        window(fisheye, (25, 20), 15, 12, 6_000),
        disc(fisheye, (28, 24), 2, 900_000),
    )
    add(
        "two-suns-in-a-window",
        fisheye,
        250,
        window(fisheye, (0, 25), 30, 12, 6_000),
        disc(fisheye, (-20, 24), 2, 300_000),
        disc(fisheye, (19, 28), 3, 90_000),
    )
    add("bright-room", fisheye, 900, window(fisheye, (-20, 15), 20, 16, 12_000))
    add("dark-room", fisheye, 2, disc(fisheye, (5, 10), 3, 3_000))
    add("wide-sky", fisheye, 300, window(fisheye, (0, 45), 70, 25, 8_000))
    add("none", fisheye, 300)
    wide, narrow, tall = (
        Camera.perspective(480, 270, 90),
        Camera.perspective(320, 240, 50),
        Camera.perspective(240, 320, 60),
    )
    add("perspective-one", wide, 100, disc(wide, (10, 8), 4, 10_000))
    add("perspective-below", wide, 100, disc(wide, (-20, -12), 3, 10_000))
    add("perspective-graded", narrow, 60, disc(narrow, (-8, 6), 5, 20_000, graded=True))
    add("perspective-three", wide, 100, *(disc(wide, (a, 15), 2.5, 9_000) for a in (-30, -3, 28)))
    add("perspective-merged", narrow, 60, disc(narrow, (-5, 6), 2, 8_000), disc(narrow, (2, 6), 2, 8_000))
    add("perspective-tall", tall, 60, disc(tall, (5, 25), 3, 8_000), disc(tall, (-6, -20), 3, 8_000))
    add(
        "perspective-sun",
        wide,
        150,
        window(wide, (20, 10), 12, 8, 7_000),
        disc(wide, (24, 11), 1.2, 1_000_000),
    )
    return made
