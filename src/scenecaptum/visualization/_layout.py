"""Layout of plain tables and notes, for terminals and notebooks."""

from __future__ import annotations

import html
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence

from ._numbers import columns, pad

_NAMED = 3  # of a list of names


def grid(headers: Sequence[str], rows: Sequence[Sequence[str]], *, right: bool = False) -> list[str]:
    """Return the headers and rows as lines with aligned columns; with ``right`` only the first is on the left."""
    widths = [max(map(columns, column)) for column in zip(headers, *rows, strict=True)]
    return [
        "  ".join(
            [pad(name, widths[0]), *(pad(c, w, right=right) for c, w in zip(cells, widths[1:], strict=True))]
        ).rstrip()
        for name, *cells in (headers, *rows)
    ]


def group_by_text(pairs: Iterable[tuple[str, str | None]]) -> dict[str, list[str]]:
    """Group names by their text, without those that have none."""
    groups: dict[str, list[str]] = {}
    for name, text in pairs:
        if text:
            groups.setdefault(text, []).append(name)
    return groups


def first_few(names: Sequence[str], separator: str = ", ", *, of: int | None = None) -> str:
    """Return the first few names, and how many more there are: ``of`` a number, by default of the names."""
    named = names[:_NAMED]
    hidden = (len(names) if of is None else of) - len(named)
    return separator.join(named) + (f" and {hidden} more" if hidden else "")


def wrap(text: str, width: int, indent: int = 4) -> str:
    """Wrap a text into lines of a width, indented from the second on."""
    width = max(width, 20)
    return "\n".join(wrapped_lines(text, width, min(indent, width // 2)))


def wrapped_lines(text: str, width: int, indent: int = 0) -> list[str]:
    """Return the lines of a wrapped text, which never break within a number, its error and a percent sign."""
    joined = text.replace(" ± ", "\u00a0±\u00a0").replace(" %", "\u00a0%")
    lines = textwrap.wrap(joined, width, subsequent_indent=" " * indent, break_on_hyphens=False)
    return [line.replace("\u00a0", " ") for line in lines]


def html_cells(row: Iterable[str], tag: str) -> str:
    """Return the cells of a row of an HTML table; ``tag`` is ``"td"`` or ``"th"``."""
    return "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)


def terminal_width() -> int | None:
    """Return the terminal's width; None if the output goes to a file or a pipe."""
    if os.environ.get("COLUMNS", "").isdecimal() or (sys.stdout is not None and sys.stdout.isatty()):
        return shutil.get_terminal_size().columns
    return None
