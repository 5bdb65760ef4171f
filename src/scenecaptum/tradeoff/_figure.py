"""Figure of the cost and accuracy of settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..visualization import SMALL, TEXT, TITLE, add_footnotes, pack
from ._rows import Measured, Reference
from ._text import setting_text, value_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
_NOTE_WIDTH = 96


def draw(ax: Axes, rows: Sequence[Measured], front: Sequence[Measured], reference: Reference) -> None:
    """Draw the error over the time: a star for the first row, a marker for every other, and the Pareto front."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.plot(
        [row.seconds for row in front],
        [row.relative_error.value for row in front],
        color="0.7",
        linewidth=1.2,
        drawstyle="steps-post",
        zorder=1,
    )
    own = rows[0]
    _draw_points(ax, [own], "*", "0.35", f"own: {setting_text(own.setting)}", size=11)
    for key, (name, marker, color, offset) in _STYLES.items():
        varied = [row for row in rows if row.varied == key]
        if varied:
            _draw_points(ax, varied, marker, color, name)
            for row in varied:
                _annotate(ax, row, color, offset)
    if reference.relative_error > 0:
        ax.axhline(reference.relative_error, color="0.5", linewidth=0.9, linestyle=(0, (4, 3)))


def label(ax: Axes, title: str, remarks: Sequence[str]) -> None:
    """Write the title, the legend, the axes' labels and the remarks."""
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
    ax.set_title(title, loc="left", fontsize=TITLE, pad=10 + 12 * lines, parse_math=False)
    add_footnotes(ax, pack(remarks, _NOTE_WIDTH), below=34)


def _draw_points(
    ax: Axes, rows: Sequence[Measured], marker: str, color: str, name: str, *, size: float = 5.5
) -> None:
    ax.errorbar(
        [row.seconds for row in rows],
        [row.relative_error.value for row in rows],
        yerr=[min(row.relative_error.error, 0.9 * row.relative_error.value) for row in rows],
        fmt=marker,
        markersize=size,
        color=color,
        elinewidth=1,
        label=name,
        zorder=3,
    )


def _annotate(ax: Axes, row: Measured, color: str, offset: tuple[float, float]) -> None:
    ax.annotate(
        value_text(row),
        (row.seconds, row.relative_error.value),
        xytext=offset,
        textcoords="offset points",
        ha="right" if offset[0] < 0 else "left" if offset[0] > 0 else "center",
        fontsize=SMALL - 0.5,
        color=color,
        parse_math=False,
        zorder=4,
    )
