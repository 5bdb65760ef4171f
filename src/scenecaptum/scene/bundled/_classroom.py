"""A classroom that daylight lights from one side."""

from __future__ import annotations

from ._parts import Plugin, base, box, centre_and_size, diffuse, disk, glossy, metal, panel, rgb, span

_X, _Y, _Z = (-4.0, 4.0), (0.0, 6.0), (0.0, 3.0)  # the room, in metres
_OUTSIDE = -0.3  # the outer face of the wall with the windows
_SILL, _HEAD = 1.0, 2.35
_WINDOWS = ((-3.4, -2.2), (-1.55, -0.35), (0.35, 1.55), (2.2, 3.4))
_BLIND_DEPTH = 0.4  # how far the blind hangs down
_DESK_X, _DESK_Y = (-1.7, -0.3, 1.1, 2.5), (1.15, 3.0, 4.85)
_DESK_TOP = 0.74


def classroom() -> Plugin:
    """Return a classroom of 8 × 6 × 3 m with a row of windows in its south wall, for questions of daylight.

    Lengths are in metres, x points east and y north. Its only light is the sky, of 4500 cd/m² where radiances are
    in W·m⁻²·sr⁻¹, through panes that transmit 55 %. Each window has a roller blind, which hangs down by 0.4 m; all
    four are one object, ``blind``, whose pose and opacity are inputs. The film has 640 × 360 pixels.
    """
    return {
        # Light that reaches the back of the room has crossed a pane and several surfaces.
        **base(
            resolution=(640, 360), max_depth=10, origin=(3.75, 5.35, 1.75), target=(-2.6, 1.7, 1.02), fov=56.0
        ),
        **_materials(),
        **_room(),
        **_windows(),
        **_desks(),
        **_chairs(),
        **_front(),
        **_back(),
        "sky": {"type": "constant", "radiance": rgb(23.5, 25.0, 29.0)},
        "ground_shape": disk((0, 0, _OUTSIDE), (0, 0, 1), (60.0, 60.0), "ground"),
    }


def _materials() -> dict[str, Plugin]:
    cloth = {"type": "twosided", "bsdf": diffuse(0.50, 0.48, 0.42)}
    return {
        "ceiling": diffuse(0.64, 0.64, 0.62),
        "floor": diffuse(0.24, 0.22, 0.19),
        "wall_windows": diffuse(0.55, 0.54, 0.51),
        "wall_front": diffuse(0.52, 0.52, 0.50),
        "wall_back": diffuse(0.42, 0.47, 0.42),
        "wall_corridor": diffuse(0.58, 0.54, 0.47),
        "ground": diffuse(0.16, 0.19, 0.12),
        # At right angles to the pane, reflection leaves 92 % of the light, and the coated glass 60 % of these.
        "pane": {"type": "thindielectric", "int_ior": 1.5, "specular_transmittance": rgb(0.6, 0.6, 0.6)},
        "window_frame": diffuse(0.65, 0.65, 0.63),
        "sill": diffuse(0.60, 0.59, 0.56),
        "cloth": {"type": "mask", "opacity": 0.8, "bsdf": cloth},
        "desk": glossy(0.48, 0.36, 0.22, roughness=0.35),
        "legs": metal("Al", roughness=0.35),
        "chair": diffuse(0.10, 0.22, 0.38),
        "board": glossy(0.03, 0.09, 0.07, roughness=0.4),
        "board_frame": diffuse(0.40, 0.28, 0.16),
        "door": diffuse(0.34, 0.20, 0.10),
        "pinboard": diffuse(0.36, 0.24, 0.13),
        "paper": diffuse(0.74, 0.73, 0.69),
        "poster": diffuse(0.55, 0.20, 0.08),
        "cabinet": diffuse(0.50, 0.46, 0.38),
    }


def _room() -> dict[str, Plugin]:
    (x, y, z), (width, depth, height) = centre_and_size(_X, _Y, _Z)
    across, along, up = (width, 0, 0), (0, depth, 0), (0, 0, height)
    thick, band = (_OUTSIDE, _Y[0]), (_SILL, _HEAD)
    edges = [_X[0], *(edge for window in _WINDOWS for edge in window), _X[1]]
    piers = {
        f"wall_pier_{i}": span((left, right), thick, band, "wall_windows")
        for i, (left, right) in enumerate(zip(edges[::2], edges[1::2], strict=True))
    }
    return {
        **piers,
        "wall_parapet": span(_X, thick, (_OUTSIDE, _SILL), "wall_windows"),
        "wall_lintel": span(_X, thick, (_HEAD, _Z[1]), "wall_windows"),
        "floor_shape": panel((x, y, _Z[0]), across, along, "floor"),
        "ceiling_shape": panel((x, y, _Z[1]), along, across, "ceiling"),
        "wall_front_shape": panel((_X[0], y, z), along, up, "wall_front"),
        "wall_back_shape": panel((_X[1], y, z), up, along, "wall_back"),
        "wall_corridor_shape": panel((x, _Y[1], z), across, up, "wall_corridor"),
    }


def _windows() -> dict[str, Plugin]:
    (z,), (height,) = centre_and_size((_SILL, _HEAD))
    glass, bar = -0.2, 0.06
    shapes: dict[str, Plugin] = {
        "sill_shape": span((_X[0] + 0.3, _X[1] - 0.3), (-0.16, 0.12), (_SILL - 0.03, _SILL + 0.01), "sill")
    }
    for i, window in enumerate(_WINDOWS):
        (x,), (width,) = centre_and_size(window)
        shapes[f"pane_{i}"] = panel((x, glass, z), (width, 0, 0), (0, 0, height), "pane")
        for k, place in enumerate((window[0] + bar / 2, x, window[1] - bar / 2)):
            shapes[f"frame_post_{i}_{k}"] = box((place, glass, z), (bar, bar, height), "window_frame")
        for k, level in enumerate((_SILL + bar / 2, 1.9, _HEAD - bar / 2)):
            shapes[f"frame_rail_{i}_{k}"] = box((x, glass, level), (width, bar, bar), "window_frame")
        # In front of the wall, so that it can be moved; numbers would make each an object of its own.
        middle = (x, 0.05, _HEAD + 0.05 - _BLIND_DEPTH / 2)
        shapes[f"blind_{'abcd'[i]}"] = panel(middle, (width + 0.1, 0, 0), (0, 0, _BLIND_DEPTH), "cloth")
    return shapes


def _desks() -> dict[str, Plugin]:
    shapes: dict[str, Plugin] = {}
    for i, (x, y) in enumerate((x, y) for y in _DESK_Y for x in _DESK_X):
        shapes |= _table(f"desk_{i}", (x, y), (0.55, 1.3))
    return shapes


def _table(name: str, place: tuple[float, float], size: tuple[float, float]) -> dict[str, Plugin]:
    """Return a table: its top, and a leg in each corner."""
    (x, y), (depth, width), thick = place, size, 0.03
    corners = [(i, j) for i in (-1, 1) for j in (-1, 1)]
    legs = {
        f"{name}_leg_{k}": box(
            (x + i * (depth / 2 - 0.05), y + j * (width / 2 - 0.05), (_DESK_TOP - thick) / 2),
            (0.035, 0.035, _DESK_TOP - thick),
            "legs",
        )
        for k, (i, j) in enumerate(corners)
    }
    return {**legs, f"{name}_top": box((x, y, _DESK_TOP - thick / 2), (depth, width, thick), "desk")}


def _chairs() -> dict[str, Plugin]:
    shapes: dict[str, Plugin] = {}
    seats = ((x + 0.5, y + side) for y in _DESK_Y for x in _DESK_X for side in (-0.33, 0.33))
    for i, (x, y) in enumerate(seats):
        shapes[f"chair_{i}_seat"] = box((x, y, 0.44), (0.4, 0.4, 0.03), "chair")
        shapes[f"chair_{i}_back"] = box((x + 0.19, y, 0.65), (0.025, 0.38, 0.16), "chair")
        for side in (-1, 1):
            edge = y + 0.17 * side
            shapes[f"chair_{i}_leg_{side}"] = box((x - 0.16, edge, 0.215), (0.025, 0.025, 0.43), "legs")
            shapes[f"chair_{i}_post_{side}"] = box((x + 0.19, edge, 0.285), (0.025, 0.025, 0.57), "legs")
    return shapes


def _front() -> dict[str, Plugin]:
    """Return what stands at the wall that the class looks at."""
    wall = _X[0]
    return {
        **_table("teacher", (-3.0, 1.5), (0.7, 1.5)),
        "board_shape": span((wall, wall + 0.03), (1.5, 4.5), (0.95, 2.15), "board"),
        "board_above": span((wall, wall + 0.045), (1.45, 4.55), (2.15, 2.2), "board_frame"),
        "board_below": span((wall, wall + 0.1), (1.45, 4.55), (0.9, 0.95), "board_frame"),
        "poster_shape": span((wall, wall + 0.01), (4.9, 5.5), (1.2, 2.05), "poster"),
        "teacher_paper": box((-3.0, 1.35, _DESK_TOP + 0.002), (0.297, 0.21, 0.004), "paper", turn=14),
    }


def _back() -> dict[str, Plugin]:
    """Return what stands at the back, and at the wall to the corridor."""
    corridor = _Y[1]
    sheets = {
        f"sheet_{i}": box(
            (-1.3 + 0.42 * i, corridor - 0.035, 1.55 + 0.12 * (i % 2)), (0.21, 0.01, 0.3), "paper"
        )
        for i in range(7)
    }
    return {
        **sheets,
        "pinboard_shape": span((-1.7, 1.7), (corridor - 0.03, corridor), (1.1, 2.1), "pinboard"),
        "door_shape": span((-3.6, -2.65), (corridor - 0.04, corridor), (0.0, 2.05), "door"),
        "cabinet_shape": span((3.62, 4.0), (0.5, 4.2), (0.0, 0.72), "cabinet"),
    }
