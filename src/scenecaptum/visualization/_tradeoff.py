"""Table, recommendation and figure of the cost and accuracy of settings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ..rendering._plan import STOCK
from ._figures import SMALL, TEXT, TITLE, WIDTH, add_footnotes, figure_of, new_figure
from ._text import pack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..tradeoff import Measured, Setting, Tradeoff

# Label, marker and colour (Okabe and Ito's) of each varied option in the figure, and the offset of its annotations
# in points, chosen so that those of neighbouring settings do not overlap.
_STYLES = {
    "spp": ("spp", "o", "#0072B2", (0, 6)),
    "primal_spp": ("spp of the primal", "^", "#56B4E9", (-6, 4)),
    "gradient_spp": ("spp of the gradient", "v", "#009E73", (6, -9)),
    "max_depth": ("depth", "s", "#D55E00", (6, 4)),
    "resolution": ("resolution", "D", "#CC79A7", (-6, -10)),
    "replicates": ("replicates", "P", "#E69F00", (0, -13)),
    "integrator": ("integrator", "X", "#000000", (-6, 5)),
}
_HEADER = ("", "seconds", "error", "bias", "Spearman", "Kendall", "top 5")
_NOTE_WIDTH = 96


def tradeoff_text(trade: Tradeoff, tolerance: float) -> str:
    """Format ``trade`` for a terminal, with the reference and the recommendation for ``tolerance``."""
    front = trade.front
    cells = [
        (
            _name(row, trade.rows[0].setting),
            f"{row.seconds:.3g}",
            _percent(*row.relative_error),
            _bias(row),
            _correlation(row.spearman.value),
            _correlation(row.kendall.value),
            f"{100 * row.top.value:.0f} %",
        )
        for row in trade.rows
    ]
    widths = [max(map(len, column)) for column in zip(_HEADER, *cells, strict=True)]
    lines = [
        "  ".join(
            [f"{line[0]:{widths[0]}}", *(f"{c:>{w}}" for c, w in zip(line[1:], widths[1:], strict=True))]
        )
        for line in (_HEADER, *cells)
    ]
    marks = ["", *("  *" if row in front else "" for row in trade.rows)]
    return "\n".join(
        [
            f"{trade.scene}, {trade.metric}: {trade.parameters} parameters, {trade.runs} runs of each setting",
            "",
            *(line + mark for line, mark in zip(lines, marks, strict=True)),
            "",
            "* on the Pareto front of time and error;  bias: ≤ upper limit where not significant",
            reference_words(trade),
            trade.recommendation(tolerance),
        ]
    )


def reference_words(trade: Tradeoff) -> str:
    """Describe the reference and its accuracy."""
    reference = trade.reference
    return (
        f"reference: {setting_words(reference.setting)}, relative error {_percent_of(reference.relative_error)}; "
        f"rankings of its halves have Kendall's τ {_correlation(reference.kendall_of_halves)}"
    )


def recommendation_text(trade: Tradeoff, tolerance: float) -> str:
    """Return the recommended setting in ``trade`` for a relative error of ``tolerance``, or why there is none."""
    best = trade.cheapest(tolerance)
    if best is not None:
        return (
            f"For an error of {_percent_of(tolerance)}: {setting_words(best.setting)} ({best.seconds:.2g} s), "
            f"error {_percent(*best.relative_error)}, {100 * best.top.value:.0f} % of the top five correct."
        )
    closest = min(trade.rows, key=lambda row: row.relative_error.value)
    error, bias = closest.relative_error.value, closest.bias.value if closest.bias.significant else 0.0
    start = f"No setting is within {_percent_of(tolerance)}: the best, {setting_words(closest.setting)},"
    if bias >= tolerance:
        return f"{start} has a bias of {_percent_of(bias)}, which more samples do not reduce."
    # The error without bias is proportional to 1/√spp.
    factor = ((error + closest.relative_error.error) ** 2 - bias**2) / (tolerance**2 - bias**2)
    spp = math.ceil(factor * max(closest.setting.primal_spp, closest.setting.gradient_spp))
    start += f" has an error of {_percent(*closest.relative_error)}"
    return f"{start}; about {_round_up(spp)} spp should suffice."


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
    """Plot the relative error over the time, with one marker per setting and one style per varied option.

    The grey line is the Pareto front; the dashed line is the error of the reference itself.

    Parameters
    ----------
    trade
        The result to plot.
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
    for key, (label, marker, color, offset) in _STYLES.items():
        rows = [row for row in trade.rows if row.varied == key]
        if rows:
            _draw(ax, rows, marker, color, label)
            for row in rows:
                _annotate(ax, row, color, offset)
    if trade.reference.relative_error > 0:
        ax.axhline(trade.reference.relative_error, color="0.5", linewidth=0.9, linestyle=(0, (4, 3)))
    _finish(ax, trade)
    return figure_of(ax)


def _draw(ax: Axes, rows: list[Measured], marker: str, color: str, label: str, *, size: float = 5.5) -> None:
    ax.errorbar(
        [row.seconds for row in rows],
        [row.relative_error.value for row in rows],
        yerr=[min(row.relative_error.error, 0.9 * row.relative_error.value) for row in rows],
        fmt=marker,
        markersize=size,
        color=color,
        elinewidth=1,
        label=label,
        zorder=3,
    )


def _annotate(ax: Axes, row: Measured, color: str, offset: tuple[float, float]) -> None:
    ax.annotate(
        _value(row),
        (row.seconds, row.relative_error.value),
        xytext=offset,
        textcoords="offset points",
        ha="right" if offset[0] < 0 else "left" if offset[0] > 0 else "center",
        fontsize=SMALL - 0.5,
        color=color,
        parse_math=False,
        zorder=4,
    )


def _finish(ax: Axes, trade: Tradeoff) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.margins(x=0.12, y=0.1)
    for axis, format_tick in ((ax.xaxis, lambda x, _: f"{x:g}"), (ax.yaxis, lambda y, _: f"{100 * y:g} %")):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(format_tick))
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
        f"Cost and accuracy: {trade.metric}",
        loc="left",
        fontsize=TITLE,
        pad=10 + 12 * lines,
        parse_math=False,
    )
    remarks = [
        "grey line: Pareto front",
        f"dashed: error of the reference ({setting_words(trade.reference.setting)})",
        f"error bars: one standard error, from {trade.runs} runs",
    ]
    add_footnotes(ax, pack(remarks, _NOTE_WIDTH), below=34)


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
    if not row.bias.significant:
        return f"≤ {_percent_of(row.bias.upper_limit)}"
    return _percent(row.bias.value, row.bias.error)


def _percent(value: float, error: float) -> str:
    """``'4.1 ± 0.3 %'``, with one digit of the error."""
    value, error = 100 * value, 100 * error
    if error == 0 or not math.isfinite(error):
        return f"{value:.3g} %"
    places = min(max(-math.floor(math.log10(error)), 0), 4)
    return f"{value:.{places}f} ± {error:.{places}f} %"


def _percent_of(value: float) -> str:
    return f"{100 * value:.2g} %" if value < 0.995 else f"{100 * value:.0f} %"


def _correlation(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}"


def _round_up(number: int) -> str:
    """Round up to two significant digits."""
    unit: int = 10 ** max(len(str(number)) - 2, 0)
    return str(-(-number // unit) * unit)
