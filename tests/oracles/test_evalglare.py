"""Glare ratings against evalglare 3.06, which the Python package pyradiance bundles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from scenecaptum import Camera
from scenecaptum.metrics import (
    DaylightGlareIndex,
    DaylightGlareProbability,
    UnifiedGlareRating,
    VerticalIlluminance,
    position_index,
)

from .pictures import Picture, disc, pictures, room
from .radiance import EFFICACY, run_evalglare, view_line, write_coloured, write_picture

PICTURES = pictures()
# Pictures whose phenomenon another picture has: a direction, a gradient, several sources, a window, a camera.
LONG = {
    *(
        "one-high",
        "one-below",
        "one-far-below",
        "one-to-the-side",
        "graded",
        "separate",
        "row-of-four",
        "eight",
    ),
    *("window", "two-suns-in-a-window", "bright-room"),
    *("perspective-one", "perspective-below", "perspective-tall", "perspective-merged"),
}
by_name = pytest.mark.parametrize(
    "picture",
    [
        pytest.param(picture, id=picture.name, marks=pytest.mark.long if picture.name in LONG else ())
        for picture in PICTURES
    ],
)


@pytest.fixture(scope="session")
def evalglare() -> Path:
    pyradiance = pytest.importorskip(
        "pyradiance", reason="evalglare is not here: pip install 'scenecaptum[test]' brings pyradiance==1.3.1"
    )
    return Path(pyradiance.__path__[0]) / "bin" / "evalglare"


@pytest.fixture(scope="session")
def evaluated(evalglare, tmp_path_factory):
    """Each picture as evalglare decodes it, and evalglare's report, computed once."""
    folder, kept = tmp_path_factory.mktemp("evalglare"), {}

    def evaluate(picture: Picture, *options: str):
        key = (picture.name, *options)
        if key not in kept:
            path = folder / f"{picture.name}.hdr"
            image = write_picture(path, picture.luminance, view_line(picture.camera))
            kept[key] = image, run_evalglare(evalglare, path, *options)
        return kept[key]

    return evaluate


def within(measured: float, expected: float, allowed: float) -> None:
    assert abs(measured - expected) <= allowed, f"{measured:.5f} against {expected:.5f}, allowed {allowed}"


@by_name
def test_ratings_and_number_of_sources_are_those_of_evalglare(picture, evaluated):
    image, report = evaluated(picture, "-b", "2000")
    settings = {"relaxation": 0, "background": "hemisphere"}
    rating = UnifiedGlareRating(picture.camera, **settings)
    assert len(rating.sources(image)) == len(report.sources)
    # evalglare prints six digits; 0.15 and 0.003 are allowed.
    within(rating(image).item(), report.ratings["ugr"], 1e-3)
    within(DaylightGlareProbability(picture.camera, **settings)(image).item(), report.ratings["dgp"], 1e-4)
    within(DaylightGlareIndex(picture.camera, **settings)(image).item(), report.ratings["dgi"], 1e-3)


@by_name
def test_sources_are_those_of_evalglare(picture, evaluated):
    image, report = evaluated(picture, "-b", "2000")
    rating = UnifiedGlareRating(picture.camera, relaxation=0)
    ours = sorted((s.column, s.luminance, s.solid_angle, s.position_index) for s in rating.sources(image))
    theirs = sorted((row[2], row[4], row[5], row[6]) for row in report.sources)
    np.testing.assert_allclose(ours, theirs, rtol=1e-4)


@by_name
def test_illuminance_is_that_of_evalglare(picture, evaluated):
    image, report = evaluated(picture, "-b", "2000")
    # evalglare counts a pixel on the fisheye's circle whole or not at all.
    assert VerticalIlluminance(picture.camera)(image).item() == pytest.approx(report.ratings["E_v"], rel=2e-4)


@by_name
def test_a_threshold_relative_to_the_mean_is_that_of_evalglare(picture, evaluated):
    image, report = evaluated(picture, "-b", "5")
    rating = UnifiedGlareRating(picture.camera, threshold_factor=5, relaxation=0, background="hemisphere")
    assert len(rating.sources(image)) == len(report.sources)
    within(rating(image).item(), report.ratings["ugr"], 1e-3)


@by_name
def test_a_relaxed_rating_is_close_to_evalglare(picture, evaluated):
    near = (np.abs(picture.luminance / 2000 - 1) < 0.3).any()
    image, report = evaluated(picture, "-b", "2000")
    rating = UnifiedGlareRating(picture.camera, background="hemisphere")
    within(rating(image).item(), report.ratings["ugr"], 0.3 if near else 1e-3)


def test_the_images_cover_the_relevant_cases():
    assert len(PICTURES) >= 25
    assert {picture.camera.projection for picture in PICTURES} == {"fisheye", "perspective"}
    clear = [p for p in PICTURES if not (np.abs(p.luminance / 2000 - 1) < 0.3).any()]
    assert len(clear) >= 25


def test_a_threshold_relative_to_a_task_zone_is_that_of_evalglare(evalglare, tmp_path):
    camera = Camera.fisheye(200, 200)
    luminance = np.maximum.reduce(
        [room(camera, 100), disc(camera, (0, -20), 12, 400), disc(camera, (25, 20), 4, 1_500)]
    )
    path = tmp_path / "task.hdr"
    image = write_picture(path, luminance, view_line(camera))
    row, column = 120, 100
    axis = camera.directions[row, column]
    task = torch.acos((camera.directions @ axis).clamp(-1, 1)) * 2 <= 0.3
    # evalglare counts rows upward
    report = run_evalglare(evalglare, path, "-b", "3", "-t", str(column), str(camera.height - 1 - row), "0.3")
    rating = UnifiedGlareRating(camera, threshold_factor=3, task=task, relaxation=0)
    assert len(rating.sources(image)) == len(report.sources) == 1
    within(rating(image).item(), report.ratings["ugr"], 1e-3)


COLOURS = {"candle": (1.6, 0.9, 0.35), "sky": (0.7, 0.95, 2.2), "sodium": (1.9, 0.8, 0.1)}


@pytest.mark.parametrize("colour", COLOURS)
@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(one, marks=pytest.mark.long) for one in ("merged", "window-of-three-panes")),
        "sun-in-a-window",
        "perspective-three",
    ],
)
def test_coloured_images_agree_in_radiance_primaries(evalglare, tmp_path, name, colour):
    # A render has Rec. 709 primaries, which evalglare does not know; luminance does not depend on the choice.
    picture = next(picture for picture in PICTURES if picture.name == name)
    lamp, wall = np.array(COLOURS[colour]), np.array([0.9, 1.05, 0.8])
    bright = (picture.luminance > 2000)[..., None]
    radiance = picture.luminance[..., None] / EFFICACY * np.where(bright, lamp, wall)
    path = tmp_path / "coloured.hdr"
    image = write_coloured(path, radiance, view_line(picture.camera))
    report = run_evalglare(evalglare, path, "-b", "2000")
    settings = {"relaxation": 0, "background": "hemisphere"}
    rating = UnifiedGlareRating(picture.camera, **settings)
    assert len(rating.sources(image)) == len(report.sources)
    within(rating(image).item(), report.ratings["ugr"], 1e-2)
    within(DaylightGlareProbability(picture.camera, **settings)(image).item(), report.ratings["dgp"], 3e-4)


@pytest.mark.parametrize("name", ["dark-room", "none", "one-ahead", "bright-room"])
def test_the_correction_for_low_light_is_that_of_evalglare(evaluated, name):
    picture = next(picture for picture in PICTURES if picture.name == name)
    image, report = evaluated(picture, "-b", "2000", "-C", "l+")
    metric = DaylightGlareProbability(picture.camera, relaxation=0, low_light=True)
    within(metric(image).item(), report.ratings["dgp"], 1e-4)


def test_the_published_constants_differ_from_those_of_evalglare(evaluated):
    image, report = evaluated(PICTURES[0], "-b", "2000")
    published = DaylightGlareProbability(PICTURES[0].camera, relaxation=0, constants="published")(
        image
    ).item()
    assert 1e-4 < abs(published - report.ratings["dgp"]) < 2e-3


@pytest.mark.parametrize(
    "camera", [Camera.fisheye(128, 128), Camera.perspective(96, 64, 100)], ids=lambda c: c.projection
)
def test_position_index_is_that_of_evalglare_in_every_pixel(evalglare, tmp_path, camera):
    import subprocess

    path, painted = tmp_path / "flat.hdr", tmp_path / "index.hdr"
    write_picture(path, np.full((camera.height, camera.width), 100.0), view_line(camera))
    subprocess.run([evalglare, "-p", "-c", painted, path], capture_output=True, check=False, timeout=120)
    values = subprocess.run(
        [evalglare.parent / "pvalue", "-h", "-H", "-d", "-b", "-df", painted], capture_output=True, check=True
    ).stdout
    theirs = np.frombuffer(values, np.float32).reshape(camera.height, camera.width) * 179
    ours = position_index(camera.directions).numpy()
    seen = (camera.directions[..., 2].numpy() > 0) & (camera.solid_angles.numpy() > 0)
    np.testing.assert_allclose(theirs[seen], ours[seen], rtol=1 / 128)  # a mantissa of eight bits
