"""Quantiles of Student's t distribution, and how many standard errors make an effect clear of its noise."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Any

DISAGREEMENT_LEVEL = 0.997  # confidence that a prediction and a measurement differ
FALSE_ALARMS = 0.05  # allowed for all effects together
CHANCE = 0.01  # of noise, at an effect that is larger than another that is clear
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
    degrees = degrees_of_freedom(info)
    return 2.0 if degrees >= _ENOUGH_DEGREES else student_t(0.95, degrees)


def all_clear_from(errors: Iterable[float | None], info: Mapping[str, Any]) -> float:
    """Return how many standard errors noise alone may reach at some effect, at 5 % for all together.

    The noise of many parameters takes one of them beyond two standard errors.

    Example
    -------
    >>> round(all_clear_from([0.1], {"replicates": 8}), 2), round(all_clear_from([0.1] * 10, {"replicates": 8}), 2)
    (2.36, 4.03)
    """
    noisy = sum(bool(error) for error in errors)
    return student_t(1 - FALSE_ALARMS / noisy, degrees_of_freedom(info)) if noisy else 0.0


def rankable(
    sizes: Mapping[str, float],
    errors: Mapping[str, float | None],
    info: Mapping[str, Any],
    known: Collection[str] = (),
) -> set[str]:
    """Return the effects that are clear enough to rank: of all together, and larger ones whose own sign is clear.

    Parameters
    ----------
    sizes
        The magnitudes of the effects.
    errors
        Standard errors of these, and of others among which they were found.
    info
        That of the result.
    known
        The effects that are clear by other means.

    Example
    -------
    >>> sizes = {"lamp": 5.0, "desk": 1.0, "wall": 1.0}
    >>> rankable(sizes, {"lamp": 1.4, "desk": 0.1, "wall": 0.4}, {"replicates": 8}) == {"lamp", "desk"}
    True
    """

    def beyond(limit: float) -> set[str]:
        return {name for name, size in sizes.items() if size > limit * (errors[name] or 0.0)}

    clear = beyond(all_clear_from(errors.values(), info)) | (sizes.keys() & known)
    smallest = min((sizes[name] for name in clear), default=math.inf)
    return clear | {
        name for name in beyond(student_t(1 - CHANCE, degrees_of_freedom(info))) if sizes[name] > smallest
    }


def degrees_of_freedom(info: Mapping[str, Any]) -> int:
    """Return the degrees of freedom of the errors of a result, at least 1: those of its replicates, or fewer."""
    return max(1, int(info.get("degrees_of_freedom", info.get("replicates", _ENOUGH_DEGREES + 1) - 1)))


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
