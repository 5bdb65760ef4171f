"""The derivative with respect to a low roughness, before and after a change: the grid of ``variance.py --lobes``.

Five materials with five roughnesses in two scenes: a ball on a floor under a lamp and a constant sky, and the tall
box of the Cornell box, whose light is mostly indirect. Both versions of the package run in processes of their own,
which take turns, and propagate the same adjoint, that of the mean luminance, with the same samples per pixel.
"""

from __future__ import annotations

import io
import json
import math
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch

RESOLUTION, DEPTH = (64, 36), 6
ROUGHNESSES = (0.02, 0.05, 0.1, 0.2, 0.5)
SPP = 16
TURNS = 2
WARM_UPS = 2
STEP = 0.05  # of the finite difference, relative
DIFFERENCE_SEEDS, DIFFERENCE_SPP = 16, 64
ROOT = Path(__file__).parents[1]
HEADINGS = ("scene", "material", "α", "gain [95 %]", "variance", "time", "z, before", "z, difference")

Bootstrap = Callable[[torch.Tensor, torch.Tensor], tuple[float, float, float]]


@dataclass(frozen=True)
class Material:
    """A material at a roughness α, and its parameters with their values."""

    bsdf: dict[str, Any]
    values: dict[str, float]


def materials(alpha: float) -> dict[str, Material]:
    """Return every material of the grid; ``principled`` squares its roughness."""
    ggx: dict[str, Any] = {"distribution": "ggx"}
    metal = {"type": "roughconductor", "material": "Al"} | ggx
    both = {"alpha_u": alpha, "alpha_v": alpha / 2}
    alone = {"alpha": alpha}
    base = {"type": "principled", "base_color": {"type": "rgb", "value": 0.6}, "metallic": 0.5}
    return {
        "metal": Material(metal | alone, alone),
        "anisotropic metal": Material(metal | both, both),
        "glass": Material({"type": "roughdielectric"} | ggx | alone, alone),
        "plastic": Material({"type": "roughplastic", "diffuse_reflectance": 0.3} | ggx | alone, alone),
        "principled": Material(
            base | {"specular": 0.5, "roughness": math.sqrt(alpha)}, {"roughness": math.sqrt(alpha)}
        ),
    }


def ball(bsdf: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Return a ball on a floor under a lamp and a sky, and the prefix of the ball's parameters."""
    from scenecaptum import activate

    transform = activate().ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
    lamp_at = transform().look_at([2, -2, 4], [0, 0, 0.5], [0, 0, 1]) @ transform().scale(0.5)
    film = {"type": "hdrfilm", "width": RESOLUTION[0], "height": RESOLUTION[1], "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": DEPTH},
        "sensor": {
            "type": "perspective",
            "fov": 45,
            "to_world": transform().look_at([0, -6, 2.5], [0, 0, 0.6], [0, 0, 1]),
            "film": film,
        },
        "floor": {"type": "rectangle", "to_world": transform().scale(4), "bsdf": grey},
        "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 1, "bsdf": bsdf},
        "lamp": {
            "type": "rectangle",
            "to_world": lamp_at,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 10.0}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
    }
    return scene, "ball.bsdf."


def box(bsdf: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the Cornell box with a material for its tall box, and the prefix of that box's parameters."""
    from scenecaptum import activate
    from scenecaptum.scene.bundled import BUNDLED

    activate()
    scene = BUNDLED["cornell-box"]()
    scene["tall_box"] = bsdf
    scene["sensor"]["film"] |= dict(zip(("width", "height"), RESOLUTION, strict=True))
    return scene, "tall_box."


SCENES = {"ball": ball, "Cornell box": box}


def cells(pattern: str) -> Iterator[tuple[str, str, float]]:
    """Return scene, material and α of the cells whose ``scene/material/α`` matches a glob."""
    for scene in SCENES:
        for material in materials(1):
            for alpha in ROUGHNESSES:
                if fnmatch(f"{scene}/{material}/{alpha}", pattern):
                    yield scene, material, alpha


# ------------------------------------------------------------------------------------------------- one version


def _renderer(scene: str, material: str, alpha: float) -> Any:
    from scenecaptum import SceneRenderer

    chosen = materials(alpha)[material]
    built, prefix = SCENES[scene](chosen.bsdf)
    names = [f"{prefix}{name}*" for name in chosen.values]
    return SceneRenderer(built, names, resolution=RESOLUTION, max_depth=DEPTH)


def _adjoint() -> torch.Tensor:
    width, height = RESOLUTION
    return torch.tensor([0.2126, 0.7152, 0.0722]).expand(height, width, 3) / (width * height)


def gradients(cell: tuple[str, str, float], seeds: range) -> Iterator[tuple[list[float], float]]:
    """Return a gradient and the seconds of its backward pass for each seed."""
    renderer = _renderer(*cell)
    for number, seed in enumerate([1] * WARM_UPS + list(seeds)):
        leaves = {name: value.clone().requires_grad_() for name, value in renderer.inputs.items()}
        image = renderer(leaves, seed=2 * seed + 1, seed_grad=2 * seed, spp=SPP)
        start = time.perf_counter()
        image.backward(_adjoint())
        elapsed = time.perf_counter() - start
        if number >= WARM_UPS:
            yield [float(leaf.grad) for leaf in leaves.values()], elapsed


def differences(cell: tuple[str, str, float], seeds: range) -> Iterator[tuple[list[float], float]]:
    """Return a central difference with common random numbers for each seed, and 0 seconds."""
    renderer = _renderer(*cell)
    for seed in seeds:
        quotients = []
        for name, value in renderer.inputs.items():
            shift = STEP * value
            with torch.no_grad():
                up, down = (
                    renderer(renderer.inputs | {name: value + sign * shift}, seed=seed, spp=DIFFERENCE_SPP)
                    for sign in (1, -1)
                )
            quotients.append(float(((up - down).double() * _adjoint()).sum() / (2 * shift)))
        yield quotients, 0.0


def work(task: str, pattern: str, first: int, last: int) -> None:
    """Print a line of JSON for each cell: the numbers of each seed, and the median time."""
    measure = {"gradients": gradients, "differences": differences}[task]
    for cell in cells(pattern):
        values, seconds = zip(*measure(cell, range(first, last)), strict=True)
        print(json.dumps([cell, values, seconds]), flush=True)


# ------------------------------------------------------------------------------------------------- both versions


def _run(source: Path, task: str, pattern: str, seeds: range) -> Iterator[tuple[Any, Any, Any]]:
    command = [sys.executable, __file__, task, pattern, str(seeds.start), str(seeds.stop)]
    environment = os.environ | {"PYTHONPATH": str(source)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            cell, values, seconds = json.loads(line)
            yield tuple(cell), values, seconds
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} failed")


def compare(revision: str, pattern: str, repeats: int, bootstrap: Bootstrap) -> list[tuple[str, ...]]:
    """Print and return a row per cell: the present sources against those of a git revision."""
    archive = subprocess.run(["git", "archive", revision, "src"], cwd=ROOT, capture_output=True, check=True)
    samples: dict[Any, list[list[float]]] = defaultdict(list)
    seconds: dict[Any, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
            tar.extractall(folder, filter="data")
        sides = {"before": Path(folder, "src"), "now": ROOT / "src"}
        for turn in range(TURNS):
            seeds = range(10 + turn * repeats // TURNS, 10 + (turn + 1) * repeats // TURNS)
            for side, source in sides.items():
                for cell, values, times in _run(source, "gradients", pattern, seeds):
                    samples[cell, side] += values
                    seconds[cell, side] += times
        for cell, values, _ in _run(
            sides["now"], "differences", pattern, range(10**6, 10**6 + DIFFERENCE_SEEDS)
        ):
            samples[cell, "difference"] += values
    rows = [_row(cell, samples, seconds, bootstrap) for cell in cells(pattern)]
    for row in (HEADINGS, *rows):
        print(" | ".join(row))
    return rows


def _row(cell: tuple[str, str, float], samples: Any, seconds: Any, bootstrap: Bootstrap) -> tuple[str, ...]:
    before, now, difference = (
        torch.tensor(samples[cell, side], dtype=torch.float64) for side in ("before", "now", "difference")
    )
    low, middle, high = bootstrap(before, now)
    ratio = statistics.median(seconds[cell, "before"]) / statistics.median(seconds[cell, "now"])
    scene, material, alpha = cell
    return (
        scene,
        material,
        f"{alpha}",
        f"{middle * ratio:.2f} [{low * ratio:.2f}, {high * ratio:.2f}]",
        f"{middle:.2f}",
        f"{ratio:.2f}",
        *(f"{_largest_z(now, other):.1f}" for other in (before, difference)),
    )


def _largest_z(first: torch.Tensor, second: torch.Tensor) -> float:
    error = (first.var(0) / len(first) + second.var(0) / len(second)).sqrt()
    return float(((first.mean(0) - second.mean(0)) / error).abs().max())


if __name__ == "__main__":
    work(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
