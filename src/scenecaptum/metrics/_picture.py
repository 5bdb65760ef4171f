"""From the image a renderer returns to the layouts and colours that networks and kornia take; nowhere else."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError


def channels_first(image: torch.Tensor) -> torch.Tensor:
    """Return an ``(H, W, 3)`` image as the ``(1, 3, H, W)`` that kornia and networks take.

    Raises
    ------
    SceneCaptumError
        Where the image has another shape.
    """
    check_image(image)
    return image.movedim(-1, 0)[None]


def channels_last(picture: torch.Tensor) -> torch.Tensor:
    """Return a ``(1, 3, H, W)`` picture as the ``(H, W, 3)`` that renderers and figures take."""
    return picture[0].movedim(0, -1)


def check_image(image: torch.Tensor) -> None:
    """Raise where a tensor is no ``(H, W, 3)`` image."""
    if image.ndim != 3 or image.shape[-1] != 3 or not image.numel():
        raise SceneCaptumError(
            f"An image has shape (H, W, 3), height first; this one has {tuple(image.shape)}."
        )


def srgb_picture(image: torch.Tensor, exposure: float = 1.0) -> torch.Tensor:
    """Return linear radiance as the sRGB picture that a camera would save, ``sRGB(min(exposure · L, 1))``.

    The gradient is finite everywhere: 12.92 · exposure at black, and 0 above white, where the picture is clipped.

    Example
    -------
    >>> srgb_picture(torch.full((1, 1, 3), 0.2140)).flatten()[0]
    tensor(0.5000)

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance, Rec. 709 primaries.
    exposure
        What radiance is multiplied by before it is clipped at 1, white.

    Returns
    -------
    Tensor
        ``(1, 3, H, W)`` in [0, 1].

    Raises
    ------
    SceneCaptumError
        Where the image has another shape, or a value that is negative or not finite.

    References
    ----------
    IEC 61966-2-1 (sRGB), as kornia writes it.
    """
    from kornia.color import linear_rgb_to_rgb

    radiance = channels_first(image)
    if not bool(((radiance >= 0) & (radiance < torch.inf)).all()):
        bad = int((~((radiance >= 0) & (radiance < torch.inf))).any(1).sum())
        raise SceneCaptumError(
            f"Radiance must be finite and not negative; on {bad} of {image.shape[0] * image.shape[1]} pixels it "
            "is not. Mend the scene, or remove the values with image.nan_to_num(0).clamp(min=0)."
        )
    encoded: torch.Tensor = linear_rgb_to_rgb((radiance * exposure).clamp(max=1.0))
    return encoded


def check_exposure(exposure: float) -> float:
    """Return a factor that radiance can be multiplied by, or say what is wrong with it."""
    if not 0 < exposure < float("inf"):
        raise SceneCaptumError(f"exposure must be a positive, finite factor, not {exposure!r}.")
    return float(exposure)


def check_reference(reference: torch.Tensor) -> torch.Tensor:
    """Return a reference image as a constant of its own, or say what is wrong with it."""
    check_image(reference)
    if not torch.isfinite(reference).all():
        raise SceneCaptumError("The reference has values that are not finite: pass it through nan_to_num(0).")
    return reference.detach().clone()


def check_same_shape(image: torch.Tensor, reference: torch.Tensor) -> None:
    """Raise where an image cannot be compared with its reference pixel by pixel."""
    if image.shape != reference.shape:
        raise SceneCaptumError(
            f"The image is {tuple(image.shape)} and its reference {tuple(reference.shape)} (height, width, "
            "channels). Render both at the same resolution."
        )
