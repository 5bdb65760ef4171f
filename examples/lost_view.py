"""Turn the camera until a classifier no longer sees the shape that it saw.

The margin of the logit over the best other class is lowered by gradient descent on ``camera.pose.rotation``, whose
derivative needs no second render. Prints the margin and the rotation, and draws both views.

    python examples/lost_view.py [--out out/lost-view] [--resolution 64x64] [--spp 64]
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

from _options import parser

from scenecaptum import SceneRenderer, activate, metrics, optimize

ROTATION = "camera.pose.rotation"


def still_life() -> dict[str, Any]:
    """Return a cube on a table under a lamp."""
    mi = activate()
    place = mi.ScalarTransform4f
    look = place().look_at(origin=(0, -4, 1.6), target=(0, 0, 0.3), up=(0, 0, 1))
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 35.0, "to_world": look, "film": film},
        "table": {"type": "rectangle", "to_world": place().scale(6)},
        "wall": {
            "type": "rectangle",
            "to_world": place().translate((0, 3, 0)).rotate((1, 0, 0), 90).scale(6),
        },
        "cube": {
            "type": "cube",
            "to_world": place().translate((0, 0, 0.5)).rotate((0, 0, 1), 30).scale(0.5),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.25, 0.15]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": place().translate((1, -1, 4)).rotate((1, 0, 0), 180),
            "emitter": {"type": "area", "radiance": 6.0},
        },
        "sky": {"type": "constant", "radiance": 0.2},
    }


def main(
    folder: Path, resolution: tuple[int, int] = (64, 64), spp: int = 64, steps: int = 40
) -> optimize.Optimization:
    renderer = SceneRenderer(still_life(), ROTATION, resolution=resolution, spp=spp)
    network = metrics.ShapeClassifier.pretrained()
    margin = metrics.ClassLogit(network, "cube", against="best", smoothing=0.3)
    limits = {ROTATION: (-math.radians(20), math.radians(20))}
    found = optimize.minimize(
        renderer, margin, below=0.0, limits=limits, steps=steps, show_progress=sys.stderr.isatty()
    )
    print(found)
    folder.mkdir(parents=True, exist_ok=True)
    found.plot().savefig(folder / "lost-view.png")
    print(f"{folder / 'lost-view.png'}  both views and the margin at each step")
    return found


if __name__ == "__main__":
    options = parser(__doc__, resolution="64x64", spp=64, out="out/lost-view").parse_args()
    main(options.out, options.resolution, options.spp)
