"""The result of the randomisation check, with its table and figure."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..visualization import (
    LOWERS,
    RAISES,
    SMALL,
    add_footnotes,
    axes_or_new,
    figure_of,
    grid,
    shorten,
    style_axes,
)

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

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot mean and draws of the rank correlations over the randomised layers, into ``ax`` if given."""
        ax = axes_or_new(ax, 5.4, 3.9)
        # Shifted sideways, since both begin near 1.
        shift = 0.01 * self.randomized[-1]
        curves = ((RAISES, self.magnitudes, "magnitudes", -shift), (LOWERS, self.signed, "signed", shift))
        for color, rows, label, offset in curves:
            positions = [count + offset for count in self.randomized]
            ax.plot(positions, rows.mean(1), color=color, linewidth=1.5, label=label)
            for draw in rows.T:
                ax.scatter(positions, draw, s=18, facecolors="none", edgecolors=color, zorder=3)
        ax.axhline(0, color="0.75", linewidth=1, zorder=0)
        lowest = min(self.magnitudes.min().item(), self.signed.min().item(), 0.0)
        ax.set_ylim(lowest - 0.05, 1.05)
        ax.set_xticks(self.randomized)
        x = "randomised layers, from the output; 0: other seeds only"
        style_axes(ax, "Randomisation check", x=x, y="rank correlation (Spearman)")
        ax.legend(fontsize=SMALL, frameon=False)
        add_footnotes(ax, textwrap.wrap(self.verdict, _NOTE_WIDTH), below=34)
        return figure_of(ax)

    def __str__(self) -> str:
        names = shorten(["none", *(self.layers[count - 1] for count in self.randomized[1:])], _NAME_WIDTH)
        counts = [f"{count} of {len(self.layers)}" for count in self.randomized]
        columns = (map(_mean_and_range, values) for values in (self.magnitudes, self.signed))
        rows = list(zip(counts, names, *columns, strict=True))
        head = (
            f"{self.metric}, {self.method}: rank correlation with the attribution of the unmodified network"
        )
        lines = grid(("random layers", "back to", "magnitudes", "signed"), rows)
        return "\n".join([head, "", *lines, "", *textwrap.wrap(self.verdict, 100)])

    __repr__ = __str__


def _all_below(correlations: torch.Tensor) -> bool:
    return bool(correlations[-1].max() < correlations[0].min())


def _mean_and_range(values: torch.Tensor) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"
