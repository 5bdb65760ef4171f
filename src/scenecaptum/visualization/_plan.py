"""Map of the points of a sensor grid on the plan of a room."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, Any

import torch

from ..errors import SceneCaptumError
from ..grid import FROM_BELOW
from ._figures import SMALL, TEXT, TITLE, WIDTH, characters_per_line, figure_of, new_figure, style_axes
from ._layout import wrapped_lines
from ._numbers import rounded

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.contour import ContourSet
    from matplotlib.figure import Figure

BLANK = "blank: inside an object, or at the edge of the floor"
# Of the scale of illuminance in EN 12464-1, in lx: what a room may have to reach.
LEVELS = (50.0, 100.0, 150.0, 200.0, 300.0, 500.0, 750.0, 1000.0, 1500.0, 2000.0, 3000.0, 5000.0)
# A label of a contour is horizontal, in a dark box: an outline alone is hard to read on cells of many colours.
_LABEL = {"facecolor": "black", "alpha": 0.75, "edgecolor": "none", "boxstyle": "round,pad=0.15"}
_APART = 0.08  # of the longer side, between two labels
_LEAST_ROWS = 4  # along each side: contours between fewer points are zigzags
_PLACES = [0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9]  # of a label along its contour, the best first
_LINE = " (line)"  # in a title, of the contour
_MARGIN, _COLORBAR = 0.9, 1.0  # inches around a map, for labels and the colour bar
_BESIDE_TITLE = 1.2  # inches left of a title, which begins at the map, and at its right
_TITLE_LINE = 0.17  # inches


def plot_plan(  # noqa: PLR0913 -- a figure with its texts
    values: torch.Tensor,
    plan: torch.Tensor,
    inside: torch.Tensor | None = None,
    *,
    ax: Axes | None = None,
    width: float = WIDTH,
    levels: Sequence[float] = LEVELS,
    title: str = "",
    label: str = "illuminance in lx",
    axes: tuple[str, str] = ("x", "y"),
    error: float | None = None,
) -> Figure:
    """Plot a value at each point of a sensor grid on the plan of the room, in false colours with contours.

    Example
    -------
    >>> lux = 179 * metrics.luminance(renderer(seed=0))                                        # doctest: +SKIP
    >>> plot_plan(lux, renderer.grid.plan, renderer.grid.inside, title="Office, work plane")   # doctest: +SKIP

    Parameters
    ----------
    values
        ``(H, W)``, a value for each point.
    plan
        ``(H, W, 2)``: the coordinates of the points, ``renderer.grid.plan``, in metres.
    inside
        ``(H, W)`` bool: the points to show, ``renderer.grid.inside``; all by default. The others are left blank,
        which the title of a new figure says, and outer rows and columns without a point are left out.
    ax
        Axes to draw into; by default those of a new figure.
    width
        The largest width of a new figure in inches. The text keeps its size.
    levels
        Values of the contours; those outside the range of ``values`` are not drawn, and none where a side has less
        than 4 points. By default the steps of the scale of illuminance in EN 12464-1 from 50 to 5000 lx.
    title
        Written above the map; ``" (line)"`` is left out of it where no contour is drawn.
    label
        Quantity and unit, at the colour bar.
    axes
        Names of the coordinates across and up, ``renderer.grid.axes``. The room is shown from above: with x and z,
        −z points up.

    error
        The typical standard error of a value, which is written below the map. If four of it are as much as the
        median step between contours, these would show the noise, and are left out.

    Raises
    ------
    SceneCaptumError
        If the tensors do not fit together, a value inside is not finite, no point is inside, or the points do not
        form rows and columns.
    """
    shown, x, y = _rows_and_columns(values, plan, inside)
    within = [level for level in sorted(set(levels)) if shown.min() < level < shown.max()]
    is_noise = bool(error and within) and 4 * (error or 0.0) >= _step(within, levels, shown)
    has_contours = bool(within) and not is_noise and min(shown.shape) >= _LEAST_ROWS
    if not has_contours:
        title = title.replace(_LINE, "")
    if ax is None:
        across, up = _size(x, y, width)
        title = "\n".join(filter(None, [title, BLANK if shown.mask.any() else ""]))
        title = _wrap(title, across - _BESIDE_TITLE, TITLE)
        label = _wrap(label, up - _MARGIN, TEXT)
        # With a fixed aspect, "constrained" reserves too little for the title, by what the aspect leaves unused.
        up += _TITLE_LINE * len(title.splitlines())
        ax = new_figure(across, up, layout="compressed").add_subplot()
    mapped = ax.pcolormesh(x, y, shown, shading="nearest", cmap="viridis")
    if has_contours:
        _draw_contours(ax, x, y, shown, within, _APART * WIDTH / width)
    ax.set_aspect("equal")
    if axes == FROM_BELOW:
        ax.invert_yaxis()
    below = [f"{axes[0]} in m"]
    if error:
        unit = label.replace("\n", " ").rpartition(" in ")[2]
        without = ": too noisy for contours" if is_noise else ""
        below.append(f"± {rounded(error, 2)} {unit} at a point{without}")
    style_axes(ax, title, x="\n".join(below), y=f"{axes[1]} in m")
    bar = figure_of(ax).colorbar(mapped, ax=ax, aspect=25, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label(label, fontsize=TEXT)
    return figure_of(ax)


def share_scale(plans: Iterable[Figure]) -> None:
    """Give the figures of ``plot_plan`` a common scale of colours, so that they can be compared."""
    from matplotlib.collections import QuadMesh

    maps = [
        next(part for part in plan.axes[0].get_children() if isinstance(part, QuadMesh)) for plan in plans
    ]
    limits = [limit for one in maps for limit in one.get_clim()]
    for one in maps:
        one.set_clim(min(limits), max(limits))


def _wrap(text: str, inches: float, size: float) -> str:
    """Break the lines of a text that do not fit into a width."""
    fitting = characters_per_line(inches, size)
    return "\n".join(part for line in text.split("\n") for part in wrapped_lines(line, fitting))


def _rows_and_columns(
    values: torch.Tensor, plan: torch.Tensor, inside: torch.Tensor | None
) -> tuple[np.ma.MaskedArray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Check the tensors; return the values, masked where blank, and the coordinates of columns and rows."""
    import numpy as np

    mask = torch.ones(values.shape, dtype=torch.bool) if inside is None else inside.detach().cpu().bool()
    if values.ndim != 2 or tuple(plan.shape) != (*values.shape, 2) or mask.shape != values.shape:
        raise SceneCaptumError(
            "plot_plan takes values (H, W), plan (H, W, 2) and inside (H, W), not "
            f"{tuple(values.shape)}, {tuple(plan.shape)} and {tuple(mask.shape)}: use the plan of the renderer, "
            "renderer.grid.plan."
        )
    if not mask.any():
        raise SceneCaptumError("No point of the grid is inside the room, so there is nothing to plot.")
    shown = values.detach().cpu().double()
    if not shown[mask].isfinite().all():
        raise SceneCaptumError("A value of the plan is not finite: leave its point out with inside=.")
    x, y = plan.detach().cpu().double().unbind(-1)
    if not (torch.allclose(x, x[:1]) and torch.allclose(y, y[:, :1])):
        raise SceneCaptumError(
            "The points do not form rows and columns, which a plan needs: it shows grids over a floor."
        )
    # A floor may reach into the openings of windows and doors, where no point has its margin.
    rows, columns = (_span(mask.any(axis)) for axis in (1, 0))
    masked = np.ma.masked_array(shown.numpy(), ~mask.numpy())[rows, columns]
    return masked, x[0, columns].numpy(), y[rows, 0].numpy()


def _span(mask: torch.Tensor) -> slice:
    """Return the slice from the first to the last True."""
    found = mask.nonzero().flatten()
    return slice(int(found[0]), int(found[-1]) + 1)


def _step(within: Sequence[float], levels: Sequence[float], shown: np.ma.MaskedArray[Any, Any]) -> float:
    """Return the median distance between neighbouring levels; of a single one, the range of the values."""
    known = sorted(set(levels))
    if len(known) < 2:
        return float(shown.max() - shown.min())
    return median(high - low for low, high in pairwise(known) if low in within or high in within)


def _draw_contours(
    ax: Axes,
    x: np.ndarray[Any, Any],
    y: np.ndarray[Any, Any],
    shown: np.ma.MaskedArray[Any, Any],
    within: Sequence[float],
    apart: float,
) -> None:
    """Draw contours at levels within the range of the values, in white on black, and label them.

    Labels are ``apart`` by a part of the longer side.
    """
    from matplotlib.patheffects import withStroke

    # Without corner masks no line passes between blank points, where it would be a piece without meaning.
    lines = ax.contour(x, y, shown, levels=within, colors="white", linewidths=1.0, corner_mask=False)
    lines.set(path_effects=[withStroke(linewidth=2.2, foreground="black")])
    _label(ax, lines, apart * max(abs(float(side[-1] - side[0])) for side in (x, y)))


def _label(ax: Axes, lines: ContourSet, apart: float) -> None:
    """Write its value on each contour, as near to its middle as other labels are no nearer than a distance."""
    import numpy as np

    kept: list[np.ndarray[Any, Any]] = []
    for level, parts in zip(lines.levels, lines.allsegs, strict=True):
        for part in parts:
            along = np.concatenate([[0.0], np.hypot(*np.diff(part, axis=0).T).cumsum()])
            if along[-1] < apart:
                continue  # shorter than its label
            places = along[-1] * np.array(_PLACES)
            candidates = np.stack([np.interp(places, along, side) for side in part.T], -1)
            place = next(
                (one for one in candidates if all(math.dist(one, two) >= apart for two in kept)), None
            )
            if place is not None:
                kept.append(place)
                across, up = place
                ax.text(
                    across,
                    up,
                    rounded(level, digits=4),
                    size=TEXT,
                    color="white",
                    ha="center",
                    va="center",
                    bbox=_LABEL,
                )


def _size(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any], width: float) -> tuple[float, float]:
    """Return the size of a figure that fits a room: the longer side is limited by the width of a page."""
    across, along = (
        abs(float(side[-1] - side[0])) * (1 + 1 / max(len(side) - 1, 1)) or 1.0 for side in (x, y)
    )
    scale = min((width - _MARGIN - _COLORBAR) / across, 4.8 / along)
    return max(across * scale + _MARGIN + _COLORBAR, 3.0), max(along * scale + _MARGIN, 2.0)
