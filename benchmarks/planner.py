"""Whether ``attribute(tolerance=…)`` delivers what it promises, at what cost, and whether a time limit is kept.

Office: 20 runs for each tolerance are held against a reference of more samples, whose own error is printed, and
against the cheapest fixed number of samples that would have done, in both readings: (a) its error is within the
tolerance in 17 of 20 runs, (b) its 95 % half-widths are, so that one would have known. What stops by 95 %
intervals cannot be as cheap as (a), which takes the errors as known.

Walls and floor only, by default: the mirror takes some hundred times their samples to the same relative error.
Rooms: 5 runs at 160×90 on each scene of the folder. Time: the seconds that a limit leaves.

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
from scenecaptum.attr._passes import channel_totals
from scenecaptum.attr._simultaneous import Quantity, simultaneous_quantile

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = ("living-room", "dining-room")
INPUTS = ["wall_*", "floor.*"]
SHARE = 0.05
ENOUGH = 17 / 20
REFERENCE = 8  # times the samples of the tightest run


class Run(NamedTuple):
    """One attribution: its error, its half-width, both relative to the gradient and the worst of all."""

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
    """Return the parameters that have the share."""
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
    return max(quantile * one.error / one.size for one in quantities)


def measure(
    method: VanillaSceneGradient, truth: SceneAttribution | None, runs: int, **options: Any
) -> list[Run]:
    found = []
    for seed in range(runs):
        began = time.perf_counter()
        one = method.attribute(seed=seed, **options)
        seconds = time.perf_counter() - began
        planner = one.info.get("planner")
        width = planner["relative_half_width"] if planner else worst_width(one)
        error = math.nan if truth is None else worst_error(one, truth)
        found.append(Run(error, width, one.info["spp"], seconds, len(planner["rounds"]) if planner else 1))
    return found


def at_rank(values: Sequence[float], runs: int) -> float:
    """Return the value that enough of the runs stay below."""
    return sorted(values)[math.ceil(ENOUGH * runs) - 1]


def line(name: str, runs: list[Run], tolerance: float) -> str:
    errors, widths = [one.error for one in runs], [one.width for one in runs]
    spent = [one.spp for one in runs]
    return (
        f"  {name:22s} error ≤ {tolerance:g} in {sum(e <= tolerance for e in errors)} of {len(runs)}, half-width "
        f"in {sum(w <= tolerance for w in widths)}; median {statistics.median(spent):.0f} spp "
        f"[{min(spent)}, {max(spent)}], {statistics.median(one.seconds for one in runs):.2f} s, error "
        f"{statistics.median(errors):.2%}, 17th of 20 {at_rank(errors, len(runs)):.2%}, rounds "
        f"{statistics.mean(one.rounds for one in runs):.1f}"
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
        spent = {}
        for tolerance in tolerances:
            runs = measure(method, truth, options.runs, tolerance=tolerance)
            spent[tolerance] = statistics.median(one.spp for one in runs)
            print(line(f"tolerance={tolerance:g}", runs, tolerance), flush=True)
            compare(method, truth, runs, tolerance)
        if len(tolerances) > 1:
            print(f"  the tightest takes {spent[tolerances[-1]] / spent[tolerances[0]]:.1f} × the samples")


def compare(method: VanillaSceneGradient, truth: SceneAttribution, runs: list[Run], tolerance: float) -> None:
    """Find the cheapest fixed settings, and print what the planner takes beside them."""
    guess = math.ceil(statistics.median(one.spp for one in runs))
    for reading in ("width", "error"):
        # Twice: what is needed is predicted from a setting near by, as errors fall with the root of the samples.
        for _ in range(2):
            fixed = measure(method, truth, len(runs), spp=guess)
            needed = at_rank([getattr(one, reading) for one in fixed], len(runs)) / tolerance
            if 0.9 < needed <= 1:
                break
            guess = max(8, math.ceil(guess * (needed * 1.02) ** 2))
        letter = {"error": "a", "width": "b"}[reading]
        print(line(f"({letter}) spp={fixed[0].spp}", fixed, tolerance))
        ratio = time_ratio(method, {"tolerance": tolerance}, {"spp": fixed[0].spp}, len(runs))
        verdict = "holds" if ratio <= 1.5 else "does not hold"
        print(f"      the planner takes {ratio:.2f} × its time: ≤ 1.5 {verdict}", flush=True)


def time_ratio(
    method: VanillaSceneGradient, ours: dict[str, Any], theirs: dict[str, Any], runs: int
) -> float:
    """Return the ratio of the median times of two ways, which take turns: what else the machine does hits both."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for seed, (options, taken) in itertools.product(range(runs), zip((ours, theirs), seconds, strict=True)):
        began = time.perf_counter()
        method.attribute(seed=seed, **options)
        taken.append(time.perf_counter() - began)
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
            renderer = SceneRenderer("office", resolution=(160, 90), max_depth=6)  # compiles anew
            method = VanillaSceneGradient(renderer, metric_of(name, renderer))
            for turn in ("first", "again"):
                began = time.perf_counter()
                planner = method.attribute(time_limit=limit).info["planner"]
                seconds = time.perf_counter() - began - planner["setup_seconds"]
                last = planner["rounds"][-1]
                print(
                    f"{name}, {limit:g} s, {turn}: {seconds:.2f} s ({seconds / limit - 1:+.1%}) and "
                    f"{planner['setup_seconds']:.2f} s before; a pass takes "
                    f"{last['seconds'] / last['passes']:.2f} s; half-width {planner['relative_half_width']:.2%}, "
                    f"rounds {[(one['passes'], one['spp_per_pass']) for one in planner['rounds']]}",
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
    torch.set_num_threads(1)  # Dr.Jit has threads of its own
    {"office": office, "rooms": rooms, "time": limits}[options.part](options)


if __name__ == "__main__":
    main()
