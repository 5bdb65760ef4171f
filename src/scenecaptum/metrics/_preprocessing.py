"""Preprocessing for networks: resizing, cropping and normalization."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..errors import SceneCaptumError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ResizeCropNormalize(torch.nn.Module):
    """Standard classifier preprocessing: ``(crop(resize(picture)) − mean) / std``.

    The defaults give the same result as torchvision's ``ResNet50_Weights.IMAGENET1K_V2.transforms()``, without
    torchvision. Differentiable.

    Example
    -------
    >>> ResizeCropNormalize()(torch.rand(1, 3, 180, 320)).shape
    torch.Size([1, 3, 224, 224])

    Parameters
    ----------
    resize
        Length in pixels of the shorter side after resizing (antialiased); ``None`` for no resizing.
    crop
        Side in pixels of the square centre crop; ``None`` for no cropping.
    mean, std
        Per channel, of an sRGB picture in [0, 1].
    interpolation
        ``"bilinear"`` or ``"bicubic"``, as used in the network's training.

    Raises
    ------
    SceneCaptumError
        If the interpolation is unknown, or the crop is larger than the picture.
    """

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(
        self,
        resize: int | None = 232,
        crop: int | None = 224,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        interpolation: str = "bilinear",
    ) -> None:
        super().__init__()
        if interpolation not in ("bilinear", "bicubic"):
            raise SceneCaptumError(f"interpolation must be 'bilinear' or 'bicubic', not {interpolation!r}.")
        if resize and crop and crop > resize:
            raise SceneCaptumError(
                f"crop={crop} is larger than the resized picture: it must be at most resize={resize}."
            )
        self.resize = resize
        self.crop = crop
        self.interpolation = interpolation
        self.register_buffer("mean", torch.tensor(mean).reshape(-1, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).reshape(-1, 1, 1), persistent=False)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Return the network's input, ``(N, 3, h, w)``, for pictures ``(N, 3, H, W)`` in [0, 1]."""
        if self.resize is not None:
            picture = self._resize(picture, self.resize)
        if self.crop is not None:
            picture = _centre_crop(picture, self.crop)
        return (picture - self.mean.to(picture)) / self.std.to(picture)

    def _resize(self, picture: torch.Tensor, shorter: int) -> torch.Tensor:
        height, width = picture.shape[-2:]
        shortest = min(height, width)
        # The longer side is rounded down, as in torchvision.
        size = (shorter * height // shortest, shorter * width // shortest)
        return torch.nn.functional.interpolate(
            picture, size=size, mode=self.interpolation, align_corners=False, antialias=True
        )

    def extra_repr(self) -> str:
        """Show the sizes."""
        return f"resize={self.resize}, crop={self.crop}, interpolation={self.interpolation!r}"


def own_preprocessing(model: object, default: torch.nn.Module) -> torch.nn.Module:
    """Return the model's own ``preprocess`` module, such as the shape classifier's, or else ``default``."""
    own = getattr(model, "preprocess", None)
    return own if isinstance(own, torch.nn.Module) else default


def _centre_crop(picture: torch.Tensor, side: int) -> torch.Tensor:
    height, width = picture.shape[-2:]
    if min(height, width) < side:
        raise SceneCaptumError(
            f"A picture of {width} × {height} pixels cannot be cropped to {side} × {side}: give resize= as well."
        )
    top, left = round((height - side) / 2), round((width - side) / 2)
    return picture[..., top : top + side, left : left + side]
