"""Measure the illuminance on the work plane of the office, draw its map, and rank what limits its darkest points.

Mean illuminance and uniformity are the two numbers that EN 12464-1 sets limits for. Their derivatives say which
surfaces to paint, or which lamps to change, for each of them.

    python examples/work_plane.py [--spp 1024] [--out out]
"""

from __future__ import annotations

from pathlib import Path

from _options import parser

from scenecaptum import SceneAttribution, SceneRenderer, SensorGrid, VanillaSceneGradient, metrics
from scenecaptum.visualization import plot_plan


def main(out: Path, spp: int = 1024, spacing: float = 0.25) -> dict[str, SceneAttribution]:
    renderer = SceneRenderer("office", "reflectance", sensor=SensorGrid(spacing=spacing), spp=spp)
    grid = renderer.grid
    uniformity = metrics.Uniformity(grid)
    chosen = {"mean illuminance": metrics.MeanIlluminance(grid), "uniformity": uniformity}
    found = {
        name: VanillaSceneGradient(renderer, metric).attribute(seed=0) for name, metric in chosen.items()
    }
    for name, result in found.items():
        print(f"\n{name} {result.metric_value:.3f} ± {result.metric_standard_error:.1g}")
        for row in result.ranking(top=3):
            print(f"  {row.label:30s} {row.effect:+8.3f} ± {row.effect_error:.1g}")
    picture = renderer(seed=1)
    hard = uniformity.hard(picture).item()
    print(f"\nuniformity by the definition, without relaxation: {hard:.3f}")
    mean = chosen["mean illuminance"](picture).item()
    out.mkdir(parents=True, exist_ok=True)
    figure = plot_plan(
        179 * metrics.luminance(picture),
        grid.plan,
        grid.inside,
        title=f"The darkest point of the office has {100 * hard:.0f} % of the mean\n"
        f"0.8 m above the floor: mean {mean:.0f} lx, uniformity {hard:.2f}",
    )
    figure.savefig(out / "work-plane.png")
    return found


if __name__ == "__main__":
    options = parser(__doc__, spp=1024, out="out").parse_args()
    main(options.out, options.spp)
