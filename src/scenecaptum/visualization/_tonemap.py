"""Linear radiance to a picture that a screen can show."""

from __future__ import annotations

import os

import torch

from .._writing import whole_file
from ..errors import SceneCaptumError
from ..metrics._picture import channels_first, channels_last, check_image

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
_MIDDLE_GREY = 0.18
_LARGEST = 1e30  # far above any radiance, and its square root is still a float
_SHADOW = 1e-3  # of the bright level: what is darker says nothing about the exposure
_BRIGHT_QUANTILE = 0.95
_BRIGHTEST_EXPOSED = (
    8.0  # three stops over white: daylight in a window may fill its panes, but not hide the view
)
_KNEE = 0.6


def display_image(image: torch.Tensor, exposure: float | None = None) -> torch.Tensor:
    """Turn linear radiance into sRGB for display; finite for any input.

    Values up to a knee are shown linearly; above it a shoulder approaches full brightness. It acts on the
    largest of the three channels and scales the others alike, so a lamp or window keeps its hue.

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.
    exposure
        What radiance is multiplied by. By default the log-average luminance of the lit pixels becomes middle
        grey, unless that would wash out the bright ones.

    Returns
    -------
    Tensor
        ``(H, W, 3)`` in [0, 1].

    Raises
    ------
    SceneCaptumError
        Where the image has another shape, or the exposure is not positive.

    References
    ----------
    Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002 (the log-average exposure).
    """
    import kornia

    check_image(image)
    if exposure is not None and not exposure > 0:
        raise SceneCaptumError(f"exposure must be a positive factor, not {exposure!r}.")
    radiance = image.detach().float().nan_to_num(0.0, _LARGEST, 0.0).clamp(0.0, _LARGEST)
    factor = automatic_exposure(radiance) if exposure is None else exposure
    shown = _shoulder((radiance * factor).clamp(max=_LARGEST))
    encoded: torch.Tensor = kornia.color.linear_rgb_to_rgb(channels_first(shown))
    return channels_last(encoded).clamp(0.0, 1.0)


def save_render(image: torch.Tensor, path: str | os.PathLike[str], exposure: float | None = None) -> None:
    """Write a render as a PNG of exactly its own width and height.

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.
    path
        Where to write it.
    exposure
        As in ``display_image``.

    Raises
    ------
    SceneCaptumError
        Where the image has another shape, or the file cannot be written.
    """
    from PIL import Image

    pixels = (display_image(image, exposure) * 255).round().to(torch.uint8)
    with whole_file(path) as partial:
        Image.fromarray(pixels.numpy(force=True)).save(partial, format="PNG")


def automatic_exposure(radiance: torch.Tensor) -> float:
    """Return the factor that brings a picture's log-average luminance to middle grey, within limits."""
    luminance = (radiance.double() @ radiance.new_tensor(_LUMINANCE).double()).flatten()
    lit = luminance[luminance > 0]
    if not len(lit):
        return 1.0
    bright = _quantile(lit, _BRIGHT_QUANTILE)
    middle = float(lit[lit >= _SHADOW * bright].log().mean().exp())
    return min(_MIDDLE_GREY / middle, _BRIGHTEST_EXPOSED / bright)


def _quantile(values: torch.Tensor, fraction: float) -> float:
    # torch.quantile refuses pictures of more than 16 million pixels.
    return float(values.kthvalue(max(round(fraction * len(values)), 1)).values)


def _shoulder(radiance: torch.Tensor) -> torch.Tensor:
    """Compress what lies above the knee, with the slope kept there, towards 1."""
    peak = radiance.amax(-1, keepdim=True)
    over = (peak - _KNEE).clamp_min(0) / (1 - _KNEE)
    compressed = _KNEE + (1 - _KNEE) * over / (1 + over)
    return radiance * torch.where(over > 0, compressed / peak.clamp_min(_KNEE), 1.0)
