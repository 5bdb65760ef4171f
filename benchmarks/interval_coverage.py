"""How often the 95 % intervals of an attribution cover the truth, and whether a doubtful one is marked.

For each metric, many independent attributions of few samples are compared with a reference. Printed for each
parameter that the reference resolves: the share of its channels' intervals (of a texture: those of its totals, by
which it is ranked) that cover the reference, how many
runs were marked ``?``, and how many of those runs that miss it. Then, for all of them: how many are covered in
less than 85 % of the runs, of how many of these at least 80 % of the misses are marked, and how often a parameter
that is covered in 90 % and more is marked all the same; in brackets the same without the pilot, where one pass
that has nearly all of the spread is the only reason for a mark. On the Cornell box, the default, the reference
must be five times as precise as the bars.

    python benchmarks/interval_coverage.py [--repeats 200] [--spp 64] [--method vanilla|integrated]
        [--scene cornell-box|office|hall|PATH] [--resolution 48x27] [--reference 32768] [--inputs reflectance …]
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
    VanillaSceneGradient,
    activate,
    metrics,
)
from scenecaptum.attr._passes import channel_totals
from scenecaptum.attr._student import student_t

RESOLUTION, DEPTH, REFERENCE = 24, 4, 32768
SPP = {"mean luminance": 64, "unified glare rating": 256}
PRECISE = 0.2  # of the bar: how large the error of the reference may be
RESOLVED = 4.0  # errors of the reference, from which on its value counts as known
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
    """Return a renderer of a room: a bundled one, the hall, or that of a file."""
    activate()
    width, height = map(int, resolution.split("x"))
    source = hall() if scene == "hall" else Path(scene) if Path(scene).is_file() else scene
    return SceneRenderer(source, inputs, resolution=(width, height), max_depth=6)


def rated(renderer: SceneRenderer) -> Mapping[str, torch.nn.Module]:
    return {
        "mean luminance": metrics.MeanLuminance(),
        "unified glare rating": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0),
    }


@dataclass
class Coverage:
    """What became of one parameter: shares of its runs.

    Attributes
    ----------
    covered
        Of the intervals that hold the reference.
    misses
        How many runs miss it in any channel.
    marked
        Of the runs whose error bar is marked, with the pilot and without.
    marked_misses
        How many of the runs that miss it are marked, with the pilot and without.
    """

    covered: float
    misses: int
    marked: tuple[float, float]
    marked_misses: tuple[int, int]

    @property
    def warned(self) -> tuple[bool, bool]:
        """Whether it is covered, or the runs that miss it say so, with the pilot and without."""
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
    """Return how the intervals fare, by parameter; with ``precise``, check the reference."""
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
        one = attribute(seed=seed, spp=spp, **settings)
        doubtful = one.untrusted_errors()
        without_pilot = dataclasses.replace(
            one, info={**one.info, "effective_samples": {}}
        ).untrusted_errors()
        found, errors = totals(one)
        reach = student_t(0.95, one.info["degrees_of_freedom"])
        for name, channels in live.items():
            off = (found[name] - exact[name]).abs()
            covered[name].append((off <= reach * errors[name])[channels])
            bars[name].append(errors[name])
            marked[name].append((name in doubtful, name in without_pilot))
    for name, each in bars.items():
        bar = torch.stack(each).square().mean(0).sqrt()
        worst = (own[name] / bar)[live[name]].max().item()
        if precise is not None and worst > precise:
            raise RuntimeError(f"{name}: the reference's error is {worst:.2f} of the bar, allowed {precise}")
    return {name: _summary(torch.stack(covered[name]), torch.tensor(marked[name])) for name in live}


def totals(found: SceneAttribution) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return each parameter's channel totals and their standard errors."""
    assert found.covariance is not None
    return (
        {name: channel_totals(value).double() for name, value in found.items()},
        {name: one.diagonal().double().sqrt() for name, one in found.covariance.items()},
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
    """Say in a line how a room fares."""
    low = [one for one in found.values() if one.covered < COVERED]
    well = [one for one in found.values() if one.covered >= WELL]
    mean = sum(one.covered for one in found.values()) / len(found)
    warned, before = (sum(one.warned[which] for one in low) for which in (0, 1))
    misses = sum(one.misses for one in low)
    seen, seen_before = (sum(one.marked_misses[which] for one in low) for which in (0, 1))
    false, false_before = (
        f"{sum(one.marked[which] for one in well) / max(1, len(well)):.1%}" for which in (0, 1)
    )
    return (
        f"{len(found)} parameters resolved, {mean:.1%} covered; {len(low)} covered in less than {COVERED:.0%}, "
        f"of which {warned} warned of ({before}), with {seen} ({seen_before}) of {misses} misses marked; of the "
        f"{len(well)} covered in {WELL:.0%} and more {false} ({false_before}) of the runs are marked"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--spp", type=int, help="instead of those of each metric")
    parser.add_argument("--method", choices=METHODS, default="vanilla")
    parser.add_argument("--scene")
    parser.add_argument("--resolution", default="48x27")
    parser.add_argument("--reference", type=int, default=REFERENCE)
    parser.add_argument("--inputs", nargs="+", default=["all"])
    parser.add_argument("--metric", choices=SPP, help="only this one")
    options = parser.parse_args()
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
        for parameter, one in found.items():
            label = renderer.labels[parameter]
            print(
                f"  {label:28s} {one.covered:6.1%} covered, {one.marked[0]:6.1%} marked, "
                f"{one.marked_misses[0]} of {one.misses} misses"
            )
        print(f"  {verdict(found)}", flush=True)


if __name__ == "__main__":
    main()
