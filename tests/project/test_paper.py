"""The command that reproduces the paper's claims writes its page (examples/paper)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "paper"


def test_page_shows_the_paper_beside_the_measured_values(tmp_path: Path) -> None:
    page = tmp_path / "paper.md"
    page.write_text("# Old\n\n## Another claim\n\nkept\n\n## Errors of stock derivatives\n\nrenewed\n")
    command = [sys.executable, str(EXAMPLE), "mirror", "--quick", "--room", "office"]
    command += ["--out", str(tmp_path / "out"), "--write", str(page)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stderr
    text = page.read_text()
    assert "# Old" not in text
    assert "## Another claim\n\nkept\n\n## Errors of stock derivatives\n\n**The paper" in text
    assert "renewed" not in text
    assert "**The paper:**" in text
    assert "**Measured:**" in text
    assert re.search(r"`mirror.eta.value` \| -\S+ ± \S+ \| -\S+ ± \S+ \| 0 ± 0 \|", text), text


def test_unknown_claims_and_rooms_are_refused(tmp_path: Path) -> None:
    for words in (["nothing"], ["--room", "attic"]):
        run = subprocess.run(
            [sys.executable, str(EXAMPLE), *words, "--out", str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert run.returncode != 0
        assert words[-1] in run.stderr
