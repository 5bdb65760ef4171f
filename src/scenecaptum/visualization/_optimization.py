"""Table and figure of an optimization: the changed parameters, and the scene before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._figures import RAISES, SMALL, TEXT, TITLE, WIDTH, new_figure
from ._numbers import shorten, with_error
from ._tonemap import automatic_exposure, display_image

if TYPE_CHECKING:
    import torch
    from matplotlib.figure import Figure

    from ..optimize import Measured, Optimization

_NAME_WIDTH = 36


def optimization_text(result: Optimization) -> str:
    """Return a text table: the value of every changed parameter before and after, and the metric."""
    names = shorten([moved.label for moved in result.moved], _NAME_WIDTH)
    cells = [
        (name, _format_values(moved.before), _format_values(moved.after), f"{moved.fraction:.0%}")
        for name, moved in zip(names, result.moved, strict=True)
    ]
    head = ("moved", "before", "after", "of its range")
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in (head, *cells)
    ]
    return "\n".join([*(line.rstrip() for line in lines), "", _outcome(result)])


def plot_optimization(result: Optimization) -> Figure:
    """Plot the scene before and after at the same exposure, and the metric at every step with the goal."""
    figure = new_figure(WIDTH, 2.9)
    panels = figure.subplot_mosaic([["before", "after", "history"]], width_ratios=[1.25, 1.25, 1])
    exposure = automatic_exposure(result.before.image)
    for name, measured in (("before", result.before), ("after", result.after)):
        panels[name].imshow(display_image(measured.image, exposure).numpy(force=True))
        panels[name].set_title(
            f"{name}: {_format_metric(measured)}", fontsize=TEXT, loc="left", parse_math=False
        )
        panels[name].set_axis_off()
        panels[name].set_anchor("N")
    history = panels["history"]
    history.plot(range(len(result.history)), result.history, color=RAISES, linewidth=1.2)
    history.axhline(result.below, color="0.4", linestyle="--", linewidth=1)
    history.annotate(
        "goal",
        (0, result.below),
        xycoords=("axes fraction", "data"),
        xytext=(3, -9),
        textcoords="offset points",
        fontsize=SMALL,
    )
    history.set_xlabel("step", fontsize=TEXT)
    history.set_title(result.metric, fontsize=TEXT, loc="left", parse_math=False)
    history.tick_params(labelsize=SMALL)
    history.spines[["top", "right"]].set_visible(False)
    figure.suptitle(_outcome(result), fontsize=TITLE, x=0.01, ha="left", parse_math=False)
    return figure


def _outcome(result: Optimization) -> str:
    outcome = f"{'' if result.reached else 'not '}below the goal of {result.below:g}"
    return f"{result.metric} {_format_metric(result.before)} → {_format_metric(result.after)}, {outcome}"


def _format_metric(measured: Measured) -> str:
    return " ± ".join(filter(None, with_error(measured.value, measured.error, digits=2)))


def _format_values(value: torch.Tensor) -> str:
    return " ".join(f"{entry:.3g}" for entry in value.flatten().tolist())
