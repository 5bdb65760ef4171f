"""Comparison of two rankings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from ..errors import SceneCaptumError
from ..protocols import Attribution
from ..ranks import kendall_tau
from ._figures import (
    DEFAULT_TOP,
    LOWERS,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    add_footnotes,
    axes_or_new,
    figure_of,
    first,
    write_at,
)
from ._numbers import minus, shorten
from ._text import method_name, metric_name, pack, pluralize

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAME_WIDTH = 30
_MEANINGS = {RAISES: "ranks higher on the right", LOWERS: "ranks lower on the right", UNCLEAR: "same rank"}


class _Line(NamedTuple):
    """A parameter's ranks in both columns, its positions there, and whether the change of rank is significant."""

    label: str
    ranks: tuple[int, int]
    positions: tuple[int, int]
    significant: bool

    @property
    def color(self) -> str:
        left, right = self.ranks
        return RAISES if right < left else LOWERS if right > left else UNCLEAR

    @property
    def dotted(self) -> bool:
        return not self.significant and self.color != UNCLEAR


class _Rank(NamedTuple):
    """The rank of a parameter, and the first and last rank that are possible within the noise."""

    rank: int
    first: int
    last: int


def _ranks(attribution: Attribution, names: Sequence[str]) -> dict[str, _Rank]:
    """Return the ranks of the named parameters, in order."""
    saliencies, errors = attribution.saliency(), attribution.saliency_error() or {}
    value = torch.tensor([saliencies[name] for name in names], dtype=torch.float64)
    error = torch.tensor([errors.get(name, 0.0) for name in names], dtype=torch.float64)
    difference = value[None, :] - value[:, None]
    noise = 2 * torch.hypot(error[None, :], error[:, None])
    first = (1 + (difference > noise).sum(1)).tolist()
    last = (len(names) - (difference < -noise).sum(1)).tolist()
    order = value.argsort(descending=True, stable=True).tolist()
    return {names[k]: _Rank(rank, first[k], last[k]) for rank, k in enumerate(order, start=1)}


def plot_rank_comparison(
    a: Attribution, b: Attribution, top: int | None = DEFAULT_TOP, *, ax: Axes | None = None
) -> Figure:
    """Plot two rankings of the same parameters as columns, with lines between the ranks of each parameter.

    Parameters among the ``top`` of either ranking appear in both columns; below the dashed line are those outside
    the top of that column, with their ranks. Lines are blue if a parameter ranks higher on the right, vermillion
    if it ranks lower, and dotted if the change is within the noise: if the intervals of its possible ranks, from
    two standard errors, overlap. The title shows Kendall's τ-b of the saliencies of all parameters, shown or not:
    1 for the same order, 0 for unrelated ones, −1 for the reverse.

    Parameters
    ----------
    a, b
        The results to compare: two metrics, methods or designs. Parameters that only one of them has are omitted.
    top
        Number of parameters of each ranking to show; None for all.
    ax
        Axes to draw into; by default those of a new figure.

    Raises
    ------
    SceneCaptumError
        If they share fewer than two parameters, or ``top`` is less than 1.

    References
    ----------
    Kendall, "The treatment of ties in ranking problems", Biometrika 33, 1945 (τ-b).
    """
    jumps = {name for one in (a, b) for name in one.info.get("jumps", {})}
    common = [name for name in a if name in b and name not in jumps]
    if len(common) < 2:
        raise SceneCaptumError(
            f"A comparison needs at least two parameters that both attributions {'rank' if jumps else 'have'}; "
            f"these share {len(common)}."
        )
    count = len(first(common, top))
    lines = _lines(a.labels, _ranks(a, common), _ranks(b, common), count)
    tau = kendall_tau(*([saliency[name] for name in common] for saliency in (a.saliency(), b.saliency())))
    ax = axes_or_new(ax, WIDTH, 1.3 + 0.2 * len(lines))
    _draw_lines(ax, lines, count)
    _draw_headers(ax, a, b, tau)
    left_out = len(set(a) ^ set(b))
    notes = [
        f"ranks by saliency among {len(common)} parameters",
        f"{pluralize(len(common) - len(lines), 'parameter')} not shown" if len(common) > len(lines) else "",
        "dotted: within the noise, or tied" if any(line.dotted for line in lines) else "",
        f"{pluralize(left_out, 'parameter')} that only one of the two has left out" if left_out else "",
        f"{pluralize(len(jumps), 'parameter')} without a derivative left out" if jumps else "",
    ]
    add_footnotes(ax, pack([note for note in notes if note], 80), below=6)
    return figure_of(ax)


def _lines(
    labels: Mapping[str, str], left: dict[str, _Rank], right: dict[str, _Rank], top: int
) -> list[_Line]:
    shown = {*list(left)[:top], *list(right)[:top]}
    # The position of a top parameter is its rank; the others follow in order.
    names, others = ([name for name in column if name in shown] for column in (left, right))
    short = shorten([labels.get(name, name) for name in names], _NAME_WIDTH)
    lines = []
    for position, (name, label) in enumerate(zip(names, short, strict=True), start=1):
        one, other = left[name], right[name]
        significant = one.last < other.first or other.last < one.first
        lines.append(_Line(label, (one.rank, other.rank), (position, 1 + others.index(name)), significant))
    return lines


def _draw_lines(ax: Axes, lines: Sequence[_Line], top: int) -> None:
    for line in lines:
        style: dict[str, Any] = {"linewidth": 1.6, "linestyle": (0, (1, 1.5)) if line.dotted else "solid"}
        ax.plot((0, 1), line.positions, color=line.color, marker="o", markersize=4, clip_on=False, **style)
        for side in (0, 1):
            _write_end(ax, line, side, faint=line.ranks[side] > top)
    if len(lines) > top:
        ax.axhline(top + 0.5, color=UNCLEAR, linewidth=0.8, linestyle=(0, (4, 3)))
    ax.set_xlim(0, 1)
    ax.set_ylim(len(lines) + 0.5, 0.4)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)


def _write_end(ax: Axes, line: _Line, side: int, *, faint: bool) -> None:
    """Write the rank and the name at the end of a line, in separate columns."""
    sign = 1 if side else -1
    style: dict[str, Any] = {
        "ha": "left" if side else "right",
        "va": "center",
        "color": ax.xaxis.label.get_color() if line.color == UNCLEAR else line.color,
        "alpha": 0.6 if faint else 1.0,
    }
    for text, distance in ((str(line.ranks[side]), 7), (line.label, 9 + 2.4 * TEXT)):
        write_at(ax, text, (side, line.positions[side]), (sign * distance, 0), **style)


def _draw_headers(ax: Axes, a: Attribution, b: Attribution, tau: float) -> None:
    """Write the names of the columns, the legend and Kendall's τ."""
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"xycoords": "axes fraction", "va": "bottom", "fontweight": "bold"}
    left, right = shorten(_names(a, b), _NAME_WIDTH)
    write_at(ax, left, (0, 1), (-7, 3), ha="right", **style)
    write_at(ax, right, (1, 1), (7, 3), ha="left", **style)
    entries = [
        Line2D([], [], color=color, marker="o", markersize=4, label=text) for color, text in _MEANINGS.items()
    ]
    ax.legend(
        handles=entries,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        borderaxespad=1.6,
        ncols=3,
        fontsize=SMALL,
        frameon=False,
    )
    value = "not defined: all saliencies of one are equal" if math.isnan(tau) else minus(f"{tau:.2f}")
    ax.set_title(f"Kendall's τ = {value}", fontsize=TITLE, pad=36)


def _names(a: Attribution, b: Attribution) -> tuple[str, str]:
    """Return names for two attributions: by metric, else by method or scene."""
    for describe in (metric_name, method_name, lambda attribution: str(attribution.info.get("scene", ""))):
        names = describe(a), describe(b)
        if names[0] != names[1]:
            return names
    return f"{metric_name(a)} (first)", f"{metric_name(b)} (second)"
