"""The randomisation check as a table and a figure."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from ._figures import LOWERS, RAISES, SMALL, TEXT, TITLE, figure_of, new_figure, small_print
from ._numbers import pad, shorten

if TYPE_CHECKING:
    import torch
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import RandomisationCheck

_NAME_WIDTH, _NOTE_WIDTH = 36, 76


def randomisation_text(check: RandomisationCheck) -> str:
    """Write the correlations for a terminal, and the verdict below them."""
    names = ["none", *(check.layers[count - 1] for count in check.randomised[1:])]
    grid = [
        ("random layers", "back to", "of magnitudes", "with signs"),
        *(
            (f"{count} of {len(check.layers)}", name, _span(magnitudes), _span(signed))
            for count, name, magnitudes, signed in zip(
                check.randomised, shorten(names, _NAME_WIDTH), check.magnitudes, check.signed, strict=True
            )
        ),
    ]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = ["  ".join(map(pad, row, widths)).rstrip() for row in grid]
    head = f"{check.metric}, {check.method}: rank correlation with the network's own attribution"
    return "\n".join([head, "", *lines, "", *textwrap.wrap(check.verdict, 100)])


def plot_randomisation(check: RandomisationCheck, ax: Axes | None = None) -> Figure:
    """Draw the rank correlations over how many layers are random: the mean, and every draw.

    Parameters
    ----------
    check
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(5.4, 3.9).add_subplot()
    # Side by side, since both begin near 1.
    apart = 0.01 * check.randomised[-1]
    kinds = ((RAISES, check.magnitudes, "of magnitudes", -apart), (LOWERS, check.signed, "with signs", apart))
    for colour, rows, label, aside in kinds:
        places = [count + aside for count in check.randomised]
        ax.plot(places, rows.mean(1), color=colour, linewidth=1.5, label=label)
        for place, row in zip(places, rows, strict=True):
            ax.scatter([place] * len(row), row, s=18, facecolors="none", edgecolors=colour, zorder=3)
    ax.axhline(0, color="0.75", linewidth=1, zorder=0)
    least = min(check.magnitudes.min().item(), check.signed.min().item(), 0.0)
    ax.set_ylim(least - 0.05, 1.05)
    ax.set_xticks(check.randomised)
    ax.set_xlabel("random layers, from the output on; 0: other seeds only", fontsize=TEXT)
    ax.set_ylabel("rank correlation (Spearman)", fontsize=TEXT)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title("Randomisation check", loc="left", fontsize=TITLE)
    ax.legend(fontsize=SMALL, frameon=False)
    small_print(ax, textwrap.wrap(check.verdict, _NOTE_WIDTH), below=34)
    return figure_of(ax)


def _span(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
