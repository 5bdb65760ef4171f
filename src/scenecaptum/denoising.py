"""Denoising of images with Open Image Denoise."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from .errors import SceneCaptumError
from .protocols import Capabilities, Renderer

CHANNELS = 3


@dataclass(frozen=True)
class Guides:
    """Noise-free auxiliary images that guide a denoiser.

    Attributes
    ----------
    albedo
        ``(H, W, 3)`` in [0, 1]; ``(cameras, H, W, 3)`` for several cameras.
    normal
        Shading normals in world space, of the same shape, each channel in [-1, 1].
    emission
        Radiance of the lamps and the surroundings that the camera sees directly, of the same shape, if known. It
        is not denoised: a denoiser takes a lamp of a few pixels for noise.
    """

    albedo: torch.Tensor
    normal: torch.Tensor
    emission: torch.Tensor | None = None

    def keeping_lamps(self) -> Guides:
        """Return guides by which whole pixels that show lamps are left as they are.

        So denoised, a picture and its derivative by the light of all lamps stay proportional.
        """
        if self.emission is None:
            return self
        shows = self.emission.amax(-1, keepdim=True) > 0
        return dataclasses.replace(
            self, emission=torch.where(shows, torch.inf, torch.zeros_like(self.emission))
        )

    @staticmethod
    def stacked(guides: Sequence[Guides]) -> Guides:
        """Return the guides of several pictures as those of one stack."""
        emission = [one.emission for one in guides if one.emission is not None]
        return Guides(
            torch.stack([one.albedo for one in guides]),
            torch.stack([one.normal for one in guides]),
            torch.stack(emission) if emission else None,
        )

    def __getitem__(self, index: int) -> Guides:
        """Return the guides of one picture of a stack."""
        emission = None if self.emission is None else self.emission[index]
        return Guides(self.albedo[index], self.normal[index], emission)


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
        Albedo, normals and emission of the same shape, if available. Of the emission, what the image has of it is
        left as it is.

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
        each = [None if guides is None else guides[index] for index in range(len(image))]
        return torch.stack([denoise(*pair) for pair in zip(image, each, strict=True)])
    radiance = image.detach().to("cpu", torch.float64).clamp_min(0)
    direct = torch.zeros_like(radiance)
    if guides is not None and guides.emission is not None:
        direct = torch.minimum(radiance, guides.emission.to(radiance))
    reflected = radiance - direct
    mean = reflected.mean().item()
    if mean == 0 or not math.isfinite(mean):
        return image.detach().clamp_min(0)
    # Normalize, since the denoiser treats very dark images as black. A power of two scales without rounding.
    scale = math.ldexp(1.0, math.frexp(mean)[1])
    color = (reflected / scale).to(torch.float32).numpy()
    aux = {} if guides is None else {"albedo": guides.albedo.numpy(), "normal": guides.normal.numpy()}
    denoised = pyoidn.denoise(color, hdr=True, clean_aux=bool(aux), **aux)
    return (torch.from_numpy(denoised).double() * scale + direct).to(image)
