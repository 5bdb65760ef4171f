"""Daylight factors and daylight coefficients of a side-lit room against Radiance's rtrace and rcontrib."""

from __future__ import annotations

import math
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from seeds import seeds
from side_lit import at, side_lit_room

from scenecaptum import SceneRenderer
from scenecaptum.daylight import DaylightFactor, SkyMatrix, SkyPatches, illuminance, synthetic_weather

# 24 points of the work plane, in four rows from the window, in the south, to the back.
POINTS = [(x, y, 0.8) for y in (-1.1, -0.4, 0.4, 1.1) for x in (-1.6, -1.0, -0.3, 0.3, 1.0, 1.6)]
DEPTH = 12
REPEATS = 8  # of Radiance's runs, which give their standard errors
AMBIENT = ("-ab", str(DEPTH - 1), "-lw", "1e-5", "-lr", "-14")
PATCHES = SkyPatches.tregenza()


class Radiance:
    """Radiance's programs on a room of grey rectangles in a folder."""

    def __init__(self, package: Path, folder: Path) -> None:
        self.package, self.folder = package, folder

    def run(self, program: str, *options: str, given: str = "") -> str:
        library = os.pathsep.join([str(self.folder), str(self.package / "lib")])
        found = subprocess.run(
            [self.package / "bin" / program, *options],
            input=given.encode(),
            capture_output=True,
            check=True,
            cwd=self.folder,
            env={**os.environ, "RAYPATH": library},
            timeout=300,
        )
        return found.stdout.decode(errors="replace")

    def octree(self, name: str, text: str) -> str:
        (self.folder / f"{name}.rad").write_text(text)
        path = self.folder / f"{name}.oct"
        program = [self.package / "bin" / "oconv", f"{name}.rad"]
        path.write_bytes(subprocess.run(program, capture_output=True, check=True, cwd=self.folder).stdout)
        return path.name

    def at_points(self, program: str, *options: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the standard error of what a program computes at each point, for each output."""
        rays = REPEATS * "".join(f"{x} {y} {z} 0 0 1\n" for x, y, z in POINTS)
        numbers = np.array(self.run(program, "-h", *options, given=rays).split(), dtype=float)
        runs = numbers.reshape(REPEATS, len(POINTS), -1, 3)[..., 0]
        return runs.mean(0), runs.std(0, ddof=1) / math.sqrt(REPEATS)


@pytest.fixture(scope="module")
def radiance(tmp_path_factory: pytest.TempPathFactory) -> Radiance:
    package = pytest.importorskip(
        "pyradiance", reason="Radiance is not here: pip install 'scenecaptum[test]' brings pyradiance==1.3.1"
    )
    return Radiance(Path(package.__path__[0]), tmp_path_factory.mktemp("radiance"))


def surfaces(scene: dict[str, Any]) -> str:
    """Return the rectangles of a scene as Radiance's polygons of a grey plastic."""
    lines = []
    for name, part in scene.items():
        if not isinstance(part, dict) or part.get("type") != "rectangle":
            continue
        grey = part["bsdf"]["reflectance"]["value"]
        matrix = np.array(part["to_world"].matrix)
        corners = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]]) @ matrix.T
        numbers = " ".join(f"{x:.9g}" for x in corners[:, :3].ravel())
        lines.append(f"void plastic m_{name}\n0\n0\n5 {grey} {grey} {grey} 0 0\n")
        lines.append(f"m_{name} polygon {name}\n0\n0\n12 {numbers}\n")
    return "\n".join(lines)


OVERCAST = """
void brightfunc overcast
2 overcast cie.cal
0
0
overcast glow sky_glow
0
0
4 1 1 1 0
sky_glow source sky
0
0
4 0 0 1 180
"""
# The CIE standard overcast sky with a zenith radiance of 1 and black ground.
CIE = "overcast = if(Dz, (1 + 2 * Dz) / 3, 0);\n"
OUTDOORS = 7 * math.pi / 9


def test_daylight_factors_are_those_of_radiance(mi: Any, radiance: Radiance) -> None:
    """At 24 points within 2 % and 3 errors; on average over them within 1 %."""
    scene = side_lit_room()
    (radiance.folder / "cie.cal").write_text(CIE)
    octree = radiance.octree("overcast", surfaces(scene) + OVERCAST)
    expected, noise = (
        100 / OUTDOORS * part[:, 0]
        for part in radiance.at_points(
            "rtrace", "-I", *AMBIENT, "-aa", "0", "-ad", "2048", "-as", "0", octree
        )
    )
    assert (noise < 0.02 * expected).all(), "rtrace has not converged"

    sky = SkyMatrix.cie_overcast(SkyPatches.reinhart(4), ground_reflectance=0.0)
    renderer = SceneRenderer(
        scene, "reflectance", sensor=at(*POINTS), sky_patches=sky.patches, spp=8, max_depth=DEPTH
    )
    runs = torch.stack([DaylightFactor(sky).of_points(renderer(seed=seed)).double() for seed in seeds(12)])
    found, error = runs.mean(0).numpy(), (runs.std(0) / math.sqrt(12)).numpy()
    off = found - expected
    assert (np.abs(off) < 0.02 * expected + 3 * np.hypot(error, noise)).all(), (found, expected, error, noise)
    assert abs(np.mean(off / expected)) < 0.01


SKY = """
void glow sky_glow
0
0
4 1 1 1 0
sky_glow source sky
0
0
4 0 0 1 180
sky_glow source ground
0
0
4 0 0 -1 180
"""


@pytest.fixture(scope="module")
def by_radiance(radiance: Radiance) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the daylight coefficients of rcontrib, ``(points, patches)``, and their standard errors."""
    octree = radiance.octree("uniform", surfaces(side_lit_room()) + SKY)
    bins = ("-e", "MF:1", "-f", "reinhart.cal", "-b", "rbin", "-bn", "Nrbins", "-m", "sky_glow")
    mean, error = radiance.at_points("rcontrib", "-I+", *AMBIENT, "-ad", "2048", *bins, octree)
    return torch.from_numpy(mean), torch.from_numpy(error)


@pytest.fixture(scope="module")
def ours(mi: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Return our daylight coefficients, ``(points, patches)``, and their standard errors."""
    renderer = SceneRenderer(
        side_lit_room(), "reflectance", sensor=at(*POINTS), sky_patches=PATCHES, spp=64, max_depth=DEPTH
    )
    runs = torch.stack([renderer(seed=seed)[..., 0].double() for seed in seeds(12)])
    return runs.mean(0), runs.std(0) / math.sqrt(12)


def test_coefficients_are_those_of_radiance(
    by_radiance: tuple[torch.Tensor, torch.Tensor], ours: tuple[torch.Tensor, torch.Tensor]
) -> None:
    """Those of each patch, and in total for each point and each patch."""
    (expected, noise), (found, error) = by_radiance, ours
    total_error = error.hypot(noise)
    well_known = expected > 4 * total_error
    assert well_known.float().mean() > 0.2
    z = ((found - expected) / total_error)[well_known]
    # Of Student's t with about 15 degrees of freedom, 15/13.
    assert abs(z.square().mean() - 1.15) < 0.4
    assert abs(z.mean()) < 0.1
    for axis in (0, 1):
        off, own = (found - expected).sum(axis), total_error.square().sum(axis).sqrt()
        assert (off.abs() <= 0.02 * expected.sum(axis) + 4 * own).all()
    assert abs(found.sum() / expected.sum() - 1) < 0.01


def test_a_year_is_that_of_radiance(
    by_radiance: tuple[torch.Tensor, torch.Tensor], ours: tuple[torch.Tensor, torch.Tensor]
) -> None:
    """Every hour, on average over the points of a row, within 3 % of the mean of the year."""
    sky = SkyMatrix.from_weather(synthetic_weather(), PATCHES)
    mine, theirs = (
        illuminance(table[..., None].expand(-1, -1, 3), sky).unflatten(0, (4, 6)).mean(1)
        for table in (ours[0], by_radiance[0])
    )
    mean = theirs.mean(1)
    assert ((mine - theirs).abs().mean(1) < 0.03 * mean).all()
