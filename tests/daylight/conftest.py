"""Radiance's programs and the synthetic year, which several files of this folder share."""

from __future__ import annotations

from pathlib import Path

import pytest

from scenecaptum.daylight import Weather, synthetic_weather


@pytest.fixture(scope="session")
def radiance() -> Path:
    """Folder of Radiance's bin and lib."""
    pyradiance = pytest.importorskip(
        "pyradiance", reason="Radiance is not here: pip install 'scenecaptum[test]' brings pyradiance==1.3.1"
    )
    return Path(pyradiance.__path__[0])


@pytest.fixture(scope="session")
def weather() -> Weather:
    return synthetic_weather()
