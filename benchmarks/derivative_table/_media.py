"""Cases of participating media and phase functions, and of surfaces in them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from scenecaptum import activate

from ._case import Case, Row, Scene, row
from ._scenes import shelf, sky, volpath


def _cells(low: float, high: float, channels: int = 1) -> Scene:
    """Return a grid of random values over the cube from -1 to 1."""
    mi = activate()
    values = np.random.default_rng(4).uniform(low, high, (3, 4, 5, channels)).astype(np.float32)
    cube = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values), "to_world": cube, "raw": True}


def _cloud(medium: Scene, boundary: Scene | None = None, shape: Scene | None = None) -> Scene:
    """Return a body filled with a medium, over a floor."""
    scene = shelf({"type": "diffuse"})
    body = shape or {"type": "sphere"}
    scene["ball0"] = {**body, "interior": medium, "bsdf": boundary or {"type": "null"}}
    scene["integrator"] = volpath()
    return scene


def _fog(medium: Scene, *materials: Scene) -> Scene:
    """Return balls in a room filled with a medium that includes the camera."""
    scene = shelf(*materials)
    del scene["block"], scene["sky"]
    scene["integrator"] = volpath()
    scene["fog"] = medium
    scene["camera"]["medium"] = {"type": "ref", "id": "fog"}
    room = {"type": "cube", "to_world": activate().ScalarTransform4f().scale(9), "bsdf": {"type": "null"}}
    scene["room"] = {**room, "interior": {"type": "ref", "id": "fog"}}
    for name in [n for n in scene if n.startswith("ball")]:
        scene[name]["exterior"] = {"type": "ref", "id": "fog"}
    for name in ("floor", "lamp"):
        scene[name]["exterior"] = {"type": "ref", "id": "fog"}
    scene["floor"]["interior"] = {"type": "ref", "id": "fog"}
    scene["sky"] = sky()
    return scene


def _milk(albedo: Any = 0.8, sigma_t: Any = 1.5, phase: Scene | None = None, scale: float = 1.0) -> Scene:
    return {
        "type": "homogeneous",
        "albedo": albedo,
        "sigma_t": sigma_t,
        "scale": scale,
        "phase": phase or {"type": "isotropic"},
    }


def medium_cases() -> list[Case]:
    """Return every case of a scene with a participating medium."""
    return [*_homogeneous(), *_heterogeneous(), *_phases(), *_rooms()]


def _homogeneous() -> list[Case]:
    own = "ball0.interior_medium"
    cases = [
        Case(
            "homogeneous",
            title,
            lambda albedo=albedo, sigma_t=sigma_t: _cloud(_milk(albedo, sigma_t)),
            (row(f"{own}.albedo", albedo), row(f"{own}.sigma_t", sigma_t), Row(f"{own}.scale", 0.1)),
        )
        for title, albedo, sigma_t in (
            ("cloud", 0.8, 1.5),
            ("black cloud", 0.0, 1.5),
            ("white cloud", 1.0, 0.5),
            ("thin cloud", 0.8, 0.05),
            ("dense cloud", 0.8, 10.0),
        )
    ]
    colour = {"type": "rgb", "value": [0.9, 0.6, 0.3]}
    density = {"type": "rgb", "value": [0.2, 0.5, 0.8]}
    return [
        *cases,
        Case("homogeneous", "no cloud", lambda: _cloud(_milk(0.8, 0.0)), (row(f"{own}.sigma_t", 0.0),)),
        Case(
            "homogeneous",
            "coloured cloud",
            lambda: _cloud(_milk(colour, density, scale=3.0)),
            (row(f"{own}.albedo", 0.6), row(f"{own}.sigma_t", 0.5), Row(f"{own}.scale", 0.3)),
        ),
        *(
            Case(
                "homogeneous",
                f"inside {boundary['type']}",
                lambda boundary=boundary: _cloud(_milk(), boundary),
                (row(f"{own}.albedo", 0.8), row(f"{own}.sigma_t", 1.5), *more),
            )
            for boundary, more in (
                ({"type": "dielectric"}, (row("ball0.bsdf.eta", 1.5),)),
                ({"type": "roughdielectric", "alpha": 0.3}, (row("ball0.bsdf.alpha", 0.3),)),
                ({"type": "thindielectric"}, (row("ball0.bsdf.eta", 1.5),)),
                (
                    {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
                    (row("ball0.bsdf.opacity", 0.5), row("ball0.bsdf.nested_bsdf.reflectance", 0.5)),
                ),
            )
        ),
    ]


def _heterogeneous() -> list[Case]:
    own = "ball0.interior_medium"

    def smoke(low: float, high: float, albedo: Any) -> Scene:
        return {"type": "heterogeneous", "albedo": albedo, "sigma_t": _cells(low, high)}

    def cube() -> Scene:
        # Slightly above the floor, because the hit of coincident surfaces is undefined.
        return {"type": "cube", "to_world": activate().ScalarTransform4f().scale(0.97)}

    return [
        Case(
            "heterogeneous",
            title,
            lambda args=args: _cloud(smoke(*args), shape=cube()),
            (Row(f"{own}.sigma_t", step, side), row(f"{own}.albedo", args[2]), Row(f"{own}.scale", 0.1)),
        )
        for title, args, step, side in (
            ("smoke", (0.5, 2.0, 0.8), 0.1, 0),
            ("black smoke", (0.5, 2.0, 0.0), 0.1, 0),
            ("white smoke", (0.1, 0.4, 1.0), 0.02, 0),
            ("thin smoke", (0.02, 0.1, 0.8), 0.01, 0),
            ("dense smoke", (4.0, 12.0, 0.8), 0.5, 0),
        )
    ] + [
        Case(
            "heterogeneous",
            "grids",
            lambda: _cloud(smoke(0.5, 2.0, _cells(0.3, 0.9, 3)), shape=cube()),
            (Row(f"{own}.sigma_t", 0.1), Row(f"{own}.albedo", 0.05)),
        ),
    ]


def _phases() -> list[Case]:
    own = "ball0.interior_medium.phase_function"

    def case(plugin: str, title: str, phase: Callable[[], Scene], *found: Row) -> Case:
        return Case(plugin, title, lambda: _cloud(_milk(0.9, 2.0, phase())), found)

    mixed = {
        "type": "blendphase",
        "weight": 0.4,
        "forward": {"type": "hg", "g": 0.7},
        "backward": {"type": "hg", "g": -0.4},
    }
    return [
        *(
            case(
                "hg",
                f"g {g:g}",
                partial(dict, type="hg", g=g),
                row(f"{own}.g", g),
                row("ball0.interior_medium.albedo", 0.9),
            )
            for g in (-0.5, 0.0, 0.5, 0.9)
        ),
        case("isotropic", "cloud", lambda: {"type": "isotropic"}, row("ball0.interior_medium.albedo", 0.9)),
        case("rayleigh", "cloud", lambda: {"type": "rayleigh"}, row("ball0.interior_medium.albedo", 0.9)),
        case(
            "tabphase",
            "cloud",
            lambda: {"type": "tabphase", "values": "0.5, 1.0, 1.5, 3.0"},
            Row(f"{own}.values", 0.1),
        ),
        case(
            "blendphase",
            "two lobes",
            lambda: dict(mixed),
            row(f"{own}.weight", 0.4),
            row(f"{own}.phase_0.g", 0.7),
            row(f"{own}.phase_1.g", -0.4),
        ),
        case("sggx", "flakes", _flakes, Row(f"{own}.S", 0.02)),
    ]


def _flakes() -> Scene:
    mi = activate()
    entries = np.tile(np.array([0.15, 1.0, 0.8, 0.0, 0.0, 0.0], np.float32), (2, 2, 2, 1))
    return {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(entries), "raw": True}}


def _rooms() -> list[Case]:
    thin = {"albedo": 0.8, "sigma_t": 0.08}
    surfaces: dict[str, tuple[Scene, dict[str, float]]] = {
        "diffuse and mirror": (
            {"type": "conductor", "eta": 1.2, "k": 3.0, "specular_reflectance": 0.9},
            {"specular_reflectance": 0.9, "k": 3.0},
        ),
        "diffuse and glass": (
            {"type": "dielectric", "specular_transmittance": 0.8},
            {"specular_transmittance": 0.8},
        ),
        "diffuse and plastic": (
            {"type": "plastic", "diffuse_reflectance": 0.4},
            {"diffuse_reflectance": 0.4},
        ),
        "diffuse and mask": (
            {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse", "reflectance": 0.05}},
            {"opacity": 0.5},
        ),
        "diffuse and rough metal": ({"type": "roughconductor", "alpha": 0.5}, {"alpha": 0.5}),
    }
    return [
        Case(
            "fog",
            title,
            lambda material=material: _fog(_milk(**thin), {"type": "diffuse", "reflectance": 0.5}, material),
            (
                row("ball0.bsdf.reflectance", 0.5),
                *(row(f"ball1.bsdf.{name}", value) for name, value in values.items()),
                row("lamp.emitter.radiance", 18.0),
                row("camera.medium.albedo", 0.8),
                row("camera.medium.sigma_t", 0.08),
            ),
        )
        for title, (material, values) in surfaces.items()
    ]
