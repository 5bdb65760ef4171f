"""An optimisation as a table and a figure: what was moved, and the scene before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._figures import RAISES, SMALL, TEXT, TITLE, WIDTH, new_figure
from ._numbers import shorten, with_error
from ._tonemap import automatic_exposure, display_image

if TYPE_CHECKING:
    import torch
    from matplotlib.figure import Figure

    from ..optimize import Measured, Optimisation

_NAME_WIDTH = 36


def optimisation_text(found: Optimisation) -> str:
    """Write the table for a terminal: every parameter before and after, and the metric."""
    names = shorten([moved.label for moved in found.moved], _NAME_WIDTH)
    cells = [
        (name, _numbers(moved.before), _numbers(moved.after), f"{moved.fraction:.0%}")
        for name, moved in zip(names, found.moved, strict=True)
    ]
    head = ("moved", "before", "after", "of its range")
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in (head, *cells)
    ]
    return "\n".join([*(line.rstrip() for line in lines), "", _outcome(found)])


def plot_optimisation(found: Optimisation) -> Figure:
    """Draw the scene before and after under one exposure, and the metric at every step with the goal."""
    figure = new_figure(WIDTH, 2.9)
    panels = figure.subplot_mosaic([["before", "after", "way"]], width_ratios=[1.25, 1.25, 1])
    exposure = automatic_exposure(found.before.image)
    for name, measured in (("before", found.before), ("after", found.after)):
        panels[name].imshow(display_image(measured.image, exposure).numpy(force=True))
        panels[name].set_title(f"{name}: {_measured(measured)}", fontsize=TEXT, loc="left", parse_math=False)
        panels[name].set_axis_off()
        panels[name].set_anchor("N")
    way = panels["way"]
    way.plot(range(len(found.history)), found.history, color=RAISES, linewidth=1.2)
    way.axhline(found.below, color="0.4", linestyle="--", linewidth=1)
    way.annotate(
        "goal",
        (0, found.below),
        xycoords=("axes fraction", "data"),
        xytext=(3, -9),
        textcoords="offset points",
        fontsize=SMALL,
    )
    way.set_xlabel("step", fontsize=TEXT)
    way.set_title(found.metric, fontsize=TEXT, loc="left", parse_math=False)
    way.tick_params(labelsize=SMALL)
    way.spines[["top", "right"]].set_visible(False)
    figure.suptitle(_outcome(found), fontsize=TITLE, x=0.01, ha="left", parse_math=False)
    return figure


def _outcome(found: Optimisation) -> str:
    outcome = (
        f"below the goal of {found.below:g}" if found.reached else f"not below the goal of {found.below:g}"
    )
    return f"{found.metric} {_measured(found.before)} → {_measured(found.after)}, {outcome}"


def _measured(measured: Measured) -> str:
    return " ± ".join(filter(None, with_error(measured.value, measured.error, digits=2)))


def _numbers(value: torch.Tensor) -> str:
    return " ".join(f"{one:.3g}" for one in value.flatten().tolist())
