"""Denoising pictures with Open Image Denoise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from .errors import SceneCaptumError

CHANNELS = 3


@dataclass(frozen=True)
class Guides:
    """Pictures without noise that tell a denoiser where edges are.

    Attributes
    ----------
    albedo
        ``(H, W, 3)`` in [0, 1]; ``(cameras, H, W, 3)`` for several cameras.
    normal
        Shading normals in world space, of the same shape, each channel in [-1, 1].
    """

    albedo: torch.Tensor
    normal: torch.Tensor


def straight_through(image: torch.Tensor, guides: Guides | None = None) -> torch.Tensor:
    """Return a denoised picture through which gradients pass unchanged: Open Image Denoise has no derivative.

    Parameters
    ----------
    image, guides
        As for ``denoise``.

    Raises
    ------
    SceneCaptumError
        As ``denoise``.
    """
    return image + (denoise(image, guides) - image).detach()


def is_picture(image: torch.Tensor) -> bool:
    """Whether a tensor has the shape ``(H, W, 3)`` or ``(cameras, H, W, 3)``, so that it can be denoised."""
    return image.ndim in (3, 4) and image.shape[-1] == CHANNELS and image.numel() > 0


def denoise(image: torch.Tensor, guides: Guides | None = None) -> torch.Tensor:
    """Return Open Image Denoise's estimate of a picture without noise.

    Example
    -------
    >>> import torch
    >>> noisy = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    >>> denoise(noisy).std() < 0.3 * noisy.std()
    tensor(True)

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance, or ``(cameras, H, W, 3)``. Negative values count as 0.
    guides
        Albedo and normals of the same shape, where they are known.

    Returns
    -------
    Tensor
        Of the same shape, dtype and device, without derivatives.

    Raises
    ------
    SceneCaptumError
        Where the image is no picture, or the guides have another shape.

    References
    ----------
    Áfra, "Intel Open Image Denoise", https://www.openimagedenoise.org.
    """
    import pyoidn

    if not is_picture(image):
        raise SceneCaptumError(
            f"Only a picture (H, W, 3) can be denoised, not a tensor {tuple(image.shape)}."
        )
    if guides is not None and guides.albedo.shape != image.shape:
        raise SceneCaptumError(
            f"The guides have the shape {tuple(guides.albedo.shape)}, the picture {tuple(image.shape)}."
        )
    if image.ndim > CHANNELS:
        each = [None] * len(image) if guides is None else map(Guides, guides.albedo, guides.normal)
        return torch.stack([denoise(*pair) for pair in zip(image, each, strict=True)])
    light = image.detach().to("cpu", torch.float64).clamp_min(0)
    mean = light.mean().item()
    if mean == 0 or not math.isfinite(mean):
        return image.detach().clamp_min(0)
    # The denoiser takes very faint pictures for black. A power of two scales without rounding.
    exposure = math.ldexp(1.0, math.frexp(mean)[1])
    color = (light / exposure).to(torch.float32).numpy()
    known = {} if guides is None else {"albedo": guides.albedo.numpy(), "normal": guides.normal.numpy()}
    found = pyoidn.denoise(color, hdr=True, clean_aux=bool(known), **known)
    return (torch.from_numpy(found).double() * exposure).to(image)
