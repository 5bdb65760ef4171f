"""Tiny scenes with known light, and the attribution of their mean brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
from seeds import shifted

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient

GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}


def small_box() -> SceneRenderer:
    return SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(8, 8), spp=4, max_depth=3)


def rgb(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def camera(mi: Any, origin: Any, target: Any, scale: float = 1.0) -> dict[str, Any]:
    return {
        "type": "perspective",
        "near_clip": 1e-2 * scale,
        "far_clip": 1e4 * scale,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 16},
    }


def furnace(mi: Any, walls: dict[str, Any], *, depth: int = 4, radiance: float = 1.0) -> dict[str, Any]:
    """The inside of a cube of equal, emitting walls of reflectance ``r``: the light is ``E Σ_{k<d} r^k``."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth},
        "camera": camera(mi, [0.1, 0.0, 0.0], [1.0, 0.3, 0.2]),
        "walls": {
            "type": "cube",
            "flip_normals": True,
            "bsdf": walls,
            "glow": {"type": "area", "radiance": rgb(radiance)},
        },
    }


def room(
    mi: Any,
    *,
    lamp: float | None = 10.0,
    ball: Any = None,
    scale: float = 1.0,
    shift: float = 0.0,
    **more: Any,
) -> Any:
    """A ball over a floor, lit by a spherical lamp."""
    transform = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": camera(mi, [shift, -4 * scale, scale], [shift, 0, 0], scale),
        "ball": {"type": "sphere", "center": [shift, 0, 0], "radius": scale, "bsdf": ball or GREY},
        "floor": {
            "type": "rectangle",
            "to_world": transform().translate([shift, 0, -scale]).scale(3 * scale),
            "bsdf": GREY,
        },
        **more,
    }
    if lamp is not None:
        scene["lamp"] = {
            "type": "sphere",
            "center": [shift + 2 * scale, -2 * scale, 3 * scale],
            "radius": 0.5 * scale,
            "emitter": {"type": "area", "radiance": rgb(lamp)},
        }
    return scene


def sky(mi: Any, texels: np.ndarray) -> dict[str, Any]:
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.astype(np.float32))}


def texture(mi: Any, texels: np.ndarray) -> dict[str, Any]:
    return {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": True},
    }


def mean(image: Any) -> Any:
    """The metric of most tests: linear, with equal weights for all pixels."""
    return image.mean()


def attribute(scene: Any, inputs: Any = "all", metric: Any = mean, **options: Any) -> SceneAttribution:
    settings = {key: options.pop(key) for key in ("resolution", "max_depth", "sensor") if key in options}
    renderer = SceneRenderer(scene, inputs=inputs, **settings)
    return VanillaSceneGradient(renderer, metric).attribute(**{"seed": shifted(), **options})


def total(attribution: SceneAttribution, name: str) -> tuple[float, float]:
    """Return the sum over the channels of an attribution and its standard error."""
    return attribution[name].double().sum().item(), attribution.covariance[name].sum().sqrt().item()


def slope(
    renderer: Any, name: str, step: float, *, spp: int = 256, sides: tuple[int, ...] = (-1, 1)
) -> float:
    """Return a difference of mean images with common random numbers; ``sides`` may be (0, 1) at a bound."""
    value = renderer.inputs[name]
    low, high = (
        renderer({name: value + side * step}, seed=shifted(3), spp=spp).double().mean() for side in sides
    )
    return ((high - low) / (step * (sides[1] - sides[0]))).item()


def z(measured: tuple[float, float], expected: float, rounding: float = 2e-5) -> float:
    """Return by how many standard errors a measurement is off, allowing for single precision."""
    value, error = measured
    return (value - expected) / (error + rounding * abs(expected) + 1e-30)


def in_the_sky(mi: Any, bsdf: dict[str, Any], *, depth: int = 4, **more: Any) -> dict[str, Any]:
    """A ball under a white sky and nothing else: if it absorbs no light, the image is 1 everywhere."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth},
        "camera": camera(mi, [0, -4, 1], [0, 0, 0]),
        "ball": {"type": "sphere", "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": rgb(1.0)},
        **more,
    }


def coverage(renderer: SceneRenderer, of: str = "ball") -> float:
    """Return the part of the image that an object covers."""
    shown = renderer.surfaces
    covered = shown.fraction[shown.object_index == shown.objects.index(of)].sum()
    return float(covered) / (shown.shape[0] * shown.shape[1])
