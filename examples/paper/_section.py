"""What the paper says, what was measured, and where the two differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Section:
    """A claim of the paper, beside what this run measured."""

    title: str
    paper: str
    measured: list[str] = field(default_factory=list)
    difference: str = ""
    figures: list[tuple[str, str]] = field(default_factory=list)  # files, with what they show

    def add_figure(self, folder: Path, name: str, figure: Any, caption: str) -> None:
        """Write a figure and list it."""
        figure.savefig(folder / f"{name}.png")
        self.figures.append((f"{name}.png", caption))

    def markdown(self, pictures: str) -> str:
        """Return the section, its figures in the folder ``pictures``."""
        shown = [f"![{caption}]({pictures}/{name})\n\n*{caption}*" for name, caption in self.figures]
        parts = [
            f"## {self.title}",
            f"**The paper:** {self.paper}",
            "**Measured:**\n\n" + "\n".join(self.measured),
            f"**The difference:** {self.difference}",
            *shown,
        ]
        return "\n\n".join(parts)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
