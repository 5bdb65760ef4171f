"""How specific saliency is to the metric: bars above maps, metrics side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ._bars import bar_legend, draw_bars, top_rows
from ._figures import SMALL, TEXT, TITLE, figure_of, letters, new_figure, title_of
from ._maps import Scale, check_scale, draw_colour_bar, draw_map, heat_of
from ._words import axis_words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..attr import Ranked, SceneAttribution

_COLUMN, _TALLEST = 3.6, 3.6  # inches
_NARROW_NAME = 26


def plot_specificity(
    attributions: Sequence[SceneAttribution],
    top: int = 8,
    *,
    shared: bool = False,
    signed: bool = False,
    scale: Scale = "sqrt",
    figure: Any = None,
) -> Figure:
    """Draw for each of several attributions its ranking as bars and, below, its saliency map.

    It is to show that metrics of one picture depend on different things.

    Parameters
    ----------
    attributions
        One for each column; usually several metrics of one renderer.
    top
        How many bars.
    shared
        Give all maps one scale, that of the most salient object in any of them, which takes metrics in the same
        unit; by default each map has its own.
    signed, scale
        As for ``plot_heatmap``.
    figure
        A matplotlib ``Figure`` or ``SubFigure`` to draw into; by default a new one.

    Raises
    ------
    SceneCaptumError
        Where there is no attribution, or one does not know what its pixels show.
    """
    if not attributions:
        raise SceneCaptumError("plot_specificity takes at least one attribution.")
    check_scale(scale)
    maximum = _shared_maximum(attributions) if shared else None
    heats = [heat_of(one, signed=signed, maximum=maximum or None) for one in attributions]
    rows = [top_rows(one, top) for one in attributions]
    bars = 1.5 + 0.19 * max(map(len, rows))
    maps = 0.1 + min(max(_COLUMN * heat.shape[0] / heat.shape[1] for heat in heats), _TALLEST)
    if figure is None:
        figure = new_figure(_COLUMN * len(attributions) + 0.7, bars + maps)
    # A grid of its own for either row lets the maps be as wide as bars and names together.
    upper, lower = figure.subfigures(2, 1, height_ratios=[bars, maps])

    columns = len(attributions)
    for ax, one, ranked in zip(upper.subplots(1, columns, squeeze=False)[0], attributions, rows, strict=True):
        _draw_ranking(ax, one, ranked)
    _draw_heads(upper, attributions)
    _draw_legend(upper, attributions, rows)
    axes = lower.subplots(1, columns, squeeze=False)[0]
    mapped = [draw_map(ax, heat, signed=signed, scale=scale) for ax, heat in zip(axes, heats, strict=True)]
    place: dict[str, Any] = {"ax": list(axes), "aspect": 18, "pad": 0.02}
    bar = draw_colour_bar(mapped[-1], scale, signed, **place)
    bar.set_label(f"relative to the strongest\n{'of all' if shared else 'in each'}", fontsize=SMALL)
    return figure_of(axes[0])


def _doubtful(attribution: SceneAttribution, rows: Sequence[Ranked]) -> list[bool]:
    cautions = attribution.info.get("cautions") or {}
    return [row.name in cautions for row in rows]


def _draw_ranking(ax: Axes, attribution: SceneAttribution, rows: Sequence[Ranked]) -> None:
    draw_bars(ax, attribution, rows, _doubtful(attribution, rows), name_width=_NARROW_NAME)
    ax.tick_params(axis="both", labelsize=SMALL)
    ax.locator_params(axis="x", nbins=4)
    words = textwrap.fill(axis_words(attribution), letters(0.68 * _COLUMN, SMALL))
    ax.set_xlabel(words, fontsize=SMALL, parse_math=False)


def _draw_heads(figure: Any, attributions: Sequence[SceneAttribution]) -> None:
    """Write each column's title in its middle, names included: above the bars alone a long one would be cut."""
    from matplotlib.transforms import blended_transform_factory

    for number, (ax, one) in enumerate(zip(figure.axes, attributions, strict=True)):
        ax.text(
            (number + 0.5) / len(attributions),
            1.03,
            title_of(one, letters(0.85 * _COLUMN, TITLE)),
            transform=blended_transform_factory(figure.transSubfigure, ax.transAxes),
            ha="center",
            fontsize=TEXT,
            parse_math=False,
        )


def _draw_legend(
    figure: Any, attributions: Sequence[SceneAttribution], rows: Sequence[Sequence[Ranked]]
) -> None:
    pairs = zip(attributions, rows, strict=True)
    entries = {
        entry.get_label(): entry
        for one, ranked in pairs
        for entry in bar_legend(one, ranked, any(_doubtful(one, ranked)))
    }
    if entries:
        figure.legend(
            handles=list(entries.values()), loc="outside lower center", ncols=2, fontsize=SMALL, frameon=False
        )


def _shared_maximum(attributions: Sequence[SceneAttribution]) -> float:
    from ..projection import shared_maximum

    return float(shared_maximum(attributions))
