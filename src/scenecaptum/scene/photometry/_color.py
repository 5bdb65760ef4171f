"""The color of a lamp, with a luminance of 1, so that its lumens do not depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real

import numpy as np
import numpy.typing as npt

from ...backend import activate
from ...errors import SceneCaptumError
from ...images import LUMINANCE_WEIGHTS

KELVIN = (1000.0, 40_000.0)
SECOND_RADIATION_CONSTANT = 1.438776877e7  # nm K


def white_of(color: Sequence[float] | float) -> list[float]:
    """Return linear Rec. 709 RGB of luminance 1, of a color of any scale or a temperature in kelvin.

    Example
    -------
    >>> [round(x, 3) for x in white_of([2, 2, 2])]
    [1.0, 1.0, 1.0]
    >>> red, _, blue = white_of(2700)
    >>> red > 1 > blue
    True
    """
    rgb = black_body(float(color)) if isinstance(color, Real) else np.array(_three(color))
    scaled: list[float] = (rgb / (rgb @ np.array(LUMINANCE_WEIGHTS))).tolist()
    return scaled


def _three(color: object) -> list[float]:
    try:
        rgb = [float(x) for x in color]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        rgb = []
    if len(rgb) != 3 or not np.isfinite(rgb).all() or min(rgb) < 0 or not any(rgb):
        raise SceneCaptumError(
            f"color must be three numbers of at least 0, not all 0, or a temperature in kelvin, not {color!r}."
        )
    return rgb


def black_body(kelvin: float) -> npt.NDArray[np.float64]:
    """Return the color of a black body as linear RGB (Planck's law, CIE 1931 observer), of any scale.

    Below 1900 K, blue is 0: these colors are outside of what Rec. 709 can show.
    """
    if not KELVIN[0] <= kelvin <= KELVIN[1]:
        raise SceneCaptumError(f"color must be RGB, or a temperature of 1000 to 40000 K, not {kelvin:g}.")
    mi = activate()
    nanometres = np.arange(360.0, 831.0, 5.0)
    power = nanometres**-5 / np.expm1(SECOND_RADIATION_CONSTANT / (nanometres * kelvin))
    observer = np.array(mi.cie1931_xyz(mi.Float(nanometres)), dtype=np.float64)
    xyz = observer @ (power / power.max())
    rgb = np.array(mi.xyz_to_srgb(mi.Color3f(*xyz.tolist())), dtype=np.float64).reshape(3)
    return np.maximum(rgb, 0.0)
