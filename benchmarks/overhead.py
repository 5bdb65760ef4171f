"""Compare the time of an attribution with that of a hand-written Mitsuba script with the same samples.

The script renders once, differentiates the same torch metric, and calls ``render_backward`` once. It tracks what
Mitsuba can track of our inputs. Both sides keep their scene loaded and their kernels compiled, the
script keeps its gradients enabled, and they take turns in one process; medians over several turns are compared.
The fixed cost of a replicate is what seven more replicates with the same samples add, divided by seven.
Every scene is measured in a process of its own.

    python benchmarks/overhead.py [SCENE …] [--variant cuda_ad_rgb] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from _device import activate_variant, add_variant, device_name, peak_memory, synchronize
from _pages import measured, replace_rows
from _script import hand_written, scene_of

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.estimation import DEFAULT_REPLICATES

# The rooms of the page, with inputs and size.
ROOMS = {
    "office": ("all", "160x90"),
    "kitchen": ("all", "160x90"),
    "dining-room": ("materials", "320x180"),
    "living-room": ("materials", "320x180"),
}
# The first turn compiles, and the script compiles once more after the first attribution.
WARM_UP = 2
SCRIPT, OFF, ON = "hand-written script", "attribution, bars off", "attribution, bars on"
HEADER = (
    "room",
    "inputs",
    "image",
    "device",
    "script",
    "one replicate",
    f"{DEFAULT_REPLICATES} replicates with error bars",
    "fixed cost of a replicate",
)


@dataclass(frozen=True)
class Setting:
    """What is measured, and how."""

    scene: str
    inputs: str
    size: str
    spp: int
    depth: int
    turns: int
    variant: str


def measure(setting: Setting) -> list[str]:
    """Return the row of a scene, and print its figures."""
    activate(setting.variant)
    metric = metrics.MeanLuminance()
    scene, (width, height) = scene_of(setting.scene), map(int, setting.size.split("x"))
    renderer = SceneRenderer(
        scene, setting.inputs, resolution=(width, height), spp=setting.spp, max_depth=setting.depth
    )
    left_out = renderer.parameters_table().keys() - renderer.inputs.keys()
    script, tracked = hand_written(
        scene, metric, (width, height), setting.spp, setting.depth, left_out=left_out
    )
    method = VanillaSceneGradient(renderer, metric)
    print(
        f"{scene}, {setting.variant}: {len(renderer.inputs)} inputs, {len(renderer.plan.differences)} of them by "
        f"finite differences; the script tracks {len(tracked)}. {setting.size}, {setting.spp} spp, "
        f"depth {setting.depth}"
    )
    seconds = take_turns(
        {
            SCRIPT: script,
            OFF: lambda seed: method.attribute(seed=seed, replicates=1).metric_value,
            ON: lambda seed: method.attribute(seed=seed).metric_value,
        },
        setting.turns,
    )
    base, off, on = (statistics.median(times) for times in seconds.values())
    for name, times in seconds.items():
        ratios = [own / script for own, script in zip(times, seconds[SCRIPT], strict=True)]
        print(
            f"{name:22s} median {statistics.median(times):6.3f} s   ratio of medians "
            f"{statistics.median(times) / base:.3f}   median of ratios {statistics.median(ratios):.3f}"
        )
    alone = (on - off) / (DEFAULT_REPLICATES - 1)
    print(f"fixed cost of a replicate: {alone:.3f} s")
    print(
        f"peak memory (all sides), {device_name()}: {measured(peak_memory() / 2**30, '{:.2f} GiB')}",
        flush=True,
    )
    fewer = f" (script: {len(tracked)})" if len(tracked) != len(renderer.inputs) else ""
    return [
        name_of(setting.scene),
        f"{len(renderer.inputs)}, {setting.inputs}{fewer}",
        f"{width}×{height}, {setting.spp} spp, depth {setting.depth}",
        device_name(),
        f"{base:.3g} s",
        f"{off / base:.2f}×",
        f"{on / base:.2f}×",
        f"{alone:.2g} s",
    ]


def take_turns(sides: Mapping[str, Callable[[int], float]], turns: int) -> dict[str, list[float]]:
    """Return the seconds of each side's turns, from an idle device to one that has finished."""
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(WARM_UP + turns):
        for name, run in sides.items():
            start = time.perf_counter()
            run(100 * turn + 1)
            synchronize()
            if turn >= WARM_UP:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def name_of(scene: str) -> str:
    """Return the room's name for a file or a name."""
    path = Path(scene)
    return path.absolute().parent.name if path.name == "scene.xml" else path.stem


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=list(ROOMS), metavar="SCENE", help="a file or a name")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--inputs", help='for example "materials"; by default those of the room\'s row')
    parser.add_argument("--size", help="WIDTHxHEIGHT in pixels; by default that of the room's row")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--depth", type=int, default=6)
    add_variant(parser)
    parser.add_argument("--write", type=Path, help="page with the tables 'overhead VARIANT'")
    options = parser.parse_args()
    variant = activate_variant(parser, options.variant)
    for scene in options.scenes:
        inputs, size = ROOMS.get(name_of(scene), ("all", "320x180"))
        setting = Setting(
            scene,
            options.inputs or inputs,
            options.size or size,
            options.spp,
            options.depth,
            options.turns,
            variant,
        )
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            row = pool.submit(measure, setting).result()
        if options.write:
            replace_rows(options.write, f"overhead {variant}", [HEADER, row])


if __name__ == "__main__":
    main()
