"""The result of the randomisation check, with its table and figure."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..visualization import LOWERS, RAISES, SMALL, TEXT, TITLE, add_footnotes, figure_of, new_figure, shorten
from ._drawing import table_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAME_WIDTH, _NOTE_WIDTH = 36, 76


@dataclass(frozen=True, repr=False)
class RandomizationCheck:
    """Rank correlation of attributions with randomised and with learnt weights; prints as a table.

    Attributes
    ----------
    layers
        The network's layers, from the output to the input.
    randomized
        Number of randomised layers at each stage, from 0 to all.
    magnitudes
        ``(stages, draws)``: Spearman correlation of the saliencies with those of the unmodified network. The first
        row repeats the unmodified network with other renderer seeds: the upper limit that noise sets.
    signed
        The same for the signed attributions, channel by channel.
    metric, method
        Names of the metric and of the attribution method.
    """

    layers: tuple[str, ...]
    randomized: tuple[int, ...]
    magnitudes: torch.Tensor
    signed: torch.Tensor
    metric: str
    method: str

    @property
    def ranking_changes(self) -> bool:
        """Whether every correlation with all layers randomised is below every one of the unmodified network.

        If the weights made no difference, the probability of this would be 1 in ``(2n choose n)`` for ``n`` draws:
        1 in 70 for 4.
        """
        return _all_below(self.magnitudes)

    @property
    def signs_change(self) -> bool:
        """The same for the signed attributions."""
        return _all_below(self.signed)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        checks = (("ranking", self.ranking_changes), ("signs", self.signs_change))
        changed = [name for name, changes in checks if changes]
        dependence = (
            f"the attribution depends on the learnt weights, in its {' and its '.join(changed)}"
            if changed
            else "the attribution shows no dependence on the learnt weights"
        )
        return (
            f"{dependence}: with all {len(self.layers)} layers randomised, the magnitudes have a rank correlation "
            f"of {_mean_and_range(self.magnitudes[-1])} with those of the unmodified network, against "
            f"{_mean_and_range(self.magnitudes[0])} for the unmodified network with other seeds; signed "
            f"attributions {_mean_and_range(self.signed[-1])} against {_mean_and_range(self.signed[0])}"
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Plot the rank correlations over the number of randomised layers: the mean and every draw.

        Parameters
        ----------
        ax
            Axes to draw into; by default those of a new figure.
        """
        return _draw(self, ax)

    def __str__(self) -> str:
        return _text(self)

    __repr__ = __str__


def _text(check: RandomizationCheck) -> str:
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
    head = f"{check.metric}, {check.method}: rank correlation with the attribution of the unmodified network"
    return "\n".join([head, "", *table_lines(grid), "", *textwrap.wrap(check.verdict, 100)])


def _draw(check: RandomizationCheck, ax: Axes | None) -> Figure:
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


def _all_below(correlations: torch.Tensor) -> bool:
    return bool(correlations[-1].max() < correlations[0].min())


def _mean_and_range(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
