"""Quantiles of Student's t distribution, and how many standard errors make an effect clear of its noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

DISAGREEMENT_LEVEL = 0.997  # confidence that a prediction and a measurement differ
_ENOUGH_DEGREES = 7  # of the default number of replicates, 8


def clear_from(info: Mapping[str, Any]) -> float:
    """Return how many standard errors from 0 an effect is clear of its noise, and its sign known.

    Two, as is usual, from 7 degrees of freedom on, those of 8 replicates, the default. With fewer it is as many
    as in ``interval(0.95)``, so that no sign is called known that this interval leaves open: beyond two standard
    errors are 9 % of the effects that are 0 with 8 replicates, but 30 % with 2. Where some points of a path cause
    most of the noise, many replicates have few degrees of freedom.

    Example
    -------
    >>> clear_from({"replicates": 8}), round(clear_from({"replicates": 2}), 2)
    (2.0, 12.71)
    >>> round(clear_from({"replicates": 16, "degrees_of_freedom": 5}), 2)
    2.57
    """
    degrees = int(info.get("degrees_of_freedom", info.get("replicates", _ENOUGH_DEGREES + 1) - 1))
    return 2.0 if degrees >= _ENOUGH_DEGREES else student_t(0.95, max(degrees, 1))


@cache
def student_t(level: float, degrees: int) -> float:
    """Return ``t`` such that a Student-t variable lies in ``[-t, t]`` with probability ``level``.

    Not available in NumPy or torch; for integer degrees of freedom the probability is a finite sum.

    Example
    -------
    >>> round(student_t(0.95, 7), 4)
    2.3646

    References
    ----------
    Abramowitz and Stegun, "Handbook of Mathematical Functions", 26.7.3 and 26.7.4.
    """
    low, high = 0.0, 1.0
    while _probability(high, degrees) < level:
        high *= 2
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if _probability(middle, degrees) < level else (low, middle)
    return high


def _probability(t: float, degrees: int) -> float:
    """Return P(|T| < t)."""
    angle = math.atan(t / math.sqrt(degrees))
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees % 2 == 1
    term, total = (cosine if odd else 1.0), 0.0
    for k in range(1 if odd else 0, degrees - 1, 2):
        total += term
        term *= cosine**2 * (k + 1) / (k + 2)
    return 2 / math.pi * (angle + sine * total) if odd else sine * total
