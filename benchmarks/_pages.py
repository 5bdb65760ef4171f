"""Write measured tables into the pages of the documentation."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path


def measured(value: float, form: str) -> str:
    """Return a cell with a value, for example ``measured(1.5, "{:.2f} s")``; NaN was not measured."""
    return "not measured" if math.isnan(value) else form.format(value)


def replace_table(page: Path, name: str, rows: Sequence[Sequence[str]]) -> None:
    """Replace the text between ``<!-- name -->`` and ``<!-- end of name -->`` by a table, headings first."""
    heading, *body = (f"| {' | '.join(row)} |" for row in rows)
    table = "\n".join([heading, "|" + "---|" * len(rows[0]), *body])
    text, found = page.read_text(), _find(page, name)
    page.write_text(f"{text[: found.start(1)]}\n{table}\n\n{text[found.end(1) :]}")


def replace_rows(page: Path, name: str, rows: Sequence[Sequence[str]]) -> None:
    """Write a table, headings first, that keeps the page's rows whose first cell is that of no new row."""
    heading, *body = rows
    lines = [line for line in _find(page, name)[1].splitlines() if line.startswith("| ")]
    kept = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]
    replace_table(page, name, [heading, *{row[0]: row for row in (*kept, *body)}.values()])


def _find(page: Path, name: str) -> re.Match[str]:
    """Return the match of a table's place in a page; group 1 is what stands there."""
    marks = f"<!-- {name} -->", f"<!-- end of {name} -->"
    found = list(re.finditer(rf"{marks[0]}\n(.*?){marks[1]}", page.read_text(), flags=re.DOTALL))
    if len(found) != 1:
        raise SystemExit(f"{page} has no place for a table called {name!r}: {marks[0]} … {marks[1]}")
    return found[0]
