"""Illuminance from daylight coefficients."""

from __future__ import annotations

import torch

from ..errors import SceneCaptumError
from ..images import LUMINANCE_WEIGHTS
from ._sky_matrix import EFFICACY, SkyMatrix


def illuminance(coefficients: torch.Tensor, sky: SkyMatrix) -> torch.Tensor:
    """Return the illuminance of each point in each hour, ``179 Σ_p Σ_c w_c C[i, p, c] S[p, h, c]``.

    Example
    -------
    >>> sky = SkyMatrix.uniform(horizontal_illuminance=5000.0)
    >>> outdoors = sky.patches.projected_solid_angles.float()[None, :, None].expand(1, -1, 3)
    >>> illuminance(outdoors, sky).round()
    tensor([[5000.]])

    Parameters
    ----------
    coefficients
        ``(points, P, 3)``: irradiance at each point in W/m² per unit radiance of each patch of the sky.
    sky
        Radiance of the patches.

    Returns
    -------
    Tensor
        ``(points, hours)`` in lx, differentiable with respect to the coefficients and of their dtype.

    Raises
    ------
    SceneCaptumError
        If the coefficients have another shape, or values that are negative or not finite.

    References
    ----------
    Tregenza and Waters, "Daylight coefficients", 1983.
    """
    _check(coefficients, sky)
    # One channel at a time: no intermediate result is larger than one channel of the sky, or than the result.
    per_channel = (
        (weight * EFFICACY * coefficients[..., channel]) @ sky.radiance[..., channel].to(coefficients)
        for channel, weight in enumerate(LUMINANCE_WEIGHTS)
    )
    total = next(per_channel)
    for one in per_channel:
        total = total + one
    return total


def _check(coefficients: torch.Tensor, sky: SkyMatrix) -> None:
    shape = tuple(coefficients.shape)
    if len(shape) != 3 or shape[0] == 0 or shape[1:] != (sky.patches.count, 3):
        raise SceneCaptumError(
            f"Daylight coefficients for this sky have shape (points, {sky.patches.count}, 3), not {shape}; "
            "use the same patches for both."
        )
    values = coefficients.detach()
    if not (torch.isfinite(values).all() and (values >= 0).all()):
        raise SceneCaptumError(
            "The daylight coefficients have values that are negative or not finite; check the scene's parameters."
        )
