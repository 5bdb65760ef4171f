"""Write the synthetic weather of ``scenecaptum.daylight.synthetic_weather``: a made-up year at 48° N.

    python scripts/synthetic_weather.py FILE.epw[.gz]

That of the package is ``src/scenecaptum/daylight/synthetic.epw.gz``.

Irradiance from the altitude γ of the sun and the cloudiness N (0 to 1), after Kasten and Czeplak, "Solar and
terrestrial radiation dependent on the amount and type of cloud", Solar Energy 24, 1980:

    global horizontal     G = (910 sin γ − 30) (1 − 0.75 N^3.4) W/m²
    diffuse horizontal    D = G (0.3 + 0.7 N²)
    direct normal         (G − D) / sin γ

Cloudiness is Φ(x), the normal distribution function of a random process with a correlation time of 18 hours, more
often clear in summer. All other columns have the codes of EPW files for missing values.
"""

from __future__ import annotations

import argparse
import calendar
import gzip
import math
from pathlib import Path

import numpy as np
import torch

from scenecaptum.daylight import sun_directions
from scenecaptum.errors import SceneCaptumError
from scenecaptum.files import atomic_write

LATITUDE, LONGITUDE, TIME_ZONE, ELEVATION = 48.0, 11.0, 1.0, 500.0
SEED = 1
CORRELATION_HOURS = 18.0

HEADER = (
    f"LOCATION,SYNTHETIC,-,made up,scenecaptum,0,{LATITUDE:.2f},{LONGITUDE:.2f},{TIME_ZONE:.1f},{ELEVATION:.1f}",
    "DESIGN CONDITIONS,0",
    "TYPICAL/EXTREME PERIODS,0",
    "GROUND TEMPERATURES,0",
    "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
    "COMMENTS 1,Synthetic weather of no real place: not measured and not for the design of buildings",
    "COMMENTS 2,Written by scripts/synthetic_weather.py of scenecaptum",
    "DATA PERIODS,1,1,Data,Sunday,1/1,12/31",
)
SOURCES = "?9" * 8
BEFORE = "99.9,99.9,999,999999,9999,9999,9999"  # dry bulb to infrared radiation
AFTER = "999999,999999,999999,9999,999,999,99,99,9999,99999,9,999999999,999,.999,999,99,999,999,99"


def cloudiness(generator: np.random.Generator, day: np.ndarray) -> np.ndarray:
    """Return the cloudiness in hours of the year, from 0 to 1."""
    keep = math.exp(-1 / CORRELATION_HOURS)
    noise = generator.standard_normal(len(day))
    process = np.empty(len(day))
    value = 0.0
    for hour, one in enumerate(noise):
        process[hour] = value = keep * value + math.sqrt(1 - keep**2) * one
    winter = np.cos(2 * math.pi * (day - 10) / 365)
    return np.array([0.5 * (1 + math.erf(x / math.sqrt(2))) for x in 1.2 * process + 0.6 + 0.4 * winter])


def irradiances(sine: np.ndarray, clouds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return global horizontal, direct normal and diffuse horizontal irradiance in W/m²."""
    total = np.maximum(910 * sine - 30, 0) * (1 - 0.75 * clouds**3.4)
    diffuse = total * (0.3 + 0.7 * clouds**2)
    direct = np.where(total > 0, (total - diffuse) / np.maximum(sine, 1e-3), 0)
    return total, direct, diffuse


def rows() -> list[str]:
    """Return the rows of the file."""
    dates = [
        (month, day, hour)
        for month in range(1, 13)
        for day in range(1, calendar.monthrange(2001, month)[1] + 1)
        for hour in range(1, 25)
    ]
    day = np.arange(len(dates)) // 24 + 1
    middle = np.array([hour for *_, hour in dates]) - 0.5
    sun = sun_directions(LATITUDE, LONGITUDE, TIME_ZONE, torch.from_numpy(day), torch.from_numpy(middle))
    clouds = cloudiness(np.random.default_rng(SEED), day)
    columns = zip(dates, *irradiances(sun[:, 2].numpy(), clouds), strict=True)
    return [
        f"2001,{month},{date},{hour},60,{SOURCES},{BEFORE},{total:.0f},{direct:.0f},{diffuse:.0f},{AFTER}"
        for (month, date, hour), total, direct, diffuse in columns
    ]


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="the EPW file to write, compressed if its name ends in .gz")
    path = parser.parse_args().file
    text = ("\n".join([*HEADER, *rows()]) + "\n").encode()
    try:
        with atomic_write(path) as partial:
            partial.write_bytes(gzip.compress(text, mtime=0) if path.suffix == ".gz" else text)
    except SceneCaptumError as error:
        parser.error(str(error))
    print(path)


if __name__ == "__main__":
    main()
