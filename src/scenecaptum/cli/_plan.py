"""What is said and drawn of a sensor grid: the value by the definition, and a map on the plan of the room."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..daylight import DaylightMetric, PlanValues
from ..estimation import Metric
from ..metrics import MeanIlluminance
from ..rendering import SceneRenderer
from ..visualization import LEVELS, plot_plan, share_scale
from ._files import OutputFormat, Result, figure_writer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches of a plan; in a page it is narrow, so that a phone shows its text large.
FILE_WIDTH, REPORT_WIDTH = 7.2, 4.2


def draw_plan(
    image: torch.Tensor | None,
    renderer: SceneRenderer,
    metric: Metric,
    info: Mapping[str, Any],
    width: float = FILE_WIDTH,
) -> Figure:
    """Draw what a metric is about at each point of a sensor grid on the plan of the room.

    ``image`` is what the stated value is of, so that who counts the points on the plan finds that value. ``info``
    is that of a result, which knows the noise of as many samples.
    """
    grid = renderer.grid
    assert image is not None, "every attribution of a SceneRenderer has its image"
    error = None
    if isinstance(metric, DaylightMetric):
        shown = metric.on_plan(image)
    else:
        illuminance = MeanIlluminance(grid)
        shown = PlanValues(illuminance.illuminance(image), "illuminance in lx", LEVELS)
        error = illuminance.efficacy * ((info.get("picture") or {}).get("pixel_error") or 0.0)
    return plot_plan(
        grid.spread(shown.values),
        grid.plan,
        grid.inside,
        levels=shown.levels,
        title=_title(shown),
        label=shown.label,
        axes=grid.axes,
        width=width,
        error=error,
    )


def _title(shown: PlanValues) -> str:
    """Return what a plan shows and which points count; units stay on the lines of what they are of."""
    label = re.sub(r" (?=lx\b|in %$|%$)", "\u00a0", shown.label[0].upper() + shown.label[1:])
    return "; ".join(filter(None, [label, shown.counts]))


def plan_of(
    image: torch.Tensor | None, renderer: SceneRenderer, metric: Metric, info: Mapping[str, Any]
) -> Figure | None:
    """Return the map for a report; None if the renderer has no sensor grid."""
    return draw_plan(image, renderer, metric, info, REPORT_WIDTH) if renderer.has_grid else None


def plans_of(
    results: Sequence[tuple[torch.Tensor | None, Mapping[str, Any]]], renderer: SceneRenderer, metric: Metric
) -> Sequence[Figure | None]:
    """Return the maps of several designs, of images and infos, with a common scale of colours.

    They are None without a sensor grid.
    """
    plans = [plan_of(image, renderer, metric, info) for image, info in results]
    share_scale(plan for plan in plans if plan is not None)
    return plans


def plan_format(
    renderer: SceneRenderer,
    metric: Metric,
    of: Callable[[Result], tuple[torch.Tensor | None, Mapping[str, Any]]],
) -> OutputFormat[Result]:
    """Return the map as a file that a command writes of a result, ``of`` which it takes the image and the info."""

    def draw(result: Result) -> Figure:
        image, info = of(result)
        return draw_plan(image, renderer, metric, info)

    return OutputFormat(
        "plan.png",
        "map on the plan of the room",
        figure_writer(draw),
    )
