"""How often the 95 % intervals of an attribution cover the truth.

On the Cornell box, for each metric, many independent attributions of few samples are compared with a reference
whose own error is at most a fifth of theirs. Printed for each parameter: the share of its channels' intervals that
cover the reference.

    python benchmarks/interval_coverage.py [--repeats 200] [--spp 64] [--method vanilla|integrated]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any

import torch

from scenecaptum import IntegratedGradientsScene, SceneRenderer, VanillaSceneGradient, metrics

RESOLUTION, DEPTH, REFERENCE = 24, 4, 32768
SPP = {"mean luminance": 64, "unified glare rating": 256}
PRECISE = 0.2  # of the bar: how large the error of the reference may be

METHODS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "vanilla": (VanillaSceneGradient, {}),
    "integrated": (IntegratedGradientsScene, {"n_steps": 8}),
}


def box() -> SceneRenderer:
    return SceneRenderer(
        "cornell-box",
        ["reflectance", "emitters"],
        resolution=(RESOLUTION, RESOLUTION),
        max_depth=DEPTH,
    )


def rated(renderer: SceneRenderer) -> Mapping[str, torch.nn.Module]:
    return {
        "mean luminance": metrics.MeanLuminance(),
        "unified glare rating": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0),
    }


def coverage(
    renderer: SceneRenderer, metric: torch.nn.Module, spp: int, repeats: int, method: str = "vanilla"
) -> dict[str, float]:
    """Return the share of intervals that cover the reference, by parameter; and check the reference."""
    make, settings = METHODS[method]
    attribute = make(renderer, metric).attribute
    truth = attribute(seed=10**6, spp=REFERENCE, replicates=64, **settings)
    covered: dict[str, list[torch.Tensor]] = {name: [] for name in truth}
    bars: dict[str, list[torch.Tensor]] = {name: [] for name in truth}
    for seed in range(repeats):
        one = attribute(seed=seed, spp=spp, **settings)
        for name, (low, high) in one.interval(0.95).items():
            # A channel that cannot matter has neither value nor error.
            live = truth[name] != 0
            covered[name].append(((low <= truth[name]) & (truth[name] <= high))[live].float().mean())
            bars[name].append(one.standard_error[name])
    for name, errors in bars.items():
        live = truth[name] != 0
        bar = torch.stack(errors).square().mean(0).sqrt()
        worst = (truth.standard_error[name] / bar)[live].max().item()
        if worst > PRECISE:
            raise RuntimeError(f"{name}: the reference's error is {worst:.2f} of the bar, allowed {PRECISE}")
    return {name: torch.stack(shares).mean().item() for name, shares in covered.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--spp", type=int, help="instead of those of each metric")
    parser.add_argument("--method", choices=METHODS, default="vanilla")
    options = parser.parse_args()
    renderer = box()
    print(f"Cornell box {RESOLUTION}×{RESOLUTION}, {options.repeats} repeats, {options.method}")
    for name, metric in rated(renderer).items():
        spp = SPP[name] if options.spp is None else options.spp
        print(f"{name}, {spp} samples per pixel")
        shares = coverage(renderer, metric, spp, options.repeats, options.method)
        for parameter, share in shares.items():
            print(f"  {renderer.labels[parameter]:28s} {share:6.1%}", flush=True)


if __name__ == "__main__":
    main()
