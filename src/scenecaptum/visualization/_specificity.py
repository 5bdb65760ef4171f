"""Figure of several attributions side by side: rankings and saliency maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import SceneCaptumError
from ..projection import DEFAULT_NORM, MapNorm, heatmap, objects_of_unclear_sign, shared_maximum
from ..protocols import Attribution, RankedParameter, Scale
from ._bars import bar_doubts, bar_legend, bar_notes, draw_bars
from ._figures import (
    DEFAULT_TOP,
    SMALL,
    TEXT,
    TITLE,
    characters_per_line,
    figure_of,
    figure_title,
    first,
    new_figure,
    style_axes,
)
from ._layout import wrap, wrapped_lines
from ._maps import draw_colorbar, draw_map
from ._text import axis_label, method_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_COLUMN_WIDTH, _MAX_MAP_HEIGHT = 3.6, 3.6  # inches
_NAME_WIDTH = 26


def plot_specificity(
    attributions: Sequence[Attribution],
    top: int | None = DEFAULT_TOP,
    *,
    figure: Figure | SubFigure | None = None,
    shared: bool = False,
    signed: bool = False,
    scale: Scale | None = None,
    norm: MapNorm = DEFAULT_NORM,
) -> Figure:
    """Plot the ranking and, below it, the saliency map of each of several attributions.

    It shows how different metrics of one image depend on different parameters. Where the methods differ, each
    column has the name of its own.

    Parameters
    ----------
    attributions
        One per column; usually several metrics of one renderer.
    top
        Number of parameters in each ranking; None for all.
    figure
        Figure or subfigure to draw into; by default a new one.
    shared
        Use one scale for all maps, relative to the most salient object in any of them. The metrics must have the
        same unit. By default each map has its own scale.
    scale
        As for ``plot_bars``.
    signed, norm
        As for ``plot_heatmap``.

    Raises
    ------
    SceneCaptumError
        If there is no attribution, or one has no map of the surfaces in its image.
    """
    if not attributions:
        raise SceneCaptumError("plot_specificity needs at least one attribution.")
    maximum = shared_maximum(attributions, scale=scale) or None if shared else None
    heats = [heatmap(a, signed=signed, scale=scale, norm=norm, maximum=maximum) for a in attributions]
    rows = [first(attribution.ranking(scale=scale), top) for attribution in attributions]
    bars = 1.5 + 0.19 * max(map(len, rows))
    maps = 0.1 + min(max(_COLUMN_WIDTH * heat.shape[0] / heat.shape[1] for heat in heats), _MAX_MAP_HEIGHT)
    columns = len(attributions)
    marks = _marks(attributions, rows, scale)
    maps += 1.4 * SMALL / 72 * len(marks)
    part: Any = figure or new_figure(_COLUMN_WIDTH * columns + 0.7, bars + maps)
    # Separate subfigures let the maps be as wide as bars and names together.
    upper, lower = part.subfigures(2, 1, height_ratios=[bars, maps])

    legend: dict[Any, Any] = {}
    for ax, attribution, ranked in zip(
        upper.subplots(1, columns, squeeze=False)[0], attributions, rows, strict=True
    ):
        label = wrap(
            axis_label(attribution, scale), characters_per_line(0.68 * _COLUMN_WIDTH, SMALL), indent=0
        )
        style_axes(ax)
        draw_bars(ax, attribution, ranked, scale=scale, name_width=_NAME_WIDTH, size=SMALL)
        ax.locator_params(axis="x", nbins=4)
        ax.set_xlabel(label, fontsize=SMALL, parse_math=False)
        legend |= {entry.get_label(): entry for entry in bar_legend(attribution, ranked, scale)}
    _draw_titles(upper, attributions, scale)
    if legend:
        style: dict[str, Any] = {"loc": "outside lower center", "ncols": 2, "frameon": False}
        upper.legend(handles=list(legend.values()), fontsize=SMALL, **style)
    axes = lower.subplots(1, columns, squeeze=False)[0]
    if marks:
        lower.supxlabel("\n".join(marks), fontsize=SMALL, x=0.02, ha="left", parse_math=False)
    mapped = [draw_map(ax, heat, signed=signed) for ax, heat in zip(axes, heats, strict=True)]
    bar = draw_colorbar(mapped[-1], signed, norm, ax=list(axes), aspect=18, pad=0.02)
    noisy = signed and any(objects_of_unclear_sign(one, scale=scale) for one in attributions)
    unclear = "; white:\nsign lost in the noise" if noisy else ""
    bar.set_label(f"relative to the largest\n{'of all' if shared else 'in each'}{unclear}", fontsize=SMALL)
    return figure_of(part)


def _marks(
    attributions: Sequence[Attribution], rows: Sequence[Sequence[RankedParameter]], scale: Scale | None
) -> list[str]:
    """Return what the marks ``~`` and ``?`` beside names mean, in lines as wide as the figure."""
    width = characters_per_line(0.95 * _COLUMN_WIDTH * len(attributions), SMALL)
    pairs = list(zip(attributions, rows, strict=True))
    notes = [f"~ {note}" for one, ranked in pairs for note in bar_notes(one, ranked, scale)]
    notes += [f"? {doubt}" for one, ranked in pairs for doubt in bar_doubts(one, ranked)]
    return [part for note in dict.fromkeys(notes) for part in wrapped_lines(note, width, 2)]


def _draw_titles(figure: Any, attributions: Sequence[Attribution], scale: Scale | None) -> None:
    """Write each column's title centred over bars and names; a long one would not fit over the bars alone."""
    from matplotlib.transforms import blended_transform_factory

    width = characters_per_line(0.85 * _COLUMN_WIDTH, TITLE)
    methods_differ = len(set(map(method_name, attributions))) > 1
    for index, (ax, attribution) in enumerate(zip(figure.axes, attributions, strict=True)):
        method = wrapped_lines(method_name(attribution), width) if methods_differ else []
        ax.text(
            (index + 0.5) / len(attributions),
            1.03,
            "\n".join([*method, figure_title(attribution, width, scale)]),
            transform=blended_transform_factory(figure.transSubfigure, ax.transAxes),
            ha="center",
            fontsize=TEXT,
            parse_math=False,
        )
