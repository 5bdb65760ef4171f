"""A long hall with many rare light paths: faint lamps in niches and side rooms, beside bright panels.

Most of its parameters are visible in few pixels or none, and half of its lamps light only their own niche. It is a
harder test of error bars than the bundled rooms, which are evenly lit.
"""

from __future__ import annotations

from typing import Any

from scenecaptum import activate

Plugin = dict[str, Any]
Interval = tuple[float, float]

WIDTH, LENGTH, HEIGHT = 6.0, 30.0, 4.5  # metres
NICHE_DEPTH, NICHE_WIDTH, NICHE_HEIGHT = 1.2, 1.6, 2.4


def hall() -> Plugin:
    """Return the hall as a Mitsuba dictionary; the camera looks along it."""
    half = WIDTH / 2
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": {
            "type": "perspective",
            "fov": 62.0,
            "to_world": _transform().look_at(origin=[0, 0.3, 1.7], target=[0, LENGTH, 1.5], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 48, "height": 27, "rfilter": {"type": "box"}},
        },
        **_materials(),
        "floor_shape": _span((-half, half), (0, LENGTH), (-0.1, 0), "floor"),
        "ceiling_shape": _span((-half, half), (0, LENGTH), (HEIGHT, HEIGHT + 0.1), "ceiling"),
        "entrance_shape": _span((-half, half), (-0.1, 0), (0, HEIGHT), "plaster"),
        **_side("left", -1, (5.0, 13.0, 21.0)),
        **_side("right", 1, (9.0, 17.0, 25.0)),
        **_end(),
        **_furniture(),
        **_lamps(),
    }


def _materials() -> dict[str, Plugin]:
    return {
        "floor": {
            "type": "roughplastic",
            "diffuse_reflectance": _rgb(0.32, 0.28, 0.22),
            "alpha": 0.25,
            "nonlinear": False,
        },
        "ceiling": _diffuse(0.8, 0.8, 0.78),
        "plaster": _diffuse(0.7, 0.68, 0.62),
        "wall_left": _diffuse(0.55, 0.5, 0.45),
        "wall_right": _diffuse(0.45, 0.5, 0.55),
        "end_wall": _diffuse(0.6, 0.55, 0.5),
        "vestibule": _diffuse(0.5, 0.6, 0.5),
        "store": _diffuse(0.65, 0.6, 0.6),
        "bench": _diffuse(0.3, 0.16, 0.08),
        "column": _diffuse(0.62, 0.6, 0.58),
        "carpet": _diffuse(0.35, 0.08, 0.08),
        "door": {"type": "plastic", "diffuse_reflectance": _rgb(0.25, 0.12, 0.06)},
        "crate": _diffuse(0.4, 0.3, 0.15),
        "bronze": {"type": "roughconductor", "material": "Cu", "alpha": 0.3},
        "marble": {"type": "roughplastic", "diffuse_reflectance": _rgb(0.7, 0.7, 0.68), "alpha": 0.15},
        "clay": _diffuse(0.5, 0.25, 0.15),
        "stone": _diffuse(0.4, 0.4, 0.38),
        "vase": _diffuse(0.1, 0.2, 0.5),
        "urn": _diffuse(0.3, 0.3, 0.1),
        "gilding": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
        **{f"niche_{number}": _diffuse(0.5, 0.1 * number, 0.7 - 0.1 * number) for number in range(1, 7)},
    }


def _side(name: str, sign: int, niches: tuple[float, ...]) -> dict[str, Plugin]:
    """Return a wall of boxes with niches between them, each with its own material and an object in it."""
    inner, outer = sign * WIDTH / 2, sign * (WIDTH / 2 + NICHE_DEPTH)
    wall, thin = _ordered(inner, outer), 0.05
    objects = {"left": ("clay", "vase", "bronze"), "right": ("marble", "stone", "urn")}[name]
    shapes, start = {}, 0.0
    for index, (at, item) in enumerate(zip(niches, objects, strict=True)):
        number = 2 * index + (1 if sign < 0 else 2)
        shapes[f"wall_{name}_{index}"] = _span(wall, (start, at), (0, HEIGHT), f"wall_{name}")
        shapes[f"lintel_{name}_{index}"] = _span(
            wall, (at, at + NICHE_WIDTH), (NICHE_HEIGHT, HEIGHT), f"wall_{name}"
        )
        shapes[f"niche_{number}_back"] = _span(
            _ordered(outer, outer + sign * thin), (at, at + NICHE_WIDTH), (0, NICHE_HEIGHT), f"niche_{number}"
        )
        # A lining, so that the lamp of a niche lights only the niche's material directly.
        for side, y in (("near", (at, at + thin)), ("far", (at + NICHE_WIDTH - thin, at + NICHE_WIDTH))):
            shapes[f"niche_{number}_{side}"] = _span(wall, y, (0, NICHE_HEIGHT), f"niche_{number}")
        shapes[f"niche_{number}_floor"] = _span(wall, (at, at + NICHE_WIDTH), (-0.1, 0), f"niche_{number}")
        middle = [(inner + outer) / 2, at + NICHE_WIDTH / 2]
        shapes[f"{item}_shape"] = _ball([*middle, 0.9], 0.4, item)
        start = at + NICHE_WIDTH
    shapes[f"wall_{name}_last"] = _span(wall, (start, LENGTH), (0, HEIGHT), f"wall_{name}")
    return shapes


def _end() -> dict[str, Plugin]:
    """Return the end: a vestibule behind an opening, and a store around the corner."""
    half, y, far = WIDTH / 2, LENGTH, LENGTH + 4
    return {
        "end_left": _span((-half, -0.9), (y, y + 0.2), (0, HEIGHT), "end_wall"),
        "end_right": _span((0.9, half), (y, y + 0.2), (0, HEIGHT), "end_wall"),
        "end_top": _span((-0.9, 0.9), (y, y + 0.2), (2.5, HEIGHT), "end_wall"),
        "vestibule_back": _span((-half, half), (far, far + 0.1), (0, 2.8), "vestibule"),
        "vestibule_floor": _span((-half, half + 4), (y, far), (-0.1, 0), "vestibule"),
        "vestibule_top": _span((-half, half + 4), (y, far), (2.8, 2.9), "vestibule"),
        "vestibule_left": _span((-half - 0.1, -half), (y, far), (0, 2.8), "vestibule"),
        "vestibule_right": _span((half, half + 0.1), (y, y + 2.5), (0, 2.8), "vestibule"),
        "store_near": _span((half, half + 4), (y, y + 0.1), (0, 2.8), "store"),
        "store_far": _span((half, half + 4), (far, far + 0.1), (0, 2.8), "store"),
        "store_side": _span((half + 4, half + 4.1), (y, far), (0, 2.8), "store"),
        "door_shape": _span((-2.0, -1.0), (far - 0.1, far), (0, 2.1), "door"),
        "crate_shape": _span((half + 1.5, half + 2.5), (y + 1.5, y + 2.5), (0, 1.0), "crate"),
    }


def _furniture() -> dict[str, Plugin]:
    half = WIDTH / 2
    shapes = {
        "carpet_shape": _span((-0.7, 0.7), (4.0, 26.0), (0, 0.02), "carpet"),
        "gilding_shape": _ball([0.0, 27.5, 1.2], 0.5, "gilding"),
    }
    for index, y in enumerate((7.5, 15.5, 23.5)):
        shapes[f"bench_{index}"] = _span((half - 0.6, half - 0.1), (y - 1, y + 0.6), (0, 0.45), "bench")
        shapes[f"column_{index}"] = _span((-half, -half + 0.4), (y + 2, y + 2.4), (0, HEIGHT), "column")
    return shapes


def _lamps() -> dict[str, Plugin]:
    """Return eleven lamps; the faintest has a millionth of the power of the brightest."""
    half = WIDTH / 2
    panels = {
        f"panel_{index}": {
            "type": "rectangle",
            "to_world": _transform().look_at(origin=[0, y, HEIGHT - 0.02], target=[0, y, 0], up=[0, 1, 0])
            @ _transform().scale([0.8, 0.4, 1]),
            "bsdf": _diffuse(0.2, 0.2, 0.2),
            "emitter": {"type": "area", "radiance": _rgb(power, power, 0.9 * power)},
        }
        for index, (y, power) in enumerate(((4.0, 20.0), (12.0, 12.0), (20.0, 4.0)))
    }
    wall = half + NICHE_DEPTH / 2
    bulbs = {
        "bulb_1": ([-wall, 5.0 + NICHE_WIDTH / 2, 2.1], 1.0),
        "bulb_2": ([wall, 9.0 + NICHE_WIDTH / 2, 2.1], 8.0),
        "bulb_3": ([-wall, 13.0 + NICHE_WIDTH / 2, 2.1], 0.5),
        "bulb_4": ([wall, 17.0 + NICHE_WIDTH / 2, 2.1], 3.0),
        "bulb_5": ([-wall, 21.0 + NICHE_WIDTH / 2, 2.1], 30.0),
        "bulb_6": ([wall, 25.0 + NICHE_WIDTH / 2, 2.1], 1.5),
        "vestibule_lamp": ([0.0, LENGTH + 2.0, 2.6], 10.0),
        "store_lamp": ([half + 2.0, LENGTH + 3.2, 2.4], 20.0),
    }
    return {**panels, **{name: _bulb(*bulb) for name, bulb in bulbs.items()}}


def _bulb(center: list[float], power: float) -> Plugin:
    return {
        **_ball(center, 0.06, _diffuse(0.2, 0.2, 0.2)),
        "emitter": {"type": "area", "radiance": _rgb(power, 0.85 * power, 0.6 * power)},
    }


def _transform() -> Any:
    return activate().ScalarTransform4f()


def _rgb(*value: float) -> Plugin:
    return {"type": "rgb", "value": list(value)}


def _diffuse(*value: float) -> Plugin:
    return {"type": "diffuse", "reflectance": _rgb(*value)}


def _ordered(a: float, b: float) -> Interval:
    return min(a, b), max(a, b)


def _ball(center: list[float], radius: float, material: str | Plugin) -> Plugin:
    bsdf = {"type": "ref", "id": material} if isinstance(material, str) else material
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _span(x: Interval, y: Interval, z: Interval, material: str) -> Plugin:
    """Return the box that fills the three given intervals."""
    center = _transform().translate([sum(interval) / 2 for interval in (x, y, z)])
    size = [(high - low) / 2 for low, high in (x, y, z)]
    return {"type": "cube", "to_world": center.scale(size), "bsdf": {"type": "ref", "id": material}}
