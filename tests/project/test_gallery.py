"""The gallery in docs/examples.md is complete, and the pages that are made of scripts and notebooks are right."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from loading import load_script
from PIL import Image

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = DOCS.parent / "examples"
GALLERY = (DOCS / "examples.md").read_text()
THUMBNAILS = sorted(path.stem for path in (DOCS / "pictures" / "thumbnails").iterdir())
# Of 255 levels, on average: decoders of JPEG differ by less, other pictures or cuts by more.
ROUNDING = 1


pages, thumbnails = (load_script(DOCS / f"{name}.py") for name in ("example_pages", "thumbnails"))


def test_every_script_has_a_title_in_the_gallery() -> None:
    assert len(pages.scripts()) > 10
    assert set(pages.scripts()) == pages.titles().keys()


def test_every_notebook_is_a_card_and_in_the_sidebar() -> None:
    names = [path.stem for path in (EXAMPLES / "notebooks").glob("*.ipynb")]
    assert names
    for name in names:
        assert f"**](../examples/notebooks/{name}.ipynb)\n" in GALLERY
        assert f"\ngenerated/notebooks/{name}\n" in GALLERY


@pytest.mark.parametrize("name", pages.scripts())
def test_the_page_of_a_script_shows_what_it_is_and_its_source(name: str) -> None:
    page = pages.script_page(name)
    folder = DOCS / "generated" / "scripts"
    assert page.startswith(f"# {pages.titles()[name]}\n")
    assert "\nfrom __future__" in (EXAMPLES / f"{name}.py").read_text(), "where the listing starts"
    assert re.search(rf"^```sh\npython examples/{name}\.py", page, re.MULTILINE)
    for alternative, link in re.findall(r"(!?\[.*?\])\(([^)]+)\)", page):
        assert (folder / link).resolve().is_file(), link
        assert alternative[0] != "!" or len(alternative) > 15


@pytest.mark.parametrize("path", sorted((DOCS / "outputs").iterdir()), ids=lambda path: path.stem)
def test_a_kept_output_begins_with_the_command_that_printed_it(path: Path) -> None:
    first, *output = path.read_text().splitlines()
    assert shlex.split(first)[:3] == ["$", "python", f"examples/{path.stem}.py"]
    assert any(output)
    assert first in pages.script_page(path.stem)


@pytest.mark.parametrize("path", sorted((EXAMPLES / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_page_of_a_notebook_has_its_outputs_and_describes_its_figures(path: Path) -> None:
    before, after = (json.loads(text)["cells"] for text in (path.read_text(), pages.notebook_page(path)))
    assert [cell.get("outputs") for cell in after] == [cell.get("outputs") for cell in before]
    for cell in after:
        if any("image/png" in output.get("data", {}) for output in cell.get("outputs", ())):
            assert cell["metadata"]["mystnb"]["image"]["alt"].startswith("Figure: ")
        if cell["cell_type"] == "markdown":
            links = re.findall(r"\]\((?!http)([^)#]+)", cell["source"])
            made = {other.name for other in path.parent.glob("*.ipynb")}
            assert all(link in made or (DOCS / link.removeprefix("../../")).is_file() for link in links)


def test_links_to_examples_lead_to_their_pages() -> None:
    text = "[a](../examples/notebooks/office_glare.ipynb) [b](../examples/which_lamp.py) [c](speed.md#x)"
    expected = (
        "[a](generated/notebooks/office_glare.ipynb) [b](generated/scripts/which_lamp.md) [c](speed.md#x)"
    )
    assert pages.linked_to_pages(text) == expected


def test_every_card_has_a_thumbnail_of_its_own() -> None:
    assert sorted(re.findall(r"\(pictures/thumbnails/([\w-]+)\.jpg\)", GALLERY)) == THUMBNAILS


def test_thumbnails_are_those_of_the_script(tmp_path: Path) -> None:
    thumbnails.main(tmp_path)
    assert sorted(path.stem for path in tmp_path.iterdir()) == THUMBNAILS
    for path in tmp_path.iterdir():
        kept, cut = Image.open(DOCS / "pictures" / "thumbnails" / path.name), Image.open(path)
        assert kept.size == cut.size == thumbnails.SIZE
        change = np.abs(np.asarray(kept, float) - np.asarray(cut, float)).mean()
        assert change < ROUNDING, f"{path.name} has changed by {change:.1f}: run python docs/thumbnails.py"
