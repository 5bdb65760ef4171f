"""Two rankings side by side: what one metric moves up and the other down."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..errors import SceneCaptumError
from ._figures import (
    LOWERS,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    UNCLEAR,
    WIDTH,
    figure_of,
    new_figure,
    small_print,
)
from ._numbers import shorten
from ._words import count_words, method_name, metric_name, pack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..attr import SceneAttribution

_NAME_WIDTH = 30
_MEANINGS = {RAISES: "ranks higher on the right", LOWERS: "ranks lower on the right", UNCLEAR: "same rank"}


class _Line(NamedTuple):
    """A parameter's ranks, and the places in the two columns that it is drawn at."""

    label: str
    ranks: tuple[int, int]
    places: tuple[int, int]

    @property
    def colour(self) -> str:
        left, right = self.ranks
        return RAISES if right < left else LOWERS if right > left else UNCLEAR


def plot_rank_comparison(
    a: SceneAttribution, b: SceneAttribution, top: int = 12, ax: Axes | None = None
) -> Figure:
    """Draw two rankings of the same parameters as columns, and lines from each rank to the other.

    A parameter that is among the ``top`` first in either ranking appears in both columns; where it is not among
    the first it stands below the dashed line, in order, with its rank. Lines are blue where a parameter ranks
    higher on the right than on the left, vermillion where it ranks lower. The title has Kendall's τ-b of the
    saliencies of all parameters, shown or not: 1 for the same order, 0 for unrelated ones, −1 for the reverse.

    Parameters
    ----------
    a, b
        What to compare: two metrics, methods or designs. Parameters that only one has are left out.
    top
        How many parameters of each to show.
    ax
        Axes to draw into; by default those of a new figure.

    Raises
    ------
    SceneCaptumError
        Where they share fewer than two parameters, or ``top`` is less than 1.

    References
    ----------
    Kendall, "The treatment of ties in ranking problems", Biometrika 33, 1945 (τ-b).
    """
    if top < 1:
        raise SceneCaptumError(f"top must be at least 1, not {top!r}.")
    common = [name for name in a if name in b]
    if len(common) < 2:
        raise SceneCaptumError(
            f"A comparison takes at least two parameters that both attributions have; these share {len(common)}."
        )
    left, right = a.saliency(), b.saliency()
    lines = _lines({n: a.labels.get(n, n) for n in common}, left, right, top)
    tau = kendall_tau([left[name] for name in common], [right[name] for name in common])
    if ax is None:
        ax = new_figure(WIDTH, 1.3 + 0.2 * len(lines)).add_subplot()
    _draw_lines(ax, lines, top)
    _draw_heads(ax, a, b, tau)
    left_out = len(set(a) ^ set(b))
    remarks = [
        f"ranks by saliency among {len(common)} parameters",
        f"{count_words(len(common) - len(lines), 'parameter')} not shown" if len(common) > len(lines) else "",
        f"{count_words(left_out, 'parameter')} that only one of the two has left out" if left_out else "",
    ]
    small_print(ax, pack([remark for remark in remarks if remark], 80), below=6)
    return figure_of(ax)


def kendall_tau(a: Sequence[float], b: Sequence[float]) -> float:
    """Return Kendall's rank correlation τ-b, which allows for ties; NaN where all of one are tied."""
    one, other = (torch.tensor(values, dtype=torch.float64) for values in (a, b))
    first, second = (torch.sign(values[:, None] - values[None, :]) for values in (one, other))
    untied = float((first != 0).sum()) * float((second != 0).sum())
    return float((first * second).sum()) / math.sqrt(untied) if untied else math.nan


def _lines(
    labels: Mapping[str, str], left: Mapping[str, float], right: Mapping[str, float], top: int
) -> list[_Line]:
    orders = [sorted(labels, key=lambda name: -values[name]) for values in (left, right)]
    shown = set(orders[0][:top]) | set(orders[1][:top])
    ranks = [{name: rank for rank, name in enumerate(order, start=1)} for order in orders]
    # All of the first have their own rank as their place; what is shown besides follows in order.
    places = [
        {name: place for place, name in enumerate((n for n in order if n in shown), 1)} for order in orders
    ]
    names = [name for name in orders[0] if name in shown]
    short = shorten([labels[name] for name in names], _NAME_WIDTH)
    return [
        _Line(label, (ranks[0][name], ranks[1][name]), (places[0][name], places[1][name]))
        for name, label in zip(names, short, strict=True)
    ]


def _draw_lines(ax: Axes, lines: Sequence[_Line], top: int) -> None:
    for line in lines:
        ax.plot(
            (0, 1), line.places, color=line.colour, linewidth=1.6, marker="o", markersize=4, clip_on=False
        )
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
    """Write the rank at the end of a line, and beyond it the name, in columns of their own."""
    outward = 1 if side else -1
    for text, away in ((str(line.ranks[side]), 7), (line.label, 9 + 2.4 * TEXT)):
        ax.annotate(
            text,
            (side, line.places[side]),
            xytext=(outward * away, 0),
            textcoords="offset points",
            ha="left" if side else "right",
            va="center",
            fontsize=TEXT,
            color=ax.xaxis.label.get_color() if line.colour == UNCLEAR else line.colour,
            alpha=0.6 if faint else 1.0,
            parse_math=False,
        )


def _draw_heads(ax: Axes, a: SceneAttribution, b: SceneAttribution, tau: float) -> None:
    """Name the two columns, and say above them how alike they are."""
    from matplotlib.lines import Line2D

    for x, name, align in ((0, _names(a, b)[0], "right"), (1, _names(a, b)[1], "left")):
        ax.annotate(
            shorten([name], _NAME_WIDTH)[0],
            (x, 1),
            xycoords="axes fraction",
            xytext=(-7 if align == "right" else 7, 3),
            textcoords="offset points",
            ha=align,
            va="bottom",
            fontsize=TEXT,
            fontweight="bold",
            parse_math=False,
        )
    entries = [
        Line2D([], [], color=colour, marker="o", markersize=4, label=text)
        for colour, text in _MEANINGS.items()
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
    said = "not defined: one has all saliencies alike" if math.isnan(tau) else f"{tau:.2f}".replace("-", "−")
    ax.set_title(f"Kendall's τ = {said}", fontsize=TITLE, pad=36)


def _names(a: SceneAttribution, b: SceneAttribution) -> tuple[str, str]:
    """Name two attributions by their metrics, or by what else tells them apart."""
    for describe in (metric_name, method_name, lambda one: str(one.info.get("scene", ""))):
        names = describe(a), describe(b)
        if names[0] != names[1]:
            return names
    return f"{metric_name(a)} (first)", f"{metric_name(b)} (second)"
