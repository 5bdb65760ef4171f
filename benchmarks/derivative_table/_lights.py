"""Cases of emitters."""

from __future__ import annotations

from typing import Any

import numpy as np

from scenecaptum import activate

from ._case import Case, Row, Scene, message_rows, row
from ._scenes import bitmap, lamp, picture, shelf, sky

SIDES = [1.5, -2.5, 3.0]


def _lit(*materials: Scene, **lights: Scene) -> Scene:
    """Return a diffuse and a glossy ball under only the given lights."""
    scene = shelf(*(materials or ({"type": "diffuse"}, {"type": "roughconductor", "alpha": 0.2})))
    del scene["sky"], scene["lamp"]
    return {**scene, **lights}


def _towards(origin: list[float]) -> Any:
    return activate().ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 0, 1])


def _sphere(emitter: Scene) -> Scene:
    return {"type": "sphere", "center": SIDES, "radius": 0.5, "emitter": emitter}


def _panel(emitter: Scene) -> Scene:
    return {"type": "rectangle", "to_world": _towards(SIDES), "emitter": emitter}


def light_cases() -> list[Case]:
    """Return every case whose rows belong to an emitter."""
    return [*_area(), *_points(), *_distant(), *_skies(), *_suns()]


def _area() -> list[Case]:
    mirror = {"type": "conductor"}
    return [
        Case(
            "area",
            "lamps",
            lambda: _lit(
                on=_sphere({"type": "area", "radiance": 10.0}),
                off={**_sphere({"type": "area", "radiance": 0.0}), "center": [-2, -2, 3]},
                screen=_panel({"type": "area", "radiance": picture(1.0, 5.0)}),
            ),
            (
                row("on.emitter.radiance", 10.0),
                row("off.emitter.radiance", 0.0),
                row("screen.emitter.radiance.data", 3.0),
                *message_rows("on.emitter.sampling_weight"),
            ),
        ),
        Case(
            "area",
            "in a mirror",
            lambda: _lit(
                mirror, on=_sphere({"type": "area", "radiance": {"type": "rgb", "value": [9, 7, 5]}})
            ),
            (row("on.emitter.radiance", 7.0),),
        ),
        Case(
            "directionalarea",
            "panel",
            lambda: _lit(panel=_panel({"type": "directionalarea", "radiance": 5.0}), lamp=lamp()),
            (row("panel.emitter.radiance", 5.0), row("lamp.emitter.radiance", 18.0)),
        ),
    ]


def _points() -> list[Case]:
    def spot(**properties: Any) -> Scene:
        aim = _towards(SIDES)
        return {"type": "spot", "to_world": aim, "cutoff_angle": 25.0, "beam_width": 15.0, **properties}

    return [
        Case(
            "point",
            "lamps",
            lambda: _lit(
                on={"type": "point", "position": SIDES, "intensity": 10.0},
                off={"type": "point", "position": [-2, -2, 3], "intensity": 0.0},
            ),
            (row("on.intensity", 10.0), row("off.intensity", 0.0), *message_rows("on.position")),
        ),
        Case(
            "spot",
            "lamps",
            lambda: _lit(
                on=spot(intensity=20.0),
                off=spot(intensity=0.0, cutoff_angle=20.0),
                slide=spot(intensity=5.0, texture=picture()),
            ),
            (
                row("on.intensity", 20.0),
                row("on.cutoff_angle", 25.0),
                row("on.beam_width", 15.0),
                row("off.intensity", 0.0),
                row("slide.texture.data", 0.5),
                *message_rows("on.to_world"),
            ),
        ),
        Case(
            "projector",
            "slides",
            lambda: _lit(
                on={
                    "type": "projector",
                    "irradiance": picture(1.0, 3.0),
                    "to_world": _towards(SIDES),
                    "fov": 40,
                    "scale": 2.0,
                },
                off={
                    "type": "projector",
                    "irradiance": picture(),
                    "to_world": _towards([-2, -3, 3]),
                    "fov": 40,
                    "scale": 0.0,
                },
            ),
            (
                row("on.irradiance.data", 2.0),
                Row("on.scale", 0.5),
                Row("off.scale", 0.5, 1),
                *message_rows("on.to_world"),
            ),
        ),
    ]


def _distant() -> list[Case]:
    return [
        Case(
            "directional",
            "suns",
            lambda: _lit(
                on={"type": "directional", "direction": [-0.4, 0.6, -1], "irradiance": 3.0},
                off={"type": "directional", "direction": [0.4, 0.6, -1], "irradiance": 0.0},
            ),
            (row("on.irradiance", 3.0), row("off.irradiance", 0.0), *message_rows("on.to_world")),
        ),
        Case(
            "constant",
            "sky",
            lambda: _lit(sky={"type": "constant", "radiance": 1.5}),
            (row("sky.radiance", 1.5),),
        ),
        Case(
            "constant",
            "coloured sky in mirror and glass",
            lambda: _lit(
                {"type": "conductor"},
                {"type": "dielectric"},
                sky={"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.5, 0.2]}},
            ),
            (row("sky.radiance", 0.5),),
        ),
        Case("constant", "dark sky beside a lamp", _dark_sky, (row("sky.radiance", 0.0),)),
    ]


def _dark_sky() -> Scene:
    return _lit(sky={"type": "constant", "radiance": 0.0}, lamp=_sphere({"type": "area", "radiance": 5.0}))


def _skies() -> list[Case]:
    def starry() -> Scene:
        texels = np.zeros((9, 17, 3))
        texels[2, 4:9] = 30.0
        return {"type": "envmap", "bitmap": bitmap(texels)}

    return [
        Case("envmap", "smooth", lambda: _lit(sky=sky(1.5)), (Row("sky.data", 0.05), Row("sky.scale", 0.3))),
        Case(
            "envmap",
            "mostly black",
            lambda: _lit(sky=starry()),
            (Row("sky.data", 0.02, 1), Row("sky.scale", 0.3)),
        ),
        Case(
            "envmap",
            "scale 0 beside a lamp",
            lambda: _lit(sky=sky(0.0), lamp=_sphere({"type": "area", "radiance": 5.0})),
            (Row("sky.scale", 0.2, 1),),
        ),
        Case("envmap", "pose", lambda: _lit(sky=sky()), message_rows("sky.to_world")),
    ]


def _suns() -> list[Case]:
    continuous = (
        Row("sky.turbidity", 0.1),
        Row("sky.albedo", 0.05),
        Row("sky.sky_scale", 0.2),
        Row("sky.sun_scale", 0.2),
    )

    def at_noon(kind: str, **properties: Any) -> Scene:
        return _lit(sky={"type": kind, "turbidity": 3.0, "albedo": 0.3, **properties})

    times = {"latitude": 1.0, "longitude": 1.0, "hour": 0.1, "minute": 5.0, "second": 300.0}
    return [
        Case(
            "sunsky",
            "given direction",
            lambda: at_noon("sunsky", sun_direction=[-0.3, -0.5, 0.8]),
            (*continuous, Row("sky.sun_direction", 0.01), *message_rows("sky.to_world")),
        ),
        Case(
            "sunsky",
            "given time",
            lambda: at_noon("sunsky", hour=10.0),
            (
                *continuous,
                *(Row(f"sky.{name}", step) for name, step in times.items()),
                *message_rows("sky.timezone"),
            ),
        ),
        Case(
            "timed_sunsky",
            "a year",
            lambda: at_noon("timed_sunsky"),
            (
                *continuous,
                *message_rows(
                    *(
                        f"sky.{t}"
                        for t in ("latitude", "longitude", "timezone", "window_start_time", "window_end_time")
                    )
                ),
            ),
        ),
    ]
