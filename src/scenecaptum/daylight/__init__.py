"""Daylight over a year: sky patches, weather, sky matrices, and metrics of daylight coefficients.

Pure torch. A renderer delivers daylight coefficients ``(points, P, 3)``, the irradiance at each point per unit
radiance of each sky patch; everything else follows from them.
"""

from ._illuminance import illuminance as illuminance
from ._patches import PatchRows as PatchRows
from ._patches import SkyPatches as SkyPatches
from ._sky_matrix import EFFICACY as EFFICACY
from ._sky_matrix import SkyMatrix as SkyMatrix
from ._sun import sun_directions as sun_directions
from ._synthetic import synthetic_weather as synthetic_weather
from ._weather import Weather as Weather
