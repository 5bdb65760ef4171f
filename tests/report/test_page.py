"""The page in a real browser: what it opens with, its address, downloads, phones, pairs and explanations."""

from __future__ import annotations

import csv
import dataclasses
import html
import io
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from pages import HEIGHT, NASTY, PHONE, VALUES, WIDTH, Page, make, quarters
from PIL import Image
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import SceneAttribution, VanillaSceneGradient
from scenecaptum.attr import Change, Definition, Explanation, Source
from scenecaptum.errors import SceneCaptumError
from scenecaptum.metrics import ClassLogit
from scenecaptum.report import Comparison, Table, write_report
from scenecaptum.visualization import advised, findings, plot_heatmap, plot_plan

UGR = {
    "name": "unified glare rating",
    "symbol": "UGR",
    "unit": "cd/m²",
    "better": "lower",
    "limits": [2.337],
    "source": "EN 12464-1",
}
VERDICT = "within 19, the limit for offices"
LONG_NAME = "luminaire_" + 12 * "suspended"  # no place to break
SVG = "{http://www.w3.org/2000/svg}"


def ranged(**changes: Any) -> SceneAttribution:
    """A result whose ranges are known: it opens in the scale of effects."""
    channels = {name: torch.tensor(value).shape[-1:] or (1,) for name, value in VALUES.items()}
    return make(**{"extents": {name: torch.ones(count) for name, count in channels.items()}, **changes})


def noted(attribution: SceneAttribution, **info: Any) -> SceneAttribution:
    return dataclasses.replace(attribution, info={**attribution.info, **info})


def plain_picture(*colour: float) -> torch.Tensor:
    return torch.tensor(colour).expand(HEIGHT, WIDTH, 3).clone()


def explained() -> Explanation:
    before, after = torch.tensor([0.62, 0.58, 0.52]), torch.tensor([0.72, 0.68, 0.62])
    return Explanation(
        noted(ranged(), measure=UGR, verdict=VERDICT),
        sources=(Source("sky", "top", 0.89, 0.001, 3160.0), Source(LONG_NAME, "left", 0.03, 0.001, 5000.0)),
        changes=(
            Change("wall", "wall_left: reflectance", before, after, -0.7, 0.01, -0.68, 0.02),
            Change(NASTY, f"{LONG_NAME}: {NASTY}", before, after, 0.3, 0.01, 0.6, 0.02),
        ),
    )


def written(folder: Path, *results: Any, **options: Any) -> Path:
    path = folder / "report.html"
    write_report(list(results), path, **options)
    return path


def checked(page: Page, *values: str) -> list[bool]:
    return [page.page.locator(f'[type="radio"][value="{value}"]').is_checked() for value in values]


def box_of(page: Page, selector: str) -> tuple[float, float]:
    """Where an element begins and ends, from the top of the window."""
    box = page.page.locator(selector).bounding_box()
    return box["y"], box["y"] + box["height"]


def downloaded(page: Page, button: str, path: Path) -> Path:
    with page.page.expect_download() as download:
        page.page.locator(f"#{button}").click()
    download.value.save_as(path)
    return path


# ------------------------------------------------------------------------------------------- what it opens with


def test_it_opens_signed_with_the_colours_of_the_figure(browser, tmp_path):
    attribution = ranged()
    page = Page(browser, written(tmp_path, attribution))
    assert checked(page, "signed", "sqrt") == [True, True]
    drawn = plot_heatmap(attribution, signed=True).axes[1].images[0]
    in_figure = drawn.to_rgba(drawn.get_array(), bytes=True)[..., :3].astype(int)
    for line, column in ((1, 2), (1, 11), (7, 4), (5, 15)):
        painted = page.colour("overlay", column, line)[:3]
        # The canvas rounds to the next of 256 colours, where matplotlib rounds down.
        assert np.abs(np.array(painted) - in_figure[line, column]).max() <= 6
    page.context.close()


@pytest.mark.parametrize(
    ("vectors", "letters"),
    [
        ([], "R G B"),
        (["lamp.radiance.value"], "R G B or x y z"),
        (["floor.reflectance.value", "lamp.radiance.value", "chair.reflectance.data"], "x y z"),
    ],
)
def test_the_three_numbers_of_a_row_are_of_a_colour_or_along_the_axes(browser, tmp_path, vectors, letters):
    page = Page(browser, written(tmp_path, noted(ranged(), vectors=vectors)))
    assert page.page.locator("th.gradient").inner_text().startswith(f"Gradient per unit ({letters})")
    page.page.locator("#rows tr").filter(has_text="lamp").first.click()
    channels = page.page.locator("#detail .card .channel").all_inner_texts()
    assert [one.split()[0] for one in channels] == (["x", "y", "z"] if vectors else ["R", "G", "B"])
    said = (
        "of a translation or rotation in the direction with the largest effect"
        in page.page.locator("#notes").inner_text()
    )
    assert said == bool(vectors)
    lamp = page.page.locator("#rows tr").filter(has_text="lamp").first.locator(".sign")
    assert (lamp.get_attribute("title") or "").startswith("moving it in" if vectors else "raising it")
    page.context.close()


def test_the_whisker_of_the_longest_bar_is_whole(browser, tmp_path):
    attribution = ranged()
    longest, *_ = attribution.ranking()
    covariance = dict(attribution.covariance)
    covariance[longest.name] = covariance[longest.name] * (longest.saliency / 4 / longest.saliency_error) ** 2
    page = Page(browser, written(tmp_path, dataclasses.replace(attribution, covariance=covariance)))
    track = page.page.locator("#rows .track").first
    bar, whisker = (track.locator(part).bounding_box() for part in (".bar", ".whisker"))
    end = bar["x"] + bar["width"]
    assert whisker["x"] + whisker["width"] - end == pytest.approx(end - whisker["x"], abs=1.5)
    assert whisker["width"] == pytest.approx(bar["width"] / 2, abs=2)
    page.context.close()


def test_effects_are_compared_where_ranges_are_known_and_else_norms(browser, tmp_path):
    path = written(tmp_path, ranged(), make(), titles=["Ranged", "Per unit"])
    page = Page(browser, path)
    header, first = page.page.locator("th.saliency"), page.page.locator("#rows tr").first
    assert header.first.inner_text() == "Effect"
    notes = page.page.locator("#notes p").first
    assert notes.inner_text() == "Effect: first-order change of Glare over the range of the parameter"
    assert "+0.7000" in first.inner_text()  # 0.3 + 0.4
    page.page.get_by_text("Per unit", exact=True).click()
    assert header.first.inner_text() == "Norm"
    assert notes.inner_text() == "Norm: ℓ2 norm of the change of Glare per unit of the parameter"
    assert "0.5000" in first.inner_text()
    page.check(path)
    page.context.close()


def test_unit_verdict_and_metric_are_at_the_headline(browser, tmp_path):
    rated = noted(ranged(), measure=UGR, verdict=VERDICT)
    path = written(tmp_path, rated, Explanation(rated), ranged(), titles=["as it is", "explained", "Glare"])
    page = Page(browser, path)
    bare, explanation, plain = (one.inner_text().splitlines() for one in page.page.locator(".result").all())
    doubt = "too close to 2.337 to be sure"
    assert bare == ["as it is · unified glare rating", "2.3369 ± 0.0005 cd/m²", f"{VERDICT}; {doubt}"]
    assert explanation[2] == f"{VERDICT} (EN 12464-1); {doubt}"
    assert plain == ["Glare", "2.3369 ± 0.0005"]
    assert page.page.locator("th.saliency").inner_text() == "Effect (cd/m²)"
    page.check(path)
    page.context.close()


def test_the_headline_is_the_value_by_the_definition_with_the_weather(browser, tmp_path):
    exact = Explanation(ranged(), definition=Definition(2.0, "low"), premises=("weather: Oslo",))
    path = written(tmp_path, exact)
    page = Page(browser, path)
    _, value, meaning, quoted, weather = page.page.locator(".result").inner_text().splitlines()
    assert value == "2"
    assert meaning == "low"
    assert quoted.startswith("quote 2, the value by")
    assert "the relaxed value 2.3369 ± 0.0005 only serves the derivatives" in quoted
    assert weather == "weather: Oslo"
    effect = "first-order change of relaxed Glare over the range of the parameter"
    for part in ("#notes", "#caption"):  # the caption begins with it
        assert effect in page.page.locator(part).inner_text().replace("First", "first")
    with page.page.expect_download() as download:
        page.page.locator("#csv").click()
    first = next(csv.DictReader(io.StringIO(Path(download.value.path()).read_text(), newline="")))
    assert (first["metric"], float(first["metric_value"])) == (
        "relaxed Glare",
        pytest.approx(2.3369, rel=1e-4),
    )
    page.check(path)
    page.context.close()


def test_a_phone_has_one_card_in_a_row(browser, tmp_path):
    path = written(tmp_path, make(), make("Brightness"), make("Contrast"))
    for width, is_narrow in ((390, True), (600, False)):
        context = browser.new_context(viewport={"width": width, "height": 800})
        page = context.new_page()
        page.goto(path.as_uri())
        tops = page.locator(".result").evaluate_all(
            "(cards) => cards.map((one) => one.getBoundingClientRect().top)"
        )
        assert (len(set(tops)) == len(tops)) == is_narrow, width
        context.close()


@pytest.mark.parametrize(
    "width", [600, 1920, *(pytest.param(w, marks=pytest.mark.long) for w in (1000, 1200))]
)
def test_two_cards_are_side_by_side_and_as_high_as_each_other(browser, tmp_path, width):
    note = " ".join(["valid if the lights of the scene are in W/(m² sr)"] * 3)
    path = written(tmp_path, Explanation(make(), premises=(note,)), Explanation(make(), premises=(note * 2,)))
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = context.new_page()
    page.goto(path.as_uri())
    boxes = [card.bounding_box() for card in page.locator(".result-face").all()]
    assert len({box["y"] for box in boxes}) == 1
    assert boxes[0]["height"] == pytest.approx(boxes[1]["height"])
    assert boxes[0]["x"] + boxes[0]["width"] < boxes[1]["x"]
    assert page.evaluate("document.documentElement.scrollWidth") == width
    context.close()


def test_a_plan_has_no_overlay_and_nothing_to_point_at(browser, tmp_path):
    path = written(
        tmp_path,
        ranged(surfaces=None),
        ranged(),
        titles=["Grid", "View"],
        plans=[Figure(figsize=(4, 3)), None],
    )
    page = Page(browser, path)
    for plan in (True, False):
        page.page.locator("#results").get_by_text("Grid" if plan else "View", exact=True).click()
        assert page.page.locator("#plan").is_visible() == plan
        for selector in ("#picture", "#scale", "#opacity", "#png"):
            assert page.page.locator(selector).is_visible() != plan
        page.page.locator("#rows tr").first.click()
        assert page.page.locator("#detail").get_by_text("of the picture").count() == (0 if plan else 1)
        page.page.keyboard.press("Escape")
    assert page.page.locator("#rows .tag").count() > 0, "the picture does not show all"
    page.check(path)
    page.context.close()


def test_without_any_effect_the_list_is_one_line_and_the_picture_is_plain(browser, tmp_path):
    zeros = ranged(factor=0.0, covariance={n: torch.zeros_like(c) for n, c in ranged().covariance.items()})
    path = written(tmp_path, zeros, ranged(), titles=["Night", "Day"])
    page = Page(browser, path)
    for is_lit in (False, True):
        page.page.get_by_text("Day" if is_lit else "Night", exact=True).click()
        rows = page.page.locator("#rows tr").all_inner_texts()
        assert len(rows) == len(VALUES) if is_lit else rows == ["No parameter has an effect."]
        opacity = page.page.locator("#overlay").evaluate("one => getComputedStyle(one).opacity")
        assert (float(opacity) > 0) == is_lit
        grey = page.page.locator("#render").evaluate("one => one.style.filter")
        assert (grey == "grayscale(0)") != is_lit
        for selector in ("#scale", "#opacity", "#of-pictures", "#png", "#svg", "#filter"):
            assert page.page.locator(selector).is_visible() == is_lit
    page.check(path)
    page.context.close()


def lines_of(page: Page, selector: str) -> list[str]:
    """The lines of an element as they are drawn, without their spaces at both ends."""
    lines: list[str] = page.page.locator(selector).evaluate(
        """one => {
          const lines = {};
          const texts = document.createTreeWalker(one, NodeFilter.SHOW_TEXT);
          while (texts.nextNode()) for (let at = 0; at < texts.currentNode.length; at += 1) {
            const range = document.createRange();
            range.setStart(texts.currentNode, at);
            range.setEnd(texts.currentNode, at + 1);
            const { bottom, width } = range.getBoundingClientRect();
            if (width) lines[Math.round(bottom)] = (lines[Math.round(bottom)] ?? "") + range.toString();
          }
          return Object.values(lines);
        }"""
    )
    return [line.strip() for line in lines]


@pytest.mark.parametrize("width", [1280, 390])
def test_names_of_classes_break_between_their_words_if_they_are_wider_than_a_line(
    browser, tmp_path, width: int
):
    metric, method = "daylight glare probability (DaylightGlareProbability)", "ScenePart" * 8
    path = written(tmp_path, noted(ranged(), metric=metric, method=method))
    page = Page(browser, path, viewport={"width": width, "height": 900})
    assert lines_of(page, "#facts .metric dd")[-1].endswith("(DaylightGlareProbability)")
    parts = lines_of(page, "#facts .method dd")
    assert len(parts) > 1
    assert "".join(parts) == method
    assert all(re.match("Scene|Part", part) and part.endswith(("Scene", "Part")) for part in parts)
    page.context.close()


@pytest.mark.parametrize("width", [1280, 390])
def test_numbers_do_not_break_at_their_points(browser, tmp_path, width: int):
    names = [f"a threshold factor of {15 + index}.105 and 0.7311 glare" for index in range(8)]
    versions = {"scenecaptum": "0.2.0", "mitsuba": "3.9.1", "torch": "2.13.0+cpu", "numpy": "2.4.1"}
    method = "−0.06386 5.105 wall.001.k a_b v1.b DaylightGlare"
    path = written(
        tmp_path, *(noted(ranged(), versions=versions, method=method) for _ in names), titles=names
    )
    page = Page(browser, path, viewport={"width": width, "height": 900})
    page.page.locator("#rows tr").first.click()
    for selector in ("#detail .card dl", "#facts .versions dd"):
        lines = lines_of(page, f"{selector} >> nth=0")
        assert not any(re.search(r"\d\.$", line) for line in lines), lines
    words = page.page.locator("#facts .method dd .word").all()
    breaks = [(word.inner_text(), word.locator("wbr").count()) for word in words]
    assert breaks == [("wall.001.k", 2), ("a_b", 1), ("v1.b", 1), ("DaylightGlare", 1)]
    page.context.close()


def test_a_picture_too_noisy_for_the_metric_is_said(browser, tmp_path):
    noisy = noted(ranged(), picture={"spp": 4, "caution": "the noise alone raises it <b>"})
    page = Page(browser, written(tmp_path, noisy))
    assert "! the noise alone raises it <b>" in page.page.locator(".result").inner_text()
    page.context.close()


def test_a_caution_of_a_comparison_is_in_the_box_of_its_value(browser, tmp_path):
    noisy = noted(ranged(), picture={"spp": 4, "caution": "the noise alone raises it"})
    said = Explanation(ranged(), premises=("caution: DGP is valid from 0.2",), count=0)
    path = written(tmp_path, said, noisy, titles=["as it is", "B"], comparison=Comparison(0.1))
    page = Page(browser, path)
    before, after = page.page.locator(".result").all_inner_texts()
    assert "! the noise alone raises it" in after
    assert "noise" not in before
    assert "! DGP is valid from 0.2" in before
    page.context.close()


def test_the_settings_of_a_sensor_grid_and_of_an_explanation_are_those_that_were_given(browser, tmp_path):
    info = {"resolution": [9, 7], "explanation_seed": 3}
    bare = noted(ranged(surfaces=None), **info)
    described = noted(bare, **{"sensor grid": "63 points on floor, 0.8 m above it, 7 × 5 m, 0.78 m apart"})
    path = written(
        tmp_path,
        bare,
        described,
        noted(ranged(), **info),
        titles=["A", "B", "C"],
        plans=[Figure(), Figure(), None],
    )
    page = Page(browser, path)
    for title, grid in (("A", "9 × 7 sensor points"), ("B", described.info["sensor grid"])):
        page.page.locator("#results").get_by_text(title, exact=True).click()
        assert " ".join(page.page.locator("#facts").inner_text().split()).count(f"sensor grid {grid}") == 1
        assert page.page.locator("#facts .seed dd").inner_text() == "3"
        assert page.page.locator("#facts").get_by_text("resolution").count() == 0
    page.page.locator("#results").get_by_text("C", exact=True).click()
    assert page.page.locator("#facts .resolution dd").inner_text() == "9 × 7"
    assert page.page.locator("#facts .render_shown dd").inner_text() == "denoised"
    page.context.close()


def test_a_plan_of_the_command_line_can_be_read_on_a_phone(browser, tmp_path):
    points = torch.stack(torch.meshgrid(torch.arange(7.0), torch.arange(9.0), indexing="xy"), -1)
    figure = plot_plan(torch.rand(9, 7), points, width=4.2)  # as the commands draw it
    page = Page(browser, written(tmp_path, ranged(surfaces=None), plans=[figure]), **PHONE)
    shown = page.page.locator("#plan").bounding_box()
    size = figure.axes[0].xaxis.label.get_size() / 72 * shown["width"] / figure.get_size_inches()[0]
    assert size > 9, "pixels of the page"
    page.context.close()


def test_each_of_two_plans_has_the_name_of_its_design_and_says_how_to_see_the_other(browser, tmp_path):
    figures = [Figure(figsize=(4, 3)), Figure(figsize=(4, 3), facecolor="red")]
    results = [ranged(surfaces=None), ranged(surfaces=None)]
    page = Page(
        browser,
        written(tmp_path, *results, plans=figures, titles=["now", "tinted"], comparison=Comparison(0.5)),
    )
    above = page.page.locator("#plan-of")
    for title in ("now", "tinted"):
        page.page.locator(".result", has_text=title).click()
        assert above.inner_text().split("\n")[0] == title
        assert "Click another card above" in above.inner_text()
    page.context.close()
    alone = Page(browser, written(tmp_path, results[0], plans=figures[:1]))
    assert not alone.page.locator("#plan-of").is_visible()
    alone.context.close()


def long_result(rows: int) -> SceneAttribution:
    values = {f"book_{index}.reflectance.value": torch.full((3,), 1.0 - index / 100) for index in range(rows)}
    floor = "floor.reflectance.value"  # which the picture shows; the last of all
    return ranged(
        attributions={**values, floor: torch.full((3,), 1e-3)},
        standard_error={name: torch.full((3,), 1e-4) for name in (*values, floor)},
        covariance={name: 1e-8 * torch.eye(3) for name in (*values, floor)},
        parameter_values={},
        extents={name: torch.ones(3) for name in (*values, floor)},
    )


def test_a_long_table_shows_its_first_rows_what_is_selected_and_on_request_all(browser, tmp_path):
    path = written(tmp_path, long_result(30), title="A <b>room")
    page = Page(browser, path)
    assert page.page.locator("#heading").inner_text() == page.page.title() == "A <b>room"
    first = [f"book_{index}.reflectance.value" for index in range(15)]
    assert page.names() == first
    assert page.page.locator("#count").inner_text() == "15 of 31"
    page.click(2, 7)  # the floor
    assert page.names() == [*first, "floor.reflectance.value"]
    assert page.selected() == ["floor.reflectance.value"]
    page.page.locator("#filter").fill("book_2")
    assert len(page.names()) == 11, "a filter looks in all rows"
    page.page.locator("#filter").fill("")
    page.page.get_by_text("Show all 31").click()
    assert len(page.names()) == 31
    assert not page.page.locator("#more").is_visible()
    page.context.close()
    again = Page(browser, path, "#all=1")
    assert len(again.names()) == 31
    again.check(path)
    again.context.close()


# ------------------------------------------------------------------------------------------------- its address


def choose_everything(page: Page) -> None:
    page.page.get_by_text("Brightness", exact=True).first.click()
    page.page.get_by_text("Magnitude", exact=True).click()
    page.page.get_by_text("Linear", exact=True).click()
    for _ in range(2):  # once more for the reverse order
        page.page.locator("[data-sort=label]").click()
    page.page.locator("#filter").fill("chair")
    page.click(11, 1)


def shown(page: Page) -> dict[str, Any]:
    return {
        "checked": checked(page, "0", "1", "magnitude", "signed", "sqrt", "linear"),
        "sort": page.page.locator("th.label").first.get_attribute("aria-sort"),
        "filter": page.page.locator("#filter").input_value(),
        "rows": page.names(),
        "selected": page.selected(),
        "lit": page.lit(),
        "detail": page.page.locator("#detail").inner_text(),
        "colours": [page.colour("overlay", *place) for place in ((2, 1), (11, 1), (4, 7))],
        "values": page.page.locator("#rows").inner_text(),
    }


def test_a_link_shows_everything_that_was_chosen(browser, tmp_path):
    path = written(tmp_path, ranged(), ranged(metric="Brightness", factor=2.0))
    page = Page(browser, path)
    start = shown(page)
    choose_everything(page)
    chosen = shown(page)
    assert chosen["checked"] == [False, True, True, False, False, True]
    assert chosen["rows"] == chosen["selected"] == ["chair.alpha", "chair.reflectance.data"]
    assert all(chosen[name] != start[name] for name in chosen)
    fragment = page.page.evaluate("location.hash")
    page.check(path)
    page.context.close()
    linked = Page(browser, path, fragment)
    assert shown(linked) == chosen
    # An address typed into the open page is followed too.
    with linked.page.expect_navigation():
        linked.page.evaluate("location.hash = 'quantity=signed'")
    linked.page.wait_for_selector("html[data-ready]")
    assert shown(linked) == start
    assert linked.complaints == []
    linked.context.close()


@pytest.mark.parametrize(
    "fragment",
    [
        "#result=99&quantity=half&scale=cubic&sort=nonsense&row=none",
        "#result=-1&sort=__proto__&object=none",
        "#result=0.5&sort=-&row=&%E0%A4%A",
    ],
)
def test_a_broken_address_opens_the_default(browser, tmp_path, fragment):
    path = written(tmp_path, ranged(), ranged(metric="Brightness", factor=2.0))
    page, broken = Page(browser, path), Page(browser, path, fragment)
    assert shown(broken) == shown(page)
    broken.check(path)
    for one in (page, broken):
        one.context.close()


def test_a_page_inside_another_works_without_an_address(browser, tmp_path):
    report = written(tmp_path, ranged()).read_text()
    host = tmp_path / "host.html"
    host.write_text(
        f'<html data-ready><iframe width="1200" height="800" srcdoc="{html.escape(report)}"></iframe>'
    )
    page = Page(browser, host)
    inside = page.page.frame_locator("iframe")
    inside.locator("#rows tr").first.click()
    assert "lamp.radiance.value" in inside.locator("#detail").inner_text()
    assert page.complaints == []
    page.context.close()


# --------------------------------------------------------------------------------------------------- downloads


def test_the_exported_map_is_large_and_has_the_colours_of_the_overlay(browser, tmp_path):
    path = written(tmp_path, ranged())
    page = Page(browser, path)
    page.page.locator("#opacity").focus()
    page.page.keyboard.press("End")
    with Image.open(downloaded(page, "png", tmp_path / "map.png")) as picture:
        assert picture.format == "PNG"
        assert picture.width >= 1280
        assert picture.width * HEIGHT == picture.height * WIDTH
        pixels, factor = np.array(picture.convert("RGB")).astype(int), picture.width // WIDTH
    for column, line in ((2, 1), (11, 1), (4, 7), (15, 5)):
        found = pixels[line * factor + factor // 2, column * factor + factor // 2]
        assert np.abs(found - page.colour("overlay", column, line)[:3]).max() <= 1
    page.check(path)
    page.context.close()


def bars(path: Path) -> tuple[list[dict[str, float]], list[str]]:
    """The bars without the background, and all texts."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == f"{SVG}svg"
    assert {one.tag.removeprefix(SVG) for one in root.iter()} == {"svg", "rect", "text", "line"}
    places = [one.attrib for one in root.iter(f"{SVG}rect") if one.get("width") != "100%"]
    numbers = [{name: float(place[name]) for name in ("x", "width")} for place in places]
    return numbers, [one.text or "" for one in root.iter(f"{SVG}text")]


def test_exported_bars_are_the_rows_of_the_table(browser, tmp_path):
    """Effects go to either side of zero; norms, which have no sign, all to one."""
    results = noted(ranged(), measure=UGR), make()
    path = written(tmp_path, *results, titles=["Ranged", NASTY])
    page = Page(browser, path)
    for index, title in enumerate(["Ranged: 2.3369 ± 0.0005 cd/m²", f"{NASTY}: 2.3369 ± 0.0005"]):
        page.page.locator(".result").nth(index).click()
        places, texts = bars(downloaded(page, "svg", tmp_path / f"{index}.svg"))
        labels = [row.label for row in results[index].ranking()]
        numbers = page.page.locator("#rows .number").all_inner_texts()
        listed = [
            text
            for pair in zip(labels, (one.lstrip("▲▼◆ \n") for one in numbers), strict=True)
            for text in pair
        ]
        assert texts[0] == title
        assert texts[2:] == listed
        assert len(places) == len(VALUES)
        sides = {
            row.effect < 0: place["x"] for row, place in zip(results[index].ranking(), places, strict=True)
        }
        assert (sides[True] < sides[False]) == (index == 0)
        longest = max(places, key=lambda place: place["width"])
        assert longest is places[0]
    page.check(path)
    page.context.close()


def test_nothing_overlaps_in_the_exported_bars(browser, tmp_path):
    page = Page(browser, written(tmp_path, ranged()))
    path = downloaded(page, "svg", tmp_path / "bars.svg")
    page.page.goto(path.as_uri())
    read = """(all) => all.map((one) => one.getBoundingClientRect())
        .map(({left, right, top, bottom}) => [left, right, top, bottom])"""
    boxes = page.page.locator("text, rect[fill^='#']").evaluate_all(read)
    root = ElementTree.parse(path).getroot()
    whole = [float(root.attrib[name]) for name in ("width", "height")]
    assert len(boxes) == 2 + 3 * len(VALUES)
    for index, (left, right, top, bottom) in enumerate(boxes):
        assert left >= 0
        assert top >= 0
        assert right <= whole[0]
        assert bottom <= whole[1]
        for other in boxes[:index]:
            apart = left >= other[1] or right <= other[0] or top >= other[3] - 2 or bottom <= other[2] + 2
            assert apart, f"{boxes[index]} and {other}"
    page.context.close()


# ------------------------------------------------------------------------------------------- what is out of sight


def test_glass_and_mirrors_are_told_from_what_is_not_in_view(browser, tmp_path):
    glass = noted(ranged(), seen_through=["sky.radiance.value"])
    path = written(tmp_path, glass, ranged(), titles=["Behind glass", "Out of view"])
    page = Page(browser, path)
    row = page.page.locator("#rows tr", has_text="sky.radiance")
    detail = page.page.locator("#detail")
    assert row.locator(".tag").inner_text() == "behind glass or mirrored"
    assert page.page.locator("#rows .tag").count() == 1
    assert "Not in the picture" not in detail.inner_text()
    caption, left_out = (
        page.page.locator("#caption"),
        "Not on the map, seen only behind glass or mirrored: sky.radiance",
    )
    for quantity in ("Signed", "Magnitude"):
        page.page.get_by_text(quantity, exact=True).click()
        assert left_out in caption.inner_text()
    row.click()
    assert "only behind glass or in a mirror" in detail.inner_text()
    page.page.get_by_text("Out of view", exact=True).click()
    assert "Not on the map" not in caption.inner_text()
    assert row.locator(".tag").inner_text() == "not in view"
    assert "No pixel shows it directly" in detail.inner_text()
    page.page.locator("#clear").click()
    assert "Not in the picture: sky.radiance.value" in detail.inner_text()
    page.check(path)
    page.context.close()


def test_the_largest_effects_out_of_sight_are_named_and_the_others_counted(browser, tmp_path):
    found = ranged()
    unseen = dataclasses.replace(found.surfaces, parameters=tuple(() for _ in found.surfaces.objects))
    path = written(tmp_path, dataclasses.replace(found, surfaces=unseen))
    page = Page(browser, path)
    (said,) = re.findall(r"Not in the picture: (.*)", page.page.locator("#detail").inner_text())
    *named, rest = said.removesuffix(".").split("; ")
    ranked = [row for row in found.ranking() if row.saliency]
    for number, (text, row) in enumerate(zip(named, ranked[:3], strict=True), start=1):
        start = f"{row.label}, #{number} with {'an effect of ' if number == 1 else ''}"
        assert text.startswith(start)
    assert rest == f"and {len(ranked) - 3} more"
    page.check(path)
    page.context.close()


# ---------------------------------------------------------------------------------------------------- on a phone


@pytest.mark.parametrize("width", [340, 430, *(pytest.param(w, marks=pytest.mark.long) for w in (360, 390))])
def test_long_numbers_stand_within_a_narrow_page_and_do_not_break(browser, tmp_path, width):
    """The error may stand below the value, but neither is cut off or broken."""
    signed = ranged()
    error = 1e-6
    fine = dataclasses.replace(
        signed,
        attributions={name: torch.full_like(one, -0.31415926) for name, one in signed.items()},
        covariance={name: error**2 * torch.eye(len(one)) for name, one in (signed.covariance or {}).items()},
    )
    page = Page(browser, written(tmp_path, fine), viewport={"width": width, "height": 740})
    assert page.page.evaluate("document.documentElement.scrollWidth") == width
    parts = page.page.locator("#rows .whole").all()
    assert len(parts) >= 2 * len(fine) - 2
    for part in parts:
        box = part.bounding_box()
        assert box["x"] + box["width"] <= width - 15
        assert part.evaluate("one => one.getClientRects().length") <= 2  # the mark and the number
        assert box["height"] < 30, "on one line"
    page.context.close()


def test_details_on_a_phone_are_in_sight_below_what_was_touched(browser, tmp_path):
    path = written(tmp_path, explained(), ranged(metric="Brightness"))
    page = Page(browser, path, **PHONE)

    def check_detail(title: str, touched: str) -> None:
        assert title in page.page.locator("#detail h2").inner_text()
        top, bottom = box_of(page, "#detail")
        assert 0 <= top < bottom <= 740
        card_top, _ = box_of(page, "#detail .card h3 >> nth=0")
        assert card_top < 740
        start, end = box_of(page, touched)
        assert start >= 0
        assert end <= top + 1, "the details cover what was touched"

    def tap(selector: str, across: float, down: float) -> None:
        """Tap at a place of an element that is at the bottom of the window, where the details will be."""
        page.page.locator(selector).evaluate("one => scrollBy(0, one.getBoundingClientRect().bottom - 735)")
        box = page.page.locator(selector).bounding_box()
        page.page.touchscreen.tap(box["x"] + across * box["width"], box["y"] + down * box["height"])

    tap("#picture", 11 / WIDTH, 1 / HEIGHT)
    check_detail("chair", "#picture")
    for name in (NASTY, "floor: reflectance", "sky.radiance.value"):
        page.page.locator("#clear").tap()
        index = page.page.locator("#rows tr", has_text=name).get_attribute("data-row")
        row = f"#rows [data-row='{index}']"
        tap(row, 0.5, 0.5)
        check_detail(name, row)
        # The picture above shows where it is.
        assert box_of(page, "#picture")[0] == pytest.approx(0, abs=1)
        assert box_of(page, row)[0] >= box_of(page, "#picture")[1] - 1
    assert page.page.evaluate("document.documentElement.scrollWidth") == 360
    page.page.locator("#clear").tap()
    assert page.page.locator("#detail").evaluate("one => getComputedStyle(one).position") == "static"
    page.check(path)
    page.context.close()


# ----------------------------------------------------------------------------------------------- before and after


def test_the_slider_shows_before_on_the_left_and_after_on_the_right(browser, tmp_path):
    red, green = plain_picture(1.0, 0.0, 0.0), plain_picture(0.0, 1.0, 0.0)
    path = written(tmp_path, make(image=red), make(image=green), titles=["as it is", NASTY])
    page = Page(browser, path)
    slider, overlay = page.page.locator("#split"), page.page.locator("#opacity")
    assert slider.is_visible()
    # Both pictures are seen plainly, until the maps are asked for.
    assert overlay.input_value() == "0"
    assert not page.page.locator(".legend").is_visible()
    for title in ("as it is", NASTY):  # whichever of the two is chosen
        page.page.get_by_text(title, exact=True).first.click()
        slider.fill("50")
        ends = [page.page.locator(f"#split-{end}").inner_text() for end in ("before", "after")]
        assert ends == ["as it is", NASTY]
        seen = tmp_path / "seen.png"
        page.page.locator("#picture").screenshot(path=seen)
        with Image.open(seen) as picture:
            width, height = picture.size
            left, right = (picture.getpixel((width * part // 100, height // 2)) for part in (47, 53))
        assert left[0] > 2 * left[1]
        assert right[1] > 2 * right[0]
        slider.fill("0" if title == NASTY else "100")
        assert page.page.locator("#other").is_hidden()
    slider.fill("50")
    overlay.fill("75")
    assert page.page.locator(".legend").is_visible()
    clips = [
        page.page.locator(f"#{one}").evaluate("one => getComputedStyle(one).clipPath")
        for one in ("other-overlay", "overlay")
    ]
    assert clips == ["inset(0px 50% 0px 0px)", "inset(0px 0px 0px 50%)"]
    page.check(path)
    page.context.close()


def test_pictures_of_one_camera_have_one_exposure(browser, tmp_path):
    titles = ["as it is", "dimmed"]
    light, dark = plain_picture(0.5, 0.5, 0.5), plain_picture(0.05, 0.05, 0.05)
    page = Page(browser, written(tmp_path, make(image=light), make(image=dark), titles=titles))
    seen = tmp_path / "seen.png"
    page.page.locator("#picture").screenshot(path=seen)
    with Image.open(seen) as picture:
        width, height = picture.size
        left, right = (picture.getpixel((width * part // 100, height // 2))[0] for part in (40, 60))
    assert left > 2 * right
    page.context.close()


def test_a_comparison_is_on_top_with_what_was_set(browser, tmp_path):
    after = ranged(
        image=plain_picture(0.0, 1.0, 0.0),
        parameter_values={
            **ranged().parameter_values,
            "floor.reflectance.value": torch.tensor([0.75, 0.5, 0.25]),
            "chair.alpha": torch.tensor(0.3),
        },
    )
    effects = Table(
        "effect of what", ("effect of", "as it is", NASTY, "change"), [(NASTY, "1", "2", "+1 ◆")], ["◆ noise"]
    )
    comparison = Comparison(-0.263, 0.004, ["Measured <b>separately."], effects)
    path = written(tmp_path, ranged(), after, titles=["as it is", NASTY], comparison=comparison)
    page = Page(browser, path)
    shown = page.page.locator("#comparison")
    text = " ".join(shown.inner_text().split())
    for part in (f"as it is → {NASTY}", "−0.263 ± 0.004", "Measured <b>separately."):
        assert part in text
    assert [" ".join(one.split()) for one in shown.locator("dl > div").all_inner_texts()] == [
        "floor: reflectance 0.5 0.25 0.125 → 0.75 0.5 0.25",
        "chair: alpha 0.15 → 0.3",
    ]
    assert box_of(page, "#comparison")[1] <= box_of(page, "#picture")[0]
    below = page.page.locator("#changes")
    assert below.locator("tr").all_inner_texts() == [
        f"effect of\tas it is\t{NASTY}\tchange",
        f"{NASTY}\t1\t2\t+1 ◆",
    ]
    assert below.locator("p").all_inner_texts() == ["effect of what", "◆ noise"]
    numbers = json.loads(downloaded(page, "json", tmp_path / "numbers.json").read_text())["comparison"]
    assert numbers["change"] == -0.263
    assert [*map(pytest.approx, numbers["values"]["chair.alpha"])] == [[0.15], [0.3]]
    page.check(path)
    page.context.close()


def test_a_comparison_shows_both_pictures_of_a_moved_camera(browser, tmp_path):
    """Pointing and marks follow the picture that is shown, in which objects are at other places."""
    ahead = quarters(HEIGHT, WIDTH)
    line, column = np.divmod(ahead.pixel, WIDTH)
    mirrored = dataclasses.replace(ahead, pixel=(WIDTH * line + WIDTH - 1 - column).astype(np.int32))
    before = noted(make(image=plain_picture(0.5, 0.5, 0.5)), sensor="perspective, towards 0 1 0")
    after = noted(
        make(image=plain_picture(0.05, 0.05, 0.05), surfaces=mirrored), sensor="perspective, towards 1 0 0"
    )
    titles = ["as it is", "turned"]
    page = Page(browser, written(tmp_path, before, after, titles=titles, comparison=Comparison(1.0)))
    for number, title in enumerate(titles):
        page.page.get_by_text(title, exact=True).first.click()
        page.page.locator("#split").fill("50")
        seen = tmp_path / "seen.png"
        page.page.locator("#picture").screenshot(path=seen)
        with Image.open(seen) as picture:
            width, height = picture.size
            left, right = (picture.getpixel((width * part // 100, height // 4))[0] for part in (40, 60))
        assert left > 2 * right, "one exposure: the change is of the light"
        names = [page.hover(*place).split()[0] for place in ((4, 1), (11, 1))]
        assert names == ["lamp", "lamp"]
        own = ["inset(0px 50% 0px 0px)", "inset(0px 0px 0px 50%)"][number]
        for marks in ("lines", "shade"):
            clip = page.page.locator(f"#{marks}").evaluate("one => getComputedStyle(one).clipPath")
            assert clip == own
    page.context.close()


@pytest.mark.parametrize(
    "results",
    [[make()], [make(), make(), make()], [make(), make("Brightness")]],
    ids=["one", "three", "metrics"],
)
def test_a_comparison_is_of_two_results_of_one_metric(tmp_path, results):
    with pytest.raises(SceneCaptumError, match="two results of one metric"):
        written(tmp_path, *results, comparison=Comparison(1.0))


@pytest.mark.parametrize("size", [0.0, 5.0], ids=["noise", "an effect"])
def test_a_map_of_noise_says_so(browser, tmp_path, size):
    values = {name: 0.001 * torch.ones_like(torch.tensor(value)) for name, value in VALUES.items()}
    values["chair.reflectance.data"] /= 16  # texels, whose sum counts
    values["chair.alpha"] += size
    values["sky.radiance.value"] = torch.tensor(1.0)  # no pixel shows it
    page = Page(browser, written(tmp_path, ranged(attributions=values)))
    assert ("may be due to chance" in page.page.locator("#caption").inner_text()) == (size == 0)
    page.context.close()


@pytest.mark.parametrize(
    "others",
    [
        [],
        [make("Brightness")],
        [make("Brightness", image=plain_picture(1.0, 0.0, 0.0))],
        [noted(make(image=plain_picture(1.0, 0.0, 0.0)), sensor="door")],
        [make(image=torch.ones(5, 7, 3), surfaces=quarters(5, 7))],
    ],
    ids=["one result", "one picture", "another metric", "another camera", "another size"],
)
def test_without_a_picture_to_compare_there_is_no_slider(browser, tmp_path, others):
    page = Page(browser, written(tmp_path, make(), *others))
    assert page.page.locator("#split-choice").is_hidden()
    assert page.page.locator("#other").is_hidden()
    assert page.page.locator("#opacity").input_value() == "75"
    page.context.close()


# --------------------------------------------------------------------------------------------------- explanations


@pytest.mark.parametrize(
    "options", [{}, {"viewport": {"width": 1000, "height": 800}}, PHONE], ids=["desktop", "tablet", "phone"]
)
def test_an_explanation_shows_all_its_sentences(browser, tmp_path, options):
    path = written(tmp_path, explained())
    page = Page(browser, path, **options)
    parts = page.page.locator("#explanation .part").all()
    sections = [(heading, findings(lines)) for heading, lines in explained().sections()[1:]]
    assert len(sections) >= 3
    assert [
        (part.locator("h2").inner_text(), part.locator("li").all_inner_texts()) for part in parts
    ] == sections
    cut = page.page.evaluate(
        """() => [...document.querySelectorAll("#explanation li, #explanation h2")].filter((one) => {
            const part = one.closest(".part").getBoundingClientRect(), box = one.getBoundingClientRect();
            const right = Math.min(part.right, innerWidth) + 1;
            return one.scrollWidth > one.clientWidth || box.right > right || box.left < 0;
        }).map((one) => one.textContent)"""
    )
    assert cut == []
    width = page.page.evaluate("innerWidth")
    assert page.page.evaluate("document.documentElement.scrollWidth") == width
    page.check(path)
    page.context.close()


def test_results_without_an_explanation_have_no_section_for_it(browser, tmp_path):
    path = written(tmp_path, explained(), make("Brightness"))
    page = Page(browser, path)
    section = page.page.locator("#explanation")
    for title, is_explained in (("unified glare rating", True), ("Brightness", False)) * 2:
        page.page.get_by_text(title, exact=True).first.click()
        assert section.evaluate("one => one.hidden") != is_explained
        assert (section.locator("li").count() > 0) == is_explained
    page.check(path)
    page.context.close()


# ---------------------------------------------------------------------------------------------------- class names


class Room(ToyRenderer):
    """All objects of its picture have the colour ``x``."""

    surfaces = dataclasses.replace(quarters(4, 4), parameters=(("x",),) * 5)


def test_classes_are_called_by_their_names(browser, tmp_path):
    model = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 2))
    metric = ClassLogit(model, classes=["chair", "lamp"], transform=torch.nn.Identity())
    results = VanillaSceneGradient(Room(), metric).attribute(
        target=[0, 1], spp=16, replicates=4, seed=shifted()
    )
    path = written(tmp_path, *results)
    page = Page(browser, path)
    headlines = [one.inner_text().splitlines() for one in page.page.locator(".result").all()]
    assert [lines[0] for lines in headlines] == ["logit of chair", "logit of lamp"]
    said = [float(re.match(r"probability ([0-9.]+) of ", lines[2])[1]) for lines in headlines]
    logits = metric(results[0].image)
    assert said == pytest.approx(logits.softmax(0).tolist(), abs=0.01)
    likelier = ["chair", "lamp"][int(logits.argmax())]
    assert sum(lines[2].endswith(f"of {likelier}") for lines in headlines) == 2
    assert "logit of chair" in page.page.locator("#caption").inner_text()
    page.page.get_by_text("logit of lamp", exact=True).first.click()
    assert "logit of lamp" in page.page.locator("#caption").inner_text()
    page.check(path)
    page.context.close()


def printed(page: Page) -> Page:
    """The page as a browser prints it."""
    page.page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    page.page.emulate_media(media="print")
    return page


def test_on_paper_each_of_several_results_is_shown_in_full(browser, tmp_path):
    said = [dataclasses.replace(explained(), attribution=noted(ranged(), metric=name)) for name in ("A", "B")]
    page = printed(Page(browser, written(tmp_path, *said, titles=["First", "Second"])))
    parts = page.page.locator("#printed > div")
    assert [part.split(":")[0] for part in parts.locator("> h2").all_inner_texts()] == ["First", "Second"]
    for part in parts.all():
        assert part.get_by_text("Where the glare comes from").is_visible()
        assert part.locator("#render").is_visible()
        assert part.locator("#rows tr").first.is_visible()
    assert not page.page.locator(".answer ~ .explanation").is_visible()
    assert not page.page.locator(".answer ~ .work").is_visible()
    page.page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert page.page.locator("#printed > div").count() == 0
    page.context.close()


def test_on_paper_two_designs_are_whole_pictures_side_by_side(browser, tmp_path):
    dark, bright = (ranged(image=plain_picture(*3 * [value])) for value in (0.1, 0.6))
    path = written(tmp_path, dark, bright, titles=["as it is", "B"], comparison=Comparison(0.1))
    page = printed(Page(browser, path))
    first, second = page.page.locator("#printed .frame").all()
    one, other = first.bounding_box(), second.bounding_box()
    assert one["y"] == other["y"]
    assert one["x"] + one["width"] <= other["x"]
    for frame in (first, second):
        assert frame.locator("img:visible").count() == 1
        assert frame.locator("#overlay").evaluate("one => getComputedStyle(one).clipPath") == "none"
    for hint in ("Divider", "Point at the picture"):
        assert not any(one.is_visible() for one in page.page.get_by_text(hint).all())
    page.context.close()


BROKEN_WORDS = """() => [...document.querySelectorAll("#rows .label")].flatMap((one) => {
    if (!one.checkVisibility()) return [];
    const texts = document.createTreeWalker(one, NodeFilter.SHOW_TEXT);
    const broken = [];
    while (texts.nextNode()) {
        for (const { 0: word, index } of texts.currentNode.data.matchAll(/[\\p{L}]+/gu)) {
            const range = document.createRange();
            range.setStart(texts.currentNode, index);
            range.setEnd(texts.currentNode, index + word.length);
            if (new Set([...range.getClientRects()].map(({ top }) => top)).size > 1) broken.push(word);
        }
    }
    return broken;
})"""


@pytest.mark.parametrize(
    "width", [1280, 390, 360, 0], ids=["desktop", "phone", "small phone", "two on paper"]
)
def test_words_of_names_are_whole_beside_a_long_heading(browser, tmp_path, width):
    names = [*VALUES][:-1]  # the last one has no place to break
    words = (
        "floor: diffuse reflectance",
        "lamp: radiance (photosynthetic)",
        "frame: reflectance",
        "roof: transmittance",
    )
    said = {"name": "spatial daylight autonomy", "symbol": "sDA", "unit": "%"}
    gray, white = (
        noted(
            ranged(
                attributions={name: 90 * torch.tensor(VALUES[name]) for name in names},
                standard_error={name: torch.full_like(torch.tensor(VALUES[name]), 0.02) for name in names},
                labels=dict(zip(names, words, strict=False)),
                image=plain_picture(*3 * [value]),
            ),
            measure=said,
        )
        for value in (0.1, 0.6)
    )
    path = written(tmp_path, gray, white, titles=["as it is", "B"], comparison=Comparison(0.1))
    page = Page(browser, path, viewport={"width": width or 794, "height": 900})
    if not width:
        printed(page)
        assert page.page.locator("#printed #rows .label:visible").count() == 2 * len(names)
    assert page.page.locator("#columns .saliency:visible").first.inner_text() == "Effect (percentage points)"
    assert page.page.evaluate(BROKEN_WORDS) == []
    assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.context.close()


def test_a_printed_report_of_one_result_has_no_hints(browser, tmp_path):
    page = printed(Page(browser, written(tmp_path, ranged())))
    assert page.page.locator("#picture").is_visible()
    assert page.page.locator("#rows tr").first.is_visible()
    for selector in (".hint", ".controls", "#filter", ".downloads"):
        assert not page.page.locator(selector).first.is_visible()
    page.context.close()


def test_a_light_that_is_off_ranks_last_and_sets_no_scale(browser, tmp_path):
    """Its effect, to first order, may be far off: it would hide the causes of the others."""
    first, second = (row.name for row in ranged().ranking(2))
    lit = noted(ranged(), measure=UGR, lights_off=[first], lights_on=[second])
    path = written(tmp_path, lit)
    page = Page(browser, path)
    rows = page.page.locator("#rows [data-row]")
    assert rows.first.locator(".label").get_attribute("title") == second
    assert rows.last.locator(".label").get_attribute("title") == first
    assert rows.first.locator(".bar").evaluate("bar => parseFloat(bar.style.width)") > 95
    assert rows.last.locator(".bar").count() == 0
    assert rows.last.locator(".saliency .number").inner_text()
    shown = page.page.locator("main").inner_text()
    assert "effects of lights are to first order: UGR is not linear" in shown
    assert "--groups" in str(lit)
    assert "--groups" not in shown, "a page is for those who do not run the software, too"
    page.check(path)
    page.context.close()


def test_the_facts_name_the_class_of_a_network(browser, tmp_path):
    network = {"metric": "ClassLogit"}
    results = [
        noted(ranged(), **network, measure={"name": f"logit of {name}"}) for name in ("cube", "sphere")
    ]
    page = Page(browser, written(tmp_path, *results, titles=["A", "B"]))
    for title, said in (("A", "logit of cube (ClassLogit)"), ("B", "logit of sphere (ClassLogit)")):
        page.page.get_by_text(title, exact=True).click()
        assert page.page.locator("#facts .metric dd").inner_text() == said
    page.context.close()


def test_a_page_says_what_is_doubtful_and_not_what_to_run(browser, tmp_path):
    """The advice stays in tables: a page is for those who do not run the software, too."""
    picture = {"caution": "the picture is too noisy: 2 at half", "advice": "use spp=128 or more"}
    lamp = next(iter(ranged()))
    doubted = noted(
        ranged(),
        picture=picture,
        advice="smooth it",
        lights_off=[lamp],
        noisy_roughness=[lamp],
        measure=UGR,
        convergence="inconclusive",
        explained=1.0,
    )
    large = {name: 9 * torch.eye(len(one)) for name, one in (doubted.covariance or {}).items()}
    doubted = dataclasses.replace(doubted, covariance=large)
    added = dataclasses.replace(doubted, convergence_delta=0.5, convergence_delta_error=0.4)
    premises = (advised("caution: a sample", "use more samples"),)
    results = [Explanation(one, premises=premises) for one in (doubted, added)]
    steps = [
        "use spp=128",
        "smooth it",
        "render the change",
        "alone",
        "mostly noise: use more",
        "use more samples",
    ]
    printed = " ".join(f"{results[0]} {doubted} {added}".split())
    assert [step for step in steps if step not in printed] == []
    table = Table("effects", ["of", "A"], [["lamp", "1"]], [advised("~ lamp: off", "render the change")])
    comparison = Comparison(0.5, 0.1, [], table)
    path = written(tmp_path, *results, titles=["A", "B"], comparison=comparison)
    text = path.read_text()
    data = text.partition('id="data">')[2].partition("</script>")[0]
    assert [step for step in steps if step in data] == []
    page = Page(browser, path)
    shown = " ".join(page.page.locator("main").inner_text().split())
    for finding in (
        "too noisy: 2 at half",
        "a sample",
        "off, and UGR is not linear",
        "among many inputs",
        "~ lamp: off",
    ):
        assert finding in shown
    page.check(path)
    page.context.close()
