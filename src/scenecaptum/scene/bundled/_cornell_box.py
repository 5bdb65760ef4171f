"""The Cornell box."""

from __future__ import annotations

from ._parts import Plugin, base, box, diffuse, emitting, panel


def cornell_box() -> Plugin:
    """Return the Cornell box: red left wall, green right wall, two boxes and a warm ceiling light.

    The room is the cube [-1, 1]³ in arbitrary units. Each surface has its own material, so each reflectance is a
    separate parameter (``tall_box.reflectance.value``). The film has 256 × 256 pixels.
    """
    white = (0.885809, 0.698859, 0.666422)
    light = panel((0, 0, 0.99), (0.46, 0, 0), (0, -0.38, 0), diffuse(0.78, 0.78, 0.78))
    return {
        **base(resolution=(256, 256), origin=(0, -3.9, 0), target=(0, 0, 0), fov=38.0),
        "left_wall": diffuse(0.570068, 0.0430135, 0.0443706),
        "right_wall": diffuse(0.105421, 0.37798, 0.076425),
        **{name: diffuse(*white) for name in ("floor", "ceiling", "back_wall", "short_box", "tall_box")},
        "left_wall_shape": panel((-1, 0, 0), (0, 2, 0), (0, 0, 2), "left_wall"),
        "right_wall_shape": panel((1, 0, 0), (0, -2, 0), (0, 0, 2), "right_wall"),
        "floor_shape": panel((0, 0, -1), (2, 0, 0), (0, 2, 0), "floor"),
        "ceiling_shape": panel((0, 0, 1), (2, 0, 0), (0, -2, 0), "ceiling"),
        "back_wall_shape": panel((0, 1, 0), (2, 0, 0), (0, 0, 2), "back_wall"),
        "short_box_shape": box((0.335, -0.38, -0.7), (0.6, 0.6, 0.6), "short_box", turn=-17.0),
        "tall_box_shape": box((-0.33, 0.28, -0.39), (0.6, 0.6, 1.22), "tall_box", turn=18.25),
        "light": emitting(light, 18.387, 13.9873, 6.75357),
    }
