"""Position of the sun."""

from __future__ import annotations

import math

import torch


def sun_directions(
    latitude: float, longitude: float, time_zone: float, day: torch.Tensor, hour: torch.Tensor
) -> torch.Tensor:
    """Return unit vectors to the sun, ``(N, 3)`` float64 with x east, y north and z up; z < 0 at night.

    Parameters
    ----------
    latitude, longitude
        In degrees, north and east positive.
    time_zone
        Hours of standard time ahead of UTC.
    day, hour
        ``(N,)``: day of a year of 365 days, from 1, and hour of the day in standard time, with fractions.

    Notes
    -----
    Declination and equation of time are the approximations of the IES Lighting Handbook (1984 reference volume)
    that Radiance's ``gensky`` and ``gendaymtx`` use, without refraction. DAYSIM and old versions of Radiance have
    368 days in the declination instead of 365, and differ by more than half a degree in autumn.
    """
    day, hour = day.double(), hour.double()
    declination = 0.4093 * torch.sin(2 * math.pi / 365 * (day - 81))
    angle = math.pi / 12 * (hour + _equation_of_time(day) + longitude / 15 - time_zone - 12)
    phi = math.radians(latitude)
    toward_equator = torch.cos(declination) * torch.cos(angle)
    return torch.stack(
        [
            -torch.cos(declination) * torch.sin(angle),
            math.cos(phi) * torch.sin(declination) - math.sin(phi) * toward_equator,
            math.sin(phi) * torch.sin(declination) + math.cos(phi) * toward_equator,
        ],
        dim=-1,
    )


def _equation_of_time(day: torch.Tensor) -> torch.Tensor:
    """Return solar minus mean time in hours."""
    return 0.170 * torch.sin(4 * math.pi / 373 * (day - 80)) - 0.129 * torch.sin(
        2 * math.pi / 355 * (day - 8)
    )
