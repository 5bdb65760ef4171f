"""Reading of EnergyPlus weather files."""

from __future__ import annotations

import calendar
import gzip
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from ..errors import SceneCaptumError

HOURS_OF_YEAR = 8760

_LOCATION_FIELDS = 10
_DIRECT_NORMAL, _DIFFUSE_HORIZONTAL = 14, 15  # positions in a row, counted from 0
_MISSING = 9999.0
_GZIP = b"\x1f\x8b"  # how a compressed file begins, whatever its name


def read_epw(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the fields of ``Weather`` from an EPW file; raise ``SceneCaptumError`` if it is not valid."""
    path = Path(path)
    lines = _lines(path)
    location = _location(path, lines)
    rows = [row for row in _rows(path, lines) if row[:2] != (2, 29)]
    _check_calendar(path, rows)
    month, day, hour, direct, diffuse = (torch.tensor(column) for column in zip(*rows, strict=True))
    return {
        **location,
        "month": month,
        "day": day,
        "hour": hour,
        "direct_normal": direct.double(),
        "diffuse_horizontal": diffuse.double(),
    }


def _lines(path: Path) -> list[str]:
    try:
        data = path.read_bytes()
        if data.startswith(_GZIP):
            data = gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneCaptumError(f"{path} cannot be read: {reason}. Give an EPW file.") from error
    return data.decode("utf-8", errors="replace").splitlines()


def _location(path: Path, lines: list[str]) -> dict[str, Any]:
    fields = lines[0].split(",") if lines else []
    if not fields or fields[0].strip().upper() != "LOCATION" or len(fields) < _LOCATION_FIELDS:
        raise SceneCaptumError(
            f"{path} is not an EPW file: line 1 must be LOCATION with city, region, country, source, number, "
            "latitude, longitude, time zone and elevation."
        )
    names = ("latitude", "longitude", "time_zone", "elevation")
    limits = (90.0, 180.0, 14.0, 10_000.0)
    numbers = {
        name: _number(path, 1, name, text, -limit, limit)
        for name, text, limit in zip(names, fields[6:10], limits, strict=True)
    }
    return {"place": ", ".join(text.strip() for text in fields[1:4:2] if text.strip()), **numbers}


def _rows(path: Path, lines: list[str]) -> Iterator[tuple[int, int, int, float, float]]:
    """Yield month, day, hour, direct normal and diffuse horizontal irradiance of each row."""
    heads = [number for number, line in enumerate(lines) if line.upper().startswith("DATA PERIODS")]
    if not heads:
        raise SceneCaptumError(f"{path} has no line DATA PERIODS, which ends the header of an EPW file.")
    for number, line in enumerate(lines[heads[0] + 1 :], start=heads[0] + 2):
        if not line.strip():
            continue
        fields = line.split(",")
        if len(fields) <= _DIFFUSE_HORIZONTAL:
            raise SceneCaptumError(
                f"{path}, line {number}: {len(fields)} columns, expected 35 as in an EPW file, of which column "
                f"{_DIFFUSE_HORIZONTAL + 1} is the diffuse horizontal irradiance."
            )
        date = [
            int(_number(path, number, name, fields[place], 1, high))
            for place, (name, high) in enumerate((("month", 12), ("day", 31), ("hour", 24)), start=1)
        ]
        yield (
            date[0],
            date[1],
            date[2],
            _irradiance(path, number, "direct normal irradiance", fields[_DIRECT_NORMAL]),
            _irradiance(path, number, "diffuse horizontal irradiance", fields[_DIFFUSE_HORIZONTAL]),
        )


def _irradiance(path: Path, line: int, name: str, text: str) -> float:
    value = _number(path, line, name, text, 0, math.inf)
    if value >= _MISSING:
        raise SceneCaptumError(
            f"{path}, line {line}: {name} is missing ({text.strip()}); fill the gap, or use another file."
        )
    return value


def _number(path: Path, line: int, name: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        limits = f"of at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
        raise SceneCaptumError(
            f"{path}, line {line}: {name} must be a number {limits}, not {text.strip()!r}."
        )
    return value


def _check_calendar(path: Path, rows: list[tuple[int, int, int, float, float]]) -> None:
    """Raise if the rows are not the hours of a year of 365 days in order."""
    if len(rows) != HOURS_OF_YEAR:
        raise SceneCaptumError(
            f"{path} has {len(rows)} rows, expected {HOURS_OF_YEAR}: one for each hour of a year, without "
            "29 February."
        )
    dates = (
        (month, day, hour)
        for month in range(1, 13)
        for day in range(1, calendar.monthrange(2001, month)[1] + 1)
        for hour in range(1, 25)
    )
    for expected, row in zip(dates, rows, strict=True):
        if row[:3] != expected:
            raise SceneCaptumError(
                f"{path}: the row for month, day, hour {expected} is that for {row[:3]}; the hours of a year must "
                "be complete and in order."
            )
