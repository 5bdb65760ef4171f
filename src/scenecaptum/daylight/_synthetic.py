"""A year of made-up weather, for examples and tests."""

from __future__ import annotations

from importlib.resources import as_file, files

from ._weather import Weather


def synthetic_weather() -> Weather:
    """Return a year of synthetic weather at 48° N: made up, of no real place.

    ``scripts/synthetic_weather.py`` writes it, from the sun's position and random cloudiness. Use it for examples
    and tests; for the design of a building, read the EPW file of its place (`Weather.from_epw`).
    """
    with as_file(files(__package__) / "synthetic.epw.gz") as path:
        return Weather.from_epw(path)
