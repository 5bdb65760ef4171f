"""Small scenes with varied light: a non-uniform sky, a lamp, and objects that reflect it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from scenecaptum import activate

from ._case import Case, Scene, rows

DEPTH = 5

# A material, or a function that returns one if that needs Mitsuba, and its differentiated parameters' values.
Ball = tuple["Scene | Callable[[], Scene]", Mapping[str, float]]


def ball(plugin: str, values: Mapping[str, float], **fixed: Any) -> tuple[Scene, Mapping[str, float]]:
    """Return a plain material with its values."""
    return {"type": plugin, **fixed, **values}, values


def balls(plugin: str, title: str, *shelved: Ball) -> Case:
    """Return a case of balls side by side, so that a kernel is compiled once for all their materials."""
    materials = [material for material, _ in shelved]
    found = tuple(row for i, (_, values) in enumerate(shelved) for row in rows(f"ball{i}.bsdf", values))
    return Case(plugin, title, lambda: shelf(*(m() if callable(m) else m for m in materials)), found)


def shelf(*materials: Scene, **more: Scene) -> Scene:
    """Return balls over a floor and before a block, under a sky and a lamp."""
    count = len(materials)
    spheres = {
        f"ball{i}": {"type": "sphere", "center": [2.2 * (i - (count - 1) / 2), 0, 0], "bsdf": material}
        for i, material in enumerate(materials)
    }
    eye = [0.0, -4.5, 1.5] if count == 1 else [0.0, -4.0 - 0.6 * count, 2.0]
    view = 32.0 if count == 1 else 58.0
    return {
        "type": "scene",
        "integrator": path(),
        "camera": camera(eye, [0, 0, 0], view, 16 if count == 1 else 8 * count, 16 if count == 1 else 10),
        **spheres,
        "floor": floor(),
        "block": block(),
        "sky": sky(),
        "lamp": lamp(),
        **more,
    }


def lens(material: Scene) -> Scene:
    """Return a single ball under the sky, so that all noise comes from its scattering."""
    return {
        "type": "scene",
        "integrator": path(),
        "camera": camera([0, -4.5, 1.5], [0, 0, 0], 26),
        "ball0": {"type": "sphere", "bsdf": material},
        "sky": sky(),
    }


def highlight(material: Scene, alpha: float) -> Scene:
    """Return a floor that reflects a lamp into the camera; both are as narrow as the floor's specular lobe.

    The image then depends on the roughness, no matter how small it is.
    """
    return {
        "type": "scene",
        "integrator": path(3),
        "camera": camera([0, -4, 4], [0, 0, 0], float(np.degrees(2 * alpha))),
        "ball0": {"type": "rectangle", "to_world": _transform().scale(3), "bsdf": material},
        "sky": sky(),
        "lamp": {
            "type": "sphere",
            "center": [0, 4, 4],
            "radius": 4 * alpha,
            "emitter": {"type": "area", "radiance": 20.0},
        },
    }


def grazing(material: Scene) -> Scene:
    """Return a floor that is seen from just above it, so that bent normals turn away from the camera."""
    return {
        "type": "scene",
        "integrator": path(3),
        "camera": camera([0, -4, 0.5], [0, 0, 0], 30),
        "ball0": {"type": "rectangle", "to_world": _transform().scale(2), "bsdf": material},
        "lamp": lamp(),
    }


def path(depth: int = DEPTH) -> Scene:
    """Return Mitsuba's path tracer, without Russian roulette."""
    return {"type": "path", "max_depth": depth, "rr_depth": depth + 1}


def volpath(depth: int = 6) -> Scene:
    """Return Mitsuba's volumetric path tracer, without Russian roulette."""
    return {"type": "volpath", "max_depth": depth, "rr_depth": depth + 1}


def camera(origin: list[float], target: list[float], fov: float, width: int = 16, height: int = 16) -> Scene:
    """Return a camera whose pixels have independent noise."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": _transform().look_at(origin=origin, target=target, up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }


def sky(scale: float = 1.0) -> Scene:
    """Return light from everywhere, brighter above and on the camera's side, without edges."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 17), indexing="ij")
    aside = np.cos(around[..., None] + np.pi - np.array([0.0, 0.5, 1.0]))
    texels = 0.8 + 0.3 * np.cos(polar)[..., None] + 0.45 * np.sin(polar)[..., None] * aside
    return {
        "type": "envmap",
        "bitmap": bitmap(texels),
        "scale": scale,
        "to_world": _transform().rotate([1, 0, 0], 90),
    }


def bitmap(texels: Any) -> Any:
    """Return an array as a Mitsuba bitmap."""
    return activate().Bitmap(np.ascontiguousarray(texels, np.float32))


def picture(low: float = 0.2, high: float = 0.8, channels: int = 3, seed: int = 3) -> Scene:
    """Return a texture of random texels."""
    texels = np.random.default_rng(seed).uniform(low, high, (4, 6, channels))
    return {"type": "bitmap", "bitmap": bitmap(texels), "raw": True}


def floor(**material: Any) -> Scene:
    """Return a floor below the balls, grey by default."""
    bsdf = material or {"type": "diffuse", "reflectance": 0.5}
    return {"type": "rectangle", "to_world": _transform().translate([0, 0, -1]).scale(6), "bsdf": bsdf}


def block() -> Scene:
    """Return a reddish block behind the balls."""
    return {
        "type": "cube",
        "to_world": _transform().translate([0.6, 2.5, 0]).scale([3, 0.3, 1]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.3]}},
    }


def lamp(radiance: float = 20.0) -> Scene:
    """Return a spherical lamp above the camera, to one side."""
    colour = {"type": "rgb", "value": [radiance, 0.9 * radiance, 0.8 * radiance]}
    emitter = {"type": "area", "radiance": colour}
    return {"type": "sphere", "center": [1.5, -2.5, 3], "radius": 0.5, "emitter": emitter}


def _transform() -> Any:
    return activate().ScalarTransform4f()
