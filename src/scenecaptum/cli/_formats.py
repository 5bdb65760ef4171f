"""The registry of output formats of ``scenecaptum attribute``."""

from __future__ import annotations

from pathlib import Path

from ..attr import SceneAttribution
from ..projection import export
from ..report import write_csv, write_json
from ..visualization import save_render
from ._files import OutputFormat, figure_writer


def _write_render(attribution: SceneAttribution, path: Path) -> None:
    assert attribution.image is not None, "every attribution of a SceneRenderer has its image"
    save_render(attribution.image, path)


# Written in this order: numbers first, so that an interruption while plotting leaves them.
FORMATS: dict[str, OutputFormat[SceneAttribution]] = {
    "json": OutputFormat("attribution.json", "numbers and settings", write_json),
    "csv": OutputFormat("attribution.csv", "table of the numbers", write_csv),
    "npz": OutputFormat(
        "attribution.npz", "complete result, for SceneAttribution.load", SceneAttribution.save
    ),
    "render": OutputFormat("render.png", "render", _write_render),
    "heatmap": OutputFormat(
        "heatmap.png", "render and saliency map", figure_writer(SceneAttribution.plot_heatmap)
    ),
    "bars": OutputFormat("bars.png", "ranking with error bars", figure_writer(SceneAttribution.plot_bars)),
    "exr": OutputFormat(
        "attribution.exr", "render, saliency and objects for compositing", export, by_default=False
    ),
}


def default_formats() -> list[str]:
    """Return the names of the formats that are written unless others are selected."""
    return [name for name, one in FORMATS.items() if one.by_default]
