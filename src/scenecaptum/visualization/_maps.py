"""Saliency maps beside the render and over it."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from ..errors import SceneCaptumError
from ._figures import (
    LOWERS,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    figure_of,
    letters,
    new_figure,
    title_of,
)
from ._numbers import shorten, with_error
from ._tonemap import display_image
from ._words import noise_words, sign_words

if TYPE_CHECKING:
    import numpy as np
    import torch
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from ..attr import SceneAttribution

Scale = Literal["sqrt", "linear", "log"]

_SCALES = {"sqrt": "√\u00a0scale", "linear": "linear\u00a0scale", "log": "logarithmic\u00a0scale"}
_TICKS = {
    "sqrt": [0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1],
    "linear": [0.2, 0.4, 0.6, 0.8, 1],
    "log": [0.001, 0.01, 0.1, 1],
}
_LEAST = 1e-3  # where a logarithmic scale begins
_MARGIN, _GAP, _BAR, _NUMBERS = 0.12, 0.1, 0.12, 0.45  # inches
_TALLEST = 4.0
_GREY = 0.7  # how bright a render lies below a map, which is to be read by its colours


def plot_heatmap(
    attribution: SceneAttribution,
    ax: Axes | None = None,
    *,
    signed: bool = False,
    scale: Scale = "sqrt",
    **options: Any,
) -> Figure:
    """Draw the render and, beside it and of the same size, the saliency of what each pixel shows.

    Parameters
    ----------
    attribution
        What to draw.
    ax
        Axes to draw the map into, with a colour bar and without the render; by default a new figure has both.
    signed
        Draw signed values on a diverging scale, in the colours of the bars, instead of magnitudes.
    scale
        How saliencies become colours: by their square root, as they are, or by their logarithm. They often spread
        over orders of magnitude: on a linear scale all but a lamp or two may be black.
    options
        Which map: ``parameter``, ``maximum``, ``texels`` and ``surfaces`` of ``projection.heatmap``.

    Raises
    ------
    SceneCaptumError
        Where the attribution does not know what its pixels show, or has no picture.
    """
    check_scale(scale)
    heat = heat_of(attribution, signed=signed, **options)
    title = _map_title(attribution, signed, scale, options, _width(ax, heat, 2))
    if ax is not None:
        mapped = draw_map(ax, heat, signed=signed, scale=scale)
        ax.set_title(title, fontsize=TEXT, parse_math=False)
        draw_colour_bar(mapped, scale, signed, ax=ax)
        return figure_of(ax)

    render = render_of(attribution).numpy()
    figure, (left, right), bar = _panels(attribution, heat, 2, title)
    left.imshow(render)
    left.set_title("render", fontsize=TEXT)
    mapped = draw_map(right, heat, signed=signed, scale=scale)
    right.set_title(title, fontsize=TEXT, parse_math=False)
    draw_colour_bar(mapped, scale, signed, cax=bar)
    return figure


def plot_overlay(
    attribution: SceneAttribution,
    ax: Axes | None = None,
    *,
    alpha: float = 0.8,
    signed: bool = False,
    scale: Scale = "sqrt",
    **options: Any,
) -> Figure:
    """Draw the saliency map over the render, which is grey: all colour is saliency.

    Parameters
    ----------
    attribution
        What to draw.
    ax
        Axes to draw into; by default those of a new figure.
    alpha
        How much the map covers the render where it is strongest, between 0 and 1; elsewhere it covers less.
    signed, scale, options
        As for ``plot_heatmap``.

    Raises
    ------
    SceneCaptumError
        Where the attribution does not know what its pixels show, or has no picture, or ``alpha`` is out of range.
    """
    if not 0 <= alpha <= 1:
        raise SceneCaptumError(f"alpha must lie between 0 and 1, not {alpha!r}.")
    check_scale(scale)
    heat = heat_of(attribution, signed=signed, **options)
    grey = render_of(attribution).mean(-1).numpy()
    title = _map_title(attribution, signed, scale, options, _width(ax, heat, 1))
    if ax is None:
        figure, (ax,), bar = _panels(attribution, heat, 1, title)
        place: dict[str, Any] = {"cax": bar}
    else:
        figure, place = figure_of(ax), {"ax": ax}
    ax.imshow(_GREY * grey, cmap="gray", vmin=0, vmax=1)
    ax.set_title(title, fontsize=TEXT, parse_math=False)
    mapped = draw_map(ax, heat, signed=signed, scale=scale, alpha=alpha)
    draw_colour_bar(mapped, scale, signed, **place)
    return figure


def draw_map(
    ax: Axes, heat: np.ndarray[Any, Any], *, signed: bool, scale: Scale, alpha: float | None = None
) -> AxesImage:
    """Paint a map; with ``alpha`` it is the more transparent the weaker it is."""
    norm, colours = _norm(scale, signed), diverging() if signed else "inferno"
    opacity = None
    if alpha is not None:
        normed = norm(heat).filled(0)
        opacity = alpha * (abs(2 * normed - 1) if signed else normed) ** 0.5
    ax.set_axis_off()
    return ax.imshow(heat, cmap=colours, norm=norm, alpha=opacity)


def draw_colour_bar(mapped: AxesImage, scale: Scale, signed: bool, **place: Any) -> Colorbar:
    """Draw the legend of a map's colours; ``place`` is matplotlib's ``ax`` or ``cax``."""
    from matplotlib.cm import ScalarMappable

    ticks = _TICKS[scale]
    if signed:  # on either side of zero there is half the room
        few = ticks if scale == "log" else [0.1, 0.4, 1]
        ticks = [-tick for tick in reversed(few)] + [0] + few
    elif scale != "log":
        ticks = [0, *ticks]
    whole: Any = mapped.figure
    # Of the map itself it would be as transparent as the map.
    colours = ScalarMappable(norm=mapped.norm, cmap=mapped.cmap)
    bar: Colorbar = whole.figure.colorbar(colours, ticks=ticks, format="%g", **place)
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL)
    return bar


def check_scale(scale: str) -> None:
    """Refuse a scale that there is not."""
    if scale not in _SCALES:
        raise SceneCaptumError(f"scale must be one of {', '.join(map(repr, _SCALES))}, not {scale!r}.")


def _norm(scale: Scale, signed: bool) -> Normalize:
    import numpy as np
    from matplotlib.colors import FuncNorm, LogNorm, Normalize, PowerNorm, SymLogNorm

    low = -1 if signed else 0
    if scale == "linear":
        return Normalize(low, 1)
    if scale == "log":
        return SymLogNorm(_LEAST, vmin=-1, vmax=1) if signed else LogNorm(_LEAST, 1, clip=True)
    if not signed:
        return PowerNorm(0.5, 0, 1)

    def root(x: Any) -> Any:
        return np.sign(x) * np.sqrt(np.abs(x))

    return FuncNorm((root, lambda x: np.sign(x) * np.square(x)), -1, 1)


def diverging() -> Colormap:
    """Return a map from the bars' vermillion by white to their blue, as dark at one end as at the other."""
    from matplotlib.colors import LinearSegmentedColormap

    colours = ["#A84A00", LOWERS, "#F4B183", "#F7F7F7", "#8FC1E3", RAISES, "#005A8C"]
    return LinearSegmentedColormap.from_list("scenecaptum_signed", colours)


def heat_of(attribution: SceneAttribution, **options: Any) -> np.ndarray[Any, Any]:
    """Return the map; what is as usual is left unsaid."""
    unusual = {key: value for key, value in options.items() if value is not None and value is not False}
    heat: torch.Tensor = attribution.heatmap(**unusual)
    return heat.cpu().numpy()


def render_of(attribution: SceneAttribution) -> torch.Tensor:
    """Return the picture as a screen shows it."""
    if attribution.image is None:
        raise SceneCaptumError("This attribution has no picture to set beside its heatmap.")
    return display_image(attribution.image).cpu()


def _map_title(
    attribution: SceneAttribution, signed: bool, scale: Scale, options: Mapping[str, Any], width: float
) -> str:
    if not any(attribution.saliency().values()):
        return "all saliencies are 0"
    parameter, maximum = options.get("parameter"), options.get("maximum")
    names = [] if parameter is None else [parameter] if isinstance(parameter, str) else list(parameter)
    what = ", ".join(attribution.labels.get(name, name) for name in names)
    what = shorten([what], 60)[0] or ("attribution" if signed else "saliency")
    strongest = "the strongest" if maximum is None else f"{maximum:.3g}"
    lines = [f"{what}, relative to {strongest} ({_SCALES[scale]})"]
    words = sign_words(attribution) if signed else None
    if words is not None:
        lines += [f"blue: {words[0]}", f"orange: {words[1]}"]
    return "\n".join(part for line in lines for part in textwrap.wrap(line, letters(width, TEXT)))


def _width(ax: Axes | None, heat: np.ndarray[Any, Any], count: int) -> float:
    """Return how wide a picture will be, in inches: as wide as the page allows, where none is too tall."""
    if ax is not None:
        return float(ax.get_position().width) * figure_of(ax).get_figwidth()
    height, width = int(heat.shape[0]), int(heat.shape[1])
    across = (WIDTH - 2 * _MARGIN - _BAR - _NUMBERS) / count - _GAP
    return min(across, _TALLEST * width / height)


def _panels(
    attribution: SceneAttribution, heat: np.ndarray[Any, Any], count: int, heading: str
) -> tuple[Figure, list[Axes], Axes]:
    """Place pictures of one size and a colour bar as tall as they are; lengths are in inches."""
    w = _width(None, heat, count)
    h = w * heat.shape[0] / heat.shape[1]
    across = 2 * _MARGIN + count * (w + _GAP) + _BAR + _NUMBERS
    title = title_of(attribution, letters(across - 0.2, TITLE))
    captions = filter(None, [_out_of_sight(attribution), *noise_words(attribution)])
    caption = [line for one in captions for line in textwrap.wrap(one, letters(across - 0.2, SMALL))]
    bottom, top = (
        0.12 + 0.14 * len(caption),
        0.2 + 0.17 * len(title.splitlines()) + 0.14 * len(heading.splitlines()),
    )
    down = bottom + h + top
    figure = new_figure(across, down, layout="none")
    figure.text(_MARGIN / across, 1 - 0.1 / down, title, va="top", fontsize=TITLE, parse_math=False)
    small: dict[str, Any] = {"va": "bottom", "fontsize": SMALL, "parse_math": False}
    figure.text(_MARGIN / across, 0.08 / down, "\n".join(caption), **small)

    def place(x: float, extent: float) -> Axes:
        return figure.add_axes((x / across, bottom / down, extent / across, h / down))

    pictures = [place(_MARGIN + number * (w + _GAP), w) for number in range(count)]
    for axes in pictures:
        axes.set_axis_off()
    return figure, pictures, place(_MARGIN + count * (w + _GAP), _BAR)


def _out_of_sight(attribution: SceneAttribution) -> str:
    """Name the strongest parameter or group that no pixel shows, if it is one of the three most salient."""
    surfaces = attribution.surfaces
    if surfaces is None:
        return ""
    seen = {name for index in set(surfaces.object_index.tolist()) for name in surfaces.parameters[index]}
    groups = attribution.info.get("groups") or {}
    for row in attribution.ranking(3):
        if seen.isdisjoint(groups.get(row.name, [row.name])) and row.saliency > 0:
            saliency = " ± ".join(filter(None, with_error(row.saliency, row.saliency_error)))
            label = shorten([row.label], 60)[0]
            return f"not in the picture: {label}, #{row.rank} with a saliency of {saliency}"
    return ""
