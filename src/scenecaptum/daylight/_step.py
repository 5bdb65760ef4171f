"""The step at a threshold, and its relaxation."""

from __future__ import annotations

import math

import torch


def step(
    values: torch.Tensor, threshold: float, relaxation: float, *, exclusive: bool = False
) -> torch.Tensor:
    """Return 0 below the threshold, 1 above it, and a sigmoid of the logarithm in between.

    The sigmoid is the cubic smoothstep of ``ln value`` between ``threshold · exp(±3 relaxation)``. At the
    threshold it is ½ and has the slope of a logistic function of scale ``relaxation``. Outside it is exactly 0 or
    1, so that many dark hours cannot add up to a bright one, and an illuminance of 0 has a derivative of 0.

    Parameters
    ----------
    values
        Any shape, not negative.
    threshold
        Above 0.
    relaxation
        Width of the transition in units of ``ln value``; 0 is the step itself, without a derivative.
    exclusive
        Whether a value equal to the threshold counts as below. It matters only for the step itself.
    """
    if relaxation == 0:
        return (values > threshold if exclusive else values >= threshold).to(values)
    lowest = threshold * math.exp(
        -4 * relaxation
    )  # below the transition, where the logarithm does not matter
    position = (values.clamp(min=lowest) / threshold).log() / (6 * relaxation) + 0.5
    position = position.clamp(0, 1)
    return position * position * (3 - 2 * position)
