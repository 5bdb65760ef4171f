"""Time a year of daylight: spatial daylight autonomy at 100 points, attributed to 30 materials.

A side-lit room of 8 × 10 × 3 metres whose surfaces are 30 panels, each with a reflectance of its own. Prints the
relaxed sDA with its standard error, the spread of runs with other seeds, the time of an attribution and the peak
memory; then the time that Radiance's rcontrib and dctimestep take for the number alone, at rising numbers of
samples, with the spread of the number. Without pyradiance the second part is left out, and the sky is overcast.

    python benchmarks/daylight.py [--seeds 5] [--spp 16] [--threads 2]
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenecaptum import SceneRenderer, SensorGrid, VanillaSceneGradient, activate
from scenecaptum.daylight import SkyMatrix, SkyPatches, SpatialDaylightAutonomy, synthetic_weather

DEPTH = 8
SIZE = (8.0, 10.0, 3.0)
SILL, HEAD = 1.2, 2.0  # of the window band in the south wall
PATCHES = SkyPatches.tregenza()


def panels() -> dict[str, tuple[np.ndarray, float]]:
    """Return the corners ``(4, 3)`` and the reflectance of each panel; counterclockwise seen from the room."""
    x, y, z = SIZE
    found: dict[str, tuple[np.ndarray, float]] = {}

    def split(
        name: str,
        corner: tuple[float, ...],
        u: tuple[float, ...],
        v: tuple[float, ...],
        parts: int,
        rho: float,
    ) -> None:
        start, along, up = (np.array(vector) for vector in (corner, u, v))
        for k in range(parts):
            first, last = start + along * k / parts, start + along * (k + 1) / parts
            found[f"{name}_{k}"] = np.array([first, last, last + up, first + up]), rho

    split("floor", (0, 0, 0), (x, 0, 0), (0, y, 0), 6, 0.2)
    split("ceiling", (0, 0, z), (0, y, 0), (x, 0, 0), 6, 0.7)
    split("north", (0, y, 0), (x, 0, 0), (0, 0, z), 5, 0.5)
    split("west", (0, 0, 0), (0, y, 0), (0, 0, z), 4, 0.5)
    split("east", (x, y, 0), (0, -y, 0), (0, 0, z), 4, 0.5)
    split("south_low", (x, 0, 0), (-x, 0, 0), (0, 0, SILL), 3, 0.5)
    split("south_high", (x, 0, HEAD), (-x, 0, 0), (0, 0, z - HEAD), 2, 0.5)
    return found


def scene() -> dict[str, Any]:
    """Return the room as a Mitsuba scene."""
    place = activate().ScalarTransform4f
    parts: dict[str, Any] = {}
    for name, (corners, rho) in panels().items():
        middle = corners.mean(0)
        u, v = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
        n = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        matrix = np.eye(4)
        matrix[:3] = np.stack([u, v, n, middle], 1)
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": rho}}
        parts[name] = {"type": "rectangle", "to_world": place(matrix.tolist()), "bsdf": bsdf}
    x, y, _ = SIZE
    view = place().look_at(origin=[x / 2, y - 0.3, 1.5], target=[x / 2, 0, 1.5], up=[0, 0, 1])
    return {
        "type": "scene",
        "sky": {"type": "constant"},
        "camera": {"type": "perspective", "to_world": view},
        **parts,
    }


def grid() -> SensorGrid:
    """Return 10 × 10 points of the work plane."""
    x, y, _ = SIZE
    plan = [
        (0.5 + (x - 1) * (i + 0.5) / 10, 0.5 + (y - 1) * (j + 0.5) / 10, 0.8)
        for j in range(10)
        for i in range(10)
    ]
    points = torch.tensor(plan)
    return SensorGrid(points=points, normals=torch.tensor([[0.0, 0.0, 1.0]]).expand(len(plan), 3))


def ours(sky: SkyMatrix, options: argparse.Namespace) -> None:
    """Attribute sDA to the reflectances of all panels, with several seeds."""
    metric = SpatialDaylightAutonomy(sky)
    start = time.perf_counter()
    renderer = SceneRenderer(
        scene(), "reflectance", sensor=grid(), sky_patches=PATCHES, spp=options.spp, max_depth=DEPTH
    )
    method = VanillaSceneGradient(renderer, metric)
    method.attribute(seed=99)
    print(f"{len(renderer.inputs)} materials, loaded and compiled in {time.perf_counter() - start:.1f} s")
    values, errors, seconds, ranks = [], [], [], []
    for seed in range(options.seeds):
        start = time.perf_counter()
        found = method.attribute(seed=seed)
        seconds.append(time.perf_counter() - start)
        values.append(found.metric_value)
        errors.append(found.metric_standard_error or 0.0)
        ranks.append([row.name.partition(".")[0] for row in found.ranking(top=3)])
        print(
            f"  seed {seed}: sDA {values[-1]:.2f} ± {errors[-1]:.2f} % in {seconds[-1]:.1f} s; {ranks[-1]}",
            flush=True,
        )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"scenecaptum: relaxed sDA {np.mean(values):.2f} %, spread {np.std(values, ddof=1):.2f} of "
        f"{np.mean(errors):.2f} estimated, {np.median(seconds):.1f} s with all gradients, peak {memory:.2f} GiB"
    )


def by_radiance(sky: SkyMatrix, options: argparse.Namespace) -> None:
    """Compute sDA with rcontrib and dctimestep at rising numbers of ambient divisions."""
    spec = importlib.util.find_spec("pyradiance")
    assert spec is not None
    assert spec.origin is not None
    package, folder = Path(spec.origin).parent, Path(tempfile.mkdtemp())
    lines = []
    for name, (corners, rho) in panels().items():
        numbers = " ".join(f"{value:.9g}" for value in corners.ravel())
        lines.append(
            f"void plastic m_{name}\n0\n0\n5 {rho} {rho} {rho} 0 0\nm_{name} polygon {name}\n0\n0\n12 {numbers}\n"
        )
    lines.append("void glow sky_glow\n0\n0\n4 1 1 1 0\nsky_glow source sky\n0\n0\n4 0 0 1 180\n")
    lines.append("sky_glow source ground\n0\n0\n4 0 0 -1 180\n")
    (folder / "room.rad").write_text("\n".join(lines))
    environment = {**os.environ, "RAYPATH": str(package / "lib")}

    def run(program: str, *arguments: str, given: bytes = b"") -> bytes:
        command = [str(package / "bin" / program), *arguments]
        return subprocess.run(
            command, input=given, capture_output=True, check=True, cwd=folder, env=environment
        ).stdout

    (folder / "room.oct").write_bytes(run("oconv", "room.rad"))
    points = grid().points
    assert points is not None
    rays = "".join(f"{x} {y} {z} 0 0 1\n" for x, y, z in points.tolist()).encode()
    metric = SpatialDaylightAutonomy(sky)
    for divisions in (1024, 4096, 16384):
        values, seconds = [], []
        for repeat in range(options.seeds):
            start = time.perf_counter()
            # Other samples for each run: those of a ray depend on how many came before it.
            before = b"1 1 1 0 0 1\n" * repeat
            ambient = ["-ab", str(DEPTH - 1), "-ad", str(divisions), "-lw", f"{0.1 / divisions:g}"]
            bins = ["-e", "MF:1", "-f", "reinhart.cal", "-b", "rbin", "-bn", "Nrbins", "-m", "sky_glow"]
            text = run(
                "rcontrib",
                "-h",
                "-I+",
                "-n",
                str(options.threads),
                *ambient,
                *bins,
                "room.oct",
                given=before + rays,
            )
            table = np.array(text.split(), dtype=float).reshape(-1, PATCHES.count, 3)[repeat:]
            values.append(metric(torch.from_numpy(table).float()).item())
            seconds.append((time.perf_counter() - start) * len(points) / (len(points) + repeat))
        print(
            f"Radiance, -ad {divisions}: relaxed sDA {np.mean(values):.2f} %, spread "
            f"{np.std(values, ddof=1):.2f}, {np.median(seconds):.1f} s for the number alone",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    if importlib.util.find_spec("pyradiance") is None:
        print("pyradiance is not installed: an overcast sky, and no comparison")
        ours(SkyMatrix.cie_overcast(PATCHES), options)
        return
    sky = SkyMatrix.from_weather(synthetic_weather(), PATCHES)
    assert math.isfinite(sky.radiance.sum().item())
    ours(sky, options)
    by_radiance(sky, options)


if __name__ == "__main__":
    main()
