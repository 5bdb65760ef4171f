"""Measure the reliability and the cost of ``attribute(tolerance=…)``, and how well time limits are kept.

Office: 20 runs for each tolerance are compared with a reference of more samples, whose own error is printed, and
with the smallest fixed number of samples that is sufficient by one of two criteria: (a) its error is within the
tolerance in 17 of 20 runs, (b) its 95 % half-width is. A stopping rule based on 95 % intervals cannot be as cheap
as (a), which assumes that the errors are known.

By default only walls and floor are inputs: the mirror needs about a hundred times their samples for the same
relative error. Rooms: 5 runs at 160×90 on each scene of the folder. Time: elapsed seconds for several limits.

    python benchmarks/planner.py office [--metric luminance|ugr] [--tolerance 0.05 --tolerance 0.01]
    python benchmarks/planner.py rooms|time
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.estimation import Quantity, channel_totals, simultaneous_quantile

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = ("living-room", "dining-room")
INPUTS = ["wall_*", "floor.*"]
SHARE = 0.05
ENOUGH = 17 / 20
REFERENCE = 8  # samples of the reference, as a multiple of those of the tightest run


class Run(NamedTuple):
    """One attribution; error and half-width are the largest of all parameters, relative to their gradients."""

    error: float
    width: float
    spp: int
    seconds: float
    rounds: int


def metric_of(name: str, renderer: SceneRenderer) -> torch.nn.Module:
    if name == "luminance":
        return metrics.MeanLuminance()
    return metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)


def totals(attribution: SceneAttribution) -> dict[str, torch.Tensor]:
    return {name: channel_totals(value) for name, value in attribution.items()}


def chosen(truth: SceneAttribution) -> list[str]:
    """Return the parameters with at least the share of the total saliency."""
    sizes = truth.saliency()
    return [name for name, size in sizes.items() if size >= SHARE * sum(sizes.values())]


def worst_error(found: SceneAttribution, truth: SceneAttribution) -> float:
    ours, theirs = totals(found), totals(truth)
    return max(((ours[name] - theirs[name]).norm() / theirs[name].norm()).item() for name in chosen(truth))


def worst_width(found: SceneAttribution) -> float:
    """Return the largest simultaneous half-width of an attribution with a fixed number of samples."""
    quantities = []
    for name in chosen(found):
        rows = found.replicates[name]
        noise = (rows - rows.mean(0)) / math.sqrt(len(rows) * (len(rows) - 1))
        total, bias = channel_totals(found[name]), channel_totals(found.bias[name])
        quantities.append(Quantity((name,), total, noise, bias, 0.0))
    quantile = simultaneous_quantile(quantities, found.info["degrees_of_freedom"])
    return max(quantile * quantity.error / quantity.size for quantity in quantities)


def measure(
    method: VanillaSceneGradient, truth: SceneAttribution | None, runs: int, **options: Any
) -> list[Run]:
    found = []
    for seed in range(runs):
        began = time.perf_counter()
        attribution = method.attribute(seed=seed, **options)
        seconds = time.perf_counter() - began
        planner = attribution.info.get("planner")
        width = planner["relative_half_width"] if planner else worst_width(attribution)
        error = math.nan if truth is None else worst_error(attribution, truth)
        rounds = len(planner["rounds"]) if planner else 1
        found.append(Run(error, width, attribution.info["spp"], seconds, rounds))
    return found


def at_rank(values: Sequence[float], runs: int) -> float:
    """Return the smallest value that is not exceeded in enough of the runs."""
    return sorted(values)[math.ceil(ENOUGH * runs) - 1]


def line(name: str, runs: list[Run], tolerance: float) -> str:
    errors, widths = [run.error for run in runs], [run.width for run in runs]
    samples = [run.spp for run in runs]
    return (
        f"  {name:22s} error ≤ {tolerance:g} in {sum(e <= tolerance for e in errors)} of {len(runs)}, half-width "
        f"in {sum(w <= tolerance for w in widths)}; median {statistics.median(samples):.0f} spp "
        f"[{min(samples)}, {max(samples)}], {statistics.median(run.seconds for run in runs):.2f} s, error "
        f"{statistics.median(errors):.2%}, 17th of 20 {at_rank(errors, len(runs)):.2%}, rounds "
        f"{statistics.mean(run.rounds for run in runs):.1f}"
    )


def office(options: argparse.Namespace) -> None:
    width, height = options.resolution
    renderer = SceneRenderer("office", options.inputs or INPUTS, resolution=(width, height), max_depth=6)
    print(f"office {width}×{height}, depth 6, {len(renderer.inputs)} inputs: {', '.join(renderer.inputs)}")
    for name in options.metrics or ["luminance", "ugr"]:
        method = VanillaSceneGradient(renderer, metric_of(name, renderer))
        method.attribute(spp=64)  # compiles
        tolerances = sorted(options.tolerances or [0.05, 0.01], reverse=True)
        first = method.attribute(tolerance=tolerances[-1], seed=10**6)
        samples = REFERENCE * first.info["spp"]
        truth = method.attribute(spp=samples, replicates=24, seed=10**6 + 1)
        print(f"{name}: reference of {truth.info['spp']} spp, half-width {worst_width(truth):.2%}")
        median_spp = {}
        for tolerance in tolerances:
            runs = measure(method, truth, options.runs, tolerance=tolerance)
            median_spp[tolerance] = statistics.median(run.spp for run in runs)
            print(line(f"tolerance={tolerance:g}", runs, tolerance), flush=True)
            compare(method, truth, runs, tolerance)
        if len(tolerances) > 1:
            ratio = median_spp[tolerances[-1]] / median_spp[tolerances[0]]
            print(f"  the tightest takes {ratio:.1f} × the samples")


def compare(method: VanillaSceneGradient, truth: SceneAttribution, runs: list[Run], tolerance: float) -> None:
    """Find the cheapest fixed settings, and print the planner's cost relative to them."""
    guess = math.ceil(statistics.median(run.spp for run in runs))
    for criterion in ("width", "error"):
        # Two iterations, because the extrapolation by 1/√spp is accurate only for a nearby setting.
        for _ in range(2):
            fixed = measure(method, truth, len(runs), spp=guess)
            needed = at_rank([getattr(run, criterion) for run in fixed], len(runs)) / tolerance
            if 0.9 < needed <= 1:
                break
            guess = max(8, math.ceil(guess * (needed * 1.02) ** 2))
        letter = {"error": "a", "width": "b"}[criterion]
        print(line(f"({letter}) spp={fixed[0].spp}", fixed, tolerance))
        ratio = time_ratio(method, {"tolerance": tolerance}, {"spp": fixed[0].spp}, len(runs))
        verdict = "holds" if ratio <= 1.5 else "does not hold"
        print(f"      the planner takes {ratio:.2f} × its time: ≤ 1.5 {verdict}", flush=True)


def time_ratio(
    method: VanillaSceneGradient, ours: dict[str, Any], theirs: dict[str, Any], runs: int
) -> float:
    """Return the ratio of the median times of two settings, run in turns so that machine load affects both."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for seed, (options, times) in itertools.product(range(runs), zip((ours, theirs), seconds, strict=True)):
        began = time.perf_counter()
        method.attribute(seed=seed, **options)
        times.append(time.perf_counter() - began)
    return statistics.median(seconds[0]) / statistics.median(seconds[1])


def rooms(options: argparse.Namespace) -> None:
    for room in ROOMS:
        renderer = SceneRenderer(
            SCENES / room / "scene.xml", options.inputs or "materials", resolution=(160, 90), max_depth=6
        )
        method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
        tolerance = (options.tolerances or [0.1])[0]
        began = time.perf_counter()
        first = method.attribute(tolerance=tolerance, seed=10**6)
        truth = method.attribute(spp=REFERENCE * first.info["spp"], replicates=24, seed=10**6 + 1)
        print(
            f"{room} 160×90, {len(renderer.inputs)} inputs, {len(chosen(truth))} with the share; reference of "
            f"{truth.info['spp']} spp, half-width {worst_width(truth):.2%}, {time.perf_counter() - began:.0f} s"
        )
        runs = measure(method, truth, min(options.runs, 5), tolerance=tolerance)
        print(line(f"tolerance={tolerance:g}", runs, tolerance), flush=True)


def limits(options: argparse.Namespace) -> None:
    for name in options.metrics or ["luminance", "ugr"]:
        for limit in (2.0, 5.0, 10.0, 20.0):
            renderer = SceneRenderer("office", resolution=(160, 90), max_depth=6)  # compiles again
            method = VanillaSceneGradient(renderer, metric_of(name, renderer))
            for turn in ("first", "again"):
                began = time.perf_counter()
                planner = method.attribute(time_limit=limit).info["planner"]
                seconds = time.perf_counter() - began - planner["setup_seconds"]
                last = planner["rounds"][-1]
                print(
                    f"{name}, {limit:g} s, {turn}: {seconds:.2f} s ({seconds / limit - 1:+.1%}) and "
                    f"{planner['setup_seconds']:.2f} s of setup; "
                    f"{last['seconds'] / last['replicates']:.2f} s per replicate; "
                    f"half-width {planner['relative_half_width']:.2%}, "
                    f"rounds {[(item['replicates'], item['spp_per_replicate']) for item in planner['rounds']]}",
                    flush=True,
                )


def resolution(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=["office", "rooms", "time"])
    parser.add_argument("--metric", action="append", dest="metrics", choices=["luminance", "ugr"])
    parser.add_argument("--tolerance", action="append", dest="tolerances", type=float)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--inputs", action="append")
    parser.add_argument("--resolution", type=resolution, default=(48, 27))
    options = parser.parse_args()
    torch.set_num_threads(1)  # Dr.Jit has its own threads
    {"office": office, "rooms": rooms, "time": limits}[options.part](options)


if __name__ == "__main__":
    main()
