"""Melanopic ratios of spectra, and of the channels of a render."""

from __future__ import annotations

from functools import cache

import torch

from ..errors import SceneCaptumError
from ..images import LUMINANCE_WEIGHTS

# From 380 to 780 nm in steps of 10 nm: the luminous efficiency V(λ) (CIE 018), the melanopic action spectrum
# s_mel(λ) (CIE S 026) and the illuminant D65 (CIE 015).
_FIRST, _STEP = 380.0, 10.0
_PHOTOPIC = """
    3.9e-5 1.2e-4 3.96e-4 0.00121 0.004 0.0116 0.023 0.038 0.06 0.09098 0.13902 0.20802 0.323 0.503 0.71
    0.862 0.954 0.99495 0.995 0.952 0.87 0.757 0.631 0.503 0.381 0.265 0.175 0.107 0.061 0.032 0.017
    0.00821 0.004102 0.002091 0.001047 5.2e-4 2.492e-4 1.2e-4 6e-5 3e-5 1.499e-5"""
_MELANOPIC = """
    9.182e-4 0.003094 0.01143 0.04616 0.1372 0.2539 0.4016 0.5537 0.708 0.8603 0.9656 1.0 0.966 0.8629
    0.6996 0.5193 0.3517 0.2157 0.1185 0.0587 0.02687 0.01179 0.005067 0.002177 9.473e-4 4.18e-4 1.883e-4
    8.658e-5 4.069e-5 1.955e-5 9.576e-6 4.788e-6 2.438e-6 1.266e-6 6.69e-7 3.598e-7 1.967e-7 1.093e-7
    6.167e-8 3.533e-8 2.053e-8"""
_D65 = """
    49.98 54.65 82.75 91.49 93.43 86.68 104.9 117.0 117.8 114.9 115.9 108.8 109.4 107.8 104.8 107.7 104.4
    104.0 100.0 96.33 95.79 88.69 90.01 89.6 87.7 83.29 83.7 80.03 80.21 82.28 78.28 69.72 71.61 74.35
    61.6 69.89 75.09 63.59 46.42 66.81 63.38"""


def melanopic_ratio(wavelengths: torch.Tensor, power: torch.Tensor) -> float:
    """Return the melanopic daylight efficacy ratio (DER) of a spectrum: 1 for D65, lower for warm light.

    Melanopic equivalent daylight illuminance is this ratio times illuminance.

    Example
    -------
    >>> wavelengths = torch.arange(380.0, 781.0, 5.0)
    >>> round(melanopic_ratio(wavelengths, torch.ones(81)), 2)      # CIE illuminant E: 0.906
    0.91

    Parameters
    ----------
    wavelengths
        ``(N,)`` in nm, ascending.
    power
        ``(N,)``: spectral power, in any unit; it is interpolated linearly, and 0 outside the wavelengths.

    Raises
    ------
    SceneCaptumError
        If the tensors do not fit together, the wavelengths do not ascend, a power is negative or not finite, or
        the spectrum has no light.

    Notes
    -----
    ``∫ Φ s_mel / ∫ Φ V`` over that of D65, in steps of 1 nm between tables in steps of 10 nm, which is within
    0.1 % of the ratios 0.496 of illuminant A and 0.906 of illuminant E.

    References
    ----------
    CIE S 026:2018, System for metrology of optical radiation for ipRGC-influenced responses to light.
    """
    wavelengths, power = wavelengths.detach().cpu().double(), power.detach().cpu().double()
    if wavelengths.ndim != 1 or wavelengths.shape != power.shape or len(power) < 2:
        raise SceneCaptumError(
            "A spectrum is two tensors (N,) of at least 2 wavelengths and powers, not "
            f"{tuple(wavelengths.shape)} and {tuple(power.shape)}."
        )
    if not (wavelengths.diff() > 0).all():
        raise SceneCaptumError("The wavelengths of a spectrum must ascend, in nm.")
    if not (power.isfinite() & (power >= 0)).all():
        raise SceneCaptumError("The powers of a spectrum must be finite and not negative.")
    nanometres, photopic, melanopic, daylight = _tables()
    spectrum = _interpolate(nanometres, wavelengths, power)
    if not (spectrum * photopic).sum() > 0:
        raise SceneCaptumError("The spectrum has no light between 380 and 780 nm: are its wavelengths in nm?")
    return float(_share(spectrum, melanopic, photopic) / _share(daylight, melanopic, photopic))


@cache
def rgb_ratios() -> tuple[float, float, float]:
    """Return the ratios of red, green and blue if their spectra are three bands of D65 with their luminances.

    The spectrum of D65 is cut in three at the wavelengths where its light divides into the luminances of blue,
    green and red of Rec. 709. White is then exactly D65, with a ratio of 1.
    """
    nanometres, photopic, _, daylight = _tables()
    light = daylight * photopic
    red, _, blue = LUMINANCE_WEIGHTS
    below = [_part_below(light, share) for share in (blue, 1 - red)]
    bands = (1 - below[1], below[1] - below[0], below[0])
    of_red, of_green, of_blue = (melanopic_ratio(nanometres, daylight * band) for band in bands)
    return of_red, of_green, of_blue


def _part_below(light: torch.Tensor, share: float) -> torch.Tensor:
    """Return the part of each step of a spectrum that is among the first ``share`` of its light."""
    total = light.cumsum(0)
    return ((share * total[-1] - total + light) / light).clamp(0, 1)


def _tables() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return wavelengths, V, s_mel and D65 in steps of 1 nm."""
    rows = [torch.tensor([float(x) for x in text.split()]).double() for text in (_PHOTOPIC, _MELANOPIC, _D65)]
    known = _FIRST + _STEP * torch.arange(len(rows[0]), dtype=torch.float64)
    nanometres = torch.arange(_FIRST, float(known[-1]) + 0.5, dtype=torch.float64)
    photopic, melanopic, daylight = (_interpolate(nanometres, known, row) for row in rows)
    return nanometres, photopic, melanopic, daylight


def _interpolate(at: torch.Tensor, known: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Interpolate linearly; 0 outside."""
    index = torch.searchsorted(known, at).clamp(1, len(known) - 1)
    low, high = known[index - 1], known[index]
    share = (at - low) / (high - low)
    found = values[index - 1] * (1 - share) + values[index] * share
    return torch.where((at < known[0]) | (at > known[-1]), 0.0, found)


def _share(spectrum: torch.Tensor, melanopic: torch.Tensor, photopic: torch.Tensor) -> torch.Tensor:
    return (spectrum * melanopic).sum() / (spectrum * photopic).sum()
