"""Writes images for evalglare, runs it, and parses its output."""

from __future__ import annotations

import math
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from scenecaptum import Camera

EFFICACY = 179.0


@dataclass(frozen=True)
class Report:
    """The output of ``evalglare -d``: the ratings by name, and one row of numbers per source."""

    ratings: dict[str, float]
    sources: list[list[float]]


def view_line(camera: Camera) -> str:
    if camera.projection == "fisheye":
        return f"-vta -vh {camera.fov:g} -vv {camera.fov:g}"
    vertical = 2 * math.atan(math.tan(math.radians(camera.fov) / 2) * camera.height / camera.width)
    return f"-vtv -vh {camera.fov:.9g} -vv {math.degrees(vertical):.9g}"


# Rec. 709 and Radiance's own RGB, both with white at a luminance of 1, from primaries and white points.
def _to_xyz(primaries: list[tuple[float, float]], white: tuple[float, float]) -> np.ndarray:
    columns = np.array([(x / y, 1, (1 - x - y) / y) for x, y in primaries]).T
    return columns * np.linalg.solve(columns, [white[0] / white[1], 1, (1 - white[0] - white[1]) / white[1]])


REC709 = _to_xyz([(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)], (0.3127, 0.3290))
RADIANCE = _to_xyz([(0.640, 0.330), (0.290, 0.600), (0.150, 0.060)], (1 / 3, 1 / 3))


def write_picture(path: Path, luminance: np.ndarray, view: str) -> torch.Tensor:
    """Write a grey image in cd/m² as RGBE, and return it as evalglare decodes it: ``(H, W, 3)`` radiance."""
    return torch.from_numpy(_write(path, np.repeat(luminance[..., None] / EFFICACY, 3, -1), view))


def write_coloured(path: Path, radiance: np.ndarray, view: str) -> torch.Tensor:
    """Write Rec. 709 radiance as RGBE of Radiance's primaries; return it as evalglare decodes it, in Rec. 709."""
    converted = radiance @ (np.linalg.solve(RADIANCE, REC709)).T
    assert converted.min() >= 0, "the colour lies outside Radiance's gamut"
    return torch.from_numpy(_write(path, converted, view) @ (np.linalg.solve(REC709, RADIANCE)).T)


def _write(path: Path, radiance: np.ndarray, view: str) -> np.ndarray:
    _, exponent = np.frexp(radiance.max(-1, keepdims=True))
    byte = np.floor(np.ldexp(radiance, 8 - exponent)).clip(0, 255).astype(np.uint8)
    lit = radiance.max(-1, keepdims=True) > 1e-32
    pixels = np.concatenate([byte, (exponent + 128).astype(np.uint8)], -1) * lit
    height, width, _ = radiance.shape
    header = f"#?RADIANCE\nVIEW= {view}\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    path.write_bytes(header.encode() + pixels.astype(np.uint8).tobytes())
    return np.where(lit, np.ldexp((byte + 0.5) / 256, exponent), 0.0)


def run_evalglare(program: Path, picture: Path, *options: str) -> Report:
    done = subprocess.run(
        [program, "-d", *options, picture], capture_output=True, text=True, check=False, timeout=120
    )
    lines = done.stdout.splitlines()
    start = next(i for i, line in enumerate(lines) if "No pixels" in line)
    count = int(lines[start].split()[0])
    sources = [[float(word) for word in line.split()] for line in lines[start + 1 : start + 1 + count]]
    names, numbers = next(line for line in lines if line.startswith("dgp,")).split(": ")
    return Report(dict(zip(names.split(","), map(float, numbers.split()), strict=True)), sources)
