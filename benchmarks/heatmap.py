"""Measure the cost of a heatmap, relative to its attribution.

Prints the seconds of the attribution, which traces the surfaces that pixels show, and of this tracing and the
heatmap alone, with every texture texel by texel.

    python benchmarks/heatmap.py [--scene FILE] [--resolution 1280 720] [--spp 16]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOM = SCENES / "living-room" / "scene.xml"


def timed(label: str, function: Callable[[], Any], total: float | None = None) -> tuple[Any, float]:
    start = time.perf_counter()
    result = function()
    seconds = time.perf_counter() - start
    share = "" if total is None else f"  {seconds / total:6.1%}"
    print(f"{label:44s} {seconds:7.2f} s{share}", flush=True)
    return result, seconds


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default=str(ROOM) if ROOM.is_file() else "office")
    parser.add_argument("--resolution", type=int, nargs=2, default=(1280, 720))
    parser.add_argument("--spp", type=int, default=16)
    options = parser.parse_args()

    def renderer(width: int, height: int) -> SceneRenderer:
        return SceneRenderer(
            options.scene,
            ["reflectance", "emitters"],
            resolution=(width, height),
            spp=options.spp,
            max_depth=6,
        )

    VanillaSceneGradient(renderer(64, 36), metrics.MeanLuminance()).attribute()  # compiles
    room = renderer(*options.resolution)
    print(f"{Path(options.scene).parent.name or options.scene}, {room}")
    attribution, whole = timed(
        "attribution", lambda: VanillaSceneGradient(room, metrics.MeanLuminance()).attribute()
    )
    fresh = renderer(*options.resolution)
    timed("surfaces and texels of the pixels", fresh.surfaces_with_texels, whole)
    timed("heatmap", attribution.heatmap, whole)
    timed("heatmap, texel by texel", lambda: attribution.heatmap(texels=True), whole)


if __name__ == "__main__":
    main()
