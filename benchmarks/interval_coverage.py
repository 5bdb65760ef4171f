"""Measure the coverage of an attribution's 95 % intervals, and whether intervals that miss are marked.

For each metric, many independent attributions with few samples are compared with a reference. The script prints
for each parameter that the reference resolves: the share of its channels' intervals (for a texture, of its totals,
by which it is ranked) that cover the reference, how many runs were marked ``?``, and how many of the runs that
miss were marked. Then it prints for all parameters: how many are covered in less than 85 % of the runs, for how
many of these at least 80 % of the misses are marked, and how often a parameter that is covered in 90 % or more is
marked nevertheless. Brackets have the same numbers without the pilot, where a replicate with nearly all of the
spread is the only reason for a mark. On the Cornell box, the default, the reference must be five times as precise
as the error bars. Spatial daylight autonomy is that of a sensor grid, in a room with a sky.

    python benchmarks/interval_coverage.py [--repeats 200] [--spp 64] [--method vanilla|integrated]
        [--scene cornell-box|office|hall|PATH] [--resolution 48x27] [--reference 32768] [--inputs reflectance …]
    python benchmarks/interval_coverage.py --scene classroom --metric "spatial daylight autonomy"
        --inputs reflectance opacity [--repeats 30] [--reference 1024]
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from _hall import hall

from scenecaptum import (
    IntegratedGradientsScene,
    SceneAttribution,
    SceneRenderer,
    SensorGrid,
    VanillaSceneGradient,
    activate,
    metrics,
)
from scenecaptum.daylight import SkyMatrix, SkyPatches, SpatialDaylightAutonomy, synthetic_weather
from scenecaptum.estimation import channel_totals, student_t

RESOLUTION, DEPTH, REFERENCE = 24, 4, 32768
SDA = "spatial daylight autonomy"
SPP = {"mean luminance": 64, "unified glare rating": 256, SDA: 64}
PRECISE = 0.2  # largest error of the reference, relative to the error bar
RESOLVED = 4.0  # standard errors of the reference above which a value counts as resolved
COVERED, MARKED, WELL = 0.85, 0.8, 0.9

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


def room(scene: str, resolution: str, inputs: list[str]) -> SceneRenderer:
    """Return a renderer of a bundled scene, the hall, or a scene file."""
    activate()
    width, height = map(int, resolution.split("x"))
    source = hall() if scene == "hall" else Path(scene) if Path(scene).is_file() else scene
    return SceneRenderer(source, inputs, resolution=(width, height), max_depth=6)


def daylit(scene: str, inputs: list[str]) -> SceneRenderer:
    """Return a renderer of the daylight coefficients of a room's sensor grid."""
    return SceneRenderer(scene, inputs, sensor=SensorGrid(), sky_patches=SkyPatches.tregenza())


def rated(renderer: SceneRenderer) -> Mapping[str, torch.nn.Module]:
    if renderer.sky_patches is not None:
        return {
            SDA: SpatialDaylightAutonomy(SkyMatrix.from_weather(synthetic_weather(), renderer.sky_patches))
        }
    return {
        "mean luminance": metrics.MeanLuminance(),
        "unified glare rating": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0),
    }


@dataclass
class Coverage:
    """Coverage of one parameter.

    Attributes
    ----------
    covered
        Share of the intervals that cover the reference.
    misses
        Number of runs that miss it in any channel.
    marked
        Share of the runs whose error bar is marked, with the pilot and without.
    marked_misses
        Number of the runs that miss and are marked, with the pilot and without.
    """

    covered: float
    misses: int
    marked: tuple[float, float]
    marked_misses: tuple[int, int]

    @property
    def warned(self) -> tuple[bool, bool]:
        """Whether it is covered or its misses are marked, with the pilot and without."""
        with_pilot, without = (
            self.covered >= COVERED or marked >= MARKED * self.misses for marked in self.marked_misses
        )
        return with_pilot, without


def coverage(
    renderer: SceneRenderer,
    metric: torch.nn.Module,
    spp: int,
    repeats: int,
    method: str = "vanilla",
    reference: int = REFERENCE,
    *,
    precise: float | None = PRECISE,
) -> dict[str, Coverage]:
    """Return the coverage by parameter; with ``precise``, check the error of the reference."""
    make, settings = METHODS[method]
    attribute = make(renderer, metric).attribute
    truth = attribute(seed=10**6, spp=reference, replicates=64, **settings)
    exact, own = totals(truth)
    live = {n: (v != 0) & (v.abs() > RESOLVED * own[n]) for n, v in exact.items()}
    live = {name: channels for name, channels in live.items() if channels.any()}
    covered: dict[str, list[torch.Tensor]] = {name: [] for name in live}
    bars: dict[str, list[torch.Tensor]] = {name: [] for name in live}
    marked: dict[str, list[tuple[bool, bool]]] = {name: [] for name in live}
    for seed in range(repeats):
        attribution = attribute(seed=seed, spp=spp, **settings)
        untrusted = attribution.untrusted_errors()
        without_pilot = dataclasses.replace(
            attribution, info={**attribution.info, "effective_samples": {}}
        ).untrusted_errors()
        found, errors = totals(attribution)
        quantile = student_t(0.95, attribution.info["degrees_of_freedom"])
        for name, channels in live.items():
            deviation = (found[name] - exact[name]).abs()
            covered[name].append((deviation <= quantile * errors[name])[channels])
            bars[name].append(errors[name])
            marked[name].append((name in untrusted, name in without_pilot))
    for name, errors_of_runs in bars.items():
        bar = torch.stack(errors_of_runs).square().mean(0).sqrt()
        worst = (own[name] / bar)[live[name]].max().item()
        if precise is not None and worst > precise:
            raise RuntimeError(f"{name}: the reference's error is {worst:.2f} of the bar, allowed {precise}")
    return {name: _summary(torch.stack(covered[name]), torch.tensor(marked[name])) for name in live}


def totals(found: SceneAttribution) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return each parameter's channel totals and their standard errors."""
    assert found.covariance is not None
    return (
        {name: channel_totals(value).double() for name, value in found.items()},
        {name: matrix.diagonal().double().sqrt() for name, matrix in found.covariance.items()},
    )


def _summary(covered: torch.Tensor, marked: torch.Tensor) -> Coverage:
    missed = ~covered.flatten(1).all(1)
    return Coverage(
        covered.float().mean().item(),
        int(missed.sum()),
        tuple(marked.float().mean(0).tolist()),
        tuple((missed[:, None] & marked).sum(0).tolist()),
    )


def verdict(found: Mapping[str, Coverage]) -> str:
    """Return the summary of a scene on one line."""
    low = [parameter for parameter in found.values() if parameter.covered < COVERED]
    well = [parameter for parameter in found.values() if parameter.covered >= WELL]
    mean = sum(parameter.covered for parameter in found.values()) / len(found)
    warned, without = (sum(parameter.warned[which] for parameter in low) for which in (0, 1))
    misses = sum(parameter.misses for parameter in low)
    marked, marked_without = (sum(parameter.marked_misses[which] for parameter in low) for which in (0, 1))
    false, false_without = (
        f"{sum(parameter.marked[which] for parameter in well) / max(1, len(well)):.1%}" for which in (0, 1)
    )
    return (
        f"{len(found)} parameters resolved, {mean:.1%} covered; {len(low)} covered in less than {COVERED:.0%}, "
        f"{warned} ({without}) of them with marks, {marked} ({marked_without}) of their {misses} misses marked; "
        f"of the {len(well)} covered in {WELL:.0%} or more {false} ({false_without}) of the runs are marked"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--spp", type=int, help="samples per pixel (default: by metric)")
    parser.add_argument("--method", choices=METHODS, default="vanilla")
    parser.add_argument("--scene")
    parser.add_argument("--resolution", default="48x27")
    parser.add_argument("--reference", type=int, default=REFERENCE)
    parser.add_argument("--inputs", nargs="+", default=["all"])
    parser.add_argument("--metric", choices=SPP, help="only this metric")
    options = parser.parse_args()
    if options.metric == SDA:
        if options.scene is None:
            parser.error(f"--metric {SDA!r} needs a --scene with a sky, such as classroom")
        renderer = daylit(options.scene, options.inputs)
    else:
        renderer = room(options.scene, options.resolution, options.inputs) if options.scene else box()
    size = "×".join(map(str, renderer.resolution))
    print(f"{options.scene or 'cornell-box'} {size}, {options.repeats} repeats, {options.method}")
    for name, metric in rated(renderer).items():
        if options.metric not in (None, name):
            continue
        spp = SPP[name] if options.spp is None else options.spp
        print(f"{name}, {spp} samples per pixel")
        precise = None if options.scene else PRECISE
        found = coverage(
            renderer, metric, spp, options.repeats, options.method, options.reference, precise=precise
        )
        for parameter, shares in found.items():
            label = renderer.labels[parameter]
            print(
                f"  {label:28s} {shares.covered:6.1%} covered, {shares.marked[0]:6.1%} marked, "
                f"{shares.marked_misses[0]} of {shares.misses} misses"
            )
        print(f"  {verdict(found)}", flush=True)


if __name__ == "__main__":
    main()
