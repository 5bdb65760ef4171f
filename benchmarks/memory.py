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
import math
import multiprocessing
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.rendering import _chunks

RESOLUTION = (1280, 720)
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = sorted(path.parent.name for path in SCENES.glob("*/scene.xml"))
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
    "balls-800 160x90 16 8",
    *(f"{room} 160x90 {spp} 8" for room in ROOMS for spp in (16, 64)),
)


def texture_of(side: int) -> dict[str, Any]:
    """Return a grey texture of ``side``×``side`` texels."""
    texels = np.full((side, side, 3), 0.5, np.float32)
    return {"type": "bitmap", "raw": True, "format": "variant", "data": activate().TensorXf(texels)}


def balls(count: int, materials: int = 200) -> dict[str, Any]:
    """Return a cube of balls; every fifth material has a texture of 512×512 texels."""
    mi = activate()
    kinds = (
        lambda: {"type": "diffuse", "reflectance": texture_of(512)},
        lambda: {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}},
        lambda: {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.6, 0.2]}},
        lambda: {"type": "roughconductor", "alpha": 0.3},
        lambda: {"type": "roughplastic", "alpha": 0.3},
    )
    side = math.ceil(count ** (1 / 3))
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=(0, 0, 3 * side), target=(0, 0, 0), up=(0, 1, 0)
            ),
            "film": {"type": "hdrfilm"},
        },
        "sky": {"type": "constant"},
    }
    for index in range(materials):
        scene[f"material-{index}"] = {"id": f"material-{index}", **kinds[index % len(kinds)]()}
    for index in range(count):
        center = [2.2 * (c - side / 2) for c in (index % side, index // side % side, index // side**2)]
        material = {"type": "ref", "id": f"material-{index % materials}"}
        scene[f"ball-{index}"] = {"type": "sphere", "center": center, "material": material}
    return scene


def scene_of(name: str) -> Any:
    """Return a scene by name.

    ``wall-4096`` is a wall with a texture of 4096×4096 texels, ``balls-800`` has 800 shapes and 200 materials.
    """
    if (SCENES / name / "scene.xml").exists():
        return SCENES / name / "scene.xml"
    if name.startswith("balls-"):
        return balls(int(name.removeprefix("balls-")))
    if not name.startswith("wall-"):
        return name
    mi = activate()
    texture = texture_of(int(name.removeprefix("wall-")))
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
        f"{case:32s} {len(renderer.inputs):3d} inputs  predicted {predicted / MEBIBYTE:6.0f} MiB  "
        f"measured {measured / MEBIBYTE:6.0f} MiB  {predicted / measured:5.2f}",
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
