"""Scenes that come with the library, built from primitives in code: no file is shipped or downloaded.

Both are ordinary Mitsuba dictionaries. The x axis points right, y away from the camera, z up. Every material has
a readable name, which is the prefix of its parameters' names (``chair.reflectance.value``), and every emitter is
named after its shape (``sky.emitter.radiance.value``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import cos, radians, sin, sqrt
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

Plugin = dict[str, Any]
Vector = Sequence[float]


def cornell_box() -> Plugin:
    """Return the Cornell box: red left wall, green right wall, two boxes and a warm ceiling light.

    The room is the cube [-1, 1]³ in arbitrary units. Each surface has its own material, so each reflectance is a
    separate parameter (``tall_box.reflectance.value``). The film has 256 × 256 pixels.
    """
    white = (0.885809, 0.698859, 0.666422)
    light = _panel((0, 0, 0.99), (0.46, 0, 0), (0, -0.38, 0), _diffuse(0.78, 0.78, 0.78))
    return {
        **_base(resolution=(256, 256), origin=(0, -3.9, 0), target=(0, 0, 0), fov=38.0),
        "left_wall": _diffuse(0.570068, 0.0430135, 0.0443706),
        "right_wall": _diffuse(0.105421, 0.37798, 0.076425),
        **{name: _diffuse(*white) for name in ("floor", "ceiling", "back_wall", "short_box", "tall_box")},
        "left_wall_shape": _panel((-1, 0, 0), (0, 2, 0), (0, 0, 2), "left_wall"),
        "right_wall_shape": _panel((1, 0, 0), (0, -2, 0), (0, 0, 2), "right_wall"),
        "floor_shape": _panel((0, 0, -1), (2, 0, 0), (0, 2, 0), "floor"),
        "ceiling_shape": _panel((0, 0, 1), (2, 0, 0), (0, -2, 0), "ceiling"),
        "back_wall_shape": _panel((0, 1, 0), (2, 0, 0), (0, 0, 2), "back_wall"),
        "short_box_shape": _box((0.335, -0.38, -0.7), (0.6, 0.6, 0.6), "short_box", turn=-17.0),
        "tall_box_shape": _box((-0.33, 0.28, -0.39), (0.6, 0.6, 1.22), "tall_box", turn=18.25),
        "light": _emitting(light, 18.387, 13.9873, 6.75357),
    }


def office() -> Plugin:
    """Return an office with strong glare: a bright window behind a desk, luminaires, a desk lamp and a mirror.

    Lengths are in metres and radiances in W·m⁻²·sr⁻¹, so 179 lm/W times the Rec. 709 luminance of a pixel is its
    luminance in cd/m²: 3200 for the sky, 4000 for the luminaires, 5600 for the bulb, 50 to 150 for most of the
    walls, and up to 550 where the desk reflects the window. The film has 640 × 360 pixels.
    """
    return {
        **_base(resolution=(640, 360), origin=(-0.75, -0.55, 1.52), target=(-0.03, 4.6, 0.93), fov=40.0),
        **_office_materials(),
        **_office_room(),
        **_office_window(),
        **_office_luminaires(),
        **_office_desk(),
        **_office_lamp(),
        **_office_chair(),
        **_office_plant(),
        **_office_cabinet(),
        **_office_decoration(),
    }


BUNDLED: Mapping[str, Callable[[], Plugin]] = MappingProxyType({"cornell-box": cornell_box, "office": office})


# --- Parts of the office --------------------------------------------------------------------------

_X, _Y, _Z = (-2.2, 2.2), (-0.9, 4.6), (0.0, 2.7)  # the room, in metres
_WINDOW_X, _WINDOW_Z = (-1.05, 1.6), (1.1, 2.35)  # the opening in the back wall
_DESK_TOP = 0.74


def _office_materials() -> dict[str, Plugin]:
    return {
        "wall_left": _diffuse(0.62, 0.58, 0.52),
        "wall_right": _diffuse(0.26, 0.40, 0.40),
        "wall_back": _diffuse(0.64, 0.62, 0.58),
        "ceiling": _diffuse(0.78, 0.78, 0.76),
        "floor": _textured(_parquet(), filter_type="nearest"),
        "rug": _diffuse(0.10, 0.16, 0.28),
        "desk": _glossy(0.27, 0.13, 0.055, roughness=0.2),
        "cabinet": _diffuse(0.55, 0.52, 0.47),
        "chair": _diffuse(0.62, 0.30, 0.06),
        "frame": _diffuse(0.20, 0.11, 0.06),
        "metal_legs": _metal("Al", roughness=0.35),
        "screen": _glossy(0.02, 0.02, 0.025, roughness=0.15),
        "mirror": {"type": "conductor", "material": "Ag"},
        "lamp_shade": {"type": "twosided", "bsdf": _metal("Cu", roughness=0.25)},
        "lamp_stand": _metal("Al", roughness=0.2),
        "curtain": _diffuse(0.42, 0.38, 0.30),
        "window_frame": _diffuse(0.70, 0.70, 0.68),
        "luminaire_housing": _diffuse(0.60, 0.60, 0.60),
        # The light that panes, opal covers and bulbs reflect.
        "window_pane": _diffuse(0.1, 0.1, 0.1),
        "diffuser": _diffuse(0.1, 0.1, 0.1),
        "picture": _textured(_painting(), filter_type="bilinear"),
        "book_red": _diffuse(0.50, 0.09, 0.06),
        "book_blue": _diffuse(0.08, 0.18, 0.36),
        "paper": _diffuse(0.75, 0.74, 0.70),
        "mug": {"type": "twosided", "bsdf": _diffuse(0.10, 0.32, 0.28)},
        "plant": {"type": "twosided", "bsdf": _diffuse(0.10, 0.26, 0.06)},
        "pot": _diffuse(0.52, 0.24, 0.14),
    }


def _office_room() -> dict[str, Plugin]:
    (x, y, z), (width, depth, height) = _centre_and_size(_X, _Y, _Z)
    (left, right), (bottom, top), thick = _WINDOW_X, _WINDOW_Z, (_Y[1], _Y[1] + 0.2)
    across, along, up = (width, 0, 0), (0, depth, 0), (0, 0, height)
    return {
        "floor_shape": _panel((x, y, _Z[0]), across, along, "floor"),
        "ceiling_shape": _panel((x, y, _Z[1]), along, across, "ceiling"),
        "wall_left_shape": _panel((_X[0], y, z), along, up, "wall_left"),
        "wall_right_shape": _panel((_X[1], y, z), up, along, "wall_right"),
        "wall_front_shape": _panel((x, _Y[0], z), up, across, "wall_back"),
        # The back wall is 0.2 m thick, so the window sits in a reveal.
        "wall_back_below": _span(_X, thick, (_Z[0], bottom), "wall_back"),
        "wall_back_above": _span(_X, thick, (top, _Z[1]), "wall_back"),
        "wall_back_left": _span((_X[0], left), thick, (bottom, top), "wall_back"),
        "wall_back_right": _span((right, _X[1]), thick, (bottom, top), "wall_back"),
    }


def _office_window() -> dict[str, Plugin]:
    (left, right), (bottom, top) = _WINDOW_X, _WINDOW_Z
    (x, z), (width, height) = _centre_and_size(_WINDOW_X, _WINDOW_Z)
    wall, bar = _Y[1], 0.05
    posts = {
        f"window_post_{i}": _box((left + share * width, wall + 0.11, z), (bar, bar, height), "window_frame")
        for i, share in enumerate((0.01, 1 / 3, 2 / 3, 0.99))
    }
    rails = {
        f"window_rail_{i}": _box((x, wall + 0.11, level), (width, bar, bar), "window_frame")
        for i, level in enumerate((bottom + 0.025, top - 0.4, top - 0.025))
    }
    pleats = {
        f"curtain_{i}": _tube((edge, wall - depth, 0.08), (edge, wall - depth, top + 0.1), 0.04, "curtain")
        for i, (edge, depth) in enumerate(
            (start + 0.055 * step, 0.06 + 0.02 * (step % 2))
            for start in (left - 0.25, right - 0.1)
            for step in range(7)
        )
    }
    pane = _panel((x, wall + 0.14, z), (width, 0, 0), (0, 0, height), "window_pane")
    return {
        **posts,
        **rails,
        **pleats,
        "curtain_rail": _tube(
            (left - 0.4, wall - 0.07, top + 0.1), (right + 0.4, wall - 0.07, top + 0.1), 0.015, "metal_legs"
        ),
        "window_sill": _box((x, wall + 0.02, bottom), (width + 0.1, 0.16, 0.03), "window_frame"),
        # The emitting pane replaces the sky: unlike a sky outside, next-event estimation can sample it directly.
        "sky": _emitting(pane, 15.0, 18.0, 22.0, sampling_weight=4.0),
    }


def _office_luminaires() -> dict[str, Plugin]:
    places = {"left": (-1.0, 3.1), "right": (1.15, 3.1), "back": (0.1, 0.4)}
    length, width, z = 1.3, 0.16, 2.32
    shapes: dict[str, Plugin] = {}
    for name, (x, y) in places.items():
        opal = _panel((x, y, z - 0.021), (0, length, 0), (width, 0, 0), "diffuser")
        shapes[f"luminaire_{name}"] = _emitting(opal, 25.0, 22.0, 18.0)
        shapes[f"luminaire_{name}_housing"] = _box(
            (x, y, z), (width + 0.03, length + 0.03, 0.04), "luminaire_housing"
        )
        for end, dy in (("a", -0.5), ("b", 0.5)):
            shapes[f"luminaire_{name}_rod_{end}"] = _tube(
                (x, y + dy, z), (x, y + dy, _Z[1]), 0.006, "luminaire_housing"
            )
    return shapes


def _office_desk() -> dict[str, Plugin]:
    top = _DESK_TOP
    legs = {
        f"desk_leg_{i}": _box((x, y, (top - 0.035) / 2), (0.05, 0.05, top - 0.035), "metal_legs")
        for i, (x, y) in enumerate(((-0.6, 2.96), (-0.6, 3.59), (1.0, 2.96), (1.0, 3.59)))
    }
    return {
        **legs,
        "desk_top": _span((-0.68, 1.08), (2.88, 3.67), (top - 0.035, top), "desk"),
        "screen_panel": _box((0.42, 3.45, top + 0.32), (0.62, 0.025, 0.37), "screen", turn=-6),
        "screen_neck": _box((0.42, 3.48, top + 0.09), (0.05, 0.02, 0.16), "metal_legs", turn=-6),
        "screen_foot": _box((0.42, 3.46, top + 0.006), (0.24, 0.17, 0.012), "metal_legs", turn=-6),
        "keyboard": _box((0.36, 3.1, top + 0.008), (0.42, 0.13, 0.016), "screen", turn=-4),
        "paper_sheet": _box((-0.1, 3.08, top + 0.002), (0.21, 0.297, 0.004), "paper", turn=12),
        "book_lower": _box((0.87, 3.3, top + 0.02), (0.19, 0.26, 0.04), "book_blue", turn=8),
        "book_upper": _box((0.87, 3.3, top + 0.055), (0.16, 0.23, 0.03), "book_red", turn=-10),
        "mug_side": _tube((0.74, 3.06, top), (0.74, 3.06, top + 0.095), 0.042, "mug"),
        "mug_bottom": _disk((0.74, 3.06, top + 0.006), (0, 0, 1), (0.042, 0.042), "mug"),
    }


def _office_lamp() -> dict[str, Plugin]:
    foot, elbow, head = (-0.5, 3.42, _DESK_TOP), (-0.56, 3.46, 1.12), (-0.32, 3.3, 1.3)
    foot_top, axis = _offset(foot, (0, 0, 1), 0.02), _unit((0.25, -0.4, -1.0))
    return {
        "lamp_foot": _tube(foot, foot_top, 0.09, "lamp_stand"),
        "lamp_foot_top": _disk(foot_top, (0, 0, 1), (0.09, 0.09), "lamp_stand"),
        "lamp_lower_arm": _tube(foot, elbow, 0.012, "lamp_stand"),
        "lamp_elbow": _ball(elbow, 0.016, "lamp_stand"),
        "lamp_upper_arm": _tube(elbow, head, 0.012, "lamp_stand"),
        "lamp_shade_side": _tube(head, _offset(head, axis, 0.17), 0.09, "lamp_shade"),
        "lamp_shade_top": _disk(head, axis, (0.09, 0.09), "lamp_shade"),
        "bulb": _emitting(
            _ball(_offset(head, axis, 0.13), 0.04, "diffuser"), 40.0, 30.0, 20.0, sampling_weight=0.3
        ),
    }


def _office_chair() -> dict[str, Plugin]:
    x, y, turn = -0.22, 2.42, 32.0
    cosine, sine = cos(radians(turn)), sin(radians(turn))

    def place(right: float, front: float, z: float) -> Vector:
        return (x + right * cosine - front * sine, y + right * sine + front * cosine, z)

    bearings = [radians(72 * i) for i in range(5)]
    spokes = {
        f"chair_spoke_{i}": _tube(
            place(0, 0, 0.1), place(0.28 * cos(bearing), 0.28 * sin(bearing), 0.03), 0.016, "metal_legs"
        )
        for i, bearing in enumerate(bearings)
    }
    return {
        **spokes,
        "chair_seat": _box(place(0, 0, 0.46), (0.48, 0.46, 0.07), "chair", turn=turn),
        "chair_back": _box(place(0, -0.23, 0.76), (0.42, 0.05, 0.36), "chair", turn=turn),
        "chair_column": _tube(place(0, 0, 0.08), place(0, 0, 0.44), 0.025, "metal_legs"),
        "chair_bracket": _tube(place(0, -0.2, 0.44), place(0, -0.24, 0.62), 0.018, "metal_legs"),
    }


def _office_plant() -> dict[str, Plugin]:
    x, y, rim, count = -1.68, 4.1, 0.36, 28
    leaves = {}
    for i in range(count):
        age, bearing = i / (count - 1), radians(137.5 * i)  # the golden angle, as plants do
        reach, rise = 0.34 * (1 - 0.55 * age), 0.15 + 0.75 * age
        out = (cos(bearing), sin(bearing))
        centre = (x + reach * out[0], y + reach * out[1], rim + rise)
        leaves[f"plant_leaf_{i}"] = _disk(centre, (-out[0], -out[1], 1.6), (0.05, 0.15), "plant")
    return {
        **leaves,
        "plant_stem": _tube((x, y, rim), (x, y, rim + 0.95), 0.012, "plant"),
        "pot_side": _tube((x, y, 0), (x, y, rim), 0.17, "pot"),
        "pot_soil": _disk((x, y, rim - 0.01), (0, 0, 1), (0.17, 0.17), "pot"),
    }


def _office_cabinet() -> dict[str, Plugin]:
    wall, top = _X[1], 0.77
    doors = {
        f"cabinet_door_{i}": _box((1.735, 3.165 + 0.51 * i, 0.4), (0.02, 0.5, 0.66), "cabinet")
        for i in range(3)
    }
    row = ((0.24, "book_red"), (0.27, "book_blue"), (0.22, "paper"), (0.26, "book_red"), (0.24, "book_blue"))
    books = {
        f"book_{i}": _box((1.95, 3.05 + 0.05 * i, top + height / 2), (0.17, 0.042, height), cover)
        for i, (height, cover) in enumerate(row)
    }
    return {
        **doors,
        **books,
        "cabinet_body": _span((1.74, wall), (2.9, 4.45), (0, top - 0.02), "cabinet"),
        "cabinet_top": _span((1.72, wall), (2.88, 4.47), (top - 0.02, top), "frame"),
    }


def _office_decoration() -> dict[str, Plugin]:
    right, back = _X[1], _Y[1]
    return {
        "rug_shape": _span((-1.1, 1.4), (1.5, 3.3), (0, 0.012), "rug"),
        "mirror_glass": _panel((right - 0.031, 3.75, 1.55), (0, 0, 0.86), (0, 0.86, 0), "mirror"),
        "mirror_frame": _box((right - 0.015, 3.75, 1.55), (0.03, 0.92, 0.92), "frame"),
        "picture_canvas": _panel((-1.78, back - 0.026, 1.75), (0.77, 0, 0), (0, 0, 0.56), "picture"),
        "picture_frame": _box((-1.78, back - 0.0125, 1.75), (0.81, 0.025, 0.6), "frame"),
    }


def _parquet() -> npt.NDArray[np.float32]:
    """Return a 64 × 64 strip parquet; one texel is as wide as one strip, seven centimetres on the office floor."""
    rng = np.random.default_rng(7)
    oak = np.array([0.42, 0.29, 0.18])
    texels = np.empty((64, 64, 3))
    for column in range(64):
        tone = rng.uniform(0.75, 1.2, size=10)
        pieces = (np.arange(64) + rng.integers(8)) // 8
        texels[:, column] = tone[pieces, None] * oak
    return np.asarray(texels, dtype=np.float32)


def _painting() -> npt.NDArray[np.float32]:
    """Return a 32 × 44 landscape: a pale sky, a low sun and two hills."""
    height, width = 32, 44
    v, u = np.mgrid[0:height, 0:width] / np.array([height, width]).reshape(2, 1, 1)
    texels = np.array([0.72, 0.66, 0.55]) - v[..., None] * np.array([0.0, 0.2, 0.3])
    texels[(u - 0.68) ** 2 + ((v - 0.42) * height / width) ** 2 < 0.012] = (0.75, 0.24, 0.08)
    texels[v > 0.62 + 0.12 * np.sin(5 * u)] = (0.16, 0.34, 0.36)
    texels[v > 0.8 - 0.1 * np.sin(4 * u + 0.6)] = (0.05, 0.13, 0.18)
    return np.asarray(texels[::-1], dtype=np.float32)  # a texture's first row is at the bottom


# --- Scene, materials and shapes as Mitsuba plugins -----------------------------------------------


def _base(*, resolution: tuple[int, int], origin: Vector, target: Vector, fov: float) -> Plugin:
    """Return paths of at most 6 segments, and a camera of ``fov`` degrees with 64 samples per pixel."""
    import mitsuba as mi

    sensor = {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "smaller",  # a wider film shows more at the sides instead of less at top and bottom
        "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=(0, 0, 1)),
        "film": rgb_film(*resolution),
        "sampler": {"type": "independent", "sample_count": 64},
    }
    return {"type": "scene", "integrator": {"type": "prb", "max_depth": 6}, "sensor": sensor}


def rgb_film(width: int, height: int) -> Plugin:
    """Return a film that records linear RGB.

    With its box filter each sample contributes to one pixel only: pixels are independent estimates, and the
    gradient of a pixel does not leak into neighbouring objects.
    """
    pixels = {"width": width, "height": height, "pixel_format": "rgb", "component_format": "float32"}
    return {"type": "hdrfilm", **pixels, "rfilter": {"type": "box"}}


def _rgb(red: float, green: float, blue: float) -> Plugin:
    return {"type": "rgb", "value": [red, green, blue]}


def _diffuse(red: float, green: float, blue: float) -> Plugin:
    return {"type": "diffuse", "reflectance": _rgb(red, green, blue)}


def _glossy(red: float, green: float, blue: float, *, roughness: float) -> Plugin:
    color = _rgb(red, green, blue)
    return {"type": "principled", "base_color": color, "roughness": roughness, "specular": 0.5}


def _metal(element: str, *, roughness: float) -> Plugin:
    return {"type": "roughconductor", "material": element, "alpha": roughness}


def _textured(texels: npt.NDArray[np.float32], *, filter_type: str) -> Plugin:
    """Return a diffuse material with the linear reflectance ``texels`` (H, W, 3), stored as float32."""
    import mitsuba as mi

    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "format": "variant",  # a texture with fewer bits would not be a float32 input
        "filter_type": filter_type,
    }
    return {"type": "diffuse", "reflectance": texture}


def _emitting(
    shape: Plugin, red: float, green: float, blue: float, *, sampling_weight: float = 1.0
) -> Plugin:
    radiance = _rgb(red, green, blue)
    return {**shape, "emitter": {"type": "area", "radiance": radiance, "sampling_weight": sampling_weight}}


def _shape(kind: str, material: str | Plugin, **options: Any) -> Plugin:
    bsdf = {"type": "ref", "id": material} if isinstance(material, str) else material
    return {"type": kind, **options, "bsdf": bsdf}


def _panel(centre: Vector, u: Vector, v: Vector, material: str | Plugin) -> Plugin:
    """Return the rectangle with edges ``u`` and ``v``; it faces along u × v."""
    import mitsuba as mi

    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 3] = np.array(u) / 2, np.array(v) / 2, centre
    matrix[:3, 2] = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    return _shape("rectangle", material, to_world=mi.ScalarTransform4f(matrix.tolist()))


def _box(centre: Vector, size: Vector, material: str, *, turn: float = 0.0) -> Plugin:
    """Return a box with the given edge lengths, rotated by ``turn`` degrees about the vertical."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate(centre).rotate((0, 0, 1), turn)
    return _shape("cube", material, to_world=place.scale([edge / 2 for edge in size]))


def _span(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str) -> Plugin:
    """Return the box that spans three intervals."""
    return _box(*_centre_and_size(x, y, z), material)


def _tube(start: Vector, end: Vector, radius: float, material: str) -> Plugin:
    return _shape("cylinder", material, p0=list(start), p1=list(end), radius=radius)


def _ball(centre: Vector, radius: float, material: str) -> Plugin:
    return _shape("sphere", material, center=list(centre), radius=radius)


def _disk(centre: Vector, facing: Vector, radii: tuple[float, float], material: str) -> Plugin:
    """Return an ellipse with semi-axes ``radii``; the second lies in the vertical plane through ``facing``."""
    import mitsuba as mi

    up = (0, 0, 1) if facing[0] or facing[1] else (0, 1, 0)
    place = mi.ScalarTransform4f().look_at(origin=centre, target=_offset(centre, facing, 1.0), up=up)
    return _shape("disk", material, to_world=place.scale((*radii, 1)))


def _centre_and_size(*intervals: tuple[float, float]) -> tuple[Vector, Vector]:
    """Return the centres and the lengths of the intervals."""
    return tuple((a + b) / 2 for a, b in intervals), tuple(b - a for a, b in intervals)


def _unit(v: Vector) -> Vector:
    length = sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    return tuple(x / length for x in v)


def _offset(start: Vector, direction: Vector, distance: float) -> Vector:
    return tuple(x + distance * step for x, step in zip(start, direction, strict=True))
