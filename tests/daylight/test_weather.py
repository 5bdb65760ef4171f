"""Weather files: reading, refusing, hours of the year and the position of the sun."""

from __future__ import annotations

import gzip
import importlib.util
import math
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from refusals import message

from scenecaptum.daylight import Weather, sun_directions

HEADER = 8


@pytest.fixture(scope="module")
def text() -> list[str]:
    packed = files("scenecaptum.daylight") / "synthetic.epw.gz"
    return gzip.decompress(packed.read_bytes()).decode().splitlines()


def replaced(line: str, column: int, value: str) -> str:
    fields = line.split(",")
    fields[column - 1] = value
    return ",".join(fields)


def with_line(change: Callable[[str], str], row: int = 1) -> Callable[[list[str]], list[str]]:
    """Return what changes one row of data."""
    at = HEADER + row - 1
    return lambda lines: [*lines[:at], change(lines[at]), *lines[at + 1 :]]


def leap(lines: list[str]) -> list[str]:
    """Insert a 29 February with impossible irradiances."""
    after = HEADER + 24 * 59
    day = [replaced(replaced(line, 3, "29"), 16, "1111") for line in lines[after - 24 : after]]
    return [*lines[:after], *day, *lines[after:]]


BAD = {
    "empty": (lambda lines: [], "line 1 must be LOCATION"),
    "another file": (lambda lines: ["<html>", *lines], "line 1 must be LOCATION"),
    "short location": (lambda lines: ["LOCATION,a,b,c", *lines[1:]], "line 1 must be LOCATION"),
    "latitude": (
        lambda lines: [replaced(lines[0], 7, "148"), *lines[1:]],
        "latitude must be a number from -90 to 90",
    ),
    "time zone": (lambda lines: [replaced(lines[0], 9, "CET"), *lines[1:]], "time_zone must be a number"),
    "no data periods": (lambda lines: [*lines[:7], *lines[8:]], "no line DATA PERIODS"),
    "a row is missing": (lambda lines: lines[:-1], "8759 rows, expected 8760"),
    "half hours": (lambda lines: [*lines, *lines[8:]], "17520 rows, expected 8760"),
    "no rows": (lambda lines: lines[:8], "0 rows, expected 8760"),
    "few columns": (with_line(lambda line: line[:20]), "line 9: 6 columns, expected 35"),
    "direct is a word": (
        with_line(lambda line: replaced(line, 15, "sunny"), 12),
        "line 20: direct normal irradiance must",
    ),
    "direct is nan": (
        with_line(lambda line: replaced(line, 15, "nan")),
        "line 9: direct normal irradiance must",
    ),
    "diffuse is negative": (
        with_line(lambda line: replaced(line, 16, "-3")),
        "diffuse horizontal irradiance must",
    ),
    "direct is missing": (
        with_line(lambda line: replaced(line, 15, "9999")),
        "line 9: direct normal irradiance is missing",
    ),
    "diffuse is missing": (
        with_line(lambda line: replaced(line, 16, "9999.0")),
        "diffuse horizontal irradiance is missing",
    ),
    "month": (with_line(lambda line: replaced(line, 2, "13")), "month must be a number from 1 to 12"),
    "order": (with_line(lambda line: replaced(line, 4, "5")), "must be complete and in order"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_refused_in_one_line(kind, text, tmp_path):
    change, expected = BAD[kind]
    path = tmp_path / "bad.epw"
    path.write_text("\n".join(change(text)))
    said = message(lambda: Weather.from_epw(path))
    assert expected in said
    assert "\n" not in said
    assert str(path) in said


@pytest.mark.parametrize("name", ["none.epw", "none.epw.gz", "broken.epw.gz"])
def test_a_file_that_cannot_be_read_is_refused(name, tmp_path):
    (tmp_path / "broken.epw.gz").write_bytes(gzip.compress(b"LOCATION")[:-4] + b"____")
    said = message(lambda: Weather.from_epw(tmp_path / name))
    assert "cannot be read" in said
    assert "\n" not in said


def test_columns_are_those_of_the_file(weather, text):
    assert weather.place == "SYNTHETIC, made up"
    assert (weather.latitude, weather.longitude, weather.time_zone, weather.elevation) == (48, 11, 1, 500)
    noon = 172 * 24 + 12  # of 22 June
    fields = text[HEADER + noon].split(",")
    row = (weather.month, weather.day, weather.hour, weather.direct_normal, weather.diffuse_horizontal)
    assert [column[noon].item() for column in row] == [6, 22, 13, float(fields[14]), float(fields[15])]


def test_the_day_that_leap_years_have_is_left_out(weather, text, tmp_path):
    path = tmp_path / "leap.epw"
    path.write_text("\n".join(leap(text)))
    read = Weather.from_epw(path)
    assert len(read) == 8760
    assert torch.equal(read.diffuse_horizontal, weather.diffuse_horizontal)
    assert torch.equal(read.day, weather.day)


def test_occupied_hours_are_ten_a_day(weather):
    mask = weather.occupied()
    assert int(mask.sum()) == 3650
    assert set(weather.hour[mask].tolist()) == set(range(9, 19))
    assert int(weather.occupied(0, 24).sum()) == 8760
    assert "last must be" in message(lambda: weather.occupied(18, 8))


def test_daylight_hours_are_the_half_with_the_most_diffuse_light(weather):
    mask = weather.daylight()
    assert int(mask.sum()) == 4380
    assert weather.diffuse_horizontal[mask].min() >= weather.diffuse_horizontal[~mask].max()
    assert "whole year" in message(lambda: weather.select(mask).daylight())


def test_select(weather):
    part = weather.select(weather.occupied())
    assert len(part) == 3650
    assert torch.equal(part.direct_normal, weather.direct_normal[weather.occupied()])
    assert "shape (8760,)" in message(lambda: weather.select(torch.ones(3, dtype=torch.bool)))
    assert "no hour" in message(lambda: weather.select(torch.zeros(8760, dtype=torch.bool)))


def test_the_sun_is_where_gendaymtx_has_it(radiance, weather):
    found = subprocess.run(
        [str(radiance / "bin" / "gendaymtx"), "-D", "-"],
        input=weather.to_wea(),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    minutes = np.array(re.findall(r"void light solar(\d+)", found), dtype=int)  # since the year began
    theirs = np.array(
        [line.split()[1:4] for line in found.splitlines() if line.startswith("4 ")], dtype=float
    )
    ours = weather.sun_directions().numpy()
    up = np.degrees(np.arcsin(ours[:, 2])) > -0.533 / 2
    assert len(theirs) > 4000
    np.testing.assert_array_equal(np.flatnonzero(up), minutes // 60)
    np.testing.assert_allclose(ours[up], theirs, atol=1e-6)  # six digits are printed


def test_the_sun_is_highest_in_the_south_at_noon_of_midsummer():
    day, hour = torch.full((2,), 172), torch.tensor([12.0, 0.0])
    noon, midnight = sun_directions(48.0, 15.0, 1.0, day, hour)
    assert math.degrees(math.asin(noon[2])) == pytest.approx(90 - 48 + 23.45, abs=0.1)
    assert noon[1] < 0 < midnight[1]
    assert abs(noon[0]) < 0.02
    assert midnight[2] < 0


def test_the_sun_rises_in_the_east(weather):
    morning = weather.select((weather.hour == 8) & (weather.month == 6))
    assert (morning.sun_directions()[:, 0] > 0.5).all()
    south = weather.sun_directions()[(weather.hour == 12) & (weather.month == 12)]
    assert (south[:, 1] < -0.8).all()


def test_the_wea_is_that_of_epw2wea(radiance, weather, text, tmp_path):
    (tmp_path / "year.epw").write_text("\n".join(text))
    subprocess.run(
        [str(radiance / "bin" / "epw2wea"), str(tmp_path / "year.epw"), str(tmp_path / "year.wea")],
        check=True,
    )
    theirs, ours = (tmp_path / "year.wea").read_text().splitlines(), weather.to_wea().splitlines()
    table = [np.array([line.split() for line in lines[6:]], dtype=float) for lines in (theirs, ours)]
    np.testing.assert_allclose(table[1], table[0], atol=1e-3)
    for line, other in zip(theirs[1:6], ours[1:6], strict=True):
        assert line.split()[0] == other.split()[0]
        assert float(line.split()[1]) == pytest.approx(float(other.split()[1]))


def script() -> ModuleType:
    path = Path(__file__).parents[2] / "scripts" / "synthetic_weather.py"
    spec = importlib.util.spec_from_file_location("synthetic_weather_script", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_script_writes_the_weather_of_the_package(text):
    module = script()
    assert list(module.HEADER) == text[:HEADER]
    written, kept = ([row.split(",") for row in rows] for rows in (module.rows(), text[HEADER:]))
    assert [row[:13] + row[16:] for row in written] == [row[:13] + row[16:] for row in kept]
    numbers = [np.array([row[13:16] for row in rows], dtype=float) for rows in (written, kept)]
    np.testing.assert_allclose(*numbers, atol=1)  # rounded to whole W/m²
    assert text[0].startswith("LOCATION,SYNTHETIC")


def test_the_synthetic_year_is_plausible(weather):
    up = weather.sun_directions()[:, 2].clamp(min=0)
    total = (weather.direct_normal * up + weather.diffuse_horizontal).sum().item() / 1000
    assert 1000 < total < 1300  # kWh/m², as at 48° N in Europe
    assert weather.direct_normal[up == 0].sum() == 0
    clear = weather.select(up > 0.3).direct_normal
    assert (clear > 500).float().mean() > 0.1
    assert (clear < 50).float().mean() > 0.1


@pytest.mark.parametrize("name", ["year.epw", "year.epw.gz"])
def test_the_file_of_the_script_is_read_under_any_name(name, tmp_path, weather, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["synthetic_weather.py", str(tmp_path / name)])
    script().main()
    assert capsys.readouterr().out.strip() == str(tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(b"LOCATION") is (name == "year.epw")
    renamed = (tmp_path / name).rename(tmp_path / "downloaded")
    assert torch.equal(Weather.from_epw(renamed).direct_normal, weather.direct_normal)


def test_the_script_says_what_it_cannot_write(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["synthetic_weather.py", str(tmp_path / "none" / "year.epw")])
    with pytest.raises(SystemExit):
        script().main()
    assert "create its folder" in capsys.readouterr().err
