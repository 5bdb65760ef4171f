"""Write measured tables into the pages of the documentation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path


def replace_table(page: Path, name: str, rows: Sequence[Sequence[str]]) -> None:
    """Replace the text between ``<!-- name -->`` and ``<!-- end of name -->`` by a table, headings first."""
    heading, *body = (f"| {' | '.join(row)} |" for row in rows)
    table = "\n".join([heading, "|" + "---|" * len(rows[0]), *body])
    text, count = re.subn(
        rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)",
        lambda found: f"{found[1]}\n{table}\n\n{found[2]}",
        page.read_text(),
        flags=re.DOTALL,
    )
    if count != 1:
        raise SystemExit(
            f"{page} has no place for a table called {name!r}: <!-- {name} --> … <!-- end of {name} -->"
        )
    page.write_text(text)
