"""What accuracy costs, as a table, a line of advice and a figure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ..rendering._plan import STOCK
from ._figures import SMALL, TEXT, TITLE, WIDTH, figure_of, new_figure, small_print
from ._words import pack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..tradeoff import Measured, Setting, Tradeoff

# What is varied, with a marker and a colour of its own (Okabe and Ito's) in the figure; and where its value is
# written, in points to the right and up, so that those of settings side by side keep apart.
_FAMILIES = {
    "spp": ("spp", "o", "#0072B2", (0, 6)),
    "primal_spp": ("spp of the primal", "^", "#56B4E9", (-6, 4)),
    "gradient_spp": ("spp of the gradient", "v", "#009E73", (6, -9)),
    "max_depth": ("depth", "s", "#D55E00", (6, 4)),
    "resolution": ("resolution", "D", "#CC79A7", (-6, -10)),
    "replicates": ("replicates", "P", "#E69F00", (0, -13)),
    "integrator": ("integrator", "X", "#000000", (-6, 5)),
}
_HEAD = ("", "seconds", "error", "bias", "Spearman", "Kendall", "top 5")
_NOTE_WIDTH = 96


def tradeoff_text(trade: Tradeoff, tolerance: float) -> str:
    """Write ``trade`` for a terminal, with the reference and the advice for ``tolerance`` below it."""
    front = trade.front
    cells = [
        (
            _name(row, trade.rows[0].setting),
            f"{row.seconds:.3g}",
            _percent(*row.relative_error),
            _bias(row),
            _share(row.spearman.value),
            _share(row.kendall.value),
            f"{100 * row.top.value:.0f} %",
        )
        for row in trade.rows
    ]
    widths = [max(map(len, column)) for column in zip(_HEAD, *cells, strict=True)]
    lines = [
        "  ".join(
            [f"{line[0]:{widths[0]}}", *(f"{c:>{w}}" for c, w in zip(line[1:], widths[1:], strict=True))]
        )
        for line in (_HEAD, *cells)
    ]
    marks = ["", *("  *" if row in front else "" for row in trade.rows)]
    return "\n".join(
        [
            f"{trade.scene}, {trade.metric}: {trade.parameters} parameters, {trade.runs} runs of each setting",
            "",
            *(line + mark for line, mark in zip(lines, marks, strict=True)),
            "",
            "* no other is both faster and nearer;  bias: ≤ where it is not told from 0",
            reference_words(trade),
            trade.recommendation(tolerance),
        ]
    )


def reference_words(trade: Tradeoff) -> str:
    """Say what the settings are compared with, and how good that is itself."""
    reference = trade.reference
    return (
        f"reference: {setting_words(reference.setting)}, itself known to {_percent_of(reference.relative_error)}; "
        f"its halves rank with Kendall's τ {_share(reference.kendall_of_halves)}"
    )


def recommendation_text(trade: Tradeoff, tolerance: float) -> str:
    """Return one line from ``trade``: what to use for a relative error of ``tolerance``, or what is in the way."""
    best = trade.cheapest(tolerance)
    if best is not None:
        return (
            f"For an error of {_percent_of(tolerance)}: {setting_words(best.setting)} ({best.seconds:.2g} s), "
            f"{_percent(*best.relative_error)} off, {100 * best.top.value:.0f} % of the first five right."
        )
    nearest = min(trade.rows, key=lambda row: row.relative_error.value)
    error, bias = nearest.relative_error.value, nearest.bias.value if nearest.bias.told else 0.0
    found = f"No setting is within {_percent_of(tolerance)}: the nearest, {setting_words(nearest.setting)},"
    if bias >= tolerance:
        return f"{found} has a bias of {_percent_of(bias)}, which more samples do not lower."
    # What is not bias falls as one over the root of the samples.
    more = ((error + nearest.relative_error.error) ** 2 - bias**2) / (tolerance**2 - bias**2)
    spp = math.ceil(more * max(nearest.setting.primal_spp, nearest.setting.gradient_spp))
    return f"{found} is {_percent(*nearest.relative_error)} off; about {_round(spp)} spp should do."


def setting_words(setting: Setting) -> str:
    """``'64 spp, depth 6, 320×180'``."""
    primal, gradient = setting.primal_spp, setting.gradient_spp
    words = [f"{primal} spp" if primal == gradient else f"{primal} spp primal and {gradient} gradient"]
    if setting.max_depth is not None:
        words.append(_depth(setting))
    if setting.resolution is not None:
        words.append("×".join(map(str, setting.resolution)))
    if setting.replicates == 1:
        words.append("1 replicate")
    if setting.integrator in STOCK:
        words.append(str(setting.integrator))
    return ", ".join(words)


def plot_tradeoff(trade: Tradeoff, ax: Axes | None = None) -> Figure:
    """Draw relative error against seconds, a marker for each setting and a family of markers for what it varies.

    A line joins the settings that no other beats in both; up to the dashed line the reference cannot judge.

    Parameters
    ----------
    trade
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    """
    if ax is None:
        ax = new_figure(WIDTH, 4.6).add_subplot()
    ax.set_xscale("log")
    ax.set_yscale("log")
    front = trade.front
    ax.plot(
        [row.seconds for row in front],
        [row.relative_error.value for row in front],
        color="0.7",
        linewidth=1.2,
        drawstyle="steps-post",
        zorder=1,
    )
    own = trade.rows[0]
    _draw(ax, [own], "*", "0.35", f"own: {setting_words(own.setting)}", size=11)
    for key, (label, marker, colour, away) in _FAMILIES.items():
        rows = [row for row in trade.rows if row.varied == key]
        if rows:
            _draw(ax, rows, marker, colour, label)
            for row in rows:
                _write_value(ax, row, colour, away)
    if trade.reference.relative_error > 0:
        ax.axhline(trade.reference.relative_error, color="0.5", linewidth=0.9, linestyle=(0, (4, 3)))
    _finish(ax, trade)
    return figure_of(ax)


def _draw(ax: Axes, rows: list[Measured], marker: str, colour: str, label: str, *, size: float = 5.5) -> None:
    ax.errorbar(
        [row.seconds for row in rows],
        [row.relative_error.value for row in rows],
        yerr=[min(row.relative_error.error, 0.9 * row.relative_error.value) for row in rows],
        fmt=marker,
        markersize=size,
        color=colour,
        elinewidth=1,
        label=label,
        zorder=3,
    )


def _write_value(ax: Axes, row: Measured, colour: str, away: tuple[float, float]) -> None:
    ax.annotate(
        _value(row),
        (row.seconds, row.relative_error.value),
        xytext=away,
        textcoords="offset points",
        ha="right" if away[0] < 0 else "left" if away[0] > 0 else "center",
        fontsize=SMALL - 0.5,
        color=colour,
        parse_math=False,
        zorder=4,
    )


def _finish(ax: Axes, trade: Tradeoff) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.margins(x=0.12, y=0.1)
    for axis, write in ((ax.xaxis, lambda x, _: f"{x:g}"), (ax.yaxis, lambda y, _: f"{100 * y:g} %")):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(write))
        axis.set_minor_formatter(NullFormatter())
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=SMALL)
    ax.set_xlabel("seconds", fontsize=TEXT)
    ax.set_ylabel("relative error of the gradient", fontsize=TEXT)
    columns = 5
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=columns,
        fontsize=SMALL,
        frameon=False,
        borderaxespad=0.2,
        columnspacing=1.2,
        handletextpad=0.3,
    )
    lines = -(-len(ax.get_legend_handles_labels()[0]) // columns)
    ax.set_title(
        f"What accuracy costs: {trade.metric}",
        loc="left",
        fontsize=TITLE,
        pad=10 + 12 * lines,
        parse_math=False,
    )
    remarks = [
        "grey line: no setting is both faster and nearer",
        f"dashed: how well the reference ({setting_words(trade.reference.setting)}) is known itself",
        f"bars: one standard error, of {trade.runs} runs",
    ]
    small_print(ax, pack(remarks, _NOTE_WIDTH), below=34)


def _name(row: Measured, own: Setting) -> str:
    if not row.varied:
        return setting_words(own)
    return f"  {row.varied.replace('_', ' ')} {_value(row)}"


def _value(row: Measured) -> str:
    setting = row.setting
    if row.varied == "max_depth":
        return "unlimited" if setting.max_depth == -1 else str(setting.max_depth)
    if row.varied == "resolution":
        return "×".join(map(str, setting.resolution or ()))
    if row.varied == "spp":
        return str(setting.primal_spp)
    return str(getattr(setting, row.varied))


def _depth(setting: Setting) -> str:
    return "unlimited depth" if setting.max_depth == -1 else f"depth {setting.max_depth}"


def _bias(row: Measured) -> str:
    if not row.bias.told:
        return f"≤ {_percent_of(row.bias.limit)}"
    return _percent(row.bias.value, row.bias.error)


def _percent(value: float, error: float) -> str:
    """``'4.1 ± 0.3 %'``: the error to one digit."""
    value, error = 100 * value, 100 * error
    if error == 0 or not math.isfinite(error):
        return f"{value:.3g} %"
    places = min(max(-math.floor(math.log10(error)), 0), 4)
    return f"{value:.{places}f} ± {error:.{places}f} %"


def _percent_of(value: float) -> str:
    return f"{100 * value:.2g} %" if value < 0.995 else f"{100 * value:.0f} %"


def _share(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}"


def _round(number: int) -> str:
    """Write two digits of a number."""
    unit: int = 10 ** max(len(str(number)) - 2, 0)
    return str(-(-number // unit) * unit)
