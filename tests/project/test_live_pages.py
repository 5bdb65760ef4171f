"""The live pages of the documentation are embedded, small, and what the library writes today."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from loading import load_script

import scenecaptum

DOCS = Path(__file__).parents[2] / "docs"
FRAME = re.compile(r'<iframe src="([^"]+)" title="([^"]+)" loading="lazy"></iframe>')
DATA = re.compile(r'(<script type="application/json" id="[\w-]+">)(.*?)(</script>)', re.DOTALL)
SMALL = "--resolution 16x9 --spp 8"

live_pages = load_script(DOCS / "live_pages.py")
PAGES = {page.name: FRAME.findall(page.read_text()) for page in sorted(DOCS.glob("*.md"))}
REPORT, SLIDERS = "office-report.html", "office-sliders.html"
AGAIN = "run python docs/live_pages.py"


def test_every_live_page_is_embedded_with_a_title_and_a_link() -> None:
    sources = [source for frames in PAGES.values() for source, _ in frames]
    assert sorted(DOCS / source for source in sources) == sorted(live_pages.LIVE.iterdir())
    for page, frames in PAGES.items():
        text = (DOCS / page).read_text()
        assert text.count("<iframe") == len(frames), f"{page} has a frame of another form"
        for source, title in frames:
            assert len(title) > 15
            assert f'<a href="{source}" target="_blank">' in text


@pytest.mark.parametrize("path", sorted(live_pages.LIVE.iterdir()), ids=lambda path: path.stem)
def test_a_live_page_is_small_and_loads_nothing(path: Path) -> None:
    assert path.stat().st_size < 2e6
    assert "default-src 'none'; img-src data:;" in path.read_text()


def small(command: str) -> str:
    """Return a command that renders a few pixels and samples, and has one slider."""
    command = re.sub(r"--(resolution|spp) \S+", "", command)
    return re.sub(r"--top \d+", "--top 1", f"{command} {SMALL}")


@pytest.fixture(scope="module")
def written(mi: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return what the library writes today for these pages, with few pixels, by the name of the file."""
    folder = tmp_path_factory.mktemp("live")
    live_pages.write_report(folder / REPORT, small(live_pages.REPORT))
    live_pages.write_sliders(folder / SLIDERS, small(live_pages.SLIDERS))
    return {path.name: path.read_text() for path in folder.iterdir()}


def kept_page(name: str) -> str:
    """Return the text of a live page."""
    return (live_pages.LIVE / name).read_text()


def without_data(text: str) -> str:
    """Return a page without its data, which differ."""
    return DATA.sub(r"\1\3", text)


def data_of(text: str) -> Any:
    """Return the data of a page, of which it has one block."""
    [(_, data, _)] = DATA.findall(text)
    return json.loads(data)


def test_the_scripts_and_styles_of_the_live_pages_are_those_of_the_library(written: dict[str, str]) -> None:
    for name, text in written.items():
        assert without_data(kept_page(name)) == without_data(text), (
            f"{name} has another page around its data: {AGAIN}"
        )


def test_the_report_has_the_data_that_the_library_writes(written: dict[str, str]) -> None:
    kept, now = (data_of(text) for text in (kept_page(REPORT), written[REPORT]))
    assert kept.keys() == now.keys(), AGAIN
    assert len(kept["results"]) == len(now["results"])
    for old, new in zip(kept["results"], now["results"], strict=True):
        assert old.keys() == new.keys(), AGAIN
        assert old["info"].keys() == new["info"].keys(), AGAIN
        assert old["info"]["versions"]["scenecaptum"] == scenecaptum.__version__, AGAIN
        assert old["metric"] == new["metric"]
        rows = [{row["name"]: row.keys() for row in one["rows"]} for one in (old, new)]
        assert rows[0] == rows[1], AGAIN


def test_the_sliders_have_the_messages_that_the_library_sends(written: dict[str, str]) -> None:
    kept, now = (
        {message["type"].partition(" ")[0]: message for message in data_of(text)}
        for text in (kept_page(SLIDERS), written[SLIDERS])
    )
    assert {kind: message.keys() for kind, message in kept.items()} == {
        kind: message.keys() for kind, message in now.items()
    }, AGAIN
    assert kept["scene"]["parameters"] == now["scene"]["parameters"], AGAIN
