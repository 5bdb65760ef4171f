"""Melanopic equivalent daylight illuminance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ..errors import SceneCaptumError
from ..grid import GridPoints
from ..images import LUMINANCE_WEIGHTS
from ._checks import cast_like
from ._grid_metric import GridMetric
from ._measure import Measure
from ._melanopic_spectra import rgb_ratios


class MelanopicEDI(GridMetric):
    """Mean melanopic equivalent daylight illuminance of a sensor grid in lux, an estimate from RGB by default.

    Example
    -------
    >>> MelanopicEDI()(torch.ones(4, 8, 3)).round()     # white light is taken for D65: as many lux
    tensor(179.)
    >>> MelanopicEDI(ratios=0.45)(torch.ones(4, 8, 3))  # a lamp with this ratio on its data sheet
    tensor(80.5500)

    ``MEDI = Σ_c γ_c E_c``: the illuminance of each channel times the melanopic daylight efficacy ratio (DER) of
    its spectrum. At the eye, give the grid points with horizontal normals.

    Parameters
    ----------
    grid
        The points of the renderer, ``renderer.grid``; by default every pixel counts.
    ratios
        The DER γ: one for all light, or ``(red, green, blue)``. One is exact if all light has the same spectrum,
        that of lamps with this ratio in a room whose surfaces reflect all wavelengths alike. Three are exact if
        each channel has been rendered with the light of one spectrum, such as the daylight in one channel and
        the lamps in another. ``melanopic_ratio`` computes them. By default those of three bands of D65, for
        scenes in RGB: see Notes.
    efficacy
        Luminous efficacy in lm/W that converts irradiance to illuminance: 179 as in Radiance.

    Attributes
    ----------
    ratios
        ``(red, green, blue)``.
    caution
        That the value is an estimate from RGB, with the default ratios.

    Raises
    ------
    SceneCaptumError
        If a ratio is negative or not finite, or no point is inside. From ``forward``, if the picture does not
        have the shape of the grid, or has values that are negative or not finite.

    Notes
    -----
    RGB does not determine a spectrum, so the default is an approximation. It takes red, green and blue for three
    parts of the spectrum of D65, cut where they have the luminances of Rec. 709. It is exact for D65, 2 % off for
    the illuminants D55 and E, 6 % low for illuminant A, and wrong by much more for spectra with lines or peaks:
    23 % high for the fluorescent lamp FL12.

    References
    ----------
    CIE S 026:2018, System for metrology of optical radiation for ipRGC-influenced responses to light.
    """

    measure = Measure("melanopic equivalent daylight illuminance", "MEDI", unit="lx")

    def __init__(
        self,
        grid: GridPoints | None = None,
        *,
        ratios: float | Sequence[float] | None = None,
        efficacy: float = 179.0,
    ) -> None:
        super().__init__(grid, efficacy)
        self.ratios = rgb_ratios() if ratios is None else _check_ratios(ratios)
        self.caution = ESTIMATE if ratios is None else None

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the mean over the points of a picture ``(H, W, 3)``, a 0-d tensor."""
        of_channels = self.irradiance(image).mean(0)
        weights = of_channels.new_tensor(LUMINANCE_WEIGHTS) * of_channels.new_tensor(self.ratios)
        return cast_like(self.efficacy * (weights * of_channels).sum(), image)

    def extra_repr(self) -> str:
        """Show the number of points, the efficacy and the ratios."""
        return f"{super().extra_repr()}, ratios=({', '.join(f'{x:.3g}' for x in self.ratios)})"


ESTIMATE = (
    "melanopic EDI is estimated from RGB, which does not determine a spectrum: give MelanopicEDI(ratios=) of the "
    "light sources"
)


def _check_ratios(ratios: float | Sequence[float]) -> tuple[float, float, float]:
    try:
        given = [float(ratios)] * 3 if isinstance(ratios, int | float) else [float(x) for x in ratios]
    except (TypeError, ValueError):
        given = []
    if len(given) != 3 or not all(0 <= x < math.inf for x in given):
        raise SceneCaptumError(
            "ratios must be one melanopic ratio, or those of red, green and blue, finite and not negative, not "
            f"{ratios!r}."
        )
    red, green, blue = given
    return red, green, blue
