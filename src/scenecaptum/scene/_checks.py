"""Checks for scenes that Mitsuba renders wrongly without an error: unphysical values and unresolvable scales."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch

from ..errors import SceneCaptumError
from ..finite import describe_location
from ._bounds import Bounds

# Kinds whose values are physically impossible outside their bounds.
_PHYSICAL_KINDS = ("emitters", "media", "reflectance", "opacity", "ior", "roughness", "surface")
# Kinds for which Mitsuba has a convention at an open bound: a roughness of 0 is smooth.
_CLOSED_KINDS = ("roughness",)

# Tolerance above the upper bound for rounding in file formats and in sums that should be 1.
_TOLERANCE = 1e-3

# Mitsuba offsets ray origins from surfaces by this times 1 + |p|, independent of the size of the scene.
_RAY_OFFSET = 1500 * 2.0**-24

# As a fraction of the scene's diagonal: above it more than 1 % of the light is lost (benchmarks/extremes.py).
_MAX_RELATIVE_OFFSET = 0.01


def find_fault(value: torch.Tensor, kind: str, bounds: Bounds) -> str | None:
    """Describe the first entry that is not finite or physically impossible; None where there is none.

    Example
    -------
    >>> find_fault(torch.tensor([1.5, -0.0485, 1.5]), "ior", Bounds(0.0, open_low=True))
    'it is -0.0485 at channel 1, outside the physical range (0, ∞) of its kind (ior)'
    """
    low, high = value.aminmax() if value.numel() else (value.new_zeros(()),) * 2
    if not (low.isfinite() and high.isfinite()):
        return _describe_fault(value, ~torch.isfinite(value), "which is not finite")
    if kind in _PHYSICAL_KINDS and (_is_outside(low, kind, bounds) or _is_outside(high, kind, bounds)):
        bad = _is_outside(value, kind, bounds)
        return _describe_fault(value, bad, f"outside the physical range {bounds} of its kind ({kind})")
    return None


def _is_outside(value: torch.Tensor, kind: str, bounds: Bounds) -> torch.Tensor:
    is_open = bounds.open_low and kind not in _CLOSED_KINDS
    below = value <= bounds.low if is_open else value < bounds.low
    return below | (value > bounds.high + _TOLERANCE)


def _describe_fault(value: torch.Tensor, bad: torch.Tensor, reason: str) -> str:
    where = f" at {describe_location(bad)}" if bad.ndim else ""
    return f"it is {value[bad][0].item():g}{where}, {reason}"


def check_spectra(name: str, class_names: Collection[str]) -> None:
    """Raise if a scene has a spectrum that Mitsuba cannot evaluate in RGB."""
    if "BlackBodySpectrum" in class_names:
        raise SceneCaptumError(
            f"{name} has a blackbody spectrum, which Mitsuba evaluates in its spectral variants only: give the "
            "light an RGB radiance instead."
        )


def check_scale(name: str, scene: Any) -> None:
    """Raise if a scene is so small, or so far from the origin, that Mitsuba's ray offset skips nearby surfaces."""
    box = scene.bbox()
    if not box.valid():
        return
    diagonal = float(torch.tensor(list(box.extents())).double().norm())
    farthest = max(abs(float(coordinate)) for corner in (box.min, box.max) for coordinate in corner)
    offset = _RAY_OFFSET * (1 + farthest)
    if diagonal > 0 and offset > _MAX_RELATIVE_OFFSET * diagonal:
        factor = 2 * _RAY_OFFSET / _MAX_RELATIVE_OFFSET / diagonal
        fix = (
            "Move it to the origin."
            if farthest > 10 * diagonal
            else f"Scale it, with its cameras and lights, by {factor:.0f} or more."
        )
        raise SceneCaptumError(
            f"{name} is {diagonal:.2g} units across and extends {farthest:.2g} units from the origin. Mitsuba "
            f"starts rays {offset:.1g} units off a surface, which loses more than 1 % of the light. {fix}"
        )
