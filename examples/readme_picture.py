"""Make the pictures of the README: the office, and what its mean luminance and its glare depend on.

python examples/readme_picture.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics


def main(folder: Path) -> None:
    renderer = SceneRenderer(
        "office", inputs=["materials", "emitters"], resolution=(640, 360), spp=256, max_depth=6
    )
    rated = {
        "office": metrics.MeanLuminance(),
        "office-glare": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, metric in rated.items():
        method = VanillaSceneGradient(renderer, metric)
        attribution = method.attribute(seed=0, show_progress=sys.stderr.isatty())
        attribution.plot_heatmap().savefig(folder / f"{name}.png", dpi=110)
        print(attribution)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "docs" / "pictures")
