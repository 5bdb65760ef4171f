"""Metrics of daylight that have a name on the command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from ._annual_sunlight_exposure import AnnualSunlightExposure
from ._daylight_autonomy import ContinuousDaylightAutonomy, DaylightAutonomy
from ._daylight_factor import DaylightFactor
from ._daylight_provision import DaylightProvision
from ._metric import DaylightMetric
from ._patches import SkyPatches
from ._sky_matrix import SkyMatrix
from ._spatial_daylight_autonomy import SpatialDaylightAutonomy
from ._total_annual_illumination import TotalAnnualIllumination
from ._useful_daylight_illuminance import UsefulDaylightIlluminance
from ._weather import Weather

# Segments of a path. In the bundled classroom, sDA is 59.4 % with 10 segments, 59.3 % with 20, and 56.9 % with 6.
DEPTH = 10


class NamedDaylightMetric(NamedTuple):
    """A metric of daylight that can be created from a sky alone; ``description`` says what it measures.

    ``light`` is what it is about: ``"year"``, the sun and the sky of every hour, ``"sun"``, direct sunlight alone,
    or ``"overcast"``, the CIE overcast sky, which needs no weather.
    """

    create: Callable[[SkyMatrix], DaylightMetric]
    description: str
    light: Literal["year", "sun", "overcast"] = "year"

    @property
    def subdivision(self) -> int:
        """That of the sky's patches by default: finer for the sun, which patches blur."""
        return 2 if self.direct else 1

    @property
    def needs_weather(self) -> bool:
        """Whether it depends on the weather of a place, and so on where north is."""
        return self.light != "overcast"

    @property
    def direct(self) -> bool:
        """Whether its coefficients are those of direct light alone: ``SceneRenderer(…, direct_sky=True)``."""
        return self.light == "sun"

    def sky(self, weather: Weather, patches: SkyPatches, north: float = 0.0) -> SkyMatrix:
        """Return the sky that it needs; raises as `SkyMatrix.from_weather`."""
        if not self.needs_weather:
            return SkyMatrix.cie_overcast(patches)
        sun: Literal["only", "patches"] = "only" if self.direct else "patches"
        return SkyMatrix.from_weather(weather, patches, sun=sun, north=north)


BY_NAME = {
    "sda": NamedDaylightMetric(SpatialDaylightAutonomy, "spatial daylight autonomy without blinds"),
    "da": NamedDaylightMetric(DaylightAutonomy, "daylight autonomy at 300 lx"),
    "cda": NamedDaylightMetric(ContinuousDaylightAutonomy, "continuous daylight autonomy at 300 lx"),
    "udi": NamedDaylightMetric(UsefulDaylightIlluminance, "hours with a useful illuminance, 300 to 3000 lx"),
    "ase": NamedDaylightMetric(AnnualSunlightExposure, "annual sunlight exposure", light="sun"),
    "annual-illumination": NamedDaylightMetric(TotalAnnualIllumination, "light of the whole year"),
    "daylight-factor": NamedDaylightMetric(DaylightFactor, "under an overcast sky", light="overcast"),
    "en17037": NamedDaylightMetric(DaylightProvision, "daylight provision of EN 17037, minimum level"),
}
