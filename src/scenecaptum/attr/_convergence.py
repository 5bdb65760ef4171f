"""Whether attributions add up to the difference that they explain, given the errors of both."""

from __future__ import annotations

import math
from typing import Any

import torch

from ..estimation import student_t

# Allowed deviation relative to the explained difference, including two standard errors.
TOLERANCE = 0.05

# Of noise, that correct attributions are said not to add up: the errors of few draws are often too small.
FALSE_ALARMS = 0.001

ADDS_UP, DOES_NOT_ADD_UP, INCONCLUSIVE = "adds up", "does not add up", "inconclusive"

# Rounding error of a sum in single precision, relative to the sum of the magnitudes.
ROUNDING = 16 * torch.finfo(torch.float32).eps


def convergence(
    delta: float, error: float | None, explained: float, magnitude: float, freedom: int
) -> dict[str, Any]:
    """Return the entries of ``info`` about convergence.

    ``delta`` is the sum of the attributions minus the ``explained`` difference, ``error`` its standard error with
    ``freedom`` degrees of freedom, and ``magnitude`` the sum of the attributions' magnitudes, which determines the
    rounding error.
    """
    rounding = ROUNDING * (magnitude + abs(explained))
    return {
        "explained": explained if math.isfinite(explained) else None,  # JSON has no infinity
        "convergence": verdict(delta, error, explained, freedom, rounding),
    }


def verdict(delta: float, error: float | None, explained: float, freedom: int, rounding: float = 0.0) -> str:
    """Return whether attributions add up to what they explain, within 5 % including two standard errors.

    They do not if the delta is beyond 5 % by more than noise is in one case of 1000, by Student's t. The verdict
    is ``"inconclusive"`` if the error is too large to decide.

    Example
    -------
    >>> verdict(0.01, 0.01, 1.0, 7), verdict(0.2, 0.01, 1.0, 7), verdict(0.2, 1.0, 1.0, 7)
    ('adds up', 'does not add up', 'inconclusive')
    """
    if error is None or not math.isfinite(delta):
        return ADDS_UP if abs(delta) <= rounding < math.inf else INCONCLUSIVE
    allowed = TOLERANCE * abs(explained) + rounding
    if abs(delta) + 2 * error <= allowed:
        return ADDS_UP
    beyond = student_t(1 - FALSE_ALARMS, freedom) * error + allowed
    return DOES_NOT_ADD_UP if abs(delta) > beyond else INCONCLUSIVE
