"""Peak memory of a large render and its backward pass, by chunk.

Renders at 1280×720 with as many samples as fill four chunks, differentiates mean luminance with respect to every
material, and prints the peak resident memory of each chunk.

    python benchmarks/memory.py [SCENE] [--chunks 4]

With ``--predict``: attributes at several sizes, each in its own process, and compares the peak resident memory
(beyond that of the loaded scene) with the library's prediction.

    python benchmarks/memory.py --predict
"""

from __future__ import annotations

import argparse
import multiprocessing
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.rendering import _chunks

RESOLUTION = (1280, 720)
PAGE = 4096
MEBIBYTE = 2**20

spawn = multiprocessing.get_context("spawn")


def resident() -> int:
    """Return this process's resident memory in bytes (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


class Peaks:
    """Records the peak memory of every stage in a background thread."""

    def __init__(self) -> None:
        self.stages: list[tuple[str, int]] = []
        self._stop = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            if self.stages:
                label, peak = self.stages[-1]
                self.stages[-1] = (label, max(peak, resident()))

    def begin(self, label: str) -> None:
        """Start a stage."""
        self.stages.append((label, resident()))

    def end(self) -> None:
        """Stop recording."""
        self._stop.set()


CASES = (
    # Vary samples of a chunk, pixels, images and texels.
    "cornell-box 64x64 64 8",
    "cornell-box 256x256 512 8",
    "cornell-box 1280x720 8 8",
    "cornell-box 1280x720 32 32",
    "cornell-box 2560x1440 2 2",
    "office 320x180 64 8",
    "office 1280x720 8 8",
    "wall-1024 64x64 64 8",
    "wall-4096 64x64 64 8",
)


def scene_of(name: str) -> Any:
    """Return a scene by name; ``wall-4096`` is a wall with a texture of 4096×4096 texels."""
    if not name.startswith("wall-"):
        return name
    mi = activate()
    side = int(name.removeprefix("wall-"))
    texture = {
        "type": "bitmap",
        "raw": True,
        "format": "variant",
        "data": mi.TensorXf(np.full((side, side, 3), 0.5, np.float32)),
    }
    pose = mi.ScalarTransform4f().look_at(origin=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0))
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "to_world": pose, "film": {"type": "hdrfilm"}},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "lamp": {"type": "point", "position": (0, 0, 2), "intensity": 5.0},
    }


def attribute(case: str) -> None:
    """Attribute once, and print the predicted and the measured memory."""
    scene, size, spp, replicates = case.split()
    width, _, height = size.partition("x")
    renderer = SceneRenderer(scene_of(scene), "all", resolution=(int(width), int(height)))
    predicted = renderer.memory(spp=int(spp) // int(replicates), pictures=int(replicates))
    # Reset the peak.
    Path("/proc/self/clear_refs").write_text("5")
    before = resident()
    VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(
        spp=int(spp), replicates=int(replicates)
    )
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    measured = 1024 * int(status["VmHWM"].split()[0]) - before
    print(
        f"{case:32s} predicted {predicted / MEBIBYTE:6.0f} MiB  measured {measured / MEBIBYTE:6.0f} MiB  "
        f"{predicted / measured:5.2f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="cornell-box")
    parser.add_argument("--chunks", type=int, default=4)
    parser.add_argument(
        "--predict", nargs="*", metavar="CASE", help="scene, size, spp and replicates in quotes"
    )
    arguments = parser.parse_args()
    if arguments.predict is not None:
        for case in arguments.predict or CASES:
            process = spawn.Process(target=attribute, args=(case,))
            process.start()
            process.join()
        return
    renderer = SceneRenderer(arguments.scene, "materials", resolution=RESOLUTION)
    spp = arguments.chunks * (_chunks.MAX_SAMPLES // (RESOLUTION[0] * RESOLUTION[1]))
    peaks = Peaks()
    peaks.begin("loaded")
    from scenecaptum.rendering import _engine

    split, stage = _engine.chunks, "render"

    def recorded(*arguments: Any) -> Iterator[_chunks.Chunk]:
        for index, chunk in enumerate(split(*arguments)):
            peaks.begin(f"{stage}, chunk {index + 1} of {chunk.spp} spp")
            yield chunk

    _engine.chunks = recorded
    leaves = renderer.leaves()
    metric = metrics.MeanLuminance()(renderer(leaves, seed=0, seed_grad=1, spp=spp))
    peaks.begin("noise map")
    stage = "backward"
    metric.backward()
    peaks.end()
    for label, peak in peaks.stages:
        print(f"{label:32s} {peak / MEBIBYTE:6.0f} MiB")


if __name__ == "__main__":
    main()
