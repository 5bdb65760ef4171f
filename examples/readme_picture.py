"""Draw the figure of the README: the office, and the saliency for its mean luminance.

python examples/readme_picture.py [FILE]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics


def main(path: Path) -> None:
    renderer = SceneRenderer(
        "office", inputs=["materials", "emitters"], resolution=(640, 360), spp=64, max_depth=6
    )
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    attribution = method.attribute(seed=0, show_progress=sys.stderr.isatty())
    path.parent.mkdir(parents=True, exist_ok=True)
    attribution.plot_heatmap().savefig(path, dpi=170)
    print(attribution)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    picture = Path(__file__).parents[1] / "docs" / "pictures" / "office.png"
    parser.add_argument("file", type=Path, nargs="?", default=picture, help="output file")
    main(parser.parse_args().file)
