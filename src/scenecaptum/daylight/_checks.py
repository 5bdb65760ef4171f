"""Checks of settings."""

from __future__ import annotations

import math
from numbers import Real

from ..errors import SceneCaptumError


def positive(name: str, value: float, *, or_zero: bool = False) -> float:
    """Return a number above 0, or at least 0; raise for others."""
    number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not number or value < 0 or (value == 0 and not or_zero):
        raise SceneCaptumError(
            f"{name} must be a finite number {'at least' if or_zero else 'above'} 0, not {value!r}."
        )
    return float(value)


def share(name: str, value: float) -> float:
    """Return a number from 0 to 1; raise for others."""
    if positive(name, value, or_zero=True) > 1:
        raise SceneCaptumError(f"{name} must be from 0 to 1, not {value!r}.")
    return float(value)


def choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return one of the choices; raise for others."""
    if value not in choices:
        raise SceneCaptumError(f"{name} must be one of {', '.join(map(repr, choices))}, not {value!r}.")
    return value
