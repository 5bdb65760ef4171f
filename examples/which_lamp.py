"""Attribute the brightness and the glare of the office to its lamps.

The effect of a radiance over its range, from off to its value, is the contribution of the lamp: mean luminance is
linear in the light, so the contributions of all lamps add up to the whole. The glare rating is not linear: its
effects are of first order, for lamps that are dimmed a little, and a lamp out of sight lowers it. Prints the
effects of all lamps, and draws them as bars.

    python examples/which_lamp.py [--out out/which-lamp] [--resolution 160x90] [--spp 128]
"""

from __future__ import annotations

from pathlib import Path

from _options import parser

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics


def main(
    folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 128
) -> dict[str, SceneAttribution]:
    renderer = SceneRenderer("office", "emitters", resolution=resolution, spp=spp, max_depth=6)
    chosen = {
        "mean luminance": metrics.MeanLuminance(),
        "UGR": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5),
    }
    found = {
        name: VanillaSceneGradient(renderer, metric).attribute(groups="material", seed=0)
        for name, metric in chosen.items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, lamps in found.items():
        print(f"\n{name} {lamps.metric_value:.3f} ± {lamps.metric_standard_error:.1g}")
        for lamp in lamps.ranking():
            print(f"  {lamp.label:20s} {lamp.effect:+8.3f} ± {lamp.effect_error:.1g}")
        print(f"  {'all of them':20s} {sum(lamp.effect for lamp in lamps.ranking()):+8.3f}")
        file = folder / f"{name.lower().replace(' ', '-')}.png"
        lamps.plot_bars().savefig(file)
        print(f"{file}  the effects as bars")
    return found


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=128, out="out/which-lamp").parse_args()
    main(options.out, options.resolution, options.spp)
