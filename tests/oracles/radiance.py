"""Writes pictures that the real evalglare reads, runs it, and reads what it prints."""

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
    """What ``evalglare -d`` printed: the ratings by name, and one row of numbers per source."""

    ratings: dict[str, float]
    sources: list[list[float]]


def view_line(camera: Camera) -> str:
    if camera.projection == "fisheye":
        return f"-vta -vh {camera.fov:g} -vv {camera.fov:g}"
    vertical = 2 * math.atan(math.tan(math.radians(camera.fov) / 2) * camera.height / camera.width)
    return f"-vtv -vh {camera.fov:.9g} -vv {math.degrees(vertical):.9g}"


def write_picture(path: Path, luminance: np.ndarray, view: str) -> torch.Tensor:
    """Write a grey picture in cd/m² as RGBE, and return it as evalglare decodes it: ``(H, W, 3)`` radiance."""
    mantissa, exponent = np.frexp(luminance / EFFICACY)
    byte = np.floor(mantissa * 256).clip(0, 255).astype(np.uint8)
    lit = luminance > 1e-30
    pixels = np.stack([byte, byte, byte, (exponent + 128).astype(np.uint8)], -1) * lit[..., None]
    height, width = luminance.shape
    header = f"#?RADIANCE\nVIEW= {view}\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    path.write_bytes(header.encode() + pixels.astype(np.uint8).tobytes())
    decoded = np.where(lit, np.ldexp((byte + 0.5) / 256, exponent), 0.0)
    return torch.from_numpy(decoded)[..., None].expand(-1, -1, 3).contiguous()


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
