"""Tone mapping of linear radiance for display."""

from __future__ import annotations

import os

import torch

from ..errors import SceneCaptumError
from ..files import atomic_write
from ..images import LUMINANCE_WEIGHTS, channels_first, channels_last, check_image_shape

_MIDDLE_GREY = 0.18
_MAX_RADIANCE = 1e30  # far above any radiance; avoids overflow
_SHADOW_THRESHOLD = 1e-3  # relative to the bright level; darker pixels do not affect the exposure
_BRIGHT_QUANTILE = 0.95
_MAX_EXPOSED = 8.0  # of the bright level: three stops over white, so that windows do not burn out completely
_KNEE = 0.6


def display_image(image: torch.Tensor, exposure: float | None = None) -> torch.Tensor:
    """Convert linear radiance to sRGB for display; finite for any input.

    The curve is linear up to a knee; above it a shoulder approaches full brightness. It is applied to the largest
    channel and the others are scaled by the same factor, so a lamp or window keeps its hue.

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.
    exposure
        Factor applied to the radiance. By default the log-average luminance of the lit pixels becomes middle grey,
        unless that would overexpose the bright ones.

    Returns
    -------
    Tensor
        ``(H, W, 3)`` in [0, 1].

    Raises
    ------
    SceneCaptumError
        If the image has another shape, or the exposure is not positive.

    References
    ----------
    Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002 (the log-average exposure).
    """
    import kornia

    check_image_shape(image)
    if exposure is not None and not exposure > 0:
        raise SceneCaptumError(f"exposure must be a positive factor, not {exposure!r}.")
    radiance = image.detach().float().nan_to_num(0.0, _MAX_RADIANCE, 0.0).clamp(0.0, _MAX_RADIANCE)
    factor = automatic_exposure(radiance) if exposure is None else exposure
    shown = _shoulder((radiance * factor).clamp(max=_MAX_RADIANCE))
    encoded: torch.Tensor = kornia.color.linear_rgb_to_rgb(channels_first(shown))
    return channels_last(encoded).clamp(0.0, 1.0)


def save_render(image: torch.Tensor, path: str | os.PathLike[str], exposure: float | None = None) -> None:
    """Write a render as a PNG of the same width and height.

    Parameters
    ----------
    image, exposure
        As for ``display_image``.
    path
        The file to write.

    Raises
    ------
    SceneCaptumError
        If the image has another shape, or the file cannot be written.
    """
    from PIL import Image

    pixels = (display_image(image, exposure) * 255).round().to(torch.uint8)
    with atomic_write(path) as partial:
        Image.fromarray(pixels.numpy(force=True)).save(partial, format="PNG")


def automatic_exposure(radiance: torch.Tensor) -> float:
    """Return the exposure that maps the log-average luminance to middle grey, within limits."""
    luminance = (radiance.double() @ radiance.new_tensor(LUMINANCE_WEIGHTS).double()).flatten()
    lit = luminance[luminance > 0]
    if not len(lit):
        return 1.0
    bright = _quantile(lit, _BRIGHT_QUANTILE)
    middle = float(lit[lit >= _SHADOW_THRESHOLD * bright].log().mean().exp())
    return min(_MIDDLE_GREY / middle, _MAX_EXPOSED / bright)


def _quantile(values: torch.Tensor, fraction: float) -> float:
    # torch.quantile is limited to 16 million elements.
    return float(values.kthvalue(max(round(fraction * len(values)), 1)).values)


def _shoulder(radiance: torch.Tensor) -> torch.Tensor:
    """Compress values above the knee towards 1, with a continuous slope."""
    peak = radiance.amax(-1, keepdim=True)
    over = (peak - _KNEE).clamp_min(0) / (1 - _KNEE)
    compressed = _KNEE + (1 - _KNEE) * over / (1 + over)
    return radiance * torch.where(over > 0, compressed / peak.clamp_min(_KNEE), 1.0)
