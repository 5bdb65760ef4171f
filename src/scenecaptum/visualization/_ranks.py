"""Two rankings side by side: what one metric moves up and the other down."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

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
    """A parameter's ranks, the places in the two columns that it is drawn at, and whether it clearly moves."""

    label: str
    ranks: tuple[int, int]
    places: tuple[int, int]
    clear: bool

    @property
    def colour(self) -> str:
        left, right = self.ranks
        return RAISES if right < left else LOWERS if right > left else UNCLEAR

    @property
    def dotted(self) -> bool:
        return not self.clear and self.colour != UNCLEAR


class _Column(NamedTuple):
    """One ranking: each parameter's saliency, its rank, and the first and last rank that it may have."""

    saliency: dict[str, float]
    rank: dict[str, int]
    possible: dict[str, tuple[int, int]]

    @classmethod
    def of(cls, attribution: SceneAttribution, names: Sequence[str]) -> _Column:
        all_of_them, errors = attribution.saliency(), attribution.saliency_error() or {}
        saliency = {name: all_of_them[name] for name in names}
        order = sorted(names, key=lambda name: -saliency[name])
        value = torch.tensor([saliency[name] for name in names], dtype=torch.float64)
        error = torch.tensor([errors.get(name, 0.0) for name in names], dtype=torch.float64)
        ahead = value[None, :] - value[:, None]  # by how much the second is more salient than the first
        noise = 2 * torch.hypot(error[None, :], error[:, None])
        first = 1 + (ahead > noise).sum(1)
        last = len(names) - (ahead < -noise).sum(1)
        return cls(
            saliency,
            {name: rank for rank, name in enumerate(order, start=1)},
            dict(zip(names, zip(first.tolist(), last.tolist(), strict=True), strict=True)),
        )


def plot_rank_comparison(
    a: SceneAttribution, b: SceneAttribution, top: int = 12, ax: Axes | None = None
) -> Figure:
    """Draw two rankings of the same parameters as columns, and lines from each rank to the other.

    A parameter that is among the ``top`` first in either ranking appears in both columns; where it is not among
    the first it stands below the dashed line, in order, with its rank. Lines are blue where a parameter ranks
    higher on the right than on the left, vermillion where it ranks lower, and dotted where noise may have done
    it: where the ranks that it may have, given two standard errors, overlap. The title has Kendall's τ-b of the
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
    columns = _Column.of(a, common), _Column.of(b, common)
    lines = _lines({name: a.labels.get(name, name) for name in common}, columns, top)
    tau = kendall_tau(*([column.saliency[name] for name in common] for column in columns))
    if ax is None:
        ax = new_figure(WIDTH, 1.3 + 0.2 * len(lines)).add_subplot()
    _draw_lines(ax, lines, top)
    _draw_heads(ax, a, b, tau)
    left_out = len(set(a) ^ set(b))
    remarks = [
        f"ranks by saliency among {len(common)} parameters",
        f"{count_words(len(common) - len(lines), 'parameter')} not shown" if len(common) > len(lines) else "",
        "dotted: within the noise, or tied" if any(line.dotted for line in lines) else "",
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


def _lines(labels: Mapping[str, str], columns: tuple[_Column, _Column], top: int) -> list[_Line]:
    orders = [sorted(labels, key=column.rank.__getitem__) for column in columns]
    shown = set(orders[0][:top]) | set(orders[1][:top])
    # All of the first have their own rank as their place; what is shown besides follows in order.
    left, right = (
        {name: place for place, name in enumerate((n for n in order if n in shown), start=1)}
        for order in orders
    )
    short = shorten([labels[name] for name in left], _NAME_WIDTH)
    return [
        _Line(
            label,
            (columns[0].rank[name], columns[1].rank[name]),
            (left[name], right[name]),
            clear=_disjoint(columns[0].possible[name], columns[1].possible[name]),
        )
        for name, label in zip(left, short, strict=True)
    ]


def _disjoint(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return a[1] < b[0] or b[1] < a[0]


def _draw_lines(ax: Axes, lines: Sequence[_Line], top: int) -> None:
    for line in lines:
        style: dict[str, Any] = {"linewidth": 1.6, "linestyle": (0, (1, 1.5)) if line.dotted else "solid"}
        ax.plot((0, 1), line.places, color=line.colour, marker="o", markersize=4, clip_on=False, **style)
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
