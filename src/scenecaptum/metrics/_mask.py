"""The mask of an object, as the image of a render shows it and as a network gets it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..errors import SceneCaptumError
from ._network import Transform


def check_mask(mask: torch.Tensor) -> torch.Tensor:
    """Return a mask ``(H, W)`` as a detached tensor; raise if it is invalid or empty."""
    if not isinstance(mask, torch.Tensor) or mask.ndim != 2:
        came = tuple(mask.shape) if isinstance(mask, torch.Tensor) else type(mask).__name__
        raise SceneCaptumError(
            f'mask must be a tensor (H, W), such as renderer.mask("chair"), not {came}. For several cameras use '
            "PerCamera with one metric for each."
        )
    if not (mask >= 0).all() or not mask.sum() > 0:
        raise SceneCaptumError(
            "mask selects no pixel: its values must not be negative, and their sum must be positive. Perhaps the "
            "image does not show the object."
        )
    return mask.detach().clone()


def check_mask_fits(shape: Sequence[int], images: torch.Tensor) -> None:
    """Raise if a mask of this shape does not have the size of the images ``(N, H, W, 3)``."""
    if tuple(shape) != tuple(images.shape[1:3]):
        raise SceneCaptumError(
            f"mask has shape {tuple(shape)}; the image is {tuple(images.shape[1:3])} (height, width)."
        )


def mask_in_input(mask: torch.Tensor, transform: Transform, images: torch.Tensor) -> torch.Tensor:
    """Return the mask ``(h, w)`` in the network's input, for images ``(N, H, W, 3)``.

    The mask passes through the transform like a picture, so that it is resized, cropped, flipped and padded in the
    same way. Black and white pictures show how the transform scales values, which is undone; where it pads, both
    are equal.
    """
    shown = mask.to(images)
    levels = torch.stack([torch.zeros_like(shown), torch.ones_like(shown), shown / shown.max()])
    with torch.no_grad():
        black, white, level = transform(levels[:, None].expand(-1, 3, -1, -1)).to(images.dtype)
    weight: torch.Tensor = ((level - black) / (white - black)).nan_to_num(0.0, 0.0, 0.0).mean(0).clamp(0, 1)
    if not weight.sum() > 0:
        raise SceneCaptumError(
            "The network's input shows no pixel of the mask: the transform crops them away. Give a transform that "
            "keeps the whole picture, such as ResizeCropNormalize(resize=…, crop=None)."
        )
    return weight
