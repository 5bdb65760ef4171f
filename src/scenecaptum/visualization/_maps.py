"""Figures of saliency maps, beside the render and overlaid on it."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from ..denoising import denoise
from ..errors import SceneCaptumError
from ..projection import (
    DECADES,
    DEFAULT_NORM,
    MapNorm,
    heatmap,
    mapped_parameters,
    normalized,
    objects_of_unclear_sign,
    used_by_objects,
)
from ..protocols import Attribution, RankedParameter, Scale
from ..student import clear_from
from ._arrows import arrows, draw_arrows
from ._effect_notes import range_notes
from ._figures import (
    LOWERS,
    NO_CAPTIONS,
    RAISES,
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    Room,
    characters_per_line,
    check_width,
    column_of,
    figure_of,
    figure_title,
    new_figure,
    warn_if_cramped,
)
from ._layout import wrapped_lines
from ._notes import (
    caution_groups,
    doubt_notes,
    gradient_notes,
    jump_notes,
    noise_notes,
    note_of_none,
    untrusted_groups,
)
from ._numbers import format_with_error, rounded, shorten, signed_with_error
from ._text import (
    TEXEL_MEANING,
    axis_label,
    color_meanings,
    is_of_camera,
    method_name,
    metric_unit,
    pack,
    pluralize,
    unit_of_change,
)
from ._tonemap import display_image

if TYPE_CHECKING:
    import numpy as np
    import torch
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_NORMS = {"sqrt": "√\u00a0scale", "linear": "linear\u00a0scale", "log": "logarithmic\u00a0scale"}
_MARGIN, _GAP, _COLORBAR, _TICK_LABELS = 0.12, 0.1, 0.12, 0.45  # inches
_LEAST_MAP = 0.5  # width and height of a map in the axes of a caller, in inches
_MOST_UNSEEN = 3  # rank of a parameter that is named where no pixel shows it
_NEGLIGIBLE = 0.01  # relative to the largest effect: not counted there
DEFAULT_SIZE = (WIDTH, 4.0)  # the largest width of a figure and height of an image
OPACITY = 0.8  # of the map in an overlay, at its maximum
_RENDER_BRIGHTNESS = 0.7  # of the grey render below an overlay


def plot_heatmap(
    attribution: Attribution,
    *,
    ax: Axes | None = None,
    signed: bool = False,
    norm: MapNorm = DEFAULT_NORM,
    denoised: bool = False,
    figsize: tuple[float, float] = DEFAULT_SIZE,
    captions: bool = True,
    **options: Any,
) -> Figure:
    """Plot the render and the saliency map side by side.

    Parameters
    ----------
    attribution
        The result to plot.
    ax
        Axes to draw the map into, with a colour bar but without the render; by default a new figure shows both.
    signed
        Show signed values on a diverging colour scale, in the colours of the bars, instead of magnitudes.
    norm
        ``"sqrt"``, ``"linear"`` or ``"log"``, as for ``projection.heatmap``.
    denoised
        Show the render denoised, for the eye, even if the metric was evaluated on the render itself.
    figsize
        Largest width of the new figure and largest height of its images, in inches.
    captions
        Write what the map shows above it and, in a new figure, the finding and the notes. False leaves this to
        the text around the figure.
    options
        Other options of ``projection.heatmap``: ``parameter``, ``scale``, ``decades``, ``maximum``, ``texels``,
        ``surfaces``.

    Raises
    ------
    SceneCaptumError
        If the attribution has no image, or no map of the surfaces in it, or if the figure would be narrower than
        4.5 inches.
    """
    check_width(figsize)
    heat = heatmap(attribution, signed=signed, norm=norm, **options)
    texts = _map_texts(attribution, signed, norm, options) if captions else []
    drawn, bar = ax, None
    if drawn is None:
        denoised = denoised or is_denoised(attribution)
        render = _displayed_render(attribution, denoised=denoised)
        unclear = "in white" if signed else None
        left, drawn, bar = _panels(attribution, heat, 2, figsize, texts, options, unclear)
        left.imshow(render)
        left.set_title("render, denoised" if denoised else "render", fontsize=TEXT)
    mapped = draw_map(drawn, heat, signed=signed)
    draw_arrows(drawn, attribution)
    draw_colorbar(mapped, signed, norm, options.get("decades", DECADES), cax=bar or _beside(drawn))
    if ax is not None:
        _write_above(ax, texts)
    return figure_of(drawn)


def plot_overlay(
    attribution: Attribution,
    *,
    ax: Axes | None = None,
    alpha: float = OPACITY,
    signed: bool = False,
    norm: MapNorm = DEFAULT_NORM,
    figsize: tuple[float, float] = DEFAULT_SIZE,
    captions: bool = True,
    **options: Any,
) -> Figure:
    """Plot the saliency map as an overlay on the grey render.

    Parameters
    ----------
    attribution
        The result to plot.
    ax
        Axes to draw into; by default those of a new figure.
    alpha
        Opacity of the map at its maximum, between 0 and 1; it decreases with the saliency.
    signed, norm, figsize, captions, options
        As for ``plot_heatmap``.

    Raises
    ------
    SceneCaptumError
        As for ``plot_heatmap``, or if ``alpha`` is out of range.
    """
    check_width(figsize)
    if not 0 <= alpha <= 1:
        raise SceneCaptumError(f"alpha must be between 0 and 1, not {alpha!r}.")
    heat = heatmap(attribution, signed=signed, norm=norm, **options)
    texts = _map_texts(attribution, signed, norm, options) if captions else []
    drawn, bar = ax, None
    if drawn is None:
        unclear = "without colour" if signed else None
        drawn, bar = _panels(attribution, heat, 1, figsize, texts, options, unclear)
    mapped = draw_overlay(drawn, attribution, heat, signed=signed, alpha=alpha)
    draw_colorbar(mapped, signed, norm, options.get("decades", DECADES), cax=bar or _beside(drawn))
    if ax is not None:
        _write_above(ax, texts)
    return figure_of(drawn)


def draw_overlay(
    ax: Axes, attribution: Attribution, heat: torch.Tensor, *, signed: bool, alpha: float = OPACITY
) -> AxesImage:
    """Draw a map over the grey render, with the arrows of objects that could move; return the map."""
    grey = _displayed_render(attribution, denoised=is_denoised(attribution)).mean(-1)
    ax.imshow(_RENDER_BRIGHTNESS * grey, cmap="gray", vmin=0, vmax=1)
    mapped = draw_map(ax, heat, signed=signed, alpha=alpha)
    draw_arrows(ax, attribution)
    return mapped


def draw_map(ax: Axes, heat: torch.Tensor, *, signed: bool, alpha: float | None = None) -> AxesImage:
    """Draw a map; with ``alpha`` the opacity increases with the value, up to ``alpha``."""
    opacity: Any = None if alpha is None else alpha * heat.abs().sqrt().numpy(force=True)
    ax.set_axis_off()
    colormap = diverging() if signed else "inferno"
    return ax.imshow(heat.numpy(force=True), cmap=colormap, vmin=-1 if signed else 0, vmax=1, alpha=opacity)


def draw_colorbar(
    mapped: AxesImage, signed: bool, norm: MapNorm, decades: float = DECADES, **location: Any
) -> Colorbar:
    """Draw the colour bar of a map, labelled with saliencies; ``location`` is matplotlib's ``ax`` or ``cax``."""
    import torch
    from matplotlib.cm import ScalarMappable

    values = _tick_values(signed, norm, decades)
    places = normalized(torch.tensor(values, dtype=torch.float64), norm, decades).tolist()
    # A separate mappable, since the map itself may be transparent.
    opaque = ScalarMappable(norm=mapped.norm, cmap=mapped.cmap)
    bar: Colorbar = figure_of(mapped.axes).colorbar(opaque, **location)
    bar.set_ticks(places, labels=[rounded(value) for value in values])
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL)
    return bar


def _tick_values(signed: bool, norm: MapNorm, decades: float) -> list[float]:
    """Return the saliencies to label; fewer if signed, since each sign has half of the bar."""
    if norm == "log":
        positive = [10.0**-power for power in range(int(decades), -1, -1)]
        return [-value for value in positive[:0:-1]] + [0.0] + positive[1:] if signed else positive
    if signed:
        positive = [0.1, 0.4, 1.0] if norm == "sqrt" else [0.5, 1.0]
        return [-value for value in reversed(positive)] + [0.0] + positive
    return [0.0, *([0.01, 0.05, 0.1] if norm == "sqrt" else []), 0.2, 0.4, 0.6, 0.8, 1.0]


def diverging() -> Colormap:
    """Return a diverging colour map from the bars' vermillion over white to their blue, of symmetric lightness."""
    from matplotlib.colors import LinearSegmentedColormap

    colors = ["#A84A00", LOWERS, "#F4B183", "#F7F7F7", "#8FC1E3", RAISES, "#005A8C"]
    return LinearSegmentedColormap.from_list("scenecaptum_signed", colors)


def shown_render(attribution: Attribution, *, denoised: bool = False) -> torch.Tensor:
    """Return the linear render that figures show: denoised, if the metric was evaluated on a denoised image.

    ``denoised`` returns it denoised in any case.

    Raises
    ------
    SceneCaptumError
        If the attribution has no image.
    """
    return _render(attribution, denoised=denoised or is_denoised(attribution))


def _render(attribution: Attribution, *, denoised: bool) -> torch.Tensor:
    if attribution.image is None:
        raise SceneCaptumError("This attribution has no picture, which the figure of its heatmap needs.")
    return denoise(attribution.image) if denoised else attribution.image


def is_denoised(attribution: Attribution) -> bool:
    """Whether the metric was evaluated on a denoised image."""
    return bool((attribution.info.get("picture") or {}).get("denoised"))


def _displayed_render(attribution: Attribution, *, denoised: bool) -> np.ndarray[Any, Any]:
    """Return the tone-mapped render."""
    pixels: np.ndarray[Any, Any] = display_image(_render(attribution, denoised=denoised)).numpy(force=True)
    return pixels


def _map_texts(attribution: Attribution, signed: bool, norm: MapNorm, options: dict[str, Any]) -> list[str]:
    """Return what a map shows: the quantity, relative to which value, and the meaning of its colours."""
    scale: Scale | None = options.get("scale")
    if not any(row.saliency for row in attribution.ranking(scale=scale)):
        return [note_of_none(attribution)]
    names, maximum = _selected(options), options.get("maximum")
    selected = shorten([", ".join(attribution.labels.get(name, name) for name in names)], 60)[0]
    quantity = axis_label(attribution, scale, metric="the metric")
    if not signed and attribution.kind.has_sign and not attribution.ranks_by_norm(scale):
        quantity = f"magnitude of the {quantity}"  # of −0.5 it is 0.5; a norm has no sign anyway
    shown = f"{selected}: {quantity}" if selected else quantity
    unit = unit_of_change(metric_unit(attribution)) if attribution.scale_or_default(scale) == "range" else ""
    largest = (
        _largest(attribution, scale, bool(names))
        if maximum is None
        else f"{rounded(maximum)} {unit}".rstrip()
    )
    lines = [f"{shown}, relative to {largest} ({_NORMS[norm]})"]
    if options.get("texels"):
        lines.append(TEXEL_MEANING)
    if signed:
        lines.append(color_meanings(attribution))
    return lines


def _lines(texts: Sequence[str], width: float) -> list[str]:
    """Return the lines of texts above a map, of a width in inches."""
    return [line for text in texts for line in wrapped_lines(text, characters_per_line(width, TEXT))]


def _write_lines(ax: Axes, lines: Sequence[str]) -> None:
    # Not with wrap=True: matplotlib wraps anew while a layout is computed, in axes that may still be narrow.
    ax.set_title("\n".join(lines), fontsize=TEXT, parse_math=False)


def _beside(ax: Axes) -> Axes:
    """Return axes for a colour bar beside a map in a caller's axes, as high as the map."""
    return ax.inset_axes((1.03, 0.0, 0.05, 1.0))


def _write_above(ax: Axes, texts: Sequence[str]) -> None:
    """Write texts above a map in a caller's axes, as wide as their column of the figure, centred on the map."""
    figure_of(ax).draw_without_rendering()  # the layout moves the axes
    left, right = column_of(ax)
    center = (ax.bbox.x0 + ax.bbox.x1) / 2
    if texts:  # else the title is the caller's
        _write_lines(ax, _lines(texts, 2 * min(center - left, right - center) / figure_of(ax).dpi))
    warn_if_cramped(ax, Room(_LEAST_MAP, _LEAST_MAP, [NO_CAPTIONS] if texts else []))


def _largest(attribution: Attribution, scale: Scale | None, is_selection: bool) -> str:
    """Return what a map is relative to, with the name of a camera's effect, which no pixel shows."""
    first, saliency = attribution.ranking(scale=scale)[0], attribution.saliency(scale)
    if is_selection or attribution.surfaces is None or not is_of_camera(first.name):
        return "the largest"
    mapped = mapped_parameters(attribution, scale=scale)
    objects = used_by_objects(attribution, attribution.surfaces, mapped)
    if (
        max((math.hypot(*(saliency[name] for name in names)) for names in objects), default=0)
        > first.saliency
    ):
        return "the largest"
    return f"the largest, that of {shorten([first.label], 40)[0]}, which no pixel shows"


def _width(heat: torch.Tensor, count: int, limits: tuple[float, float]) -> float:
    """Return the width of an image in inches, limited by the width of the figure and the height of an image."""
    height, width = heat.shape
    available = (limits[0] - 2 * _MARGIN - _COLORBAR - _TICK_LABELS) / count - _GAP
    return min(available, limits[1] * width / height)


def _panels(
    attribution: Attribution,
    heat: torch.Tensor,
    count: int,
    limits: tuple[float, float],
    texts: Sequence[str],
    options: dict[str, Any],
    unclear: str | None,
) -> list[Axes]:
    """Create axes for ``count`` images of one size and for a colour bar of their height; lengths are in inches.

    ``texts`` stand above the last image; without any, the figure has no finding and no notes either. ``unclear``
    is how a signed map shows the objects whose sign is lost in the noise: over a dark render no grey tells them.
    """
    w = _width(heat, count, limits)
    h = w * heat.shape[0] / heat.shape[1]
    width = 2 * _MARGIN + count * (w + _GAP) + _COLORBAR + _TICK_LABELS
    title, notes = _finding_and_notes(attribution, options, unclear, width - 0.2) if texts else ("", [])
    heading = _lines(texts, w)
    bottom = 0.12 + 0.14 * len(notes)
    top = 0.2 + 0.17 * len(title.splitlines()) + 0.14 * max(len(heading), count - 1)
    height = bottom + h + top
    figure = new_figure(width, height, layout="none")
    figure.text(_MARGIN / width, 1 - 0.1 / height, title, va="top", fontsize=TITLE, parse_math=False)
    style: dict[str, Any] = {"va": "bottom", "fontsize": SMALL, "parse_math": False}
    figure.text(_MARGIN / width, 0.08 / height, "\n".join(notes), **style)

    def add_axes(x: float, extent: float) -> Axes:
        return figure.add_axes((x / width, bottom / height, extent / width, h / height))

    images = [add_axes(_MARGIN + index * (w + _GAP), w) for index in range(count)]
    for axes in images:
        axes.set_axis_off()
    _write_lines(images[-1], heading)
    return [*images, add_axes(_MARGIN + count * (w + _GAP), _COLORBAR)]


def _finding_and_notes(
    attribution: Attribution, options: dict[str, Any], unclear: str | None, width: float
) -> tuple[str, list[str]]:
    """Return the title of a figure of maps, and its notes in lines of a width in inches."""
    scale: Scale | None = options.get("scale")
    texels = bool(options.get("texels"))
    title = figure_title(attribution, characters_per_line(width, TITLE), scale, texels=texels)
    pointing = "arrows: where moving an object raises the metric most" if arrows(attribution) else ""
    notes = [
        _invisible_note(attribution, scale),
        _seen_through_note(attribution, options),
        _unclear_note(attribution, options, unclear) if unclear else "",
        pointing,
        method_name(attribution),
        *noise_notes(attribution),
        *gradient_notes(attribution),
    ]
    line_length, mapped = characters_per_line(width, SMALL), _mapped(attribution, options)
    aside = "~ " if "~" in title else ""  # objects have no marks, only a title may name one
    packed = [
        *pack([note for note in notes if note], line_length),
        *_caution_notes(attribution, mapped),
        *_doubts(attribution, mapped),
        *jump_notes(attribution, mapped),
        *(f"{aside}{note}" for note in range_notes(attribution, scale)),
    ]
    return title, [line for note in packed for line in wrapped_lines(note, line_length, 4)]


def _selected(options: dict[str, Any]) -> Sequence[str]:
    """Return the parameters that a map is of; none if it is of all."""
    parameter = options.get("parameter") or []
    return [parameter] if isinstance(parameter, str) else parameter


def _mapped(attribution: Attribution, options: dict[str, Any]) -> list[str]:
    """Return the names of the parameters that a map is of, the largest first."""
    patterns, ranking = _selected(options) or ["*"], attribution.ranking(scale=options.get("scale"))
    ordered = dict.fromkeys([*(row.name for row in ranking), *attribution])
    return [name for name in ordered if name in patterns or any(fnmatchcase(name, p) for p in patterns)]


def _caution_notes(attribution: Attribution, mapped: Sequence[str]) -> list[str]:
    """Return why derivatives that a map shows are known to be inaccurate, with the first of their parameters."""
    return doubt_notes(caution_groups(attribution, mapped), attribution.labels, mapped, len(attribution))


def _doubts(attribution: Attribution, mapped: Sequence[str]) -> list[str]:
    """Return why errors of what a map shows may be too small, with the first of their parameters."""
    groups = untrusted_groups(attribution).items()
    doubts = {why: kept for why, names in groups if (kept := [name for name in names if name in mapped])}
    notes = doubt_notes(doubts, attribution.labels, mapped, len(attribution))
    return [f"errors may be too small: {note}" for note in notes]


def _unclear_note(attribution: Attribution, options: dict[str, Any], shown: str) -> str:
    """Return how many objects of the picture are ``shown`` so because their sign is lost in the noise."""
    kept = {name: options[name] for name in ("parameter", "scale", "texels", "surfaces") if name in options}
    count = len(objects_of_unclear_sign(attribution, **kept))
    return f"{pluralize(count, 'object')} {shown}: sign lost in the noise" if count else ""


def _invisible_note(attribution: Attribution, scale: Scale | None) -> str:
    """Return a note on the parameters or groups in the top three that no pixel shows; others are only counted."""
    surfaces = attribution.surfaces
    if surfaces is None:
        return ""
    visible = surfaces.visible_parameters() | set(attribution.info.get("seen_through") or ())
    allowed = clear_from(attribution.info)
    unseen = [
        row
        for row in _without(attribution, visible, scale)
        if row.saliency > allowed * (row.saliency_error or 0.0)
    ]
    return _leading(attribution, "not in the picture", unseen)


def _seen_through_note(attribution: Attribution, options: dict[str, Any]) -> str:
    """Return a note on what the map leaves out because pixels show it only behind glass or in a mirror.

    A neutral window could be read as one that does not matter, also if the effect of its light is noisy.
    """
    surfaces = options.get("surfaces") or attribution.surfaces
    behind, selected = set(attribution.info.get("seen_through") or ()), _selected(options)
    if surfaces is None or not behind:
        return ""
    groups = attribution.info.get("groups") or {}
    hidden = [
        row
        for row in _without(attribution, surfaces.visible_parameters(), options.get("scale"))
        if behind.intersection(groups.get(row.name, [row.name]))
        and (not selected or any(row.name == one or fnmatchcase(row.name, one) for one in selected))
    ]
    return _leading(attribution, "not on the map, seen only behind glass or mirrored", hidden)


def _without(
    attribution: Attribution, visible: Collection[str], scale: Scale | None
) -> list[RankedParameter]:
    """Return the parameters or groups, other than the camera's and negligible ones, of which none is visible."""
    groups, ranking = attribution.info.get("groups") or {}, attribution.ranking(scale=scale)
    return [
        row
        for row in ranking
        if not any(name in visible for name in groups.get(row.name, [row.name]))
        and not is_of_camera(row.name)
        and row.saliency > _NEGLIGIBLE * ranking[0].saliency
    ]


def _leading(attribution: Attribution, what: str, rows: Sequence[RankedParameter]) -> str:
    """Return a note that names those of the rows in the top three and counts the others; empty without any."""
    named = [row for row in rows if row.rank <= _MOST_UNSEEN]
    if not named:
        return ""
    names = shorten([row.label for row in named], 60)
    written = signed_with_error if attribution.kind.has_sign else format_with_error
    parts = [
        f"{name}, #{row.rank} with an effect of {written(row.effect, row.effect_error)}"
        for name, row in zip(names, named, strict=True)
    ]
    more = len(rows) - len(named)
    return f"{what}: {'; '.join(parts)}{f'; and {more} more' if more else ''}"
