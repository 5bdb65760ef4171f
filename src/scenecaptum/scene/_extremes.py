"""What a renderer would show without complaint, and wrongly: impossible values, and sizes too small for rays."""

from __future__ import annotations

from typing import Any

import torch

from .._finite import place
from ..errors import SceneCaptumError
from ._bounds import Bounds

# Where a value outside its range means light or matter that cannot be. Elsewhere Mitsuba has conventions of its
# own (a principled roughness of 0).
_PHYSICAL = ("emitters", "media", "reflectance", "opacity", "ior")

# What decoding a file, or a sum that should be 1, may add.
_SLACK = 1e-3

# Mitsuba starts rays so far off a surface, times 1 + |p|: whatever the size of the scene.
_OFF = 1500 * 2.0**-24

# Of the size of a scene: more than 1 % of its light would be lost (benchmarks/extremes.py).
_MOST_OFF = 0.01


def fault_of(value: torch.Tensor, kind: str, bounds: Bounds) -> str | None:
    """Say what is wrong with a value that is not finite, or that is light or matter that cannot be; else None.

    Example
    -------
    >>> fault_of(torch.tensor([1.5, -0.0485, 1.5]), "ior", Bounds(0.0, open_low=True))
    'it holds -0.0485 at channel 1, outside the physical range (0, ∞) of its kind (ior)'
    """
    low, high = value.aminmax() if value.numel() else (value.new_zeros(()),) * 2
    if not (low.isfinite() and high.isfinite()):
        return _say(value, ~torch.isfinite(value), "which is not finite")
    if kind in _PHYSICAL and (low < bounds.low or high > bounds.high + _SLACK):
        outside = (value < bounds.low) | (value > bounds.high + _SLACK)
        return _say(value, outside, f"outside the physical range {bounds} of its kind ({kind})")
    return None


def _say(value: torch.Tensor, bad: torch.Tensor, why: str) -> str:
    where = f" at {place(bad)}" if bad.ndim else ""
    return f"it holds {value[bad][0].item():g}{where}, {why}"


def check_scale(scene: str, loaded: Any) -> None:
    """Refuse a scene that is so small, or so far from the origin, that rays miss what is near.

    Raises
    ------
    SceneCaptumError
        With the factor that helps.
    """
    box = loaded.bbox()
    if not box.valid():
        return
    diagonal = float(torch.tensor(list(box.extents())).double().norm())
    farthest = max(abs(float(one)) for corner in (box.min, box.max) for one in corner)
    off = _OFF * (1 + farthest)
    if diagonal > 0 and off > _MOST_OFF * diagonal:
        fix = (
            "Move it to the origin."
            if farthest > 10 * diagonal
            else f"Scale it, with its cameras and lights, by {2 * _OFF / _MOST_OFF / diagonal:.0f} or more."
        )
        raise SceneCaptumError(
            f"{scene} is {diagonal:.2g} units across and reaches {farthest:.2g} from the origin. Mitsuba starts "
            f"rays {off:.1g} units off a surface, which would lose more than 1 % of the light between them. {fix}"
        )
