"""Denoising of images with Open Image Denoise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from .errors import SceneCaptumError
from .protocols import Capabilities, Renderer

CHANNELS = 3


@dataclass(frozen=True)
class Guides:
    """Noise-free auxiliary images (albedo and normals) that guide a denoiser.

    Attributes
    ----------
    albedo
        ``(H, W, 3)`` in [0, 1]; ``(cameras, H, W, 3)`` for several cameras.
    normal
        Shading normals in world space, of the same shape, each channel in [-1, 1].
    """

    albedo: torch.Tensor
    normal: torch.Tensor


def guides_of(renderer: Renderer, values: Mapping[str, torch.Tensor]) -> Guides | None:
    """Return the guides of a ``renderer``, if it has some, with objects and camera where ``values`` move them."""
    moved = Capabilities(renderer).guides_of
    guides: Guides | None = Capabilities(renderer).guides if moved is None else moved(values)
    return guides


def straight_through(image: torch.Tensor, guides: Guides | None = None) -> torch.Tensor:
    """Return a denoised image with a straight-through gradient, since Open Image Denoise is not differentiable.

    ``image`` and ``guides`` are as for ``denoise``, and so are the errors.
    """
    return image + (denoise(image, guides) - image).detach()


def is_picture(image: torch.Tensor) -> bool:
    """Whether a tensor has the shape ``(H, W, 3)`` or ``(cameras, H, W, 3)``, so that it can be denoised."""
    return image.ndim in (3, 4) and image.shape[-1] == CHANNELS and image.numel() > 0


def denoise(image: torch.Tensor, guides: Guides | None = None) -> torch.Tensor:
    """Return the image denoised by Open Image Denoise.

    Example
    -------
    >>> import torch
    >>> noisy = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    >>> denoise(noisy).std() < 0.3 * noisy.std()
    tensor(True)

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance, or ``(cameras, H, W, 3)``. Negative values are clamped to 0.
    guides
        Albedo and normals of the same shape, if available.

    Returns
    -------
    Tensor
        Of the same shape, dtype and device, detached.

    Raises
    ------
    SceneCaptumError
        If the image or the guides have the wrong shape.

    References
    ----------
    Áfra, "Intel Open Image Denoise", https://www.openimagedenoise.org.
    """
    import pyoidn

    if not is_picture(image):
        raise SceneCaptumError(
            f"Only an image (H, W, 3) can be denoised, not a tensor of shape {tuple(image.shape)}."
        )
    if guides is not None and guides.albedo.shape != image.shape:
        raise SceneCaptumError(
            f"The guides have shape {tuple(guides.albedo.shape)}, but the image has {tuple(image.shape)}."
        )
    if image.ndim > CHANNELS:
        each = [None] * len(image) if guides is None else map(Guides, guides.albedo, guides.normal)
        return torch.stack([denoise(*pair) for pair in zip(image, each, strict=True)])
    radiance = image.detach().to("cpu", torch.float64).clamp_min(0)
    mean = radiance.mean().item()
    if mean == 0 or not math.isfinite(mean):
        return image.detach().clamp_min(0)
    # Normalize, since the denoiser treats very dark images as black. A power of two scales without rounding.
    scale = math.ldexp(1.0, math.frexp(mean)[1])
    color = (radiance / scale).to(torch.float32).numpy()
    aux = {} if guides is None else {"albedo": guides.albedo.numpy(), "normal": guides.normal.numpy()}
    denoised = pyoidn.denoise(color, hdr=True, clean_aux=bool(aux), **aux)
    return (torch.from_numpy(denoised).double() * scale).to(image)
