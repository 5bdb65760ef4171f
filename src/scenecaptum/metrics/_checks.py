"""Input checks and conversions shared by the metrics."""

from __future__ import annotations

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ._luminance import luminance


def check_radiance(image: torch.Tensor, camera: Camera | None = None) -> None:
    """Raise if an image has the wrong size, or values that are negative or not finite."""
    if camera is not None and tuple(image.shape[:2]) != (camera.height, camera.width):
        raise SceneCaptumError(
            f"The image is {tuple(image.shape[:2])} (height, width) and the camera "
            f"({camera.height}, {camera.width}); create the camera with the size of the image."
        )
    values = image.detach()
    bad = ~torch.isfinite(values)
    if bad.any():
        raise SceneCaptumError(
            f"The image has {int(bad.sum())} values that are not finite, the first at {_first(bad)}; "
            "a metric needs finite radiance. Check the scene's parameters for NaN."
        )
    if (values < 0).any():
        raise SceneCaptumError(
            f"The image has {int((values < 0).sum())} negative values, the first at {_first(values < 0)} "
            f"(smallest: {values.min().item():.3g}); radiance is never negative. Clamp it, or render it again."
        )


def photometric_luminance(image: torch.Tensor, efficacy: float, camera: Camera | None = None) -> torch.Tensor:
    """Check an image and return its luminance times ``efficacy``, ``(H, W)``.

    In float64, since sums over images with a contrast of 1e14 exceed the precision of float32.
    """
    values = efficacy * luminance(image.double())
    check_radiance(image, camera)
    return values


def _first(mask: torch.Tensor) -> str:
    row, column, channel = mask.nonzero()[0].tolist()
    return f"row {row}, column {column}, channel {channel}"


def cast_like(value: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Cast ``value`` to the dtype of the image, or to float32 if that is wider."""
    return value.to(torch.promote_types(image.dtype, torch.float32))
