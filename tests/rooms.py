"""Small scenes that several test files load or render, and the parameters of a scene."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenecaptum.scene import SceneParameters


def large_scenes() -> Path:
    """Return the folder of scenes too big for the repository; it may not exist."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "scenes"
    return Path(os.environ.get("SCENECAPTUM_SCENES", beside))


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


def small_scene(**objects: Any) -> dict[str, Any]:
    """A camera of 8 × 8 pixels and any objects."""
    camera = {
        "type": "perspective",
        "film": {"type": "hdrfilm", "width": 8, "height": 8},
        "sampler": {"type": "independent", "sample_count": 1},
    }
    return {"type": "scene", "eye": camera, **objects}


def ball(bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"type": "sphere", "bsdf": bsdf, **more}


def table(scene: Any) -> SceneParameters:
    """Return the parameters of a scene."""
    from scenecaptum.scene import SceneGraph, discover, load_scene

    return discover(SceneGraph(load_scene(scene)))
