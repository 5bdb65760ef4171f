"""A small scene that several test files render, with a material of their choice."""

from __future__ import annotations

from typing import Any


def room(mi: Any, ball: dict[str, Any], **integrator: Any) -> dict[str, Any]:
    """A ball over a floor under a white sky and a lamp."""
    transform = mi.ScalarTransform4f
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5, **integrator},
        "camera": {
            "type": "perspective",
            "to_world": transform().look_at(origin=[0, -4, 1], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
        "ball": {"type": "sphere", "bsdf": ball},
        "floor": {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(3)},
        "sky": {"type": "constant"},
        "lamp": {
            "type": "sphere",
            "center": [2, -2, 3],
            "radius": 0.5,
            "emitter": {"type": "area", "radiance": 10.0},
        },
    }
