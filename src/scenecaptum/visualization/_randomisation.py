"""The randomisation check as a table and a figure."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import torch

from ._figures import RAISES, SMALL, TEXT, TITLE, figure_of, new_figure, small_print
from ._numbers import pad, shorten

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import RandomisationCheck

_NAME_WIDTH, _NOTE_WIDTH = 36, 66


def randomisation_text(check: RandomisationCheck) -> str:
    """Write the correlations for a terminal, and the verdict below them."""
    total = len(check.layers)
    last = [check.layers[count - 1] for count in check.randomised]
    grid = [
        ("random layers", "back to", "rank correlation", "lowest", "highest"),
        ("none", "", *_numbers(check.ceiling)),
        *(
            (f"{count} of {total}", name, *_numbers(row))
            for count, name, row in zip(
                check.randomised, shorten(last, _NAME_WIDTH), check.correlations, strict=True
            )
        ),
    ]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = ["  ".join(map(pad, row, widths)).rstrip() for row in grid]
    draws = len(check.ceiling)
    head = f"{check.metric}, {check.method}: rankings compared with the network's own, {draws} draws each"
    return "\n".join([head, "", *lines, "", *textwrap.wrap(check.verdict, 100)])


def plot_randomisation(check: RandomisationCheck, ax: Axes | None = None) -> Figure:
    """Draw the rank correlations over how many layers are random, and what the network itself reaches.

    Parameters
    ----------
    check
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(4.8, 3.6).add_subplot()
    places = (0, *check.randomised)
    rows = [check.ceiling, *check.correlations]
    ax.axhspan(
        check.ceiling.min().item(),
        check.ceiling.max().item(),
        color="0.88",
        label="same network, other seeds",
    )
    ax.plot(places, [row.mean().item() for row in rows], color=RAISES, linewidth=1.5, label="mean")
    for number, (place, row) in enumerate(zip(places, rows, strict=True)):
        label = None if number else "each draw"
        ax.scatter([place] * len(row), row, s=18, facecolors="none", edgecolors=RAISES, label=label, zorder=3)
    ax.axhline(0, color="0.75", linewidth=1, zorder=0)
    ax.set_ylim(min(-0.05, torch.stack(rows).min().item() - 0.05), 1.05)
    ax.set_xticks(places)
    ax.set_xlabel("random layers, from the output on", fontsize=TEXT)
    ax.set_ylabel("rank correlation of saliencies (Spearman)", fontsize=TEXT)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title("Randomisation check", loc="left", fontsize=TITLE)
    ax.legend(fontsize=SMALL, frameon=False)
    small_print(ax, textwrap.wrap(check.verdict, _NOTE_WIDTH), below=34)
    return figure_of(ax)


def _numbers(values: torch.Tensor) -> tuple[str, ...]:
    return tuple(f"{one:.2f}" for one in (values.mean(), values.min(), values.max()))
