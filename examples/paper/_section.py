"""Sections of the page: a claim of the paper, the measurement, and the difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Section:
    """A claim of the paper, with the measurement of this run."""

    title: str
    paper: str
    measured: list[str] = field(default_factory=list)
    difference: str = ""
    figures: list[tuple[str, str]] = field(default_factory=list)  # files and captions

    def add_figure(self, folder: Path, name: str, figure: Any, caption: str) -> None:
        """Write a figure and add it to the section."""
        figure.savefig(folder / f"{name}.png")
        self.figures.append((f"{name}.png", caption))

    def markdown(self, pictures: str) -> str:
        """Return the section in Markdown, with its figures in the folder ``pictures``."""
        figures = [f"![{caption}]({pictures}/{name})\n\n*{caption}*" for name, caption in self.figures]
        parts = [
            f"## {self.title}",
            f"**The paper:** {self.paper}",
            "**Measured:**\n\n" + "\n".join(self.measured),
            f"**The difference:** {self.difference}",
            *figures,
        ]
        return "\n\n".join(parts)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
