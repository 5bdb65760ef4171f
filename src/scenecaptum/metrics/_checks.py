"""What a metric asks of a picture before it measures it."""

from __future__ import annotations

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ._luminance import luminance


def check_radiance(image: torch.Tensor, camera: Camera | None = None) -> None:
    """Say what is wrong with a picture: its size, a value that is not finite, or a negative one."""
    if camera is not None and tuple(image.shape[:2]) != (camera.height, camera.width):
        raise SceneCaptumError(
            f"The image is {tuple(image.shape[:2])} (height, width) and the camera "
            f"({camera.height}, {camera.width}); make the camera with the size of the image."
        )
    values = image.detach()
    bad = ~torch.isfinite(values)
    if bad.any():
        raise SceneCaptumError(
            f"The image has {int(bad.sum())} values that are not finite, the first at {_place(bad)}; "
            "a metric needs finite radiance. Look for NaN in the scene's parameters."
        )
    if (values < 0).any():
        raise SceneCaptumError(
            f"The image has {int((values < 0).sum())} negative values, the first at {_place(values < 0)} "
            f"(smallest: {values.min().item():.3g}); radiance is never negative. Clamp it, or render it again."
        )


def photopic(image: torch.Tensor, efficacy: float, camera: Camera | None = None) -> torch.Tensor:
    """Return the luminance of a checked picture times ``efficacy``: ``(H, W)``, float64.

    A sum over a picture whose contrast is 1e14 needs the digits of float64.
    """
    values = efficacy * luminance(image.double())
    check_radiance(image, camera)
    return values


def _place(where: torch.Tensor) -> str:
    row, column, channel = where.nonzero()[0].tolist()
    return f"row {row}, column {column}, channel {channel}"


def like_input(value: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Return ``value`` in the picture's own floating-point type, or float32 where that is narrower."""
    return value.to(torch.promote_types(image.dtype, torch.float32))
