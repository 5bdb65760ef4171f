"""Vertical illuminance at the eye."""

from __future__ import annotations

import torch

from ..camera import Camera
from ._checks import cast_like, photometric_luminance
from ._measure import Measure


class VerticalIlluminance(torch.nn.Module):
    """Vertical illuminance at the eye in lux, ``Ev = Σ L ω cos θ`` over the pixels in front of the camera.

    Example
    -------
    >>> VerticalIlluminance(Camera.fisheye(64, 64), efficacy=1.0)(torch.ones(64, 64, 3)).round(decimals=2)
    tensor(3.1400)

    Parameters
    ----------
    camera
        The camera of the image. A field of view below the hemisphere gives only the illuminance from within it.
    efficacy
        Luminous efficacy in lm/W that converts radiance to luminance: 179 as in Radiance.

    Raises
    ------
    SceneCaptumError
        From ``forward``, if a value is negative or not finite, or the image does not have the size of the camera.

    Notes
    -----
    L is the luminance of a pixel, ω its solid angle and θ its angle from the line of sight: the definition of
    illuminance (CIE S 017), on a plane perpendicular to the line of sight.
    """

    measure = Measure("vertical illuminance", unit="lx")
    projected: torch.Tensor

    def __init__(self, camera: Camera, efficacy: float = 179.0) -> None:
        super().__init__()
        self.camera, self.efficacy = camera, efficacy
        self.register_buffer("projected", projected_solid_angles(camera), persistent=False)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the illuminance from an ``(H, W, 3)`` linear-radiance image, a 0-d tensor."""
        values = photometric_luminance(image, self.efficacy, self.camera)
        return cast_like((self.projected.to(values) * values).sum(), image)

    def extra_repr(self) -> str:
        """Show the camera and the efficacy."""
        return f"{self.camera!r}, efficacy={self.efficacy:g}"


def projected_solid_angles(camera: Camera) -> torch.Tensor:
    """Return ``ω cos θ`` of each pixel, ``(H, W)``; 0 behind the camera."""
    return camera.solid_angles * camera.directions[..., 2].clamp(min=0)
