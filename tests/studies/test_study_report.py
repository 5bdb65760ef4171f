"""The report of a study: the pages that are written, and the index in a browser."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pytest
from browsers import browser
from pages import NASTY, PHONE
from PIL import Image

from scenecaptum import SceneCaptumError
from scenecaptum.studies import StudyResult

from . import made

__all__ = ["browser"]

ROOMS = ["office", NASTY, "attic"]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    """Cells that are finished, failed, missing, and of a value only."""
    cells = made.cells(ROOMS, ["front", "left"])
    effects = made.random_effects(cells, 0)
    failed, missing = cells[3], cells[4]
    del effects[failed], effects[missing]
    return made.study(
        tmp_path_factory.mktemp("study") / "rooms & <b>lamps",
        effects,
        failures={failed: f"SceneCaptumError: {NASTY}"},
        missing=[missing],
        values_only=[cells[0]._replace(method="value")],
    )


@pytest.fixture(scope="module")
def index(study: StudyResult) -> Path:
    """In the study's own folder, beside its cells."""
    return study.write_report(study.folder)


@pytest.fixture
def page(browser: Any, index: Path) -> Any:
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    opened = context.new_page()
    opened.goto(index.as_uri())
    yield opened
    context.close()


def shown(page: Any) -> list[str]:
    return [row.inner_text() for row in page.locator("#cells tbody tr:visible").all()]


def test_an_index_and_a_page_for_each_attribution_are_written(study: StudyResult, index: Path) -> None:
    assert index == study.folder / "index.html"
    written = {path.stem for path in (study.folder / "cells").glob("*.html")}
    assert written == {key for cell, key in study.cells.items() if cell.method != "value"}
    text = index.read_text(encoding="utf-8")
    assert all(f'href="cells/{key}.html"' in text for key in written)
    assert len(StudyResult.load(study.folder)) == len(study), "pages beside the cells are no cells"


def test_the_index_needs_no_network(index: Path) -> None:
    text = index.read_text(encoding="utf-8")
    assert set(re.findall(r'(?:src|href)="(\w+:|cells/)', text)) == {"data:", "cells/"}
    assert "default-src 'none'" in text


def test_pages_are_optional_and_links_need_them(study: StudyResult, tmp_path: Path) -> None:
    index = study.write_report(tmp_path / "summary.html", None, pages=False)
    assert index == tmp_path / "summary.html"
    assert 'href="cells/' not in index.read_text(encoding="utf-8")
    assert "wall: reflectance" in index.read_text(encoding="utf-8")


def test_a_study_of_values_has_a_table_only(tmp_path: Path) -> None:
    cells = [cell._replace(method="value") for cell in made.cells(ROOMS)]
    text = made.study(tmp_path, {}, values_only=cells).write_report(tmp_path).read_text(encoding="utf-8")
    assert "Over all rooms" not in text
    assert text.count("finished</td>") == 3


@pytest.mark.parametrize("group", ["kind", None])
def test_rankings_of_too_few_groups_are_those_of_the_parameters(
    study: StudyResult, tmp_path: Path, group: str | None
) -> None:
    # Four parameters of two kinds.
    text = study.write_report(tmp_path, group, pages=False).read_text(encoding="utf-8")
    of_parameters = "How stable the rankings of single parameters are (fewer than 3 groups in common)"
    assert f"<h2>{of_parameters if group else 'How stable the rankings are'}</h2>" in text
    assert re.search('alt="Rankings of the parameters (between|differ)', text)


def test_a_single_cell_has_no_stability(tmp_path: Path) -> None:
    result = made.study(tmp_path, made.random_effects(made.cells(["office"]), 0))
    text = result.write_report(tmp_path, pages=False).read_text(encoding="utf-8")
    assert "<h2>How stable the rankings are</h2>" in text
    assert "The stability of a ranking needs two cells" in text
    assert "group=None" not in text


def test_a_folder_that_cannot_be_written_is_named(study: StudyResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneCaptumError, match=r"file/index\.html cannot be written"):
        study.write_report(tmp_path / "file")


def test_names_stay_text(page: Any, study: StudyResult) -> None:
    assert page.evaluate("window.hacked") is None
    assert page.locator("h1").inner_text() == study.folder.name
    assert "5 finished, 1 failed, 1 missing · 3 rooms" in page.locator("header").inner_text()
    rows = shown(page)
    assert len(rows) == 7
    assert f"failed: SceneCaptumError: {NASTY}" in rows[0]
    assert sum(NASTY in row for row in rows) == 2


def test_rows_are_filtered_and_sorted(page: Any) -> None:
    page.fill("#filter", "OFFICE left")
    assert len(shown(page)) == 1
    assert page.locator("#count").inner_text() == "1 of 7"
    page.fill("#filter", "nothing of this")
    assert page.locator("#none").is_visible()
    page.fill("#filter", "")
    head = page.locator("#cells thead th", has_text="room")
    for direction, first in (("ascending", NASTY), ("descending", "office")):
        head.locator("button").press("Enter")
        assert head.get_attribute("aria-sort") == direction
        assert shown(page)[0].startswith(first)


def test_numbers_are_sorted_as_numbers_with_unknown_ones_last(page: Any) -> None:
    head = page.locator("#cells thead th", has_text="value")
    for _ in range(2):
        head.locator("button").click()
        states = [row.split("\t")[-1] for row in shown(page)]
        assert states[:5] == ["finished"] * 5


def test_links_lead_to_pages_that_draw(page: Any) -> None:
    page.locator("#cells tbody a").first.click()
    page.wait_for_selector("#rows tr")
    assert "office · front · luminance · as it is · gradient · seed 0" in page.locator("body").inner_text()


def test_figures_have_alternative_texts(page: Any) -> None:
    texts = [image.get_attribute("alt") for image in page.locator("figure img").all()]
    assert texts
    assert all(re.search("rooms|room|each pixel", text) for text in texts)
    assert page.evaluate("[...document.images].every((one) => one.naturalWidth > 0)")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_scrolls_down_only(browser: Any, index: Path, scheme: str) -> None:
    context = browser.new_context(**PHONE, color_scheme=scheme)
    problems: list[str] = []
    opened = context.new_page()
    opened.on("console", lambda message: problems.append(message.text))
    opened.goto(index.as_uri())
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    # Nothing is cut off: pictures fit the window, and each table has a box that scrolls.
    right = "(one) => one.getBoundingClientRect().right <= innerWidth"
    assert opened.evaluate(f"document.images.length > 1 && [...document.images].every({right})")
    boxes = "[...document.querySelectorAll('table')].map((one) => one.parentElement)"
    assert opened.evaluate(f"{boxes}.every({right})")
    assert opened.evaluate(f"{boxes}.every((one) => getComputedStyle(one).overflowX === 'auto')")
    dark = opened.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (dark == "rgb(19, 21, 23)") == (scheme == "dark")
    assert not problems
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_table_that_is_wider_than_its_box_has_a_shaded_edge(browser: Any, index: Path, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 800}, color_scheme=scheme)
    page = context.new_page()
    page.goto(index.as_uri())

    def shaded(scrolled: str) -> tuple[bool, bool]:
        """Whether the left and the right edge are shaded, in the padding of the first row."""
        wide = page.locator(".wide", has=page.locator("#cells"))
        wide.evaluate(f"(one) => {{ one.scrollLeft = {scrolled}; }}")
        picture = Image.open(io.BytesIO(wide.screenshot())).convert("L")
        left, right = (picture.getpixel((x, 2)) for x in (0, picture.width - 1))
        page_color = picture.getpixel((picture.width // 2, 2))
        return abs(left - page_color) > 15, abs(right - page_color) > 15

    assert shaded("0") == (False, True)
    assert shaded("40") == (True, True)
    assert shaded("one.scrollWidth") == (True, False)
    page.set_viewport_size({"width": 1600, "height": 800})
    assert shaded("0") == (False, False)
    context.close()
