"""An office with strong glare."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
import numpy.typing as npt

from ._parts import (
    Plugin,
    Vector,
    ball,
    base,
    box,
    centre_and_size,
    diffuse,
    disk,
    emitting,
    glossy,
    metal,
    offset,
    panel,
    span,
    textured,
    tube,
    unit,
)


def office() -> Plugin:
    """Return an office with strong glare: a bright window behind a desk, luminaires, a desk lamp and a mirror.

    Lengths are in metres and radiances in W·m⁻²·sr⁻¹, so 179 lm/W times the Rec. 709 luminance of a pixel is its
    luminance in cd/m²: 3200 for the sky, 4000 for the luminaires, 5600 for the bulb, 50 to 150 for most of the
    walls, and up to 550 where the desk reflects the window. The film has 640 × 360 pixels.
    """
    return {
        **base(resolution=(640, 360), origin=(-0.75, -0.55, 1.52), target=(-0.03, 4.6, 0.93), fov=40.0),
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


_X, _Y, _Z = (-2.2, 2.2), (-0.9, 4.6), (0.0, 2.7)  # the room, in metres
_WINDOW_X, _WINDOW_Z = (-1.05, 1.6), (1.1, 2.35)  # the opening in the back wall
_DESK_TOP = 0.74


def _office_materials() -> dict[str, Plugin]:
    return {
        "wall_left": diffuse(0.62, 0.58, 0.52),
        "wall_right": diffuse(0.26, 0.40, 0.40),
        "wall_back": diffuse(0.64, 0.62, 0.58),
        "ceiling": diffuse(0.78, 0.78, 0.76),
        "floor": textured(_parquet(), filter_type="nearest"),
        "rug": diffuse(0.10, 0.16, 0.28),
        "desk": glossy(0.27, 0.13, 0.055, roughness=0.2),
        "cabinet": diffuse(0.55, 0.52, 0.47),
        "chair": diffuse(0.62, 0.30, 0.06),
        "frame": diffuse(0.20, 0.11, 0.06),
        "metal_legs": metal("Al", roughness=0.35),
        "screen": glossy(0.02, 0.02, 0.025, roughness=0.15),
        "mirror": {"type": "conductor", "material": "Ag"},
        "lamp_shade": {"type": "twosided", "bsdf": metal("Cu", roughness=0.25)},
        "lamp_stand": metal("Al", roughness=0.2),
        "curtain": diffuse(0.42, 0.38, 0.30),
        "window_frame": diffuse(0.70, 0.70, 0.68),
        "luminaire_housing": diffuse(0.60, 0.60, 0.60),
        # The light that panes, opal covers and bulbs reflect.
        "window_pane": diffuse(0.1, 0.1, 0.1),
        "diffuser": diffuse(0.1, 0.1, 0.1),
        "picture": textured(_painting(), filter_type="bilinear"),
        "book_red": diffuse(0.50, 0.09, 0.06),
        "book_blue": diffuse(0.08, 0.18, 0.36),
        "paper": diffuse(0.75, 0.74, 0.70),
        "mug": {"type": "twosided", "bsdf": diffuse(0.10, 0.32, 0.28)},
        "plant": {"type": "twosided", "bsdf": diffuse(0.10, 0.26, 0.06)},
        "pot": diffuse(0.52, 0.24, 0.14),
    }


def _office_room() -> dict[str, Plugin]:
    (x, y, z), (width, depth, height) = centre_and_size(_X, _Y, _Z)
    (left, right), (bottom, top), thick = _WINDOW_X, _WINDOW_Z, (_Y[1], _Y[1] + 0.2)
    across, along, up = (width, 0, 0), (0, depth, 0), (0, 0, height)
    return {
        "floor_shape": panel((x, y, _Z[0]), across, along, "floor"),
        "ceiling_shape": panel((x, y, _Z[1]), along, across, "ceiling"),
        "wall_left_shape": panel((_X[0], y, z), along, up, "wall_left"),
        "wall_right_shape": panel((_X[1], y, z), up, along, "wall_right"),
        "wall_front_shape": panel((x, _Y[0], z), up, across, "wall_back"),
        # The back wall is 0.2 m thick, so the window sits in a reveal.
        "wall_back_below": span(_X, thick, (_Z[0], bottom), "wall_back"),
        "wall_back_above": span(_X, thick, (top, _Z[1]), "wall_back"),
        "wall_back_left": span((_X[0], left), thick, (bottom, top), "wall_back"),
        "wall_back_right": span((right, _X[1]), thick, (bottom, top), "wall_back"),
    }


def _office_window() -> dict[str, Plugin]:
    (left, right), (bottom, top) = _WINDOW_X, _WINDOW_Z
    (x, z), (width, height) = centre_and_size(_WINDOW_X, _WINDOW_Z)
    wall, bar = _Y[1], 0.05
    posts = {
        f"window_post_{i}": box((left + share * width, wall + 0.11, z), (bar, bar, height), "window_frame")
        for i, share in enumerate((0.01, 1 / 3, 2 / 3, 0.99))
    }
    rails = {
        f"window_rail_{i}": box((x, wall + 0.11, level), (width, bar, bar), "window_frame")
        for i, level in enumerate((bottom + 0.025, top - 0.4, top - 0.025))
    }
    pleats = {
        f"curtain_{i}": tube((edge, wall - depth, 0.08), (edge, wall - depth, top + 0.1), 0.04, "curtain")
        for i, (edge, depth) in enumerate(
            (start + 0.055 * step, 0.06 + 0.02 * (step % 2))
            for start in (left - 0.25, right - 0.1)
            for step in range(7)
        )
    }
    pane = panel((x, wall + 0.14, z), (width, 0, 0), (0, 0, height), "window_pane")
    return {
        **posts,
        **rails,
        **pleats,
        "curtain_rail": tube(
            (left - 0.4, wall - 0.07, top + 0.1), (right + 0.4, wall - 0.07, top + 0.1), 0.015, "metal_legs"
        ),
        "window_sill": box((x, wall + 0.02, bottom), (width + 0.1, 0.16, 0.03), "window_frame"),
        # The emitting pane replaces the sky: unlike a sky outside, next-event estimation can sample it directly.
        "sky": emitting(pane, 15.0, 18.0, 22.0, sampling_weight=4.0),
    }


def _office_luminaires() -> dict[str, Plugin]:
    places = {"left": (-1.0, 3.1), "right": (1.15, 3.1), "back": (0.1, 0.4)}
    length, width, z = 1.3, 0.16, 2.32
    shapes: dict[str, Plugin] = {}
    for name, (x, y) in places.items():
        opal = panel((x, y, z - 0.021), (0, length, 0), (width, 0, 0), "diffuser")
        shapes[f"luminaire_{name}"] = emitting(opal, 25.0, 22.0, 18.0)
        shapes[f"luminaire_{name}_housing"] = box(
            (x, y, z), (width + 0.03, length + 0.03, 0.04), "luminaire_housing"
        )
        for end, dy in (("a", -0.5), ("b", 0.5)):
            shapes[f"luminaire_{name}_rod_{end}"] = tube(
                (x, y + dy, z), (x, y + dy, _Z[1]), 0.006, "luminaire_housing"
            )
    return shapes


def _office_desk() -> dict[str, Plugin]:
    top = _DESK_TOP
    legs = {
        f"desk_leg_{i}": box((x, y, (top - 0.035) / 2), (0.05, 0.05, top - 0.035), "metal_legs")
        for i, (x, y) in enumerate(((-0.6, 2.96), (-0.6, 3.59), (1.0, 2.96), (1.0, 3.59)))
    }
    return {
        **legs,
        "desk_top": span((-0.68, 1.08), (2.88, 3.67), (top - 0.035, top), "desk"),
        "screen_panel": box((0.42, 3.45, top + 0.32), (0.62, 0.025, 0.37), "screen", turn=-6),
        "screen_neck": box((0.42, 3.48, top + 0.09), (0.05, 0.02, 0.16), "metal_legs", turn=-6),
        "screen_foot": box((0.42, 3.46, top + 0.006), (0.24, 0.17, 0.012), "metal_legs", turn=-6),
        "keyboard": box((0.36, 3.1, top + 0.008), (0.42, 0.13, 0.016), "screen", turn=-4),
        "paper_sheet": box((-0.1, 3.08, top + 0.002), (0.21, 0.297, 0.004), "paper", turn=12),
        "book_lower": box((0.87, 3.3, top + 0.02), (0.19, 0.26, 0.04), "book_blue", turn=8),
        "book_upper": box((0.87, 3.3, top + 0.055), (0.16, 0.23, 0.03), "book_red", turn=-10),
        "mug_side": tube((0.74, 3.06, top), (0.74, 3.06, top + 0.095), 0.042, "mug"),
        "mug_bottom": disk((0.74, 3.06, top + 0.006), (0, 0, 1), (0.042, 0.042), "mug"),
    }


def _office_lamp() -> dict[str, Plugin]:
    foot, elbow, head = (-0.5, 3.42, _DESK_TOP), (-0.56, 3.46, 1.12), (-0.32, 3.3, 1.3)
    foot_top, axis = offset(foot, (0, 0, 1), 0.02), unit((0.25, -0.4, -1.0))
    return {
        "lamp_foot": tube(foot, foot_top, 0.09, "lamp_stand"),
        "lamp_foot_top": disk(foot_top, (0, 0, 1), (0.09, 0.09), "lamp_stand"),
        "lamp_lower_arm": tube(foot, elbow, 0.012, "lamp_stand"),
        "lamp_elbow": ball(elbow, 0.016, "lamp_stand"),
        "lamp_upper_arm": tube(elbow, head, 0.012, "lamp_stand"),
        "lamp_shade_side": tube(head, offset(head, axis, 0.17), 0.09, "lamp_shade"),
        "lamp_shade_top": disk(head, axis, (0.09, 0.09), "lamp_shade"),
        "bulb": emitting(
            ball(offset(head, axis, 0.13), 0.04, "diffuser"), 40.0, 30.0, 20.0, sampling_weight=0.3
        ),
    }


def _office_chair() -> dict[str, Plugin]:
    x, y, turn = -0.22, 2.42, 32.0
    cosine, sine = cos(radians(turn)), sin(radians(turn))

    def place(right: float, front: float, z: float) -> Vector:
        return (x + right * cosine - front * sine, y + right * sine + front * cosine, z)

    bearings = [radians(72 * i) for i in range(5)]
    spokes = {
        f"chair_spoke_{i}": tube(
            place(0, 0, 0.1), place(0.28 * cos(bearing), 0.28 * sin(bearing), 0.03), 0.016, "metal_legs"
        )
        for i, bearing in enumerate(bearings)
    }
    return {
        **spokes,
        "chair_seat": box(place(0, 0, 0.46), (0.48, 0.46, 0.07), "chair", turn=turn),
        "chair_back": box(place(0, -0.23, 0.76), (0.42, 0.05, 0.36), "chair", turn=turn),
        "chair_column": tube(place(0, 0, 0.08), place(0, 0, 0.44), 0.025, "metal_legs"),
        "chair_bracket": tube(place(0, -0.2, 0.44), place(0, -0.24, 0.62), 0.018, "metal_legs"),
    }


def _office_plant() -> dict[str, Plugin]:
    x, y, rim, count = -1.68, 4.1, 0.36, 28
    leaves = {}
    for i in range(count):
        age, bearing = i / (count - 1), radians(137.5 * i)  # the golden angle, as plants do
        reach, rise = 0.34 * (1 - 0.55 * age), 0.15 + 0.75 * age
        out = (cos(bearing), sin(bearing))
        centre = (x + reach * out[0], y + reach * out[1], rim + rise)
        leaves[f"plant_leaf_{i}"] = disk(centre, (-out[0], -out[1], 1.6), (0.05, 0.15), "plant")
    return {
        **leaves,
        "plant_stem": tube((x, y, rim), (x, y, rim + 0.95), 0.012, "plant"),
        "pot_side": tube((x, y, 0), (x, y, rim), 0.17, "pot"),
        "pot_soil": disk((x, y, rim - 0.01), (0, 0, 1), (0.17, 0.17), "pot"),
    }


def _office_cabinet() -> dict[str, Plugin]:
    wall, top = _X[1], 0.77
    doors = {
        f"cabinet_door_{i}": box((1.735, 3.165 + 0.51 * i, 0.4), (0.02, 0.5, 0.66), "cabinet")
        for i in range(3)
    }
    row = ((0.24, "book_red"), (0.27, "book_blue"), (0.22, "paper"), (0.26, "book_red"), (0.24, "book_blue"))
    books = {
        f"book_{i}": box((1.95, 3.05 + 0.05 * i, top + height / 2), (0.17, 0.042, height), cover)
        for i, (height, cover) in enumerate(row)
    }
    return {
        **doors,
        **books,
        "cabinet_body": span((1.74, wall), (2.9, 4.45), (0, top - 0.02), "cabinet"),
        "cabinet_top": span((1.72, wall), (2.88, 4.47), (top - 0.02, top), "frame"),
    }


def _office_decoration() -> dict[str, Plugin]:
    right, back = _X[1], _Y[1]
    return {
        "rug_shape": span((-1.1, 1.4), (1.5, 3.3), (0, 0.012), "rug"),
        "mirror_glass": panel((right - 0.031, 3.75, 1.55), (0, 0, 0.86), (0, 0.86, 0), "mirror"),
        "mirror_frame": box((right - 0.015, 3.75, 1.55), (0.03, 0.92, 0.92), "frame"),
        "picture_canvas": panel((-1.78, back - 0.026, 1.75), (0.77, 0, 0), (0, 0, 0.56), "picture"),
        "picture_frame": box((-1.78, back - 0.0125, 1.75), (0.81, 0.025, 0.6), "frame"),
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
