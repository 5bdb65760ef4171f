"""Lower the glare of the office below 19 by moving the five parameters that matter most.

UGR 19 is the limit for offices of EN 12464-1. The ranking chooses what is moved, by half of its range at most, and
torch's Adam moves it. Prints the parameters before and after, and draws both rooms.

    python examples/office_glare.py [--out out/office-glare] [--resolution 160x90] [--spp 64]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from scenecaptum import SceneRenderer, metrics, optimize

LIMIT = 19.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/office-glare"))
    parser.add_argument("--resolution", default="160x90")
    parser.add_argument("--spp", type=int, default=64)
    arguments = parser.parse_args()
    width, height = map(int, arguments.resolution.split("x"))
    renderer = SceneRenderer(
        "office", ["materials", "emitters"], resolution=(width, height), spp=arguments.spp
    )
    glare = metrics.UnifiedGlareRating(renderer.camera)
    found = optimize.minimize(renderer, glare, LIMIT, top=5, change=0.5, show_progress=sys.stderr.isatty())
    print(found)
    arguments.out.mkdir(parents=True, exist_ok=True)
    found.plot().savefig(arguments.out / "office-glare.png")
    print(f"{arguments.out / 'office-glare.png'}  before, after and the way between")


if __name__ == "__main__":
    main()
