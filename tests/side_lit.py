"""A room with a window, and sensor grids in it, for tests of daylight."""

from __future__ import annotations

from typing import Any

import torch

from scenecaptum import SensorGrid

Config = dict[str, Any]


def grey(value: float) -> Config:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def rgb(value: float) -> Config:
    return {"type": "rgb", "value": value}


def at(*points: tuple[float, ...], facing: tuple[float, ...] = (0, 0, 1)) -> SensorGrid:
    return SensorGrid(points=torch.tensor(points), normals=torch.tensor([facing] * len(points)).float())


def room(**parts: Config) -> Config:
    """Return a scene with a camera that shows that z is up."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().look_at(origin=[0, -1.4, 1], target=[0, 1, 1], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    return {"type": "scene", "sensor": {"type": "perspective", "to_world": to_world, "film": film}, **parts}


def walls(**reflectances: float) -> Config:
    """Return a closed room of 4 × 3 × 2 metres on the floor, one-sided surfaces with a reflectance of 0.5."""
    import mitsuba as mi

    place = mi.ScalarTransform4f
    sides = {
        "ceiling": place().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale([2, 1.5, 1]),
        "floor": place().scale([2, 1.5, 1]),
        "left": place().translate([-2, 0, 1]).rotate([0, 1, 0], 90).scale([1, 1.5, 1]),
        "right": place().translate([2, 0, 1]).rotate([0, 1, 0], -90).scale([1, 1.5, 1]),
        "back": place().translate([0, 1.5, 1]).rotate([1, 0, 0], 90).scale([2, 1, 1]),
        "front": place().translate([0, -1.5, 1]).rotate([1, 0, 0], -90).scale([2, 1, 1]),
    }
    return {
        name: {"type": "rectangle", "to_world": to_world, "bsdf": grey(reflectances.get(name, 0.5))}
        for name, to_world in sides.items()
    }


def side_lit_room(*, pane: bool = False, blind: bool = False) -> Config:
    """Return a room whose front, in the south, is open above 0.8 m; with a pane, or a blind in the opening."""
    import mitsuba as mi

    place = mi.ScalarTransform4f
    parts = walls()
    opening = place().translate([0, -1.5, 1.4]).rotate([1, 0, 0], -90).scale([2, 0.6, 1])
    parts["front"]["to_world"] = place().translate([0, -1.5, 0.4]).rotate([1, 0, 0], -90).scale([2, 0.4, 1])
    if pane:
        glass = {"type": "thindielectric", "specular_transmittance": rgb(0.8)}
        parts["pane"] = {"type": "rectangle", "to_world": opening, "bsdf": glass}
    if blind:
        cloth = {"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": grey(0.3)}}
        half = place().translate([0, -1.45, 1.6]).rotate([1, 0, 0], -90).scale([2, 0.3, 1])
        parts["blind"] = {"type": "rectangle", "to_world": half, "bsdf": cloth}
    return room(sky={"type": "constant"}, **parts)
