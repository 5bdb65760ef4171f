"""The report: the file, and its behaviour in a real browser."""

from __future__ import annotations

import base64
import csv
import dataclasses
import io
import json
import math
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pages import HEIGHT, NASTY, OBJECTS, PHONE, VALUES, WIDTH, Page, data_of, make, quarters
from PIL import Image
from seeds import shifted

from scenecaptum import FeatureAblationScene, SceneAttribution, SceneCaptumError, VanillaSceneGradient, cli
from scenecaptum.attr import AttributionInterrupted
from scenecaptum.projection import SurfaceMap, TexelMap, export, heatmap, shared_maximum
from scenecaptum.report import Comparison, describe_objects, write_csv, write_report
from scenecaptum.report._pixels import LAYERS, encode_picture, encode_surfaces
from scenecaptum.visualization import Arrow, automatic_exposure, plot_heatmap, shown_render

# ------------------------------------------------------------------------------------------ what is written


def test_the_same_results_give_the_same_file_with_shared_pictures_once(tmp_path):
    results = [make(), make("Brightness")]
    for name in ("one.html", "two.html"):
        write_report(results, tmp_path / name)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.html", "two.html"]
    data = data_of(tmp_path / "one.html")
    assert [len(data[key]) for key in ("results", "views", "pictures")] == [2, 1, 1]


def test_the_picture_is_denoised_for_the_eye_unless_off(tmp_path):
    result = make()
    for denoised in (True, False):
        write_report(result, tmp_path / "report.html", denoised=denoised)
        data = data_of(tmp_path / "report.html")
        image = shown_render(result, denoised=denoised)
        assert data["pictures"] == [encode_picture(image, automatic_exposure(image))]
        assert [one["isDenoised"] for one in data["results"]] == [denoised]
    assert not torch.equal(shown_render(result, denoised=True), shown_render(result))
    # The image on which the metric was evaluated was denoised.
    of_denoised = dataclasses.replace(result, info={**result.info, "picture": {"denoised": True}})
    write_report(of_denoised, tmp_path / "report.html", denoised=False)
    assert data_of(tmp_path / "report.html")["results"][0]["isDenoised"]


def test_pictures_of_different_cameras_are_kept_apart(tmp_path):
    other = make(image=torch.rand(5, 7, 3), surfaces=quarters(5, 7))
    write_report([make(), other], tmp_path / "report.html")
    data = data_of(tmp_path / "report.html")
    assert [len(data[key]) for key in ("results", "views", "pictures")] == [2, 2, 2]
    assert [data["views"][one["view"]]["width"] for one in data["results"]] == [WIDTH, 7]


def test_arrows_of_gradients_are_left_out_between_two_designs(tmp_path, monkeypatch):
    """They would look like what was moved."""
    arrow = Arrow("chair.pose.translation", 1.0, 1.0, 2.0, 0.0)
    monkeypatch.setattr("scenecaptum.report._data.arrows", lambda attribution: [arrow])
    for comparison, count in ((None, 1), (Comparison(0.1), 0)):
        write_report([make(), make()], tmp_path / "report.html", ["A", "B"], comparison=comparison)
        data = data_of(tmp_path / "report.html")
        assert [len(one["arrows"]) for one in data["results"]] == [count, count]


def test_objects_are_coloured_as_in_the_heatmap(tmp_path):
    attribution = make()
    write_report(attribution, tmp_path / "report.html")
    (result,) = data_of(tmp_path / "report.html")["results"]
    painted = torch.tensor([one["magnitude"] for one in result["objects"]]) / result["largest"]
    shown = heatmap(attribution, norm="linear")
    for index, (line, column) in enumerate([(8, 0), (0, 0), (0, 10), (0, 15)]):
        assert float(painted[index]) == pytest.approx(float(shown[line, column]), rel=1e-5)
    # Raising all parameters of the chair raises the metric, although one of them lowers it.
    signs = [math.copysign(1, one["signed"]) for one in result["objects"]]
    assert signs == [-1, 1, 1, 1]


def with_sky() -> SceneAttribution:
    """The chair is a sky, with a map of light and its scale."""
    sky = {"chair.scale": torch.tensor(4.0), "chair.data": torch.ones(2, 2, 3) / 4}
    surfaces = quarters(HEIGHT, WIDTH)
    parameters = [
        ("chair.scale", "chair.data") if "chair.alpha" in used else used for used in surfaces.parameters
    ]
    return make(
        attributions={**sky, "floor.reflectance.value": torch.tensor([-1.0, 0.0, 0.0])},
        covariance=None,
        standard_error=None,
        surfaces=dataclasses.replace(surfaces, parameters=tuple(parameters)),
    )


def read(browser: Any, path: Path) -> tuple[str, str]:
    """Return the caption, and what is said at the chair and the floor."""
    page = Page(browser, path)
    caption, tips = page.page.locator("#caption").inner_text(), page.hover(11, 1) + page.hover(4, 7)
    page.check(path)
    page.context.close()
    return caption, tips


def test_the_size_of_an_object_with_several_parameters_is_called_a_norm(browser, tmp_path):
    write_report(make(), tmp_path / "report.html")
    caption, tips = read(browser, tmp_path / "report.html")
    assert "of an object with several: root of the sum of squares" in caption
    assert tips.count("all together, root of the sum of squares: 0.33") == 1  # the chair, not the floor


def test_a_map_of_light_is_left_out_of_its_object_beside_its_scale(browser, tmp_path):
    attribution = with_sky()
    write_report(attribution, tmp_path / "report.html")
    (result,) = data_of(tmp_path / "report.html")["results"]
    sky = result["objects"][OBJECTS.index("chair")]
    assert [result["rows"][row]["name"] for row in sky["rows"]] == ["chair.scale", "chair.data"]
    assert (sky["mapped"], sky["magnitude"], sky["signed"], result["largest"]) == (1, 4, 4, 4)
    caption, tips = read(browser, tmp_path / "report.html")
    assert "sum of squares" not in caption
    assert "all together" not in tips
    explored = describe_objects(attribution.surfaces, attribution, [attribution])
    assert explored["effects"][0][OBJECTS.index("chair")] == 4


def test_an_explored_object_has_no_colour_for_a_light_that_is_off():
    """To first order, the effect of switching it on may be far off."""
    sky = with_sky()
    ranges = {name: torch.ones(value.shape[-1:]) for name, value in sky.items()}
    sky = dataclasses.replace(
        sky,
        attributions={**sky, "chair.data": torch.zeros(2, 2, 3)},  # the map of a light that is off
        extents=ranges,
        info={**sky.info, "lights_off": ["chair.scale"]},
    )
    linear = dataclasses.replace(sky, info={**sky.info, "linear_in_light": True})
    assert sky.surfaces is not None
    explored = describe_objects(sky.surfaces, sky, [sky, linear])
    assert [effects[OBJECTS.index("chair")] for effects in explored["effects"]] == [0, 4]


def with_texels() -> SceneAttribution:
    """The chair has a texture of 2 × 2 texels; its upper left texel lowers the metric and is on the left."""
    attribution = make()
    assert attribution.surfaces is not None
    on_chair = np.flatnonzero(attribution.surfaces.object_index == 2).astype(np.int32)
    column = attribution.surfaces.pixel[on_chair] % WIDTH
    texels = TexelMap(
        entry=on_chair,
        texel=(column > 11).astype(np.int32),
        weight=np.full(len(on_chair), 4.0, np.float32),
    )
    gradient = torch.zeros(2, 2, 3)
    gradient[0, 0], gradient[0, 1] = -0.05, 0.02
    return dataclasses.replace(
        attribution,
        attributions={**attribution.attributions, "chair.reflectance.data": gradient},
        surfaces=dataclasses.replace(attribution.surfaces, texels={"chair.reflectance.data": texels}),
    )


def test_texels_are_coloured_as_in_the_heatmap(tmp_path):
    attribution = with_texels()
    write_report([attribution], tmp_path / "report.html")
    (texels,) = (one["texels"] for one in data_of(tmp_path / "report.html")["results"])
    assert texels["largest"] == pytest.approx(shared_maximum([attribution], texels=True))
    for name, zero, top in (("magnitude", 0, 255), ("signed", 128, 127)):
        roots = np.frombuffer(zlib.decompress(base64.b64decode(texels[name])), np.uint8).astype(float) - zero
        painted = np.sign(roots) * (roots / top) ** 4
        expected = attribution.heatmap(texels=True, signed=name == "signed", norm="linear").numpy().ravel()
        # Rounding error: half a step of the square root.
        np.testing.assert_allclose(
            np.abs(painted) ** 0.25 * np.sign(painted),
            np.abs(expected) ** 0.25 * np.sign(expected),
            atol=0.51 / top,
        )
    write_report([make()], tmp_path / "report.html")
    assert data_of(tmp_path / "report.html")["results"][0]["texels"] is None


def test_pixels_keep_their_three_largest_objects_and_whole_weights():
    rng = np.random.default_rng(shifted(3))
    count, objects = 60, 12
    fraction = rng.dirichlet(np.full(objects, 0.3), size=count).astype(np.float32)
    fraction[-1] = 0  # outside a fisheye's circle
    pixel, index = np.nonzero(fraction > 1e-3)
    surfaces = SurfaceMap(
        shape=(6, 10),
        pixel=pixel.astype(np.int32),
        object_index=index.astype(np.int32),
        fraction=fraction[pixel, index],
        objects=tuple(f"object {one}" for one in range(objects)),
        parameters=((),) * objects,
    )
    import base64
    import zlib

    planes, shown = encode_surfaces(surfaces)
    decoded = {name: zlib.decompress(base64.b64decode(text)) for name, text in planes.items()}
    first = shown[np.frombuffer(decoded["objects"], "<u2").reshape(LAYERS, count)[0]]
    weights = np.frombuffer(decoded["weights"], np.uint8).reshape(LAYERS, count).astype(int)
    np.testing.assert_array_equal(first[:-1], fraction[:-1].argmax(1))
    assert (weights.sum(0)[:-1] >= 254).all()
    assert weights[:, -1].sum() == 0


def test_groups_and_results_without_error_bars_are_reported(tmp_path):
    grouped = SceneAttribution(
        attributions={"room": torch.tensor(2.0), "chair.alpha": torch.tensor(-1.0)},
        standard_error=None,
        metric_value=float("nan"),
        image=torch.rand(HEIGHT, WIDTH, 3),
        surfaces=quarters(HEIGHT, WIDTH),
        info={
            "groups": {
                "room": ["floor.reflectance.value", "lamp.radiance.value"],
                "chair.alpha": ["chair.alpha"],
            }
        },
    )
    write_report(grouped, tmp_path / "report.html")
    (result,) = data_of(tmp_path / "report.html")["results"]
    assert [one["rows"] for one in result["objects"]] == [[0], [0], [1], []]
    assert result["rows"][0]["members"] == ["floor.reflectance.value", "lamp.radiance.value"]
    assert result["rows"][0]["error"] is None
    assert result["value"] is None
    assert result["groupNotes"] == []
    named = {"paint (floor, wall)": ["floor.reflectance.value"], "lamp": ["lamp.radiance.value"]}
    shared = dataclasses.replace(
        grouped,
        attributions={name: torch.tensor(1.0) for name in named},
        surfaces=dataclasses.replace(
            quarters(HEIGHT, WIDTH),
            objects=("floor", "wall", "lamp", "chair"),
            parameters=(
                ("floor.reflectance.value",),
                ("floor.reflectance.value",),
                ("lamp.radiance.value",),
                (),
            ),
        ),
        info={"groups": named},
    )
    write_report(shared, tmp_path / "shared.html")
    (result,) = data_of(tmp_path / "shared.html")["results"]
    assert [note[:40] for note in result["groupNotes"]] == ["a material that several shapes share is "]


@pytest.mark.parametrize(
    ("results", "titles", "words"),
    [
        ([], None, ["at least one"]),
        ([make(surfaces=None)], None, ["Glare", "which object each pixel shows"]),
        ([make(image=None)], None, ["Glare", "no picture"]),
        ([make(image=torch.zeros(2, 9, 16, 3))], None, ["(2, 9, 16, 3)", "one picture"]),
        ([make()], ["a", "b"], ["titles", "1", "2"]),
    ],
)
def test_invalid_input_is_refused(results, titles, words, tmp_path):
    with pytest.raises(SceneCaptumError) as caught:
        write_report(results, tmp_path / "report.html", titles)
    for word in words:
        assert word in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_plan_stands_in_place_of_a_picture(tmp_path):
    from matplotlib.figure import Figure

    of_a_grid, figure = make(surfaces=None), Figure(figsize=(4, 3))
    write_report([of_a_grid, make()], tmp_path / "report.html", plans=[figure, None])
    data = data_of(tmp_path / "report.html")
    plan, view = (data["views"][result["view"]] for result in data["results"])
    assert (plan["width"], plan["height"], plan["names"]) == (960, 720, [])
    assert view["names"]
    assert [data["pictures"][result["picture"]][:15] for result in data["results"]] == [
        "data:image/png;",
        "data:image/jpeg",
    ]
    assert [len(result["rows"]) for result in data["results"]] == [6, 6]
    with pytest.raises(SceneCaptumError, match="a figure or None for each of the 2"):
        write_report([make(), make()], tmp_path / "other.html", plans=[None])


def test_an_unwritable_path_is_named_and_no_file_is_left(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for path in (
        tmp_path / "nowhere" / "report.html",
        tmp_path / "folder",
        tmp_path / "file" / "report.html",
    ):
        with pytest.raises(SceneCaptumError, match="cannot be written") as caught:
            write_report(make(), path)
        assert str(path) in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_results_of_one_metric_get_different_titles(tmp_path):
    before, after = make(), make()
    titles = []
    for info in ({"scene": "after.xml"}, {}):
        changed = dataclasses.replace(after, info={**after.info, **info})
        write_report([before, changed], tmp_path / "report.html")
        titles.append([one["title"] for one in data_of(tmp_path / "report.html")["results"]])
    assert titles == [["Glare · rooms/office.xml", "Glare · after.xml"], ["Glare (1)", "Glare (2)"]]


def test_a_noisy_render_of_640_by_360_stays_below_5_megabytes(tmp_path):
    height, width, objects = 360, 640, 400
    rng = np.random.default_rng(shifted())
    blocks = rng.integers(0, objects, (height // 8, width // 8)).repeat(8, 0).repeat(8, 1).ravel()
    edges = rng.integers(0, height * width, 60_000)
    pixel = np.concatenate([np.arange(height * width), edges])
    names = [f"shape_{one}.bsdf.reflectance.value" for one in range(objects)]
    every = np.arange(len(pixel), dtype=np.int32)
    surfaces = SurfaceMap(
        shape=(height, width),
        pixel=pixel.astype(np.int32),
        object_index=np.concatenate([blocks, rng.integers(0, objects, len(edges))]).astype(np.int32),
        fraction=np.concatenate([np.full(len(blocks), 0.6), np.full(len(edges), 0.4)]).astype(np.float32),
        objects=tuple(f"shape_{one}" for one in range(objects)),
        parameters=tuple((name,) for name in names),
        texels={"noise": TexelMap(every, every, rng.exponential(size=len(pixel)).astype(np.float32))},
    )
    noise = torch.rand(2, height, width, 3, generator=torch.Generator().manual_seed(shifted()))
    values = {name: torch.tensor([0.1 * index, 0.2, -0.3]) for index, name in enumerate(names)}
    values["noise"] = torch.from_numpy(rng.normal(size=(1, len(pixel), 3)).astype(np.float32))
    covariance = {name: 1e-4 * torch.eye(3) for name in values}
    both = [make(attributions=values, covariance=covariance, image=one, surfaces=surfaces) for one in noise]
    write_report(both, tmp_path / "report.html")
    size = (tmp_path / "report.html").stat().st_size
    assert size < 5e6, f"{size / 1e6:.2f} MB of pure noise twice"


# ------------------------------------------------------------------------------------------ values in results


def test_results_keep_small_values_and_the_mean_of_textures(stage, tmp_path):
    attribution = FeatureAblationScene(stage, torch.mean).attribute(spp=4, replicates=2)
    kept = attribution.parameter_values
    assert kept["ball.bsdf.alpha"] == stage.inputs["ball.bsdf.alpha"]
    texture = "ground.bsdf.reflectance.data"
    torch.testing.assert_close(kept[texture], stage.inputs[texture].mean((0, 1)))
    attribution.save(tmp_path / "result.npz")
    loaded = SceneAttribution.load(tmp_path / "result.npz")
    assert list(loaded.parameter_values) == list(kept)
    torch.testing.assert_close(loaded.parameter_values[texture], kept[texture])
    assert set((loaded - attribution).parameter_values) == set(kept)


# -------------------------------------------------------------------------------------------- in the browser


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    other = make("Brightness", 2.0)
    other = dataclasses.replace(other, info={**other.info, "scene": NASTY})
    write_report([make(), other], path, titles=[NASTY, "Brightness"])
    return path


@pytest.fixture
def report(browser: Any, written: Path) -> Iterator[Page]:
    page = Page(browser, written)
    yield page
    page.check(written)
    page.context.close()


def test_pointing_at_a_pixel_reads_the_object_with_values_and_errors(report):
    chair = report.hover(11, 1)
    for said in (
        "chair",
        "chair.reflectance.data",
        "Σ",
        "0.2 0.3 0.4",
        "chair: alpha",
        "!",
        "0.15",
        "0.0500 ± 0.0020",
    ):
        assert said in re.sub(r"\s+", " ", chair)
    floor = re.sub(r"\s+", " ", report.hover(4, 7))
    assert "0.5 0.25 0.125" in floor
    assert "0.3033 ± 0.0020" in floor
    report.page.mouse.move(2, 2)
    assert report.page.locator("#tip").is_hidden()


def test_a_click_in_the_picture_selects_the_rows_and_back(report):
    report.click(11, 1)
    assert report.selected() == ["chair.reflectance.data", "chair.alpha"]
    assert report.lit() == ["chair"]
    assert "its size is off <b>" in report.page.locator("#detail").inner_text()
    report.click(11, 1)
    assert report.selected() == []
    assert report.colour("shade", 4, 7)[3] == 0
    report.page.locator("#rows tr", has_text="lamp.radiance").click()
    assert report.lit() == ["lamp"]
    assert report.colour("shade", 7, 1)[3] == pytest.approx(0.68 * 255 * 0.25, abs=2)  # a shared edge
    assert "R +0.3000 ± 0.0020" in report.page.locator("#detail").inner_text()
    report.page.locator("#clear").click()
    assert report.selected() == []


def test_error_bars_that_cannot_be_trusted_are_marked(browser, tmp_path):
    path = tmp_path / "report.html"
    even = {name: torch.linspace(-1, 1, 8)[:, None].expand(8, 3) for name in VALUES}
    rare = {**even, "chair.alpha": torch.tensor([0, 0, 0, 0, 0, 0, 1e-5, 1])[:, None]}
    few = {**make().info, "replicates": 2}
    write_report([make(replicates=rare), make(info=few)], path, titles=["Rare", "Few"])
    page = Page(browser, path)
    notes = page.page.locator("#notes")
    assert "? one replicate has nearly all of the spread" in notes.inner_text()
    assert (
        "others may be missing; effects other than these may miss such light, too (chair: alpha)"
        in notes.inner_text()
    )
    marked = page.page.locator("#rows tr", has=page.page.locator(".mark", has_text="?"))
    assert [row.inner_text().split()[1:3] for row in marked.all()] == [["chair:", "alpha!?"]]
    page.click(11, 1)
    assert "? one replicate has nearly all" in page.page.locator("#detail").inner_text()
    # A caution for all parameters is shown once.
    page.page.get_by_text("Few", exact=True).first.click()
    reason = "all parameters: with 2 replicates the standard error has about 71 % relative uncertainty"
    assert reason in notes.inner_text()
    assert reason in page.page.locator("#detail").inner_text()
    assert "?" not in notes.inner_text()
    assert marked.count() == 0
    page.check(path)


def test_effects_that_may_be_far_off_are_marked_in_their_rows(browser, tmp_path):
    path = tmp_path / "report.html"
    extents = {name: torch.ones(torch.tensor(value).shape[-1:] or (1,)) for name, value in VALUES.items()}
    low = {"chair.alpha": torch.tensor(0.01)}
    effects = {**make().attributions, "chair.alpha": torch.tensor(-0.5)}
    write_report(make(attributions=effects, extents=extents, parameter_values=low), path)
    page = Page(browser, path)
    marked = page.page.locator("#rows tr", has=page.page.locator(".mark", has_text="~"))
    assert [row.inner_text().split()[1:3] for row in marked.all()] == [["chair:", "alpha!~"]]
    said = "a small roughness often acts most near 0"
    assert said in marked.locator(".mark", has_text="~").get_attribute("title")
    assert f"~ chair: alpha: {said}" in page.page.locator("#notes").inner_text()
    page.click(11, 1)
    assert f"~ chair: alpha: {said}" in page.page.locator("#detail").inner_text()
    page.check(path)


def test_parameters_left_out_for_their_values_are_named(report):
    notes = report.page.locator("#notes").inner_text()
    assert "! knob.eta is left out: it is -0.0485 <i>" in notes


def test_invisible_objects_are_marked(report):
    row = report.page.locator("#rows tr", has_text="sky.radiance")
    assert "not in view" in row.inner_text()
    assert "Not in the picture: sky.radiance.value, #4" in report.page.locator("#detail").inner_text()
    row.click()
    assert "No pixel shows it directly" in report.page.locator("#detail").inner_text()


def test_the_table_sorts_both_ways_and_filters_by_name_and_object(report):
    by_saliency = report.names()
    assert by_saliency[0] == "lamp.radiance.value"
    header = report.page.locator("[data-sort=saliency]")
    header.click()
    assert report.names() == by_saliency
    assert report.page.locator("th.saliency").first.get_attribute("aria-sort") == "descending"
    header.click()
    assert report.names() == by_saliency[::-1]
    assert report.page.locator("th.saliency").first.get_attribute("aria-sort") == "ascending"
    report.page.locator("[data-sort=label]").click()
    labels = [
        one.inner_text().splitlines()[0].lower() for one in report.page.locator("#rows .label div").all()
    ]
    assert labels == sorted(labels)
    report.page.locator("[data-sort=gradient]").click()
    assert report.names()[0] == "lamp.radiance.value"
    assert report.names()[-1] == "floor.reflectance.value"
    report.page.locator("#filter").fill("chair alpha")
    assert report.names() == ["chair.alpha"]
    assert report.page.locator("#count").inner_text() == "1 of 6"
    report.page.locator("#filter").fill("nothing like it")
    assert "No parameter matches" in report.page.locator("#rows").inner_text()


def test_switches_and_slider_repaint_the_picture(report):
    before = report.colour("overlay", 4, 7)
    report.page.get_by_text("Signed", exact=True).click()
    signed, lamp = report.colour("overlay", 4, 7), report.colour("overlay", 2, 1)
    assert signed[0] > signed[2]  # vermillion: raising the floor lowers the metric
    assert lamp[2] > lamp[0]  # blue
    report.page.get_by_text("Linear", exact=True).click()
    assert report.colour("overlay", 11, 1) != before
    linear = report.colour("overlay", 15, 5)
    assert min(linear[:3]) > 230  # almost zero: pale
    report.page.get_by_text("Magnitude", exact=True).click()
    assert max(report.colour("overlay", 15, 5)[:3]) < 10  # black
    slider = report.page.locator("#opacity")
    slider.focus()
    report.page.keyboard.press("Home")
    assert report.page.locator("#overlay").evaluate("canvas => getComputedStyle(canvas).opacity") == "0"
    assert report.page.locator("#opacity-value").inner_text() == "off"


def test_report_figure_and_exported_picture_show_the_same_map(browser, tmp_path):
    attribution = make()
    write_report(attribution, tmp_path / "report.html")
    export(attribution, tmp_path / "map.png", colours="inferno")
    exported = np.array(Image.open(tmp_path / "map.png"))
    drawn = plot_heatmap(attribution).axes[1].images[0]
    in_figure = drawn.to_rgba(drawn.get_array(), bytes=True)[..., :3]
    assert np.abs(in_figure.astype(int) - exported).max() <= 1
    page = Page(browser, tmp_path / "report.html")
    page.page.get_by_text("Magnitude", exact=True).click()
    for line, column in ((1, 2), (1, 11), (7, 4), (5, 15)):
        painted = page.colour("overlay", column, line)[:3]
        # The canvas rounds to the next of 256 colours, where matplotlib rounds down.
        assert np.abs(np.array(painted) - exported[line, column]).max() <= 6
    page.context.close()


def test_texels_are_painted_while_they_are_switched_on(browser, tmp_path):
    path = tmp_path / "report.html"
    write_report([with_texels(), make("Other")], path)
    page = Page(browser, path)
    page.page.get_by_text("Signed", exact=True).click()
    assert page.colour("overlay", 9, 1) == page.colour("overlay", 14, 1)
    each_texel = "each texel: effect of a whole texture that acts like it"
    assert each_texel not in page.page.locator("#caption").inner_text()
    page.page.locator("#texels").check()
    assert each_texel in page.page.locator("#caption").inner_text()
    left, right = page.colour("overlay", 9, 1), page.colour("overlay", 14, 1)
    assert left[0] > left[2]  # vermillion: that texel lowers the metric
    assert right[2] > right[0]  # blue: the texel outweighs the roughness
    page.page.locator("#texels").uncheck()
    assert page.colour("overlay", 9, 1) == page.colour("overlay", 14, 1)
    page.page.get_by_text("Other").click()
    assert page.page.locator("#texels-choice").is_hidden()
    page.check(path)


def test_another_result_keeps_the_selection_and_shows_its_own_numbers(report):
    report.click(4, 7)
    report.page.get_by_text("Brightness", exact=True).first.click()
    assert report.selected() == ["floor.reflectance.value"]
    assert "0.6066 ± 0.0020" in report.page.locator("#rows").inner_text()
    assert f"in {NASTY}" in report.page.locator("#detail").inner_text()
    assert "Brightness" in report.page.locator("#facts").inner_text()


def test_contributions_add_and_variances_have_no_sign(browser, tmp_path):
    path = tmp_path / "report.html"
    quantities = ("effect of ablation", "variance of the gradient per unit")
    write_report(
        [dataclasses.replace(make(), info={**make().info, "quantity": one}) for one in quantities],
        path,
        titles=["Ablation", "Variance"],
    )
    page = Page(browser, path)
    assert page.page.locator("#rows .sign.lowers").first.get_attribute("title") == "takes from the metric"
    page.page.get_by_text("Signed", exact=True).click()
    assert "adds to the metric" in page.page.locator("#caption").inner_text()
    page.page.get_by_text("Variance", exact=True).first.click()
    assert page.page.locator("#rows .sign").count() == 0
    assert page.page.locator("[value=signed]").is_disabled()
    assert "Variance of the change of Glare" in page.page.locator("#caption").inner_text()
    page.check(path)


def test_each_result_has_its_own_image(browser, tmp_path):
    path = tmp_path / "report.html"
    fisheye = quarters(HEIGHT * 2, HEIGHT * 2)
    looks = fisheye.pixel % (HEIGHT * 2) > 0  # the first column shows nothing
    surfaces = dataclasses.replace(
        fisheye,
        **{name: getattr(fisheye, name)[looks] for name in ("pixel", "object_index", "fraction")},
    )
    write_report([make(), make("Fisheye", image=torch.rand(*surfaces.shape, 3), surfaces=surfaces)], path)
    page = Page(browser, path)
    page.click(4, 7)
    page.page.get_by_text("Fisheye", exact=True).first.click()
    assert page.selected() == ["floor.reflectance.value"]
    box = page.page.locator("#picture").bounding_box()
    assert box["width"] == pytest.approx(box["height"], abs=1)
    page.hover(0.1, 1)
    assert page.page.locator("#tip").is_hidden()
    assert page.colour("overlay", 0, 3) == [0, 0, 0, 0]
    assert page.hover(4, 1).startswith("lamp")
    page.check(path)


def test_results_of_one_metric_can_share_a_scale(browser, tmp_path):
    path = tmp_path / "report.html"
    write_report([make(), make(factor=10.0)], path)
    page = Page(browser, path)
    page.page.get_by_text("Magnitude", exact=True).click()
    page.page.get_by_text("Linear", exact=True).click()
    own = page.colour("overlay", 2, 1)
    page.page.locator("#shared").check()
    assert sum(page.colour("overlay", 2, 1)[:3]) < sum(own[:3])
    page.check(path)


def test_everything_can_be_reached_with_the_keyboard(report):
    keyboard, focused = report.page.keyboard, "document.activeElement.{}"
    report.page.locator("#filter").focus()
    reached = []
    for _ in range(6):
        keyboard.press("Tab")
        reached.append(
            report.page.evaluate("document.activeElement.dataset.row ?? document.activeElement.dataset.sort")
        )
    assert reached[:5] == ["rank", "label", "saliency", "gradient", "0"]
    report.page.locator("#rows tr").first.focus()
    keyboard.press("ArrowDown")
    assert report.page.evaluate(focused.format("dataset.row")) == "1"
    outline = report.page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"
    keyboard.press("Enter")
    assert report.selected() == ["chair.reflectance.data"]
    assert report.lit() == ["chair"]
    keyboard.press("End")
    assert report.page.evaluate(focused.format("dataset.row")) == "5"
    keyboard.press("Escape")
    assert report.selected() == []
    report.page.locator("#picture").focus()
    for _ in range(4):
        keyboard.press("ArrowUp")
    assert report.page.locator("#tip").inner_text().startswith("chair")
    assert "chair: alpha, norm 0.0500" in report.page.locator("#announcement").inner_text()
    keyboard.press("Enter")
    assert report.selected() == ["chair.reflectance.data", "chair.alpha"]


def test_every_control_has_a_name_and_names_from_scenes_are_escaped(report):
    unnamed = report.page.evaluate(
        """() => [...document.querySelectorAll("button, input, [role=grid], [role=application], [role=img]")]
        .filter((one) => !(one.ariaLabel || one.textContent.trim() || one.closest("label")))
        .map((one) => one.outerHTML)"""
    )
    assert unnamed == []
    report.hover(15.5, 5)
    report.click(15.5, 5)
    assert NASTY in report.page.locator("#detail").inner_text()
    assert NASTY.rpartition("/")[2] in report.page.title(), "as a path, without its folders"
    assert NASTY.rsplit("/", maxsplit=1)[-1] in report.page.locator("h1").inner_text()
    assert report.page.evaluate("window.hacked") is None
    assert report.page.locator('img[src="x"]').count() == 0
    assert report.page.locator("script").count() == 2


def test_the_page_blocks_foreign_scripts_and_requests(browser, written):
    page = Page(browser, written)
    page.page.evaluate(
        """() => { const script = document.createElement("script"); script.textContent = "window.hacked = 1";
        document.body.append(script); }"""
    )
    assert page.page.evaluate("window.hacked") is None
    failed = page.page.evaluate("fetch('https://example.com/').then(() => 'sent', () => 'refused')")
    assert failed == "refused"
    assert not [url for url in page.requests if url.startswith("http")]


def test_downloaded_numbers_have_full_precision(report):
    contents = {}
    for kind in ("csv", "json"):
        with report.page.expect_download() as download:
            report.page.locator(f"#{kind}").click()
        assert download.value.suggested_filename == f"attributions.{kind}"
        contents[kind] = Path(download.value.path()).read_text()
    rows = list(csv.DictReader(io.StringIO(contents["csv"], newline="")))
    results = json.loads(contents["json"])["results"]
    for attribution, result in zip([make(), make("Brightness", 2.0)], results, strict=True):
        mine = [row for row in rows if row["result"] == result["title"]]
        ranking = attribution.ranking()
        assert [row["name"] for row in mine] == [row.name for row in ranking]
        assert [row["name"] for row in result["ranking"]] == [row.name for row in ranking]
        for line, entry, row in zip(mine, result["ranking"], ranking, strict=True):
            assert float(line["effect"]) == entry["effect"] == pytest.approx(row.effect, rel=1e-7)
            assert float(line["effect_error"]) == pytest.approx(row.effect_error, rel=1e-7)
            assert float(line["total_1"]) == entry["total"][0] == pytest.approx(row.total[0], rel=1e-7)
            assert line["caution"] == (entry["caution"] or "")
            assert line["metric_unit"] == result["metric"]["unit"]
    assert any(row["caution"] for row in rows)
    assert results[0]["info"]["seed"] == shifted(7)
    assert {row["name"]: row["value_2"] for row in rows}["floor.reflectance.value"] == "0.25"


def test_the_downloaded_table_is_that_of_write_csv(browser, tmp_path):
    result = make()
    extents = {name: torch.full((result.covariance[name].shape[0],), 0.8) for name in result}
    info = {**result.info, "metric_cautions": ["the lamp is smaller than a pixel"]}
    result = dataclasses.replace(result, extents=extents, info=info)
    write_report(result, tmp_path / "report.html")
    write_csv(result, tmp_path / "written.csv")
    page = Page(browser, tmp_path / "report.html")
    with page.page.expect_download() as download:
        page.page.locator("#csv").click()
    saved = list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text(), newline="")))
    page.context.close()
    written = list(csv.DictReader(io.StringIO((tmp_path / "written.csv").read_text(), newline="")))
    assert [*saved[0]] == ["result", *written[0]]
    for one, other in zip(saved, written, strict=True):
        for name, text in other.items():
            assert one[name] == text or float(one[name]) == pytest.approx(float(text), rel=1e-6), name
    assert {row["metric_caution"] for row in saved} == {"the lamp is smaller than a pixel"}
    assert float(saved[0]["range_1"]) == pytest.approx(0.8)


def test_the_footer_says_how_results_were_computed(report):
    facts = report.page.locator("#facts").inner_text()
    for said in ("rooms/office.xml", "VanillaSceneGradient", "64", str(shifted(7)), "torch 2.13"):
        assert said in facts
    report.page.get_by_text("Every setting").click()
    assert '"replicates": 8' in report.page.locator("#settings").inner_text()


def test_light_and_dark_follow_the_system_and_the_button(browser, written):
    brightness = """() => getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).slice(0, 3)
        .reduce((sum, one) => sum + Number(one), 0)"""
    shades = {}
    for scheme in ("light", "dark"):
        page = Page(browser, written, color_scheme=scheme)
        shades[scheme] = page.page.evaluate(brightness)
        page.page.locator("#theme").click()
        shades[f"{scheme} switched"] = page.page.evaluate(brightness)
        page.check(written)
        page.context.close()
    assert shades["light"] == shades["dark switched"] > 600
    assert shades["dark"] == shades["light switched"] < 150


def test_the_page_fits_a_phone_and_a_tap_selects(browser, written):
    page = Page(browser, written, **PHONE)
    page.page.touchscreen.tap(*page.place(11, 1))
    assert page.selected() == ["chair.reflectance.data", "chair.alpha"]
    assert page.lit() == ["chair"]
    assert "0.0500 ± 0.0020" in page.page.locator("#detail").inner_text()
    assert page.page.evaluate("document.documentElement.scrollWidth") == 360
    small = page.page.evaluate(
        """() => [...document.querySelectorAll("button:not([data-sort]), .switch span, #rows tr")]
        .filter((one) => one.offsetParent && one.getBoundingClientRect().height < 24)
        .map((one) => one.outerHTML)"""
    )
    assert small == []
    # The image stays visible above the table.
    page.page.locator("#rows tr").last.scroll_into_view_if_needed()
    assert page.page.locator("#picture").bounding_box()["y"] == pytest.approx(0, abs=1)
    page.check(written)
    page.context.close()


# ------------------------------------------------------------------------------------------ the command line


def test_ctrl_c_leaves_a_report_of_finished_results(tmp_path, capsys, monkeypatch):
    def interrupted_at_the_second(self, inputs: object = None, **_: object) -> SceneAttribution:
        result = make(type(self.metric).__name__)
        result.info["metric_bias"] = 0.0
        result.info["picture"] = {"caution": None}
        if "Glare" in result.info["metric"]:
            raise AttributionInterrupted(result)
        return result

    monkeypatch.setattr(VanillaSceneGradient, "attribute", interrupted_at_the_second)
    arguments = ["attribute", "cornell-box", "--metric", "luminance", "--metric", "ugr", "--metric", "dgp"]
    size = ["--resolution", "16x9"]  # of the picture that make gives
    assert cli.main([*arguments, *size, "--report", "--json", "--out", str(tmp_path)]) == 130
    titles = [one["title"] for one in data_of(tmp_path / "report.html")["results"]]
    assert titles == ["MeanLuminance", "UnifiedGlareRating"]


def test_the_command_line_writes_one_report_for_all_metrics(tmp_path, capsys, browser):
    out = tmp_path / "out"
    small = ["--resolution", "24x24", "--spp", "16", "--max-depth", "3", "--no-progress"]
    metrics = ["--metric", "luminance", "--metric", "ugr", "--threshold-factor", "3"]
    arguments = ["attribute", "cornell-box", *small, *metrics, "--report", "--out", str(out)]
    assert cli.main(arguments) == 0
    path = out / "report.html"
    assert str(path) in capsys.readouterr().out
    page = Page(browser, path)
    assert page.page.locator(".result").count() == 2
    assert page.page.locator("#rows tr").count() > 5
    assert page.page.locator("#rows .swatch").count() > 3
    page.check(path)
