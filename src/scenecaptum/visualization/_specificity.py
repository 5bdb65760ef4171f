"""Figure of several attributions side by side: rankings and saliency maps."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ._bars import bar_legend, draw_bars, top_rows
from ._figures import SMALL, TEXT, TITLE, characters_per_line, figure_of, figure_title, new_figure
from ._maps import ColorScale, check_scale, draw_colorbar, draw_map, heatmap_array
from ._text import axis_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..protocols import Attribution, RankedParameter

_COLUMN_WIDTH, _MAX_MAP_HEIGHT = 3.6, 3.6  # inches
_NAME_WIDTH = 26


def plot_specificity(
    attributions: Sequence[Attribution],
    top: int = 8,
    *,
    shared: bool = False,
    signed: bool = False,
    scale: ColorScale = "sqrt",
    figure: Any = None,
) -> Figure:
    """Plot the ranking and, below it, the saliency map of each of several attributions.

    It shows how different metrics of one image depend on different parameters.

    Parameters
    ----------
    attributions
        One per column; usually several metrics of one renderer.
    top
        Number of bars.
    shared
        Use one scale for all maps, relative to the most salient object in any of them. The metrics must have the
        same unit. By default each map has its own scale.
    signed, scale
        As for ``plot_heatmap``.
    figure
        A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.

    Raises
    ------
    SceneCaptumError
        If there is no attribution, or one has no map of the surfaces in its image.
    """
    if not attributions:
        raise SceneCaptumError("plot_specificity needs at least one attribution.")
    check_scale(scale)
    maximum = _shared_maximum(attributions) if shared else None
    heats = [heatmap_array(a, signed=signed, maximum=maximum or None) for a in attributions]
    rows = [top_rows(attribution, top) for attribution in attributions]
    bars = 1.5 + 0.19 * max(map(len, rows))
    maps = 0.1 + min(max(_COLUMN_WIDTH * heat.shape[0] / heat.shape[1] for heat in heats), _MAX_MAP_HEIGHT)
    if figure is None:
        figure = new_figure(_COLUMN_WIDTH * len(attributions) + 0.7, bars + maps)
    # Separate subfigures let the maps be as wide as bars and names together.
    upper, lower = figure.subfigures(2, 1, height_ratios=[bars, maps])

    columns = len(attributions)
    axes = upper.subplots(1, columns, squeeze=False)[0]
    for ax, attribution, ranked in zip(axes, attributions, rows, strict=True):
        _draw_ranking(ax, attribution, ranked)
    _draw_titles(upper, attributions)
    _draw_legend(upper, attributions, rows)
    axes = lower.subplots(1, columns, squeeze=False)[0]
    mapped = [draw_map(ax, heat, signed=signed, scale=scale) for ax, heat in zip(axes, heats, strict=True)]
    location: dict[str, Any] = {"ax": list(axes), "aspect": 18, "pad": 0.02}
    bar = draw_colorbar(mapped[-1], scale, signed, **location)
    bar.set_label(f"relative to the strongest\n{'of all' if shared else 'in each'}", fontsize=SMALL)
    return figure_of(axes[0])


def _inaccurate(attribution: Attribution, rows: Sequence[RankedParameter]) -> list[bool]:
    cautions = attribution.info.get("cautions") or {}
    return [row.name in cautions for row in rows]


def _draw_ranking(ax: Axes, attribution: Attribution, rows: Sequence[RankedParameter]) -> None:
    draw_bars(ax, attribution, rows, _inaccurate(attribution, rows), name_width=_NAME_WIDTH)
    ax.tick_params(axis="both", labelsize=SMALL)
    ax.locator_params(axis="x", nbins=4)
    label = textwrap.fill(axis_label(attribution), characters_per_line(0.68 * _COLUMN_WIDTH, SMALL))
    ax.set_xlabel(label, fontsize=SMALL, parse_math=False)


def _draw_titles(figure: Any, attributions: Sequence[Attribution]) -> None:
    """Write each column's title centred over bars and names; a long one would not fit over the bars alone."""
    from matplotlib.transforms import blended_transform_factory

    for index, (ax, attribution) in enumerate(zip(figure.axes, attributions, strict=True)):
        ax.text(
            (index + 0.5) / len(attributions),
            1.03,
            figure_title(attribution, characters_per_line(0.85 * _COLUMN_WIDTH, TITLE)),
            transform=blended_transform_factory(figure.transSubfigure, ax.transAxes),
            ha="center",
            fontsize=TEXT,
            parse_math=False,
        )


def _draw_legend(
    figure: Any, attributions: Sequence[Attribution], rows: Sequence[Sequence[RankedParameter]]
) -> None:
    pairs = zip(attributions, rows, strict=True)
    entries = {
        entry.get_label(): entry
        for attribution, ranked in pairs
        for entry in bar_legend(attribution, ranked, any(_inaccurate(attribution, ranked)))
    }
    if entries:
        figure.legend(
            handles=list(entries.values()), loc="outside lower center", ncols=2, fontsize=SMALL, frameon=False
        )


def _shared_maximum(attributions: Sequence[Attribution]) -> float:
    from ..projection import shared_maximum

    return float(shared_maximum(attributions))
