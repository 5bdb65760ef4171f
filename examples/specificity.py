"""Measure how specific saliency is to its metric: brightness, glare and contrast of the office.

All three are measured on the same renders, so that their rankings differ only because of the metrics. Prints
Spearman's rank correlation of the signed effects on two metrics; on the diagonal, that of a metric with
itself and another seed, which is the upper limit set by noise. Draws the rankings as bars, and the maps below.

    python examples/specificity.py [--out out/specificity] [--resolution 160x90] [--spp 128]
"""

from __future__ import annotations

from pathlib import Path

import torch
from _options import parser
from own_metric import WeberContrast

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.visualization import plot_specificity


def rank_correlation(a: SceneAttribution, b: SceneAttribution) -> float:
    """Return Spearman's correlation of the signed effects."""
    effects = torch.tensor([[attribution.effects()[name] for name in a] for attribution in (a, b)])
    return torch.corrcoef(effects.argsort().argsort().float())[0, 1].item()


def main(
    folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 128
) -> dict[tuple[str, str], float]:
    renderer = SceneRenderer(
        "office", ["reflectance", "emitters"], resolution=resolution, spp=spp, max_depth=6
    )
    desk = torch.from_numpy(renderer.surfaces.shown(["desk.base_color.value"]))
    chosen = {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": metrics.UnifiedGlareRating(renderer.camera),
        "desk's contrast": WeberContrast(desk),
    }
    found, again = (
        {name: VanillaSceneGradient(renderer, metric).attribute(seed=seed) for name, metric in chosen.items()}
        for seed in (0, 1)
    )
    correlations = {
        (a, b): rank_correlation(found[a], (again if a == b else found)[b]) for a in chosen for b in chosen
    }
    print(" " * 16 + "".join(f"{name:>17s}" for name in chosen))
    for a in chosen:
        print(f"{a:16s}" + "".join(f"{correlations[a, b]:17.2f}" for b in chosen))
    folder.mkdir(parents=True, exist_ok=True)
    plot_specificity(list(found.values()), signed=True).savefig(folder / "specificity.png")
    print(f"\n{folder / 'specificity.png'}  rankings and maps of each metric")
    return correlations


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=128, out="out/specificity").parse_args()
    main(options.out, options.resolution, options.spp)
