"""Lower the glare of the office below 19 by moving the five parameters that matter most.

UGR 19 is the limit for offices in EN 12464-1. The ranking selects the parameters, and torch's Adam moves them by
half of their range at most. Prints the parameters before and after, and draws both rooms.

    python examples/office_glare.py [--out out/office-glare] [--resolution 160x90] [--spp 64]
"""

from __future__ import annotations

import sys
from pathlib import Path

from _options import parser

from scenecaptum import SceneRenderer, metrics, optimize

LIMIT = 19.0


def main(folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 64) -> optimize.Optimization:
    renderer = SceneRenderer("office", ["materials", "emitters"], resolution=resolution, spp=spp)
    glare = metrics.UnifiedGlareRating(renderer.camera)
    found = optimize.minimize(renderer, glare, LIMIT, top=5, change=0.5, show_progress=sys.stderr.isatty())
    print(found)
    folder.mkdir(parents=True, exist_ok=True)
    found.plot().savefig(folder / "office-glare.png")
    print(f"{folder / 'office-glare.png'}  before, after and the optimization")
    return found


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=64, out="out/office-glare").parse_args()
    main(options.out, options.resolution, options.spp)
