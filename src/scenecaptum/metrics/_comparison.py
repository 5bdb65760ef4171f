"""Comparison of a render with a reference image."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ._measure import Measure
from ._picture import check_exposure, check_reference, check_same_shape, srgb_picture


class MeanSquaredError(torch.nn.Module):
    """Mean squared error to a reference in linear radiance, ``mean((L − L_ref)²)``.

    Example
    -------
    >>> MeanSquaredError(torch.zeros(4, 8, 3))(torch.full((4, 8, 3), 0.5))
    tensor(0.2500)

    Parameters
    ----------
    reference
        ``(H, W, 3)`` linear radiance.

    Raises
    ------
    SceneCaptumError
        If the reference is not a finite image or, from ``forward``, the image has another size.

    Notes
    -----
    In squared units of radiance, and dominated by bright pixels. Render noise adds its variance to the mean; use
    more samples where that matters.
    """

    measure = Measure("mean squared error", better="lower")
    reference: torch.Tensor

    def __init__(self, reference: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("reference", check_reference(reference))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the error of an ``(H, W, 3)`` image, a 0-d tensor; 0 for identical images."""
        check_same_shape(image, self.reference)
        return (image - self.reference.to(image)).square().mean()

    def extra_repr(self) -> str:
        """Show the reference's size."""
        return f"reference={tuple(self.reference.shape)}"


class StructuralSimilarity(torch.nn.Module):
    """Mean structural similarity (SSIM) to a reference, of the sRGB pictures; 1 for identical images.

    ``(2 μ_x μ_y + c₁)(2 σ_xy + c₂) / ((μ_x² + μ_y² + c₁)(σ_x² + σ_y² + c₂))`` with ``c₁ = 0.01²`` and
    ``c₂ = 0.03²``, in a Gaussian window of σ = 1.5 pixels around every pixel, averaged over pixels and channels.

    Example
    -------
    >>> image = torch.rand(16, 16, 3)
    >>> StructuralSimilarity(image)(image)
    tensor(1.)

    Parameters
    ----------
    reference
        ``(H, W, 3)`` linear radiance.
    exposure
        Factor on radiance before it is clipped at white and encoded as sRGB.
    window
        Width of the window in pixels, odd.

    Raises
    ------
    SceneCaptumError
        If a setting does not fit the reference or, from ``forward``, the image has another size or values that are
        negative or not finite.

    References
    ----------
    Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", 2004; computed by
    kornia.
    """

    measure = Measure("structural similarity", "SSIM", better="higher")
    reference: torch.Tensor

    def __init__(self, reference: torch.Tensor, *, exposure: float = 1.0, window: int = 11) -> None:
        super().__init__()
        if window < 3 or window % 2 == 0:
            raise SceneCaptumError(f"window must be an odd number of pixels, 3 or more, not {window!r}.")
        if min(reference.shape[:2]) <= window // 2:
            raise SceneCaptumError(
                f"A window of {window} pixels needs images of more than {window // 2} pixels on each side; the "
                f"reference is {tuple(reference.shape)}. Choose a smaller window= or a higher resolution."
            )
        self.exposure = check_exposure(exposure)
        self.window = window
        self.register_buffer("reference", check_reference(reference))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the similarity of an ``(H, W, 3)`` image, a 0-d tensor in [−1, 1]."""
        from kornia.metrics import ssim

        check_same_shape(image, self.reference)
        picture = srgb_picture(image, self.exposure)
        reference = srgb_picture(self.reference.to(image), self.exposure)
        # c₁c₂ > 0 keeps the quotient finite; with kornia's extra eps the SSIM of identical black images is not 1.
        similarity: torch.Tensor = ssim(picture, reference, self.window, eps=0.0).mean()
        return similarity

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"exposure={self.exposure:g}, window={self.window}, reference={tuple(self.reference.shape)}"
