"""What stands between a picture and a network: resizing, cropping and normalisation."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..errors import SceneCaptumError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ResizeCropNormalize(torch.nn.Module):
    """A picture as a classifier was trained to see it: ``(crop(resize(picture)) − mean) / std``.

    The defaults are those of torchvision's ``ResNet50_Weights.IMAGENET1K_V2.transforms()``, to which it is equal
    on the same picture; it needs no torchvision, and it is differentiable.

    Example
    -------
    >>> ResizeCropNormalize()(torch.rand(1, 3, 180, 320)).shape
    torch.Size([1, 3, 224, 224])

    Parameters
    ----------
    resize
        Length in pixels of the shorter side after resizing (antialiased); ``None`` leaves the size alone.
    crop
        Side in pixels of the square cut from the middle; ``None`` keeps all of the picture.
    mean, std
        Per channel, of an sRGB picture in [0, 1].
    interpolation
        ``"bilinear"`` or ``"bicubic"``, as the network's model card says.

    Raises
    ------
    SceneCaptumError
        Where the interpolation is unknown, or the square to be cut is larger than the picture.
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
            raise SceneCaptumError(f"interpolation is 'bilinear' or 'bicubic', not {interpolation!r}.")
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
        """Return what the network takes, ``(N, 3, h, w)``, for ``(N, 3, H, W)`` in [0, 1]."""
        if self.resize is not None:
            picture = self._resized(picture, self.resize)
        if self.crop is not None:
            picture = _middle(picture, self.crop)
        return (picture - self.mean.to(picture)) / self.std.to(picture)

    def _resized(self, picture: torch.Tensor, shorter: int) -> torch.Tensor:
        height, width = picture.shape[-2:]
        least = min(height, width)
        # Whole numbers, rounded down: what torchvision does with the longer side.
        size = (shorter * height // least, shorter * width // least)
        return torch.nn.functional.interpolate(
            picture, size=size, mode=self.interpolation, align_corners=False, antialias=True
        )

    def extra_repr(self) -> str:
        """Show the sizes."""
        return f"resize={self.resize}, crop={self.crop}, interpolation={self.interpolation!r}"


def own_preprocessing(model: object, otherwise: torch.nn.Module) -> torch.nn.Module:
    """Return the ``preprocess`` that a model brings along, such as the shape classifier's, or ``otherwise``."""
    own = getattr(model, "preprocess", None)
    return own if isinstance(own, torch.nn.Module) else otherwise


def _middle(picture: torch.Tensor, side: int) -> torch.Tensor:
    height, width = picture.shape[-2:]
    if min(height, width) < side:
        raise SceneCaptumError(
            f"A square of {side} pixels cannot be cut from a picture of {width} × {height}: give resize= as well."
        )
    top, left = round((height - side) / 2), round((width - side) / 2)
    return picture[..., top : top + side, left : left + side]
