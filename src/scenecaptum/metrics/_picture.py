"""Conversion of rendered images to the colour space of networks and kornia, and checks of metrics' arguments."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ..images import channels_first, check_image_shape


def srgb_picture(image: torch.Tensor, exposure: float = 1.0) -> torch.Tensor:
    """Encode linear radiance as an sRGB picture, ``sRGB(min(exposure · L, 1))``.

    The image is ``(H, W, 3)`` linear radiance with Rec. 709 primaries, the picture ``(1, 3, H, W)`` in [0, 1];
    for a stack ``(N, H, W, 3)`` it is ``(N, 3, H, W)``. The gradient is finite everywhere: 12.92 · exposure at
    black, and 0 above white, where values are clipped. Raises if the image has another shape, or a value that is
    negative or not finite.

    Example
    -------
    >>> srgb_picture(torch.full((1, 1, 3), 0.2140)).flatten()[0]
    tensor(0.5000)

    References
    ----------
    IEC 61966-2-1 (sRGB), as implemented in kornia.
    """
    from kornia.color import linear_rgb_to_rgb

    radiance = channels_first(image)
    valid = (radiance >= 0) & (radiance < torch.inf)
    if not bool(valid.all()):
        raise SceneCaptumError(
            f"Radiance must be finite and not negative; on {int((~valid).any(1).sum())} of {valid[:, 0].numel()} "
            "pixels it is not. Fix the scene, or remove the values with image.nan_to_num(0).clamp(min=0)."
        )
    encoded: torch.Tensor = linear_rgb_to_rgb((radiance * exposure).clamp(max=1.0))
    return encoded


def check_exposure(exposure: float) -> float:
    """Return a positive, finite factor; raise otherwise."""
    if not 0 < exposure < float("inf"):
        raise SceneCaptumError(f"exposure must be a positive, finite factor, not {exposure!r}.")
    return float(exposure)


def check_reference(reference: torch.Tensor) -> torch.Tensor:
    """Return a detached copy of a reference image; raise if it is invalid."""
    check_image_shape(reference)
    if not torch.isfinite(reference).all():
        raise SceneCaptumError("The reference has values that are not finite: pass it through nan_to_num(0).")
    return reference.detach().clone()


def check_same_shape(image: torch.Tensor, reference: torch.Tensor) -> None:
    """Raise if an image and its reference have different shapes."""
    if image.shape != reference.shape:
        raise SceneCaptumError(
            f"The image is {tuple(image.shape)} and its reference {tuple(reference.shape)} (height, width, "
            "channels). Render both at the same resolution."
        )
