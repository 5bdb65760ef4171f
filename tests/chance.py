"""How far a number may be from what is claimed, in its own standard errors."""

from __future__ import annotations

import math

from scenecaptum.estimation import student_t

# That of a normal variable beyond 4 standard deviations.
RARE = 6.3e-5


def allowed(replicates: int, comparisons: int = 1) -> float:
    """Return how many standard errors are allowed, where so many replicates tell the error: 4 for very many.

    Each of the comparisons that share a claim gets its part of the one false alarm in 16 000. With 8 replicates
    the mean of normal variables is beyond 4 of its errors once in 200.
    """
    return student_t(1 - RARE / comparisons, replicates - 1)


def together(*errors: float) -> float:
    """Return the standard error of a sum or difference of independent numbers."""
    return math.hypot(*errors)
