"""Refusing scenes that a renderer would show without complaint, and wrongly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from .._finite import place
from ..errors import SceneCaptumError
from ._parameters import Parameter

# Where a value outside its range means light or matter that cannot be. Elsewhere Mitsuba has conventions of its
# own (a principled roughness of 0).
_PHYSICAL = ("emitters", "media", "reflectance", "opacity", "ior")

# What decoding a file, or a sum that should be 1, may add.
_SLACK = 1e-3

# Mitsuba starts rays so far off a surface, times 1 + |p|: whatever the size of the scene.
_OFF = 1500 * 2.0**-24

# Of the size of a scene: more than 1 % of its light would be lost (benchmarks/extremes.py).
_MOST_OFF = 0.01


def check_values(scene: str, values: Mapping[str, torch.Tensor], table: Mapping[str, Parameter]) -> None:
    """Refuse a scene whose own values are not finite, or whose light or matter is unphysical.

    Raises
    ------
    SceneCaptumError
        Naming the parameter, the value and where it is.
    """
    for name, value in values.items():
        low, high = value.aminmax() if value.numel() else (value.new_zeros(()),) * 2
        if not (low.isfinite() and high.isfinite()):
            _refuse(scene, name, value, ~torch.isfinite(value), "which is not finite")
        bounds, kind = table[name].bounds, table[name].kind
        if kind in _PHYSICAL and (low < bounds.low or high > bounds.high + _SLACK):
            outside = (value < bounds.low) | (value > bounds.high + _SLACK)
            _refuse(scene, name, value, outside, f"outside the physical range {bounds} of its kind ({kind})")


def _refuse(scene: str, name: str, value: torch.Tensor, bad: torch.Tensor, why: str) -> None:
    where = f" at {place(bad)}" if bad.ndim else ""
    raise SceneCaptumError(
        f"{scene}: {name!r} holds {value[bad][0].item():g}{where}, {why}. Mend it in the scene, or in the file "
        "that it comes from."
    )


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
