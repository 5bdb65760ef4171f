"""What is said and drawn of a sensor grid: the value by the definition, and a map on the plan of the room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch

from ..attr import Definition, SceneAttribution
from ..daylight import DaylightMetric, PlanValues
from ..estimation import Metric, TargetedMetric
from ..explanation import definition_of
from ..metrics import MeanIlluminance
from ..rendering import SceneRenderer
from ..visualization import LEVELS, plot_plan, share_scale
from ._files import OutputFormat, Result, figure_writer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches of a plan; in a page it is narrow, so that a phone shows its text large.
FILE_WIDTH, REPORT_WIDTH = 7.2, 4.2


def by_definition(attribution: SceneAttribution, metric: Metric) -> Definition | None:
    """Return the value of a relaxed metric of a sensor grid by its definition; None of others, and of pictures."""
    if (
        attribution.image is None or attribution.surfaces is not None
    ):  # a picture has replicates and a transform
        return None
    return definition_of(TargetedMetric(metric), attribution.image[None])


def draw_plan(
    image: torch.Tensor | None, renderer: SceneRenderer, metric: Metric, width: float = FILE_WIDTH
) -> Figure:
    """Draw what a metric is about at each point of a sensor grid on the plan of the room.

    ``image`` is what the stated value is of, so that who counts the points on the plan finds that value.
    """
    grid = renderer.grid
    assert image is not None, "every attribution of a SceneRenderer has its image"
    shown = (
        metric.on_plan(image)
        if isinstance(metric, DaylightMetric)
        else PlanValues(MeanIlluminance(grid).illuminance(image), "illuminance in lx", LEVELS)
    )
    return plot_plan(
        grid.spread(shown.values),
        grid.plan,
        grid.inside,
        levels=shown.levels,
        title="\n".join(filter(None, [shown.label[0].upper() + shown.label[1:], shown.counts])),
        label=shown.label,
        axes=grid.axes,
        width=width,
    )


def plan_of(image: torch.Tensor | None, renderer: SceneRenderer, metric: Metric) -> Figure | None:
    """Return the map for a report; None if the renderer has no sensor grid."""
    return draw_plan(image, renderer, metric, REPORT_WIDTH) if renderer.has_grid else None


def plans_of(
    images: Sequence[torch.Tensor | None], renderer: SceneRenderer, metric: Metric
) -> Sequence[Figure | None]:
    """Return the maps of several designs with a common scale of colours; None without a sensor grid."""
    plans = [plan_of(image, renderer, metric) for image in images]
    share_scale(plan for plan in plans if plan is not None)
    return plans


def plan_format(
    renderer: SceneRenderer, metric: Metric, image_of: Callable[[Result], torch.Tensor | None]
) -> OutputFormat[Result]:
    """Return the map as a file that a command writes of a result, from which a function takes the image."""
    return OutputFormat(
        "plan.png",
        "map on the plan of the room",
        figure_writer(lambda result: draw_plan(image_of(result), renderer, metric)),
    )
