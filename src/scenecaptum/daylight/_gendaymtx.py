"""Runs Radiance's gendaymtx, which the Python package pyradiance bundles."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Literal

import torch

from ..errors import SceneCaptumError
from ._checks import choice
from ._patches import SkyPatches
from ._radiance_matrix import parse_matrix
from ._weather import Weather

Sun = Literal["patches", "none", "only"]

_SUN_OPTIONS: dict[str, list[str]] = {"patches": [], "none": ["-s"], "only": ["-d"]}


def run_gendaymtx(weather: Weather, patches: SkyPatches, sun: Sun, north: float = 0.0) -> torch.Tensor:
    """Return the radiance of each patch in each hour by the sky model of Perez, ``(P, hours, 3)`` float32.

    The sky is grey (``-c 1 1 1``), so that the three channels are equal and no choice of primaries matters. The
    values are photometric (``-O0``): the luminance in cd/m² divided by 179 lm/W. ``north`` is the bearing of the
    scene's y axis, in degrees clockwise from north.
    """
    options = _SUN_OPTIONS[choice("sun", sun, tuple(_SUN_OPTIONS))]
    command = [
        _program(),
        "-m",
        str(patches.subdivision),
        "-O0",
        "-of",
        "-c",
        "1",
        "1",
        "1",
        "-r",
        f"{north:g}",
    ]
    done = subprocess.run(
        [*command, *options], input=weather.to_wea().encode(), capture_output=True, check=False
    )
    said = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
    if done.returncode != 0:
        raise SceneCaptumError(
            f"gendaymtx failed on the weather of {weather.place}: {said[-1] if said else 'no message'}."
        )
    if said:
        warnings.warn(f"{len(said)} messages of gendaymtx, the first: {said[0]}", stacklevel=3)
    return parse_matrix(done.stdout, "the output of gendaymtx")


def _program() -> str:
    found = importlib.util.find_spec("pyradiance")
    if found is None or found.origin is None:
        raise SceneCaptumError(
            "A sky matrix from weather needs Radiance's gendaymtx: pip install 'scenecaptum[daylight]'."
        )
    program = shutil.which("gendaymtx", path=Path(found.origin).parent / "bin")
    if program is None:
        raise SceneCaptumError(
            "pyradiance is installed without its program gendaymtx: pip install --force-reinstall "
            "'scenecaptum[daylight]'."
        )
    return program
