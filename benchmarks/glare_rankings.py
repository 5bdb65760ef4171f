"""Compare the ranking by glare with the ranking by brightness, on real rooms.

Prints Kendall's τ between the two rankings of a scene's materials and lights, the leading parameters of each, and
the share of the total saliency on lights, mirrors and glossy surfaces (the rest is diffuse), and writes both
heatmaps.

    python benchmarks/glare_rankings.py [--spp 64] [--out out/rankings]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = ("office", "living-room", "dining-room")
LEADING = 6


def kendall(first: SceneAttribution, second: SceneAttribution) -> float:
    """Return τ: the share of concordant pairs of parameters, minus the share of discordant ones."""
    names = list(first)
    saliencies = (np.array([result.saliency()[name] for name in names]) for result in (first, second))
    signs = [np.sign(values[:, None] - values) for values in saliencies]
    pairs = np.triu_indices(len(names), 1)
    return float((signs[0] * signs[1])[pairs].mean())


def specular_share(attribution: SceneAttribution, renderer: SceneRenderer) -> float:
    """Return the share of the total saliency that is not on diffuse surfaces."""
    saliency, table = attribution.saliency(), renderer.parameters_table()
    diffuse = sum(saliency[name] for name in attribution if table[name].plugin == "SmoothDiffuse")
    return 1 - diffuse / sum(saliency.values())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--out", type=Path, default=Path("out/rankings"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for room in ROOMS:
        scene = room if room == "office" else SCENES / room / "scene.xml"
        if room != "office" and not scene.is_file():
            print(f"{room}: skipped, {scene} does not exist")
            continue
        renderer = SceneRenderer(scene, "all", resolution=(160, 90), spp=arguments.spp, max_depth=6)
        rated = {
            "luminance": metrics.MeanLuminance(),
            "ugr": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0),
        }
        found = {name: VanillaSceneGradient(renderer, m).attribute(seed=0) for name, m in rated.items()}
        print(f"{room}: Kendall's τ between the rankings {kendall(*found.values()):.2f}")
        for name, attribution in found.items():
            attribution.plot_heatmap().savefig(arguments.out / f"{room}-{name}.png", dpi=100)
            leading = ", ".join(f"{row.label} {row.saliency:.3g}" for row in attribution.ranking(LEADING))
            share = specular_share(attribution, renderer)
            print(
                f"  {name} {attribution.metric_value:.4g}: {share:.0%} on lights and glossy surfaces; {leading}"
            )


if __name__ == "__main__":
    main()
