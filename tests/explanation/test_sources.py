"""The objects that cause a metric, on pictures and maps made by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from scenecaptum import Camera, metrics
from scenecaptum.estimation import TargetedMetric
from scenecaptum.explanation._sources import _place, find_sources
from scenecaptum.projection import SurfaceMap

SIZE = 16
WINDOW = torch.zeros(SIZE, SIZE, dtype=torch.bool)
WINDOW[2:8, 4:12] = True
FRAME = WINDOW.clone()  # half of the outermost pixels of the window
FRAME[3:7, 5:11] = False
NAMES = ("sky", "window_frame", "lamp", "wall")
PARAMETERS = (
    ("window_pane.reflectance.value", "sky.emitter.radiance.value"),
    ("wood.reflectance.value", "window_frame.pose.translation"),
    ("diffuser.reflectance.value", "lamp.emitter.radiance.value"),
    ("paint.reflectance.value", "wall.pose.translation"),
)


def fractions() -> torch.Tensor:
    """Return the fraction of each pixel that each object covers, ``(4, H, W)``."""
    sky = WINDOW.double() - 0.5 * FRAME
    frame = 0.5 * FRAME
    frame[2, 2] = 1.0  # a pixel that shows nothing but the frame
    lamp = torch.zeros(SIZE, SIZE, dtype=torch.float64)
    lamp[4:6, 13] = 1.0
    return torch.stack([sky, frame, lamp, 1 - sky - frame - lamp])


def surface_map(covered: torch.Tensor) -> SurfaceMap:
    entries = covered.flatten(1).nonzero().T.numpy().astype(np.int32)
    of_entries = covered.flatten(1)[tuple(entries)].numpy().astype(np.float32)
    return SurfaceMap((SIZE, SIZE), entries[1], entries[0], of_entries, NAMES, PARAMETERS)


@pytest.fixture
def found() -> dict[str, object]:
    """The sources of a window of 3000 cd/m² in a dark frame, merged with those of a lamp of 5000 cd/m²."""
    metric = metrics.UnifiedGlareRating(Camera.perspective(SIZE, SIZE, fov_x=30))
    covered = fractions()
    radiance = torch.tensor([3000.0, 10.0, 5000.0, 50.0]).double() / metric.efficacy
    image = torch.einsum("o,ohw->hw", radiance, covered)[..., None].expand(-1, -1, 3)
    assert len(metric.sources(image)) == 1
    return {
        source.name: source
        for source in find_sources(
            TargetedMetric(metric, None), torch.stack([image] * 3), surface_map(covered)
        )
    }


def test_each_object_of_a_merged_source_has_its_own_luminance(found):
    assert found["sky"].luminance == pytest.approx(3000, rel=0.01)
    assert found["lamp"].luminance == pytest.approx(5000, rel=0.01)


def test_the_luminance_is_not_that_of_a_denoiser_that_overshoots():
    metric = metrics.UnifiedGlareRating(Camera.perspective(SIZE, SIZE, fov_x=30))
    covered = fractions()
    radiance = torch.tensor([3000.0, 10.0, 5000.0, 50.0]).double() / metric.efficacy
    image = torch.einsum("o,ohw->hw", radiance, covered)[..., None].expand(-1, -1, 3)
    brightened = TargetedMetric(metric, None).with_transform(lambda picture: 1.2 * picture)
    sources = find_sources(brightened, torch.stack([image] * 3), surface_map(covered))
    assert {one.name: one.luminance for one in sources}["lamp"] == pytest.approx(5000, rel=0.01)


def test_the_light_in_the_pixels_of_an_edge_is_that_of_the_sky(found):
    assert set(found) == {"sky", "lamp"}
    assert found["sky"].share + found["lamp"].share > 0.98


def test_what_a_pane_reflects_has_little_of_the_sky_behind_it():
    """The frame is a twelfth of what the pixels of the window show, and hardly any of their light."""
    metric = TargetedMetric(metrics.UnifiedGlareRating(Camera.perspective(SIZE, SIZE, fov_x=30)), None)
    sky, frame, lamp, wall = fractions()
    covered = torch.stack([sky * 11 / 12, sky / 12, lamp, wall + frame])
    radiance = torch.tensor([3000.0, 10.0, 5000.0, 50.0]).double() / metric.metric.efficacy
    seen = (radiance[:, None, None] * covered)[..., None].expand(-1, -1, -1, 3)
    images = torch.stack([seen.sum(0)] * 3)
    emitted = {name: seen[NAMES.index(name)] for name in ("sky", "lamp")}
    assert "wood" in {one.name for one in find_sources(metric, images, surface_map(covered))}
    found = find_sources(metric, images, surface_map(covered), light=emitted)
    assert {one.name for one in found} == {"sky", "lamp"}
    assert sum(one.share for one in found) > 0.99


def test_a_shape_is_not_named_after_another_in_which_its_material_is_defined():
    metric, image = TargetedMetric(metrics.MeanLuminance(), None), torch.ones(3, SIZE, SIZE, 3)
    floor = dataclasses.replace(
        surface_map(fractions()),
        objects=("picture", *NAMES[1:]),
        parameters=(("picture.bsdf.reflectance.value",), *[("picture.bsdf.reflectance.value",)] * 3),
    )
    assert {source.name for source in find_sources(metric, image, floor)} == {"picture", *NAMES[1:]} - {
        "lamp"
    }


def test_the_names_do_not_depend_on_what_is_selected(found):
    assert "window_pane" not in found
    assert "diffuser" not in found


@pytest.mark.parametrize(
    ("windows", "place"),
    [
        ([(8, 40)], "left"),
        ([(8, 18), (19, 30)], "left"),  # a thin bar
        ([(4, 24), (70, 95)], "right and left"),
        ([(4, 24), (38, 58), (72, 92)], "left, centre and right"),
        ([(4, 24), (90, 92)], "left"),  # a glimpse
    ],
)
def test_the_place_is_that_of_each_of_the_separate_parts(windows: list[tuple[int, int]], place: str) -> None:
    shown = np.zeros((54, 96))
    for number, (start, stop) in enumerate(windows):
        shown[22:32, start:stop] = 1 - 0.01 * number
    assert _place(shown.ravel(), np.arange(shown.size), shown.shape) == place


def test_an_object_of_many_parts_is_in_several_places() -> None:
    shown = np.zeros((54, 96))
    shown[4:12, 4:20] = shown[4:12, 76:92] = shown[42:50, 4:20] = shown[42:50, 76:92] = 1.0
    assert _place(shown.ravel(), np.arange(shown.size), shown.shape) == "several places"
