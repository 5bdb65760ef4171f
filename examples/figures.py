"""Draw every figure of the library for the office under two metrics, mean luminance and the glare rating UGR.

python examples/figures.py FOLDER
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.visualization import plot_rank_comparison, plot_specificity


def main(folder: Path, resolution: tuple[int, int] = (256, 144), spp: int = 64) -> None:
    renderer = SceneRenderer(
        "office", inputs=["reflectance", "emitters"], resolution=resolution, spp=spp, max_depth=6
    )
    glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    progress = sys.stderr.isatty()
    by_luminance, by_glare = (
        VanillaSceneGradient(renderer, metric).attribute(seed=0, show_progress=progress)
        for metric in (metrics.MeanLuminance(), glare)
    )
    figures = {
        "luminance": metrics.plot_luminance(by_glare.image, glare),
        "bars": by_glare.plot_bars(),
        "heatmap": by_glare.plot_heatmap(),
        "overlay": by_glare.plot_overlay(),
        "specificity": plot_specificity([by_luminance, by_glare]),
        "ranks": plot_rank_comparison(by_luminance, by_glare),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png")
        print(folder / f"{name}.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="output folder")
    main(parser.parse_args().folder)
