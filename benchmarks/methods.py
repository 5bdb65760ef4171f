"""Measure the cost of each attribution method, relative to plain gradients with the same total of samples.

The methods take turns in one process. The script prints the medians of the seconds and of their ratio to the plain
gradient of the same turn. Samples are split over steps and noisy scenes, so additional time is the overhead of
many small renders, of rounding up the samples, and of evaluating the metric at the inputs themselves. Perturbation
methods do not differentiate: a sample of theirs takes less time, but each of their scenes gets at least
one sample in each of 8 replicates.

    python benchmarks/methods.py [--scene FILE] [--resolution 320 180] [--spp 64] [--turns 3]
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scenecaptum as sc
from scenecaptum import SceneRenderer, metrics

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOM = SCENES / "living-room" / "scene.xml"

METHODS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "VanillaSceneGradient": (sc.VanillaSceneGradient, {}),
    "InputXGradientScene": (sc.InputXGradientScene, {}),
    "IntegratedGradientsScene, 32 steps": (sc.IntegratedGradientsScene, {"n_steps": 32}),
    "SmoothGradScene, 25 samples": (sc.SmoothGradScene, {"nt_samples": 25}),
    "GradientShapScene, 25 samples": (
        sc.GradientShapScene,
        {"baselines": ["black", "grey"], "n_samples": 25},
    ),
    "FeatureAblationScene": (sc.FeatureAblationScene, {}),
    "ShapleyValueScene, kinds, all orders": (sc.ShapleyValueScene, {"groups": "kind", "n_samples": "all"}),
}


def seconds(
    method: Callable[..., Any], renderer: SceneRenderer, seed: int, **settings: Any
) -> tuple[float, int]:
    """Return the seconds of an attribution, and the samples per pixel of its gradients."""
    start = time.perf_counter()
    attribution = method(renderer, metrics.MeanLuminance()).attribute(seed=seed, **settings)
    return time.perf_counter() - start, attribution.info["spp"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default=str(ROOM) if ROOM.is_file() else "office")
    parser.add_argument("--resolution", type=int, nargs=2, default=(320, 180))
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    renderer = SceneRenderer(
        options.scene,
        ["reflectance", "emitters"],
        resolution=tuple(options.resolution),
        spp=options.spp,
        max_depth=6,
    )
    print(f"{Path(options.scene).parent.name or options.scene}, {renderer}")
    times: dict[str, list[float]] = {name: [] for name in METHODS}
    for turn in range(options.turns + 1):  # the first compiles
        for name, (method, settings) in METHODS.items():
            elapsed, spp = seconds(method, renderer, turn, **settings)
            if turn:
                times[name].append(elapsed)
            if turn == options.turns:
                ratios = [a / b for a, b in zip(times[name], times["VanillaSceneGradient"], strict=False)]
                median = statistics.median(times[name])
                print(f"{name:36s} {median:6.1f} s  {statistics.median(ratios):5.2f}×  {spp} spp", flush=True)


if __name__ == "__main__":
    main()
