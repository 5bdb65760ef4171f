"""Shape, layout and luminance of rendered images."""

from __future__ import annotations

import torch

from .errors import SceneCaptumError

# Of R, G and B with the Rec. 709 primaries, as in Mitsuba and kornia.
LUMINANCE_WEIGHTS = (0.212671, 0.715160, 0.072169)


def channels_first(image: torch.Tensor) -> torch.Tensor:
    """Convert an ``(H, W, 3)`` image to ``(1, 3, H, W)``, the layout of kornia and networks; raise for others.

    A stack ``(N, H, W, 3)`` becomes ``(N, 3, H, W)``.
    """
    stack = image if image.ndim == 4 else image[None]
    check_image_shape(stack[0] if len(stack) else image)
    return stack.movedim(-1, 1)


def channels_last(picture: torch.Tensor) -> torch.Tensor:
    """Convert a ``(1, 3, H, W)`` picture to ``(H, W, 3)``, the layout of renderers and figures."""
    return picture[0].movedim(0, -1)


def check_image_shape(image: torch.Tensor) -> None:
    """Raise if a tensor is not an ``(H, W, 3)`` image."""
    if image.ndim != 3 or image.shape[-1] != 3 or not image.numel():
        each = (
            " For the pictures of several cameras use metrics.PerCamera(metric)." if image.ndim == 4 else ""
        )
        raise SceneCaptumError(
            f"An image has shape (H, W, 3), height first; this one has {tuple(image.shape)}.{each}"
        )
