"""False-colour map of luminance, with the glare sources outlined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..camera import Camera
from ..errors import SceneCaptumError
from ..images import check_image_shape
from ..visualization import (
    SMALL,
    TEXT,
    TITLE,
    WIDTH,
    figure_of,
    log_steps,
    new_figure,
    pluralize,
    rounded,
    write_at,
)
from ._glare import GlareRating
from ._luminance import luminance
from ._sources import GlareSource

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EFFICACY = 179.0  # lm/W, as in Radiance
_MAX_LISTED = 8
_MAX_DECADES = 4
_DARK_QUANTILE = 0.005  # lower end of the scale, so that a few black pixels do not extend it
_MASKED_COLOR, _UNDER_COLOR = "#B0B0B0", "#1A0A24"


def plot_luminance(
    image: torch.Tensor,
    view: GlareRating | Camera | None = None,
    *,
    ax: Axes | None = None,
    efficacy: float | None = None,
    limits: tuple[float, float] | None = None,
) -> Figure:
    """Plot the luminance of each pixel in cd/m² in false colours on a logarithmic scale.

    Example
    -------
    >>> rating = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)  # doctest: +SKIP
    >>> plot_luminance(attribution.image, rating)                                 # doctest: +SKIP

    Parameters
    ----------
    image
        ``(H, W, 3)`` linear radiance.
    view
        A glare rating, whose sources are outlined, numbered and listed below the image, the brightest first; or a
        camera. With either, pixels outside a fisheye's circle are grey.
    ax
        Axes to draw into; by default those of a new figure.
    efficacy
        Luminous efficacy in lm/W that converts radiance to luminance; by default the rating's, or Radiance's 179.
    limits
        Luminances at the ends of the scale; by default the range of the image, at most four decades.

    Raises
    ------
    SceneCaptumError
        If the image does not have the shape of the camera's image, contains negative or non-finite values that the
        rating rejects, or the limits are not positive and increasing.
    """
    check_image_shape(image)
    rating = view if isinstance(view, GlareRating) else None
    camera = rating.camera if rating is not None else view if isinstance(view, Camera) else None
    if efficacy is None:
        efficacy = EFFICACY if rating is None else rating.efficacy
    shown = efficacy * luminance(image.detach().cpu().float())
    valid = _valid_pixels(shown, camera)
    low, high = _default_limits(shown[valid]) if limits is None else _check_limits(limits)
    sources = [] if rating is None else rating.sources(image)

    # If each pixel is its own source, a list of single sources is not informative.
    listed = [] if rating is None or rating.grouping == "pixel" else sources[:_MAX_LISTED]

    if ax is None:
        ax = _new_axes(shown, len(listed) + (len(sources) > len(listed)))
    _draw(ax, shown.masked_fill(~valid, math.nan).numpy(), low, high)
    mean = float((shown[valid] * _weights(camera, valid)).sum())
    heading = f"mean {'over pixels' if camera is None else 'luminance'} {rounded(mean, 4)} cd/m²"
    if rating is not None:
        count = pluralize(len(sources), "glare source") if sources else "no glare source"
        symbol = rating.measure.symbol or rating.measure.name
        heading = f"{symbol} = {rounded(float(rating(image)), 4)}, {count}, {heading}"
        _outline(ax, sources, shown.shape, separate=rating.grouping != "pixel")
        _write_numbers(ax, listed)
        style: dict[str, Any] = {"va": "top", "fontsize": SMALL, "linespacing": 1.4}
        lines = "\n".join(_source_lines(listed, len(sources)))
        write_at(ax, lines, (0, 0), (0, -5), xycoords="axes fraction", **style)
    ax.set_title(heading, fontsize=TITLE, loc="left")
    return figure_of(ax)


def _valid_pixels(shown: torch.Tensor, camera: Camera | None) -> torch.Tensor:
    """Return a mask of the pixels with a finite luminance and a solid angle."""
    finite = shown.isfinite()
    if camera is None:
        return finite
    if tuple(camera.solid_angles.shape) != tuple(shown.shape):
        raise SceneCaptumError(
            f"The image is {tuple(shown.shape)} (height, width), but the camera's is "
            f"{tuple(camera.solid_angles.shape)}: pass the camera that the image was rendered with."
        )
    return finite & (camera.solid_angles.cpu() > 0)


def _weights(camera: Camera | None, valid: torch.Tensor) -> torch.Tensor:
    angles = torch.ones(valid.shape) if camera is None else camera.solid_angles.cpu().float()
    return angles[valid] / angles[valid].sum()


def _default_limits(values: torch.Tensor) -> tuple[float, float]:
    """Return the ends of the scale, rounded to 1, 2 or 5 times a power of ten."""
    lit = values[values > 0].double()
    if not len(lit):
        return 0.1, 1.0
    # kthvalue, since torch.quantile is limited to 16 million elements.
    darkest = float(lit.kthvalue(1 + int(_DARK_QUANTILE * (len(lit) - 1))).values)
    high = _round(float(lit.max()), up=True)
    low = max(_round(darkest, up=False), _round(high / 10**_MAX_DECADES, up=False))
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
        raise SceneCaptumError(f"limits must be two increasing positive luminances in cd/m², not {limits!r}.")
    return low, high


def _new_axes(shown: torch.Tensor, lines: int) -> Axes:
    height, width = shown.shape
    figure_width = WIDTH if width >= height else 5.2
    figure_height = min((figure_width - 1.0) * height / width, 6.0) + 0.5 + 0.15 * lines
    ax: Axes = new_figure(figure_width, figure_height).add_subplot()
    return ax


def _draw(ax: Axes, shown: np.ndarray[Any, Any], low: float, high: float) -> None:
    import matplotlib
    import numpy as np
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    finite = shown[np.isfinite(shown)]
    below, above = bool((finite < low).any()), bool((finite > high).any())
    colormap = matplotlib.colormaps["viridis"].with_extremes(bad=_MASKED_COLOR, under=_UNDER_COLOR)
    # Zero is dark, not invalid: keep it on the logarithmic scale.
    floored = np.where(np.isfinite(shown), np.maximum(shown, low / 1e3), np.nan)
    mapped = ax.imshow(np.ma.masked_invalid(floored), cmap=colormap, norm=LogNorm(low, high))
    ax.set_axis_off()
    extend = {(True, False): "min", (False, True): "max", (True, True): "both"}.get((below, above), "neither")
    bar = figure_of(ax).colorbar(mapped, ax=ax, extend=extend, aspect=25, pad=0.02)
    bar.locator = LogLocator(subs=log_steps(low, high))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.formatter = FuncFormatter(lambda value, _: _format_thousands(value))
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("luminance in cd/m²", fontsize=TEXT)


def _outline(ax: Axes, sources: Sequence[GlareSource], shape: Sequence[int], *, separate: bool) -> None:
    """Outline the sources along pixel edges, in white on black, which is visible on any colour."""
    from matplotlib.collections import LineCollection

    # Pixel centres have integer coordinates, so edges are offset by half a pixel, and the frame by one more.
    owner = torch.zeros(shape[0] + 2, shape[1] + 2, dtype=torch.long)
    for number, source in enumerate(sources, start=1):
        rows, columns = source.pixels.cpu().unbind(-1)
        owner[rows + 1, columns + 1] = number if separate else 1
    above = (owner[1:] != owner[:-1]).nonzero().tolist()
    left = (owner[:, 1:] != owner[:, :-1]).nonzero().tolist()
    edges = [[(x - 1.5, y - 0.5), (x - 0.5, y - 0.5)] for y, x in above]
    edges += [[(x - 0.5, y - 1.5), (x - 0.5, y - 0.5)] for y, x in left]
    for color, width in (("black", 2.2), ("white", 1.0)):
        ax.add_collection(LineCollection(edges, colors=color, linewidths=width, capstyle="projecting"))


def _write_numbers(ax: Axes, sources: Sequence[GlareSource]) -> None:
    box = {"boxstyle": "circle,pad=0.25", "facecolor": "black", "edgecolor": "white", "linewidth": 0.8}
    style: dict[str, Any] = {
        "ha": "center",
        "va": "center",
        "fontweight": "bold",
        "color": "white",
        "bbox": box,
    }
    for number, source in enumerate(sources, start=1):
        write_at(ax, str(number), (source.column, source.row), (0, 0), **style)


def _source_lines(listed: Sequence[GlareSource], count: int) -> list[str]:
    lines = [
        f"{number}   {_format_thousands(round(source.luminance))} cd/m², {rounded(source.solid_angle)} sr, "
        f"position index {source.position_index:.2f}, {pluralize(len(source.pixels), 'pixel')}"
        for number, source in enumerate(listed, start=1)
    ]
    if not listed and count:
        return ["each pixel above the threshold is a separate source"]
    return [*lines, f"… and {count - len(listed)} less bright"] if count > len(listed) else lines


def _format_thousands(value: float) -> str:
    """Format a number with thin spaces as thousands separators."""
    return f"{value:,.10g}".replace(",", "\u202f")
