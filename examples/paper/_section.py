"""Sections of the page: a claim of the paper, the measurement, and the difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HOLDS, IN_PART = 0.95, 0.5  # fractions of the cases in which a claim holds, or holds in part


@dataclass
class Section:
    """A claim of the paper, with the measurement of this run.

    ``claims`` and ``facts`` are for the top of the page: lines of its table, and what its sentences state.
    """

    title: str
    paper: str
    measured: list[str] = field(default_factory=list)
    difference: str = ""
    claims: list[tuple[str, str, str]] = field(default_factory=list)  # claim, measured, verdict
    facts: dict[str, Any] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)  # the files
    figure: str = ""  # what the section shows below its text

    def save(self, figure: Any, path: Path) -> None:
        """Write a figure, fine enough for its small text."""
        figure.savefig(path, dpi=160, pil_kwargs={"quality": 90, "method": 6})
        self.pictures.append(path.name)

    def show(self, figure: Any, path: Path, caption: str) -> None:
        """Write a figure, and show it in the section."""
        self.save(figure, path)
        self.figure = picture(path.name, caption)

    def markdown(self) -> str:
        """Return the section in Markdown."""
        parts = [
            f"## {self.title}",
            f"**The paper:** {self.paper}",
            "**Measured:**\n\n" + "\n".join(self.measured),
            f"**The difference:** {self.difference}",
            self.figure,
        ]
        return "\n\n".join(filter(None, parts))


def picture(name: str, caption: str) -> str:
    """Return a picture with its caption in Markdown."""
    return f"![{caption}](pictures/paper/{name})\n\n*{caption}*"


def verdict(count: int, total: int) -> str:
    """Return whether a claim holds, from the number of cases in which it does."""
    share = count / total if total else 0.0
    return "holds" if share >= HOLDS else "holds in part" if share >= IN_PART else "does not hold"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
