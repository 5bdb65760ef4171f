"""A false-colour map of luminance, with the sources of glare outlined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ..metrics import luminance
from ..metrics._glare import GlareRating
from ..metrics._picture import check_image
from ._figures import SMALL, TEXT, TITLE, WIDTH, figure_of, new_figure
from ._words import count_words

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..metrics._sources import GlareSource

EFFICACY = 179.0  # Radiance's lm/W
_MOST_LISTED = 8
_MOST_DECADES = 4
_DARK_QUANTILE = 0.005  # a few black pixels take no part of the scale
_OUTSIDE, _BELOW = "#B0B0B0", "#1A0A24"


def plot_luminance(
    image: torch.Tensor,
    view: GlareRating | Camera | None = None,
    ax: Axes | None = None,
    *,
    efficacy: float | None = None,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Draw the luminance of each pixel in cd/m² as false colours with a logarithmic legend.

    Example
    -------
    >>> rating = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)  # doctest: +SKIP
    >>> plot_luminance(attribution.image, rating)                                 # doctest: +SKIP

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.
    view
        A glare rating, whose sources are outlined, numbered and listed below the picture, the brightest first; or
        a camera. With either, what lies outside a fisheye's circle is grey.
    ax
        Axes to draw into; by default those of a new figure.
    efficacy
        Luminous efficacy in lm/W that turns radiance into luminance; by default the rating's, or Radiance's 179.
    limits
        Luminances at the ends of the scale; by default what the picture has, at most four decades of it.

    Raises
    ------
    SceneCaptumError
        If the image has another shape or size than the camera's picture, holds negative or non-finite values
        that the rating refuses, or the limits are not positive and rising.
    """
    check_image(image)
    rating = view if isinstance(view, GlareRating) else None
    camera = rating.camera if rating is not None else view if isinstance(view, Camera) else None
    if efficacy is None:
        efficacy = EFFICACY if rating is None else rating.efficacy
    shown = efficacy * luminance(image.detach().cpu().float())
    seen = _seen(shown, camera)
    low, high = _limits(shown[seen]) if limits is None else _check_limits(limits)
    sources = [] if rating is None else rating.sources(image)

    # Where each pixel is a source of its own, single ones say nothing.
    listed = [] if rating is None or rating.grouping == "pixel" else sources[:_MOST_LISTED]

    if ax is None:
        ax = _new_axes(shown, len(listed) + (len(sources) > len(listed)))
    _draw(ax, shown.masked_fill(~seen, math.nan).numpy(), low, high)
    mean = float((shown[seen] * _weights(camera, seen)).sum())
    heading = f"mean {'over pixels' if camera is None else 'luminance'} {mean:.4g} cd/m²"
    if rating is not None:
        heading = f"{type(rating).__name__} = {float(rating(image)):.4g}   ({_count(sources)}; {heading})"
        _outline(ax, sources, shown.shape, apart=rating.grouping != "pixel")
        _number(ax, listed)
        _write_below(ax, _list(listed, len(sources)))
    ax.set_title(heading, fontsize=TITLE, loc="left")
    return figure_of(ax)


def _seen(shown: torch.Tensor, camera: Camera | None) -> torch.Tensor:
    """Tell which pixels have a luminance: those that the camera sees, unless they are NaN or infinite."""
    finite = shown.isfinite()
    if camera is None:
        return finite
    if tuple(camera.solid_angles.shape) != tuple(shown.shape):
        raise SceneCaptumError(
            f"The image is {tuple(shown.shape)} (height, width), and the camera's picture is "
            f"{tuple(camera.solid_angles.shape)}: give the camera that it was rendered with."
        )
    return finite & (camera.solid_angles.cpu() > 0)


def _weights(camera: Camera | None, seen: torch.Tensor) -> torch.Tensor:
    angles = torch.ones(seen.shape) if camera is None else camera.solid_angles.cpu().float()
    return angles[seen] / angles[seen].sum()


def _limits(values: torch.Tensor) -> tuple[float, float]:
    """Choose the ends of the scale, round numbers: 1, 2 or 5 times a power of ten."""
    lit = values[values > 0].double()
    if not len(lit):
        return 0.1, 1.0
    # torch.quantile refuses large pictures; the k-th value does not.
    darkest = float(lit.kthvalue(1 + int(_DARK_QUANTILE * (len(lit) - 1))).values)
    high = _round(float(lit.max()), up=True)
    low = max(_round(darkest, up=False), _round(high / 10**_MOST_DECADES, up=False))
    return (low, high) if low < high else (high / 10, high)


def _round(value: float, *, up: bool) -> float:
    exponent = math.floor(math.log10(value))
    steps = [digit * 10.0 ** (exponent + shift) for shift in (0, 1) for digit in (1, 2, 5)]
    if up:
        return next(step for step in steps if step >= value * (1 - 1e-6))
    return [step for step in steps if step <= value * (1 + 1e-6)][-1]


def _check_limits(limits: tuple[float, float]) -> tuple[float, float]:
    low, high = limits
    if not 0 < low < high < math.inf:
        raise SceneCaptumError(f"limits must be two rising positive luminances in cd/m², not {limits!r}.")
    return low, high


def _new_axes(shown: torch.Tensor, lines: int) -> Axes:
    height, width = shown.shape
    across = WIDTH if width >= height else 5.2
    down = min((across - 1.0) * height / width, 6.0) + 0.5 + 0.15 * lines
    ax: Axes = new_figure(across, down).add_subplot()
    return ax


def _draw(ax: Axes, shown: np.ndarray[Any, Any], low: float, high: float) -> None:
    import matplotlib
    import numpy as np
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    finite = shown[np.isfinite(shown)]
    below, above = bool((finite < low).any()), bool((finite > high).any())
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=_OUTSIDE, under=_BELOW)
    # A logarithm has no place for 0, which is dark and not unknown.
    floored = np.where(np.isfinite(shown), np.maximum(shown, low / 1e3), np.nan)
    mapped = ax.imshow(np.ma.masked_invalid(floored), cmap=colours, norm=LogNorm(low, high))
    ax.set_axis_off()
    extend = {(True, False): "min", (False, True): "max", (True, True): "both"}.get((below, above), "neither")
    bar = figure_of(ax).colorbar(mapped, ax=ax, extend=extend, aspect=25, pad=0.02)
    decades = math.log10(high / low)
    bar.locator = LogLocator(subs=(1, 2, 5) if decades <= 3.5 else (1,))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.formatter = FuncFormatter(lambda value, _: _thousands(value))
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("luminance in cd/m²", fontsize=TEXT)


def _outline(ax: Axes, sources: Sequence[GlareSource], shape: Sequence[int], *, apart: bool) -> None:
    """Outline the sources along the edges of their pixels, in white on black, which shows on any colour."""
    from matplotlib.collections import LineCollection

    # The middle of a pixel has whole coordinates, so an edge lies half a pixel before it; a frame adds one more.
    owner = torch.zeros(shape[0] + 2, shape[1] + 2, dtype=torch.long)
    for number, source in enumerate(sources, start=1):
        rows, columns = source.pixels.cpu().unbind(-1)
        owner[rows + 1, columns + 1] = number if apart else 1
    above = (owner[1:] != owner[:-1]).nonzero().tolist()
    left = (owner[:, 1:] != owner[:, :-1]).nonzero().tolist()
    edges = [[(x - 1.5, y - 0.5), (x - 0.5, y - 0.5)] for y, x in above]
    edges += [[(x - 0.5, y - 1.5), (x - 0.5, y - 0.5)] for y, x in left]
    for colour, width in (("black", 2.2), ("white", 1.0)):
        ax.add_collection(LineCollection(edges, colors=colour, linewidths=width, capstyle="projecting"))


def _number(ax: Axes, sources: Sequence[GlareSource]) -> None:
    for number, source in enumerate(sources, start=1):
        ax.annotate(
            str(number),
            (source.column, source.row),
            ha="center",
            va="center",
            fontsize=TEXT,
            fontweight="bold",
            color="white",
            bbox={
                "boxstyle": "circle,pad=0.25",
                "facecolor": "black",
                "edgecolor": "white",
                "linewidth": 0.8,
            },
        )


def _list(listed: Sequence[GlareSource], count: int) -> list[str]:
    lines = [
        f"{number}   {_thousands(round(source.luminance))} cd/m², {source.solid_angle:.3g} sr, position index "
        f"{source.position_index:.2f}, {count_words(len(source.pixels), 'pixel')}"
        for number, source in enumerate(listed, start=1)
    ]
    if not listed and count:
        return ["each pixel above the threshold is a source of its own"]
    return [*lines, f"… and {count - len(listed)} less bright"] if count > len(listed) else lines


def _thousands(value: float) -> str:
    """Write a number with thin spaces between its thousands."""
    return f"{value:,.10g}".replace(",", "\u202f")


def _count(sources: Sequence[GlareSource]) -> str:
    return count_words(len(sources), "glare source") if sources else "no glare source"


def _write_below(ax: Axes, lines: Sequence[str]) -> None:
    ax.annotate(
        "\n".join(lines),
        (0, 0),
        xycoords="axes fraction",
        xytext=(0, -5),
        textcoords="offset points",
        va="top",
        fontsize=SMALL,
        linespacing=1.4,
    )
