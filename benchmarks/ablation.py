"""Run the ablation test of the ranking by glare: move each leading parameter along its own gradient, room by room.

Prints the predicted and the measured change for every room, with the verdict, and writes the figure, where crosses
are the fixed step of the paper.

    python benchmarks/ablation.py [--room living-room] [--metric ugr] [--spp 256] [--top 12] [--out out/ablation]
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from scenecaptum import SceneRenderer, metrics
from scenecaptum.validation import ablation_test

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = ("office", "living-room", "dining-room")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--room", choices=ROOMS, action="append")
    parser.add_argument("--metric", choices=("ugr", "luminance"), default="ugr")
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--top", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("out/ablation"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for room in arguments.room or ROOMS:
        scene = room if room == "office" else SCENES / room / "scene.xml"
        if room != "office" and not scene.is_file():
            print(f"{room}: skipped, {scene} does not exist")
            continue
        renderer = SceneRenderer(scene, "all", resolution=(64, 36), spp=arguments.spp, max_depth=6)
        glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0)
        test = ablation_test(
            renderer,
            glare if arguments.metric == "ugr" else metrics.MeanLuminance(),
            top=arguments.top,
            replicates=16,
            show_progress=sys.stderr.isatty(),
        )
        print(f"{room}, {arguments.spp} spp\n\n{test}\n", flush=True)
        test.plot().savefig(arguments.out / f"{room}-{arguments.metric}.png")


if __name__ == "__main__":
    main()
