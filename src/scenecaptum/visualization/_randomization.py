"""Table and figure of the randomisation check."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from ._figures import LOWERS, RAISES, SMALL, TEXT, TITLE, add_footnotes, figure_of, new_figure
from ._numbers import pad, shorten

if TYPE_CHECKING:
    import torch
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..validation import RandomizationCheck

_NAME_WIDTH, _NOTE_WIDTH = 36, 76


def randomization_text(check: RandomizationCheck) -> str:
    """Format the correlations and the verdict for a terminal."""
    names = ["none", *(check.layers[count - 1] for count in check.randomized[1:])]
    grid = [
        ("random layers", "back to", "magnitudes", "signed"),
        *(
            (f"{count} of {len(check.layers)}", name, _mean_and_range(magnitudes), _mean_and_range(signed))
            for count, name, magnitudes, signed in zip(
                check.randomized, shorten(names, _NAME_WIDTH), check.magnitudes, check.signed, strict=True
            )
        ),
    ]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = ["  ".join(map(pad, row, widths)).rstrip() for row in grid]
    head = f"{check.metric}, {check.method}: rank correlation with the attribution of the unmodified network"
    return "\n".join([head, "", *lines, "", *textwrap.wrap(check.verdict, 100)])


def plot_randomization(check: RandomizationCheck, ax: Axes | None = None) -> Figure:
    """Plot the rank correlations over the number of randomised layers: the mean and every draw.

    Parameters
    ----------
    check
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(5.4, 3.9).add_subplot()
    # Shifted sideways, since both begin near 1.
    shift = 0.01 * check.randomized[-1]
    curves = ((RAISES, check.magnitudes, "magnitudes", -shift), (LOWERS, check.signed, "signed", shift))
    for color, rows, label, offset in curves:
        positions = [count + offset for count in check.randomized]
        ax.plot(positions, rows.mean(1), color=color, linewidth=1.5, label=label)
        for x, row in zip(positions, rows, strict=True):
            ax.scatter([x] * len(row), row, s=18, facecolors="none", edgecolors=color, zorder=3)
    ax.axhline(0, color="0.75", linewidth=1, zorder=0)
    lowest = min(check.magnitudes.min().item(), check.signed.min().item(), 0.0)
    ax.set_ylim(lowest - 0.05, 1.05)
    ax.set_xticks(check.randomized)
    ax.set_xlabel("randomised layers, from the output; 0: other seeds only", fontsize=TEXT)
    ax.set_ylabel("rank correlation (Spearman)", fontsize=TEXT)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title("Randomisation check", loc="left", fontsize=TITLE)
    ax.legend(fontsize=SMALL, frameon=False)
    add_footnotes(ax, textwrap.wrap(check.verdict, _NOTE_WIDTH), below=34)
    return figure_of(ax)


def _mean_and_range(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
