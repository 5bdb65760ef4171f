"""Whether attributions add up to the difference that they explain, given the errors of both."""

from __future__ import annotations

import math
from typing import Any

import torch

# Allowed deviation relative to the explained difference, including two standard errors.
TOLERANCE = 0.05

ADDS_UP, DOES_NOT_ADD_UP, INCONCLUSIVE = "adds up", "does not add up", "inconclusive"

# Rounding error of a sum in single precision, relative to the sum of the magnitudes.
ROUNDING = 16 * torch.finfo(torch.float32).eps


def convergence(delta: float, error: float | None, explained: float, magnitude: float) -> dict[str, Any]:
    """Return the entries of ``info`` about convergence.

    ``delta`` is the sum of the attributions minus the ``explained`` difference, ``error`` its standard error, and
    ``magnitude`` the sum of the attributions' magnitudes, which determines the rounding error.
    """
    rounding = ROUNDING * (magnitude + abs(explained))
    return {
        "explained": explained if math.isfinite(explained) else None,  # JSON has no infinity
        "convergence": verdict(delta, error, explained, rounding),
    }


def verdict(delta: float, error: float | None, explained: float, rounding: float = 0.0) -> str:
    """Return whether attributions add up to what they explain, within 5 % including two standard errors.

    The verdict is ``"inconclusive"`` if the error is too large to decide.

    Example
    -------
    >>> verdict(0.01, 0.01, 1.0), verdict(0.2, 0.01, 1.0), verdict(0.2, 1.0, 1.0)
    ('adds up', 'does not add up', 'inconclusive')
    """
    if error is None or not math.isfinite(delta):
        return ADDS_UP if abs(delta) <= rounding < math.inf else INCONCLUSIVE
    allowed = TOLERANCE * abs(explained) + rounding
    if abs(delta) + 2 * error <= allowed:
        return ADDS_UP
    return DOES_NOT_ADD_UP if abs(delta) - 2 * error > allowed else INCONCLUSIVE
