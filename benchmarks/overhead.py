"""Compare the time of an attribution with that of a hand-written Mitsuba script with the same samples.

The script renders once, differentiates the same torch metric, and calls ``render_backward`` once. Both sides keep
their scene loaded and their kernels compiled, the script keeps its gradients enabled, and they take turns in one
process; the medians over several turns are compared.

    python benchmarks/overhead.py [SCENE.xml] [--turns 5]
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics

WIDTH, HEIGHT, SPP, DEPTH = 320, 180, 64, 6
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))


def hand_written(path: Path, names: list[str], metric: torch.nn.Module) -> Callable[[int], float]:
    """Return the script of a careful Mitsuba user, as a function of the seed."""
    mi = activate()
    import drjit as dr

    scene = mi.load_file(
        str(path),
        optimize=False,
        resx=WIDTH,
        resy=HEIGHT,
        spp=SPP,
        max_depth=DEPTH,
        integrator="prb",
        texture_format="variant",
    )
    params = mi.traverse(scene)
    params.keep(names)
    for name in names:
        dr.enable_grad(params[name])
    params.update()
    integrator = scene.integrator()

    def run(seed: int) -> float:
        with dr.suspend_grad():
            image = integrator.render(scene, 0, seed=seed, spp=SPP).torch().requires_grad_()
        value = metric(image)
        value.backward()
        integrator.render_backward(scene, params, mi.TensorXf(image.grad), 0, seed=seed + 1, spp=SPP)
        gradients = {name: dr.grad(params[name]) for name in names}
        dr.eval(gradients)
        dr.sync_thread()
        for name in names:
            dr.clear_grad(params[name])
        return value.item()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=SCENES / "dining-room" / "scene.xml")
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()

    metric = metrics.MeanLuminance()
    renderer = SceneRenderer(
        options.scene, inputs="materials", resolution=(WIDTH, HEIGHT), spp=SPP, max_depth=DEPTH
    )
    script = hand_written(options.scene, list(renderer.inputs), metric)
    method = VanillaSceneGradient(renderer, metric)
    sides: dict[str, Callable[[int], float]] = {
        "hand-written script": script,
        "attribution, bars off": lambda seed: method.attribute(seed=seed, replicates=1).metric_value,
        "attribution, bars on": lambda seed: method.attribute(seed=seed).metric_value,
    }
    print(f"{options.scene}: {len(renderer.inputs)} inputs, {WIDTH}×{HEIGHT}, {SPP} spp, depth {DEPTH}")
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
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory of the process (all sides): {peak:.2f} GiB")


if __name__ == "__main__":
    main()
