"""Compare the time of an attribution with that of a hand-written Mitsuba script with the same samples.

The script renders once, differentiates the same torch metric, and calls ``render_backward`` once. It tracks what
Mitsuba can track of our inputs. Both sides keep their scene loaded and their kernels compiled, the
script keeps its gradients enabled, and they take turns in one process; medians over several turns are compared.
The time of a replicate for itself is what seven more replicates with the same samples add, divided by seven.

    python benchmarks/overhead.py [SCENE.xml] [--inputs materials] [--size 320x180] [--spp 64] [--turns 5]
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from _script import hand_written

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.estimation import DEFAULT_REPLICATES

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default=str(SCENES / "dining-room" / "scene.xml"))
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--inputs", default="all", help='for example "materials"')
    parser.add_argument("--size", default="320x180", help="WIDTHxHEIGHT in pixels")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--depth", type=int, default=6)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))

    activate()
    metric = metrics.MeanLuminance()
    renderer = SceneRenderer(
        options.scene, options.inputs, resolution=(width, height), spp=options.spp, max_depth=options.depth
    )
    left_out = renderer.parameters_table().keys() - renderer.inputs.keys()
    script, tracked = hand_written(
        options.scene, metric, (width, height), options.spp, options.depth, left_out=left_out
    )
    method = VanillaSceneGradient(renderer, metric)
    sides: dict[str, Callable[[int], float]] = {
        "hand-written script": script,
        "attribution, bars off": lambda seed: method.attribute(seed=seed, replicates=1).metric_value,
        "attribution, bars on": lambda seed: method.attribute(seed=seed).metric_value,
    }
    print(
        f"{options.scene}: {len(renderer.inputs)} inputs, {len(renderer.plan.differences)} of them by finite "
        f"differences; the script tracks {len(tracked)}. {options.size}, {options.spp} spp, depth {options.depth}"
    )
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(options.turns + 1):
        for name, run in sides.items():
            start = time.perf_counter()
            run(100 * turn + 1)
            if turn > 0:  # the first turn compiles
                seconds[name].append(time.perf_counter() - start)
    base = statistics.median(seconds["hand-written script"])
    for name, times in seconds.items():
        ratios = [own / script for own, script in zip(times, seconds["hand-written script"], strict=True)]
        print(
            f"{name:22s} median {statistics.median(times):6.2f} s   ratio of medians "
            f"{statistics.median(times) / base:.3f}   median of ratios {statistics.median(ratios):.3f}"
        )
    off, on = (statistics.median(seconds[f"attribution, bars {state}"]) for state in ("off", "on"))
    print(f"a replicate for itself: {(on - off) / (DEFAULT_REPLICATES - 1):.3f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory of the process (all sides): {peak:.2f} GiB")


if __name__ == "__main__":
    main()
