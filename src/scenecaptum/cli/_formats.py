"""The registry of output formats of ``scenecaptum attribute``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..attr import SceneAttribution
from ..errors import SceneCaptumError
from ..projection import export
from ..protocols import Scale
from ..report import write_csv, write_json
from ..student import clear_from
from ..visualization import save_render, shown_render
from ._files import OutputFormat, figure_writer

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _write_render(attribution: SceneAttribution, path: Path, *, denoised: bool = True) -> None:
    save_render(shown_render(attribution, denoised=denoised), path)


# Written in this order: numbers first, so that an interruption while plotting leaves them.
FORMATS: dict[str, OutputFormat[SceneAttribution]] = {
    "json": OutputFormat("attribution.json", "numbers and settings", write_json),
    "csv": OutputFormat("attribution.csv", "table of the numbers", write_csv),
    "npz": OutputFormat(
        "attribution.npz", "complete result, for SceneAttribution.load", SceneAttribution.save
    ),
    "render": OutputFormat("render.png", "render", _write_render, of_a_view=True),
    "heatmap": OutputFormat(
        "heatmap.png",
        "render and map of the effects",
        figure_writer(SceneAttribution.plot_heatmap),
        of_a_view=True,
    ),
    "bars": OutputFormat("bars.png", "effects with error bars", figure_writer(SceneAttribution.plot_bars)),
    "exr": OutputFormat(
        "attribution.exr",
        "render, effects and objects for compositing",
        export,
        by_default=False,
        of_a_view=True,
    ),
}


def selected_formats(
    names: Collection[str], scale: Scale | None, *, signed: bool | None, denoised: bool
) -> list[OutputFormat[SceneAttribution]]:
    """Return the formats with these names, their figures in a scale.

    The map has signs if ``signed``; if that is None, wherever effects of both signs are clear of the noise.
    ``denoised`` shows the render denoised, alone and beside the map.
    """

    def plot_heatmap(attribution: SceneAttribution) -> Figure:
        has_signs = _has_both_signs(attribution, scale) if signed is None else signed
        return attribution.plot_heatmap(scale=scale, signed=has_signs, denoised=denoised)

    drawn: dict[str, Callable[[SceneAttribution, Path], None]] = {
        "render": partial(_write_render, denoised=denoised),
        "heatmap": figure_writer(plot_heatmap),
        "bars": figure_writer(partial(SceneAttribution.plot_bars, scale=scale)),
        "exr": partial(export, scale=scale, signed=bool(signed)),
    }
    return [
        dataclasses.replace(one, write=drawn.get(name, one.write))
        for name, one in FORMATS.items()
        if name in names
    ]


def _has_both_signs(attribution: SceneAttribution, scale: Scale | None) -> bool:
    """Whether there are effects of both signs that are clear of their noise."""
    allowed = clear_from(attribution.info)
    clear = [
        row.effect
        for row in attribution.ranking(scale=scale)
        if abs(row.effect) > allowed * (row.effect_error or 0.0)
    ]
    return attribution.kind.has_sign and bool(clear) and min(clear) < 0 < max(clear)


def default_formats(*, view: bool = True) -> list[str]:
    """Return the names of the formats that are written unless others are selected.

    A sensor grid is no view: its pixels show no objects, and a map on the plan stands for its picture.
    """
    return [name for name, one in FORMATS.items() if one.by_default and (view or not one.of_a_view)]


def check_formats(names: Collection[str]) -> None:
    """Raise if one of the formats needs a view, for a sensor that shows none."""
    for name in names:
        if FORMATS[name].of_a_view:
            others = [other for other, one in FORMATS.items() if not one.of_a_view]
            raise SceneCaptumError(
                f"--format {name} needs a picture of objects, and this sensor shows none: choose "
                f"{', '.join(others[:-1])} or {others[-1]}, or leave --format out, which also writes "
                "the plan of a grid."
            )
