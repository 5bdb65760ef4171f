"""What a camera sees of lamps whose light pixels average with what is around it."""

from __future__ import annotations

from typing import NamedTuple

import torch

FILLED = 0.5  # the fraction of a pixel from which a lamp dominates it


class SmallLamp(NamedTuple):
    """What a camera sees of a lamp that is smaller than a pixel.

    Attributes
    ----------
    radiance
        The largest radiance towards the camera, ``(3,)``.
    solid_angle
        In steradians, about: of a lamp without dents.
    pixel
        The row and the column that show it.
    """

    radiance: torch.Tensor
    solid_angle: float
    pixel: tuple[int, int]


class Reflection(NamedTuple):
    """What a camera sees of a lamp, or of the sky, by way of panes that reflect it.

    Attributes
    ----------
    radiance
        That of the reflection where a pixel shows it, ``(H, W, 3)``; 0 elsewhere.
    fraction
        The part of each pixel that it covers, about, ``(H, W)``.
    """

    radiance: torch.Tensor
    fraction: torch.Tensor
