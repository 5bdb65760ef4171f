"""The command that reproduces the paper's claims writes its page (examples/paper)."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "paper"
PAGE = Path(__file__).parents[2] / "docs" / "paper.md"
PICTURE = re.compile(r"!\[.*?\]\((pictures/paper/[\w-]+\.webp)\)")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLE), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the module that puts the page together."""
    monkeypatch.syspath_prepend(EXAMPLE)
    return importlib.import_module("_page")


def test_page_shows_the_paper_beside_the_measured_values(tmp_path: Path) -> None:
    page, pictures = tmp_path / "paper.md", tmp_path / "pictures" / "paper"
    page.write_text("# Old\n\n## Another claim\n\nkept\n\n## Errors of stock derivatives\n\nrenewed\n")
    pictures.mkdir(parents=True)
    stored = json.loads((PAGE.parent / "pictures" / "paper" / "results.json").read_text())
    (pictures / "results.json").write_text(json.dumps(stored))
    finished = run(
        *("mirror", "--quick", "--room", "office", "--out", str(tmp_path / "out"), "--write", str(page))
    )
    assert finished.returncode == 0, finished.stderr
    text = page.read_text()
    assert "# Old" not in text
    assert "## Another claim\n\nkept\n\n## Errors of stock derivatives\n\n**The paper" in text
    assert "renewed" not in text
    assert "**The paper:**" in text
    assert "**Measured:**" in text
    assert re.search(r"`mirror.eta.value` \| -\S+ ± \S+ \| -\S+ ± \S+ \| 0 ± 0 \|", text), text
    top = text.partition("\n## ")[0]
    assert "no derivative of 3 of 3 parameters of smooth mirrors" in top, "the new result"
    renewed = json.loads((pictures / "results.json").read_text())
    assert renewed["mirror"]["rooms"] == ["office"]
    for name in stored.keys() - {"mirror"}:
        assert renewed[name] == stored[name]
        for claim, measured, verdict in stored[name]["claims"]:
            assert f"| {claim} | {measured} | {verdict} |" in top, "an earlier result"


def test_top_of_the_page_states_the_stored_results(parts: ModuleType) -> None:
    results = json.loads((PAGE.parent / "pictures" / "paper" / "results.json").read_text())
    assert PAGE.read_text().startswith(parts.top(results)), "run python examples/paper mirror --write"
    assert len(parts.conclusions({name: one["facts"] for name, one in results.items()})) == 3
    assert parts.conclusions({}) == []


def test_page_has_one_picture_at_the_top_and_at_most_one_in_each_section() -> None:
    top, *sections = PAGE.read_text().split("\n## ")
    assert PICTURE.findall(top) == ["pictures/paper/grid-maps.webp"]
    assert all(len(PICTURE.findall(section)) <= 1 for section in sections)
    kept = (PAGE.parent / "pictures" / "paper").glob("*.webp")
    assert {f"pictures/paper/{path.name}" for path in kept} == set(PICTURE.findall(PAGE.read_text()))


def test_a_verdict_follows_from_the_number_of_cases(parts: ModuleType) -> None:
    section = importlib.import_module("_section")
    verdicts = [section.verdict(count, 20) for count in (20, 19, 18, 10, 9)]
    assert verdicts == ["holds", "holds", "holds in part", "holds in part", "does not hold"]
    assert section.verdict(0, 0) == "does not hold"


@pytest.mark.long
def test_every_claim_adds_its_section_and_its_lines(tmp_path: Path, parts: ModuleType) -> None:
    page = tmp_path / "paper.md"
    finished = run("--quick", "--room", "office", "--out", str(tmp_path / "out"), "--write", str(page))
    assert finished.returncode == 0, finished.stderr
    text = page.read_text()
    results = json.loads((tmp_path / "pictures" / "paper" / "results.json").read_text())
    assert list(results) == list(parts.CLAIMS)
    assert text.startswith(parts.top(results))
    assert len(re.findall(r"^## ", text, re.MULTILINE)) == len(results)
    assert len(PICTURE.findall(text)) == 4
    assert all((tmp_path / name).is_file() for name in PICTURE.findall(text))


def test_unknown_claims_and_rooms_are_refused(tmp_path: Path) -> None:
    for words in (["nothing"], ["--room", "attic"]):
        finished = run(*words, "--out", str(tmp_path))
        assert finished.returncode != 0
        assert words[-1] in finished.stderr
