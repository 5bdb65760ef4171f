"""Memory, file size and start-up of an attribution in real rooms, beside a hand-written Mitsuba script.

Each figure is that of a fresh process: the peak memory of an attribution to all inputs, the predicted one
beyond the loaded scene, the size of the saved result, and the time from loading to the first result, a median of
turns with Mitsuba's start-up, which is loading and a first render. Memory is resident memory on a CPU, and what
Dr.Jit and torch allocate on a GPU. The script renders and differentiates once by ``prb``, with respect to the same
inputs as far as Mitsuba tracks them. Kernels are in the caches on disk, unless ``--cold``.

    python benchmarks/rooms.py [ROOM …] [--cold] [--variant cuda_ad_rgb] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from _device import activate_variant, add_variant, clock, memory, peak_memory
from _pages import measured, replace_table
from _script import SCENES, scene_of

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.scene import load_scene

RESOLUTION, SPP, DEPTH, REPLICATES = (160, 90), 16, 6, 8
TURNS = 3  # of starts
MEBIBYTE = 2**20
ROOMS = ["office", *sorted(path.parent.name for path in SCENES.glob("*/scene.xml"))]


def attribution(room: str) -> dict[str, Any]:
    """Attribute to all inputs."""
    start = clock()
    renderer = SceneRenderer(scene_of(room), "all", resolution=RESOLUTION, spp=SPP, max_depth=DEPTH)
    loaded, loading_peak, resident = clock(), peak_memory(), memory()
    result = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(replicates=REPLICATES)
    finished, peak = clock(), peak_memory()
    with tempfile.TemporaryDirectory() as folder:
        result.save(Path(folder) / "attribution.npz")
        size = (Path(folder) / "attribution.npz").stat().st_size
    return {
        "peak": max(loading_peak, peak),
        "beyond": peak - resident,
        "predicted": renderer.memory(spp=SPP // REPLICATES, pictures=REPLICATES),
        "size": size,
        "load": loaded - start,
        "seconds": finished - start,
        "names": [name for name in renderer.inputs if renderer.parameters_table()[name].tracked],
    }


def _with_film(scene: Any) -> Any:
    mi = activate()
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = list(RESOLUTION)
    film.update()
    return mi.load_dict({"type": "prb", "max_depth": DEPTH})


def script(room: str, names: list[str]) -> dict[str, Any]:
    """Render, differentiate mean luminance and the image, each once."""
    mi = activate()
    import drjit as dr

    scene = load_scene(scene_of(room))  # with textures as floats, which prb can track
    integrator = _with_film(scene)
    params = mi.traverse(scene)
    params.keep(names)
    for name in names:
        dr.enable_grad(params[name])
    params.update()
    with dr.suspend_grad():
        image = integrator.render(scene, 0, seed=0, spp=SPP).torch().requires_grad_()
    metrics.MeanLuminance()(image).backward()
    integrator.render_backward(scene, params, mi.TensorXf(image.grad), 0, seed=1, spp=SPP)
    gradients = {name: dr.grad(params[name]) for name in names}
    dr.eval(gradients)
    dr.sync_thread()
    return {"peak": peak_memory()}


def first_render(room: str) -> dict[str, Any]:
    """Load a room as Mitsuba does, and render it once."""
    mi = activate()
    import drjit as dr

    from scenecaptum.scene.bundled import BUNDLED

    dr.set_thread_count(max(2, dr.thread_count()))  # with a single thread Mitsuba waits forever for EXR files
    start = clock()
    if room in BUNDLED and not (SCENES / room / "scene.xml").exists():
        scene = mi.load_dict(BUNDLED[room](), optimize=False)
    else:
        scene = mi.load_file(scene_of(room), optimize=False)
    loaded = clock()
    dr.eval(mi.render(scene, integrator=_with_film(scene), spp=SPP, seed=0))
    return {"load": loaded - start, "seconds": clock() - start}


TASKS = {"attribution": attribution, "script": script, "first_render": first_render}


def in_fresh_process(task: str, *arguments: Any, cache: str | None = None) -> dict[str, Any]:
    """Run a task in another Python with the active variant, and return its answer."""
    own = ["--variant", activate().variant(), "--task", json.dumps([task, *arguments])]
    command = [sys.executable, "-W", "ignore", __file__, *own]
    environment = {**os.environ, **({"HOME": cache, "OPTIX_CACHE_PATH": cache} if cache else {})}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def start(room: str, *, cold: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Attribute in a fresh process, and render by Mitsuba in another."""
    with tempfile.TemporaryDirectory() as empty:
        cache = empty if cold else None
        return in_fresh_process("attribution", room, cache=cache), in_fresh_process(
            "first_render", room, cache=cache
        )


def measure(room: str, *, cold: bool) -> list[str]:
    """Return the row of a room."""
    if not cold:  # fill the cache on disk
        start(room, cold=False)
    starts = [start(room, cold=cold) for _ in range(TURNS)]
    ours = starts[0][0]
    written = in_fresh_process("script", room, ours["names"])
    (load, seconds), (their_load, their_seconds) = (
        [median(answer[key] for answer in answers) for key in ("load", "seconds")]
        for answers in zip(*starts, strict=True)
    )
    return [
        room,
        measured(ours["peak"] / MEBIBYTE, "{:.0f} MiB"),
        measured(written["peak"] / MEBIBYTE, "{:.0f} MiB"),
        measured(ours["peak"] / written["peak"], "{:.2f}×"),
        measured(ours["beyond"] / MEBIBYTE, "{:.0f} MiB"),
        f"{ours['predicted'] / MEBIBYTE:.0f} MiB",
        measured(100 * (ours["beyond"] / ours["predicted"] - 1), "{:+.0f} %"),
        f"{ours['size'] / 1e6:.2f} MB",
        f"{load:.1f} + {seconds - load:.1f} s",
        f"{their_load:.1f} + {their_seconds - their_load:.1f} s",
        f"{seconds / their_seconds:.1f}×",
    ]


HEADER = (
    "room",
    "peak",
    "hand-written",
    "ratio",
    "beyond the scene",
    "predicted",
    "measured against that",
    "file",
    "load + first result",
    "Mitsuba: load + first render",
    "ratio",
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rooms", nargs="*", default=ROOMS, metavar="ROOM")
    parser.add_argument("--cold", action="store_true", help="start with an empty kernel cache on disk")
    add_variant(parser)
    parser.add_argument("--write", type=Path, help="page with the tables 'rooms VARIANT'")
    parser.add_argument("--task", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    variant = activate_variant(parser, options.variant)
    if options.task:
        task, *arguments = options.task
        print(json.dumps(TASKS[task](*arguments)))
        return
    rows: list[Sequence[str]] = [HEADER]
    print(" | ".join(HEADER), flush=True)
    for room in options.rooms:
        rows.append(measure(room, cold=options.cold))
        print(" | ".join(rows[-1]), flush=True)
    if options.write:
        replace_table(options.write, f"rooms {variant}", rows)


if __name__ == "__main__":
    main()
