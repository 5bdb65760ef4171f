"""A year of weather from an EPW file."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass

import torch

from ..errors import SceneCaptumError, whole_number
from ._epw import HOURS_OF_YEAR, read_epw
from ._sun import sun_directions

_DAYS_BEFORE_MONTH = (0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334)
_DAYLIGHT_HOURS = HOURS_OF_YEAR // 2  # EN 17037


@dataclass(frozen=True, eq=False)
class Weather:
    """Irradiance of sun and sky in the hours of a year, and the place.

    Example
    -------
    >>> from scenecaptum.daylight import synthetic_weather
    >>> weather = synthetic_weather()
    >>> weather
    Weather('SYNTHETIC, made up', latitude=48, longitude=11, 8760 hours)
    >>> weather.occupied().sum()
    tensor(3650)

    Attributes
    ----------
    place
        Name of the place.
    latitude, longitude
        In degrees, north and east positive.
    time_zone
        Hours of local standard time ahead of UTC.
    elevation
        Above sea level, in meters.
    month, day, hour
        ``(hours,)`` int64. As in EPW files, hour 1 ends at 01:00 in local standard time.
    direct_normal
        ``(hours,)`` float64: mean irradiance by the sun in W/m², perpendicular to its rays.
    diffuse_horizontal
        ``(hours,)`` float64: mean irradiance of a horizontal surface by the sky without the sun, in W/m².
    """

    place: str
    latitude: float
    longitude: float
    time_zone: float
    elevation: float
    month: torch.Tensor
    day: torch.Tensor
    hour: torch.Tensor
    direct_normal: torch.Tensor
    diffuse_horizontal: torch.Tensor

    @classmethod
    def from_epw(cls, path: str | os.PathLike[str]) -> Weather:
        """Read an EnergyPlus weather file (``.epw``, or compressed ``.epw.gz``).

        The rows of 29 February, if there are any, are left out: a year has 8760 hours.

        Raises
        ------
        SceneCaptumError
            If the file cannot be read, has no ``LOCATION`` or ``DATA PERIODS``, does not have one row for each
            hour of a year in order, or an irradiance that is missing (9999), negative or not a number.
        """
        return cls(**read_epw(path))

    def __len__(self) -> int:
        return len(self.hour)

    def select(self, mask: torch.Tensor) -> Weather:
        """Return the weather of the hours of a ``(hours,)`` bool mask."""
        check_mask(mask, len(self))
        names = ("month", "day", "hour", "direct_normal", "diffuse_horizontal")
        return dataclasses.replace(self, **{name: getattr(self, name)[mask] for name in names})

    def occupied(self, first: int = 8, last: int = 18) -> torch.Tensor:
        """Return which hours are between two times of every day, ``(hours,)`` bool.

        The default, 8 am to 6 pm, is the period of IES LM-83: 3650 hours, with weekends. LM-83 means clock time;
        these are hours of standard time: daylight saving time is not applied.

        Parameters
        ----------
        first, last
            Start and end in hours of the day.

        Raises
        ------
        SceneCaptumError
            If the times are not whole hours from 0 to 24, the first before the last.
        """
        first = whole_number("first", first, 0, 23)
        last = whole_number("last", last, first + 1, 24)
        return (self.hour > first) & (self.hour <= last)

    def daylight(self) -> torch.Tensor:
        """Return which hours are the daylight hours of EN 17037, ``(8760,)`` bool.

        They are the half of the year with the highest diffuse horizontal illuminance, 4380 hours; here those of
        the highest diffuse horizontal irradiance, the earliest of those with equal values.

        Raises
        ------
        SceneCaptumError
            If these are not the hours of a whole year.
        """
        if len(self) != HOURS_OF_YEAR:
            raise SceneCaptumError(
                f"The daylight hours of EN 17037 are half of the {HOURS_OF_YEAR} hours of a year, and this "
                f"weather has {len(self)}: use the whole year, or give a mask."
            )
        mask = torch.zeros(len(self), dtype=torch.bool)
        mask[self.diffuse_horizontal.sort(descending=True, stable=True).indices[:_DAYLIGHT_HOURS]] = True
        return mask

    def sun_directions(self) -> torch.Tensor:
        """Return unit vectors to the sun in the middle of each hour, ``(hours, 3)`` float64; z < 0 at night.

        x is east, y north and z up. The positions are those of Radiance's ``gendaymtx``.
        """
        day = torch.tensor(_DAYS_BEFORE_MONTH)[self.month - 1] + self.day
        return sun_directions(self.latitude, self.longitude, self.time_zone, day, self.hour - 0.5)

    def to_wea(self) -> str:
        """Return the weather in DAYSIM's format, which ``gendaymtx`` reads."""
        lines = [
            f"place {self.place}",
            f"latitude {self.latitude:.10g}",
            f"longitude {-self.longitude:.10g}",  # this format counts to the west
            f"time_zone {-15 * self.time_zone:.10g}",
            f"site_elevation {self.elevation:.10g}",
            "weather_data_file_units 1",
        ]
        columns = (self.month, self.day, self.hour, self.direct_normal, self.diffuse_horizontal)
        for month, day, hour, direct, diffuse in zip(*(column.tolist() for column in columns), strict=True):
            lines.append(f"{month} {day} {hour - 0.5:.3f} {direct:.10g} {diffuse:.10g}")
        return "\n".join(lines) + "\n"

    def __repr__(self) -> str:
        return (
            f"Weather({self.place!r}, latitude={self.latitude:g}, longitude={self.longitude:g}, "
            f"{len(self)} hours)"
        )


def check_mask(mask: torch.Tensor, hours: int) -> None:
    """Raise if a mask of hours has another type or length, or selects none."""
    if mask.dtype != torch.bool or tuple(mask.shape) != (hours,):
        raise SceneCaptumError(
            f"A mask of hours must be a bool tensor of shape ({hours},), not {mask.dtype} "
            f"of shape {tuple(mask.shape)}."
        )
    if not mask.any():
        raise SceneCaptumError("The mask selects no hour.")
