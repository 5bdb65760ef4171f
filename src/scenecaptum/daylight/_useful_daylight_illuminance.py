"""Useful daylight illuminance."""

from __future__ import annotations

from typing import Literal

import torch

from ..errors import SceneCaptumError
from ..metrics import Measure
from ._checks import choice, positive
from ._metric import RELAXATION, Hours, PointMetric, mean_over_hours
from ._sky_matrix import SkyMatrix
from ._step import step

UDIBand = Literal["fell-short", "supplementary", "autonomous", "exceeded"]

_BETTER: dict[str, Literal["lower", "higher"] | None] = {
    "fell-short": "lower",
    "supplementary": None,
    "autonomous": "higher",
    "exceeded": "lower",
}


class UsefulDaylightIlluminance(PointMetric):
    """Useful daylight illuminance in %: share of the hours in a band of illuminance, as the mean over the points.

    Parameters
    ----------
    sky, during, relaxation
        See `DaylightMetric`.
    band
        ``"fell-short"``: below 100 lx; ``"supplementary"``: from 100 lx to below 300 lx; ``"autonomous"``: from
        300 lx to 3000 lx; ``"exceeded"``: above 3000 lx. The four shares add up to 100 %.
    limits
        The three limits in lx, ascending.

    Raises
    ------
    SceneCaptumError
        If the band is unknown, or the limits are not three ascending numbers above 0.

    References
    ----------
    Nabil and Mardaljevic, "Useful daylight illuminance: a new paradigm for assessing daylight in buildings", 2005,
    with the limits of Mardaljevic, Andersen, Roy and Christoffersen, "Daylighting metrics: is there a relation
    between useful daylight illuminance and daylight glare probability?", 2012 (3000 lx instead of 2000 lx).
    """

    def __init__(
        self,
        sky: SkyMatrix,
        band: UDIBand = "autonomous",
        limits: tuple[float, float, float] = (100.0, 300.0, 3000.0),
        *,
        during: Hours = "occupied",
        relaxation: float = RELAXATION,
    ) -> None:
        super().__init__(sky, during=during, relaxation=relaxation)
        self.band = choice("band", band, tuple(_BETTER))
        self.limits = tuple(positive("limits", limit) for limit in limits)
        if len(self.limits) != 3 or list(self.limits) != sorted(set(self.limits)):
            raise SceneCaptumError(f"limits must be three ascending illuminances in lx, not {limits!r}.")

    @property
    def measure(self) -> Measure:
        """Name, unit and direction."""
        return Measure(
            f"useful daylight illuminance, {self.band}",
            "UDI",
            unit="%",
            better=_BETTER[self.band],
            definition=f"share of the {self._period_in_full} with {self._lux()}, mean over the points",
        )

    def _map_name(self) -> str:
        return f"{self.period} with {self._lux()}"

    def _lux(self) -> str:
        low, middle, high = self.limits
        return {
            "fell-short": f"less than {low:g} lx",
            "supplementary": f"{low:g} lx to less than {middle:g} lx",
            "autonomous": f"{middle:g} to {high:g} lx",
            "exceeded": f"more than {high:g} lx",
        }[self.band]

    def _of_points(self, values: torch.Tensor, relaxation: float) -> torch.Tensor:
        low, middle, high = self.limits
        if self.band == "fell-short":
            counts = 1 - step(values, low, relaxation)
        elif self.band == "supplementary":
            counts = step(values, low, relaxation) - step(values, middle, relaxation)
        elif self.band == "autonomous":
            counts = step(values, middle, relaxation) - step(values, high, relaxation, exclusive=True)
        else:
            counts = step(values, high, relaxation, exclusive=True)
        return 100 * mean_over_hours(counts)

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"{super().extra_repr()}, band={self.band!r}, limits={self.limits}"
