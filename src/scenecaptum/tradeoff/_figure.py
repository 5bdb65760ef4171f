"""Figure of the cost and accuracy of settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..visualization import SMALL, style_axes, write_at
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


def draw(ax: Axes, rows: Sequence[Measured], front: Sequence[Measured], reference: Reference) -> None:
    """Draw the error over the time: a star for the first row, a marker for every other, and the Pareto front."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set_xscale("log")
    ax.set_yscale("log")
    style: dict[str, Any] = {"color": "0.7", "linewidth": 1.2, "drawstyle": "steps-post", "zorder": 1}
    ax.plot(*zip(*((row.seconds, row.relative_error.value) for row in front), strict=True), **style)
    _draw_points(ax, rows[:1], "*", "0.35", f"own: {setting_text(rows[0].setting)}", size=11)
    for key, (name, marker, color, offset) in _STYLES.items():
        varied = [row for row in rows if row.varied == key]
        if varied:
            _draw_points(ax, varied, marker, color, name)
        for row in varied:
            align = "right" if offset[0] < 0 else "left" if offset[0] > 0 else "center"
            at = (row.seconds, row.relative_error.value)
            style = {"ha": align, "fontsize": SMALL - 0.5, "color": color, "zorder": 4}
            write_at(ax, value_text(row), at, offset, **style)
    if reference.relative_error > 0:
        ax.axhline(reference.relative_error, color="0.5", linewidth=0.9, linestyle=(0, (4, 3)))
    ax.margins(x=0.12, y=0.1)
    for axis, format_tick in ((ax.xaxis, lambda x, _: f"{x:g}"), (ax.yaxis, lambda y, _: f"{100 * y:g} %")):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(format_tick))
        axis.set_minor_formatter(NullFormatter())
    style_axes(ax, x="seconds", y="relative error of the gradient")


def _draw_points(
    ax: Axes, rows: Sequence[Measured], marker: str, color: str, name: str, *, size: float = 5.5
) -> None:
    errors = [row.relative_error for row in rows]
    ax.errorbar(
        [row.seconds for row in rows],
        [error.value for error in errors],
        yerr=[min(error.error, 0.9 * error.value) for error in errors],
        fmt=marker,
        markersize=size,
        color=color,
        elinewidth=1,
        label=name,
        zorder=3,
    )
