"""Lamps of IES files against ies2rad and rtrace, which the Python package pyradiance bundles."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from luminaires import VERTICAL, write_asymmetric, write_ies
from seeds import shifted

from scenecaptum.scene import read_ies

EFFICACY = 179.0
# Points around the lamp, which hangs at the origin, and the normals of the planes that it illuminates.
POINTS = [
    (1, 0.5, -2),
    (0.1, 0, -2),
    (-1, 2, -2),
    (0, -2, -1),
    (-1.5, -0.4, -1),
    (0.5, 1, 1.5),
    (2, -1, -0.3),
]


@pytest.fixture(scope="session")
def radiance() -> Path:
    pyradiance = pytest.importorskip(
        "pyradiance", reason="ies2rad is not here: pip install 'scenecaptum[test]' brings pyradiance==1.3.1"
    )
    return Path(pyradiance.__path__[0])


def traced(radiance: Path, file: Path) -> np.ndarray:
    """Return the illuminances at the points of a lamp that ies2rad made into a small sphere."""
    library = os.pathsep.join([str(file.parent), str(radiance / "lib")])
    environment = {**os.environ, "RAYPATH": library}

    def run(program: str, *options: str, given: bytes = b"") -> bytes:
        command = [radiance / "bin" / program, *options]
        settings = {"cwd": file.parent, "env": environment, "timeout": 120}
        return subprocess.run(command, input=given, capture_output=True, check=True, **settings).stdout

    run("ies2rad", "-dm", "-t", "white", "-i", "0.001", "-o", "lamp", file.name)
    (file.parent / "lamp.oct").write_bytes(run("oconv", "lamp.rad"))
    rays = "\n".join(f"{x} {y} {z} 0 0 {1 if z < 0 else -1}" for x, y, z in POINTS)
    options = ["-h", "-I", "-ab", "0", "-dt", "0", "-dc", "1", "-dj", "0", "-ds", "0"]
    rows = run("rtrace", *options, "lamp.oct", given=rays.encode()).split()
    irradiance = np.array(rows, dtype=float).reshape(-1, 3)
    return EFFICACY * irradiance @ [0.265, 0.670, 0.065]  # luminance of Radiance's own primaries


@pytest.mark.parametrize("kind", ["asymmetric", "halves", "quadrants", "rotation", "factors"])
def test_illuminances_are_those_of_radiance(radiance, kind, tmp_path):
    rng, path = np.random.default_rng(shifted(1)), tmp_path / "lamp.ies"
    if kind == "asymmetric":
        write_asymmetric(path, shifted(1))
    else:
        planes = {"halves": [0, 60, 180], "quadrants": [0, 30, 90], "rotation": [0], "factors": [0]}[kind]
        candela = rng.uniform(100, 1000, (len(planes), len(VERTICAL)))
        factors = {"multiplier": 1.7, "ballast": 0.85} if kind == "factors" else {}
        write_ies(path, VERTICAL, planes, candela, **factors)
    np.testing.assert_allclose(computed(path), traced(radiance, path), rtol=1e-3)


def test_planes_from_90_to_270_are_those_of_radiance_for_the_full_turn(radiance, tmp_path):
    """Of the file with half of the planes itself, ies2rad puts the plane C = 90 to −y: mirrored."""
    half = np.random.default_rng(shifted(2)).uniform(100, 1000, (5, len(VERTICAL)))
    across = write_ies(tmp_path / "across.ies", VERTICAL, [90, 120, 180, 200, 270], half)
    turn = [0, 60, 90, 120, 180, 200, 270, 340, 360]
    planes = half[[2, 1, 0, 1, 2, 3, 4, 3, 2]]  # C and 180 − C are the same
    full = write_ies(tmp_path / "full.ies", VERTICAL, turn, planes)
    np.testing.assert_allclose(computed(across), computed(full), rtol=1e-9)
    np.testing.assert_allclose(computed(across), traced(radiance, full), rtol=1e-3)


def computed(path: Path) -> np.ndarray:
    """Return the illuminances at the points by I(γ, C) cos θ / d²."""
    rays = torch.tensor(POINTS, dtype=torch.float64)
    illuminances = read_ies(path).candela(rays) * rays[:, 2].abs() / rays.norm(dim=-1) ** 3
    return illuminances.numpy()
