"""Check goals that ``attribute(tolerance=…)`` reports as reached, in random rooms.

Scene 0 is the Cornell box with its small box replaced by a ball of rough conductor, with UGR as the metric. Every
other number is the seed of a random room: walls of random colours, balls and blocks of rough metal, rough glass or
diffuse paint, lit by small lamps, small balls or spots; the metric alternates between mean luminance, UGR and DGP.
32×32 pixels, depth 4; inputs are all reflectances and roughnesses.

A run is *within* if every parameter with the share in a converged run is within the tolerance of that run. To
allow for the error of the converged run, the tolerance is widened by two of its standard errors; the number in
brackets is without this allowance. Seconds are CPU time of all cores, so that other load matters little.

The folder stores converged runs and, under a label, finished runs: the same command resumes after an interruption.

    python benchmarks/planner_random.py FOLDER [--scene 0 --scene 1] [--seeds 0-19] [--label now] [--tolerance 0.1]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.estimation import channel_totals
from scenecaptum.scene.bundled import cornell_box

SHARE = 0.05
SCENES = range(6)
WALLS = ("left_wall", "right_wall", "floor", "ceiling", "back_wall")


# --------------------------------------------------------------------------------------- scenes


def cornell_with_ball() -> dict[str, Any]:
    """Return the Cornell box with a ball of rough conductor in place of its small box."""
    scene = cornell_box()
    del scene["short_box"], scene["short_box_shape"]
    return {
        **scene,
        "ball": {"type": "roughconductor", "alpha": 0.1},
        "ball_shape": ball((0.335, -0.38, -0.5), 0.5, "ball"),
    }


def random_room(seed: int) -> dict[str, Any]:
    """Return a room with two to four objects, a rough metal among them, and one or two lamps."""
    rng = np.random.default_rng(seed)
    scene = {key: item for key, item in cornell_box().items() if "box" not in key and key != "light"}
    scene |= {wall: paint(rng) for wall in WALLS}
    for number in range(rng.integers(2, 5)):
        kind = [metal, glass, paint][rng.integers(3)] if number else metal
        name = f"object_{number}"
        scene |= {name: kind(rng), f"{name}_shape": ball_or_block(rng, name)}
    for number in range(rng.integers(1, 3)):
        scene[f"lamp_{number}"] = [panel, bulb, spot][rng.integers(3)](rng)
    return scene


def paint(rng: np.random.Generator) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": rgb(rng.uniform(0.1, 0.8, 3))}


def metal(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "type": "roughconductor",
        "distribution": str(rng.choice(["beckmann", "ggx"])),
        "material": str(rng.choice(["Cu", "Al", "Au"])),
        "alpha": float(np.exp(rng.uniform(np.log(0.07), np.log(0.4)))),
        "specular_reflectance": rgb(rng.uniform(0.5, 0.95, 3)),
    }


def glass(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "type": "roughdielectric",
        "distribution": str(rng.choice(["beckmann", "ggx"])),
        "alpha": float(np.exp(rng.uniform(np.log(0.07), np.log(0.4)))),
    }


def ball_or_block(rng: np.random.Generator, material: str) -> dict[str, Any]:
    """Return a ball or a block at a random place on the floor."""
    size = rng.uniform(0.2, 0.45)
    place = (rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), size - 1)
    if rng.random() < 0.5:
        return ball(place, size, material)
    transform = activate().ScalarTransform4f()
    turned = transform.translate(place).rotate([0, 0, 1], rng.uniform(0, 90)).scale(size)
    return {"type": "cube", "to_world": turned, "bsdf": {"type": "ref", "id": material}}


def ball(center: tuple[float, ...], radius: float, material: str) -> dict[str, Any]:
    return {
        "type": "sphere",
        "center": list(center),
        "radius": radius,
        "bsdf": {"type": "ref", "id": material},
    }


def panel(rng: np.random.Generator) -> dict[str, Any]:
    """Return a small square lamp under the ceiling."""
    half = rng.uniform(0.05, 0.2)
    place = (*rng.uniform(-0.7, 0.7, 2), 0.98)
    to_world = activate().ScalarTransform4f().translate(place).rotate([1, 0, 0], 180).scale(half)
    radiance = power(rng) / (4 * np.pi * half**2)
    return {"type": "rectangle", "to_world": to_world, "emitter": glow(radiance)}


def bulb(rng: np.random.Generator) -> dict[str, Any]:
    """Return a small luminous ball in the air."""
    radius = rng.uniform(0.03, 0.1)
    place = [*rng.uniform(-0.7, 0.7, 2), rng.uniform(0.2, 0.8)]
    radiance = power(rng) / (4 * np.pi**2 * radius**2)
    return {"type": "sphere", "center": place, "radius": radius, "emitter": glow(radiance)}


def spot(rng: np.random.Generator) -> dict[str, Any]:
    """Return a spot under the ceiling that points to the floor."""
    origin, target = (*rng.uniform(-0.7, 0.7, 2), 0.9), (*rng.uniform(-0.5, 0.5, 2), -0.7)
    return {
        "type": "spot",
        "to_world": activate().ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0]),
        "intensity": rgb([power(rng) / 2] * 3),
        "cutoff_angle": float(rng.uniform(15, 40)),
    }


def power(rng: np.random.Generator) -> float:
    """Return the power of a lamp in watts, for about 1000 lux on the walls of this room."""
    return float(rng.uniform(20, 80))


def glow(radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": rgb([radiance] * 3)}


def rgb(value: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in value]}


def method_of(number: int) -> VanillaSceneGradient:
    """Return the attribution method for a scene and its metric."""
    activate()
    scene = random_room(number) if number else cornell_with_ball()
    renderer = SceneRenderer(scene, ["reflectance", "roughness"], resolution=(32, 32), max_depth=4)
    kind = number % 3 if number else 2
    if kind == 0:
        metric: torch.nn.Module = metrics.DaylightGlareProbability(renderer.camera, threshold_factor=5)
    elif kind == 1:
        metric = metrics.MeanLuminance()
    else:
        metric = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    return VanillaSceneGradient(renderer, metric)


# --------------------------------------------------------------------------------------- runs


class Run(NamedTuple):
    """One attribution with a goal, its gradients by parameter."""

    reached: bool
    stopped: str
    samples: int
    rounds: int
    seconds: float
    totals: dict[str, list[float]]


def converged(method: VanillaSceneGradient, path: Path, samples: int) -> SceneAttribution:
    """Return the converged run, loaded from the folder if it exists."""
    if not path.exists():
        method.attribute(spp=samples, replicates=32, seed=10**6, denoise=False).save(path)
    return SceneAttribution.load(path)


def run(method: VanillaSceneGradient, seed: int, tolerance: float) -> Run:
    began = time.process_time()
    found = method.attribute(tolerance=tolerance, share=SHARE, seed=seed)
    planner = found.info["planner"]
    return Run(
        planner["reached"],
        planner["stopped"],
        found.info["spp"],
        len(planner["rounds"]),
        time.process_time() - began,
        {name: channel_totals(value).tolist() for name, value in found.items()},
    )


def deviations(result: Run, truth: SceneAttribution) -> dict[str, tuple[float, float]]:
    """Return the relative deviation of each parameter with the share, and the relative error of the truth."""
    sizes, errors = truth.saliency(), truth.saliency_error()
    assert errors is not None
    return {
        name: (
            float(np.linalg.norm(np.array(result.totals[name]) - channel_totals(truth[name]).numpy())) / size,
            errors[name] / size,
        )
        for name, size in sizes.items()
        if size >= SHARE * sum(sizes.values())
    }


COLUMNS = {
    "scene": 5,
    "metric": 24,
    "reached": 8,
    "within": 7,
    "worst": 6,
    "of": 36,
    "truth ±": 7,
    "samples": 22,
    "seconds": 7,
    "of all": 6,
    "rounds": 6,
}


def row(number: int, metric: str, truth: SceneAttribution, runs: list[Run], tolerance: float) -> list[str]:
    """Return a line of the table."""
    reached = [deviations(result, truth) for result in runs if result.reached]
    strict = sum(all(deviation <= tolerance for deviation, _ in found.values()) for found in reached)
    within = sum(
        all(deviation <= tolerance + 2 * error for deviation, error in found.values()) for found in reached
    )
    worst, name = max(((found[name][0], name) for found in reached for name in found), default=(0.0, "–"))
    error = max(error for result in runs for _, error in deviations(result, truth).values())
    samples, seconds = [result.samples for result in runs], [result.seconds for result in runs]
    return [
        str(number),
        metric,
        f"{len(reached)} of {len(runs)}",
        f"{within} ({strict})",
        f"{worst:.1%}",
        name,
        f"{error:.1%}",
        f"{statistics.median(samples):.0f} [{min(samples)}, {max(samples)}]",
        f"{statistics.median(seconds):.1f}",
        f"{sum(seconds):.0f}",
        f"{statistics.mean(result.rounds for result in runs):.1f}",
    ]


def line(cells: Iterable[str]) -> str:
    return "  ".join(f"{cell:>{width}s}" for cell, width in zip(cells, COLUMNS.values(), strict=True))


def seed_range(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", action="append", dest="scenes", type=int)
    parser.add_argument("--seeds", type=seed_range, default=range(20))
    parser.add_argument("--label", default="now", help="name for the stored runs")
    parser.add_argument("--tolerance", type=float, default=0.1)
    parser.add_argument("--converged", type=int, default=2**15, help="samples per pixel of a converged run")
    options = parser.parse_args()
    torch.set_num_threads(1)  # Dr.Jit has its own threads
    runs_folder = options.folder / f"{options.label}-{options.tolerance:g}"
    runs_folder.mkdir(parents=True, exist_ok=True)
    lines = [line(COLUMNS)]
    for number in options.scenes or SCENES:
        method = method_of(number)
        truth = converged(
            method, options.folder / f"scene-{number}-{options.converged}.npz", options.converged
        )
        compiled, runs = False, []
        for seed in options.seeds:
            path = runs_folder / f"scene-{number}-seed-{seed}.json"
            if not path.exists():
                if not compiled:
                    compiled = bool(method.attribute(spp=64))
                path.write_text(json.dumps(run(method, seed, options.tolerance)))
                print(f"scene {number}, seed {seed}", file=sys.stderr, flush=True)
            runs.append(Run(*json.loads(path.read_text())))
        lines.append(line(row(number, type(method.metric).__name__, truth, runs, options.tolerance)))
        print(lines[-1], file=sys.stderr, flush=True)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
