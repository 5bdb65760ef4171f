"""Quantiles of Student's t distribution."""

from __future__ import annotations

import math


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
