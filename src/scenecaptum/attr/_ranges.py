"""How far a parameter can go: the common scale of parameters of different kinds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from ..errors import SceneCaptumError


def ranges(renderer: Any, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the length of each parameter's physical range, a 0-d tensor.

    Where it is infinite (the radiance of a lamp, the index of a metal) the largest magnitude of its value stands
    in, or 1 where that is 0.

    Raises
    ------
    SceneCaptumError
        Where the renderer has no ``bounds``.
    """
    bounds = getattr(renderer, "bounds", None)
    if bounds is None:
        raise SceneCaptumError(
            "A range takes physical bounds, which this renderer does not tell: give it an attribute `bounds`, "
            "a dict from parameter name to (low, high)."
        )
    return {name: _length(value, *bounds.get(name, (-math.inf, math.inf))) for name, value in values.items()}


def _length(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    if math.isfinite(high - low):
        return value.new_tensor(high - low)
    return value.abs().amax() if bool(value.any()) else value.new_ones(())
