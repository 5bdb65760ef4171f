"""Daylight over a year: sky patches, weather, sky matrices, and metrics of daylight coefficients.

Pure torch. A renderer delivers daylight coefficients ``(points, P, 3)``, the irradiance at each point per unit
radiance of each sky patch; everything else follows from them.
"""

# What users see; the other names are for the rooms above.
__all__ = [
    "AnnualSunlightExposure",
    "ContinuousDaylightAutonomy",
    "DaylightAutonomy",
    "DaylightFactor",
    "DaylightMetric",
    "DaylightProvision",
    "PatchRows",
    "PlanValues",
    "SkyMatrix",
    "SkyPatches",
    "SpatialDaylightAutonomy",
    "TotalAnnualIllumination",
    "UsefulDaylightIlluminance",
    "Weather",
    "illuminance",
    "synthetic_weather",
]

from ._annual_sunlight_exposure import AnnualSunlightExposure as AnnualSunlightExposure
from ._daylight_autonomy import ContinuousDaylightAutonomy as ContinuousDaylightAutonomy
from ._daylight_autonomy import DaylightAutonomy as DaylightAutonomy
from ._daylight_factor import DaylightFactor as DaylightFactor
from ._daylight_provision import DaylightProvision as DaylightProvision
from ._illuminance import illuminance as illuminance
from ._metric import DaylightMetric as DaylightMetric
from ._metric import PointMetric as PointMetric
from ._named import BY_NAME as BY_NAME
from ._named import DEPTH as DEPTH
from ._named import NamedDaylightMetric as NamedDaylightMetric
from ._patches import PatchRows as PatchRows
from ._patches import SkyPatches as SkyPatches
from ._plan_values import PlanValues as PlanValues
from ._sky_matrix import EFFICACY as EFFICACY
from ._sky_matrix import SkyMatrix as SkyMatrix
from ._spatial_daylight_autonomy import SpatialDaylightAutonomy as SpatialDaylightAutonomy
from ._sun import sun_directions as sun_directions
from ._synthetic import synthetic_weather as synthetic_weather
from ._total_annual_illumination import TotalAnnualIllumination as TotalAnnualIllumination
from ._useful_daylight_illuminance import UsefulDaylightIlluminance as UsefulDaylightIlluminance
from ._weather import Weather as Weather
