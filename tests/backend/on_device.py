"""Attribute under a variant, and print effects and errors as JSON; ``test_cuda`` runs it on a GPU and on a CPU.

python on_device.py VARIANT SEED [CASE …]
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable
from typing import Any

import torch

import scenecaptum
from scenecaptum import (
    FeatureAblationScene,
    IntegratedGradientsScene,
    SceneAttribution,
    SceneRenderer,
    SensorGrid,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
)

SIZE, SPP = (64, 36), 64
LAMPS = ["luminaire_*.emitter.radiance.value", "wall_*.reflectance.value"]


def office(inputs: Any = "all", **options: Any) -> SceneRenderer:
    return SceneRenderer("office", inputs, **{"resolution": SIZE, "spp": SPP, "max_depth": 6, **options})


def luminance() -> SceneAttribution:
    return VanillaSceneGradient(office(), metrics.MeanLuminance()).attribute(seed=SEED)


def glare() -> SceneAttribution:
    renderer = office(LAMPS)
    return VanillaSceneGradient(renderer, metrics.UnifiedGlareRating(renderer.camera)).attribute(seed=SEED)


def network_on_the_cpu() -> SceneAttribution:
    network = metrics.ShapeClassifier.pretrained()
    metric = metrics.ClassLogit(network, "cube", smoothing=0.3)
    return VanillaSceneGradient(office(LAMPS, spp=32), metric).attribute(seed=SEED)


def poses() -> SceneAttribution:
    inputs = [
        "luminaire_left.pose.translation",
        "camera.pose.rotation",
        "camera.fov",
        "wall_left.reflectance.value",
    ]
    return VanillaSceneGradient(office(inputs), metrics.MeanLuminance()).attribute(seed=SEED)


def sensor_grid() -> SceneAttribution:
    renderer = office(LAMPS, resolution=None, sensor=SensorGrid(height=0.8, spacing=1.0))
    return VanillaSceneGradient(renderer, metrics.MeanIlluminance()).attribute(seed=SEED)


def path() -> SceneAttribution:
    method = IntegratedGradientsScene(office(LAMPS, spp=32), metrics.MeanLuminance())
    return method.attribute(seed=SEED, n_steps=4)


def smoothed() -> SceneAttribution:
    method = SmoothGradScene(office(LAMPS, spp=32), metrics.MeanLuminance())
    return method.attribute(seed=SEED, nt_samples=4)


def ablated() -> SceneAttribution:
    return FeatureAblationScene(office(LAMPS, spp=32), metrics.MeanLuminance()).attribute(seed=SEED)


def values_on_the_cpu() -> SceneAttribution:
    renderer = office(LAMPS)
    values = {name: 0.9 * value.cpu() for name, value in renderer.inputs.items()}
    return VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(values, seed=SEED)


CASES: dict[str, Callable[[], SceneAttribution]] = {
    case.__name__: case
    for case in (
        luminance,
        glare,
        network_on_the_cpu,
        poses,
        sensor_grid,
        path,
        smoothed,
        ablated,
        values_on_the_cpu,
    )
}


def rows(attribution: SceneAttribution) -> dict[str, tuple[float, float]]:
    effects, errors = attribution.effects(), attribution.effects_error()
    found = {name: (float(effects[name]), float(errors[name])) for name in effects}
    return found | {"metric": (attribution.metric_value, attribution.metric_standard_error or 0.0)}


def answer(name: str) -> dict[str, tuple[float, float]] | str:
    """Return a case's rows, or the error that it ended with."""
    try:
        return rows(CASES[name]())
    except Exception:
        return traceback.format_exc()


if __name__ == "__main__":
    variant, SEED, names = sys.argv[1], int(sys.argv[2]), sys.argv[3:] or list(CASES)
    scenecaptum.activate(variant)
    torch.set_num_threads(1)
    print(json.dumps({name: answer(name) for name in names}))
