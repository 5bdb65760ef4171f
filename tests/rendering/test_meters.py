"""Mitsuba's own sensors that have no picture: meters of radiance and irradiance, and a distant sensor."""

from __future__ import annotations

import subprocess
import sys

FREED_BEFORE_ANOTHER_IS_RECORDED = """
import gc
from scenecaptum import SceneRenderer, activate

look_at = activate().ScalarTransform4f().look_at
film = lambda width: {"type": "hdrfilm", "width": width, "height": 1, "rfilter": {"type": "box"}}
wall = {"type": "scene", "light": {"type": "constant"}, "wall": {"type": "rectangle"}}
meter = wall | {"meter": {"type": "rectangle", "sensor": {"type": "irradiancemeter", "film": film(1)}}}
camera = lambda: {"type": "perspective", "to_world": look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": film(4)}
pair = wall | {"pair": {"type": "batch", "a": camera(), "b": camera(), "film": film(8)}}

gc.disable()  # the collector runs sooner or later: here not in between
renderer = SceneRenderer(meter, "reflectance", spp=4)
renderer(seed=0)
renderer = SceneRenderer(pair, "reflectance", spp=4)
renderer(seed=0)
"""


def test_a_meter_on_a_shape_goes_together_with_its_shape() -> None:
    # In a separate process, because a failure is a segmentation fault: Dr.Jit calls all sensors that exist when it
    # records a batch of them, and a meter asks its shape.
    ran = subprocess.run(
        [sys.executable, "-c", FREED_BEFORE_ANOTHER_IS_RECORDED], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-400:]
