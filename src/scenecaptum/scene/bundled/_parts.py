"""The camera, materials and shapes that the bundled scenes are built from, as Mitsuba plugins."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from ...backend import activate

Plugin = dict[str, Any]
Vector = Sequence[float]


def base(
    *, resolution: tuple[int, int], origin: Vector, target: Vector, fov: float, max_depth: int = 6
) -> Plugin:
    """Return paths of ``max_depth`` segments, and a camera of ``fov`` degrees with 64 samples per pixel."""
    mi = activate()

    sensor = {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "smaller",  # a wider film shows more at the sides instead of less at top and bottom
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=(0, 0, 1)),
        "film": rgb_film(*resolution),
        "sampler": {"type": "independent", "sample_count": 64},
    }
    return {"type": "scene", "integrator": {"type": "prb", "max_depth": max_depth}, "sensor": sensor}


def rgb_film(width: int, height: int) -> Plugin:
    """Return a film that records linear RGB.

    With its box filter each sample contributes to one pixel only: pixels are independent estimates, and the
    gradient of a pixel does not leak into neighbouring objects.
    """
    pixels = {"width": width, "height": height, "pixel_format": "rgb", "component_format": "float32"}
    return {"type": "hdrfilm", **pixels, "rfilter": {"type": "box"}}


def rgb(red: float, green: float, blue: float) -> Plugin:
    return {"type": "rgb", "value": [red, green, blue]}


def diffuse(red: float, green: float, blue: float) -> Plugin:
    return {"type": "diffuse", "reflectance": rgb(red, green, blue)}


def glossy(red: float, green: float, blue: float, *, roughness: float) -> Plugin:
    color = rgb(red, green, blue)
    return {"type": "principled", "base_color": color, "roughness": roughness, "specular": 0.5}


def metal(element: str, *, roughness: float) -> Plugin:
    return {"type": "roughconductor", "material": element, "alpha": roughness}


def textured(texels: npt.NDArray[np.float32], *, filter_type: str) -> Plugin:
    """Return a diffuse material with the linear reflectance ``texels`` (H, W, 3), stored as float32."""
    mi = activate()

    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "format": "variant",  # a texture with fewer bits would not be a float32 input
        "filter_type": filter_type,
    }
    return {"type": "diffuse", "reflectance": texture}


def emitting(shape: Plugin, red: float, green: float, blue: float, *, sampling_weight: float = 1.0) -> Plugin:
    radiance = rgb(red, green, blue)
    return {**shape, "emitter": {"type": "area", "radiance": radiance, "sampling_weight": sampling_weight}}


def shape(kind: str, material: str | Plugin, **options: Any) -> Plugin:
    bsdf = {"type": "ref", "id": material} if isinstance(material, str) else material
    return {"type": kind, **options, "bsdf": bsdf}


def panel(centre: Vector, u: Vector, v: Vector, material: str | Plugin) -> Plugin:
    """Return the rectangle with edges ``u`` and ``v``; it faces along u × v."""
    mi = activate()

    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 3] = np.array(u) / 2, np.array(v) / 2, centre
    matrix[:3, 2] = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    return shape("rectangle", material, to_world=mi.ScalarTransform4f(matrix.tolist()))


def box(centre: Vector, size: Vector, material: str, *, turn: float = 0.0) -> Plugin:
    """Return a box with the given edge lengths, rotated by ``turn`` degrees about the vertical."""
    mi = activate()

    place = mi.ScalarTransform4f().translate(centre).rotate((0, 0, 1), turn)
    return shape("cube", material, to_world=place.scale([edge / 2 for edge in size]))


def span(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str) -> Plugin:
    """Return the box that spans three intervals."""
    return box(*centre_and_size(x, y, z), material)


def tube(start: Vector, end: Vector, radius: float, material: str) -> Plugin:
    return shape("cylinder", material, p0=list(start), p1=list(end), radius=radius)


def ball(centre: Vector, radius: float, material: str) -> Plugin:
    return shape("sphere", material, center=list(centre), radius=radius)


def disk(centre: Vector, facing: Vector, radii: tuple[float, float], material: str) -> Plugin:
    """Return an ellipse with semi-axes ``radii``; the second lies in the vertical plane through ``facing``."""
    mi = activate()

    up = (0, 0, 1) if facing[0] or facing[1] else (0, 1, 0)
    place = mi.ScalarTransform4f().look_at(origin=centre, target=offset(centre, facing, 1.0), up=up)
    return shape("disk", material, to_world=place.scale((*radii, 1)))


def centre_and_size(*intervals: tuple[float, float]) -> tuple[Vector, Vector]:
    """Return the centres and the lengths of the intervals."""
    return tuple((a + b) / 2 for a, b in intervals), tuple(b - a for a, b in intervals)


def unit(v: Vector) -> Vector:
    length = sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    return tuple(x / length for x in v)


def offset(start: Vector, direction: Vector, distance: float) -> Vector:
    return tuple(x + distance * step for x, step in zip(start, direction, strict=True))
