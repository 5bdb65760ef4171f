"""A result made by hand, with a row for every case that tables and figures treat differently."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import torch
from seeds import shifted

from scenecaptum import SceneAttribution
from scenecaptum.projection import SurfaceMap
from scenecaptum.visualization import LOWERS, RAISES, UNCLEAR

NASTY = "<script>alert('&')</script>"

# Name, value, standard error of each channel, and the colour that its bar should have; most salient first.
CASES: list[tuple[str, Any, float, str]] = [
    ("lamp", [0.3, 0.4, 0.0], 0.004, RAISES),
    ("two_minds", [0.1, -0.2, 0.01], 0.003, UNCLEAR),
    ("floor", [[[-0.02, -0.03, -0.04]] * 2] * 2, 0.002, LOWERS),
    ("rough", -0.0978, 0.0008, LOWERS),
    # Its third channel is negative because of noise only.
    ("wall", [0.05, 0.02, -0.001], 0.001, RAISES),
    ("noisy", 0.01, 0.03, UNCLEAR),
    ("tiny", 1.25e-7, 2.0e-8, RAISES),
    (NASTY, 0.0, 0.0, UNCLEAR),
]


def make(barred: bool = True, **info: Any) -> SceneAttribution:
    values = {name: torch.tensor(value) for name, value, *_ in CASES}
    errors = {name: torch.full_like(values[name], error) for name, _, error, _ in CASES}
    channels = {name: values[name].shape[-1] if values[name].ndim else 1 for name in values}
    covariance = {name: error**2 * torch.eye(channels[name]) for name, _, error, _ in CASES}
    return SceneAttribution(
        attributions=values,
        standard_error=errors if barred else None,
        metric_value=2.336942,
        metric_standard_error=0.000533 if barred else None,
        covariance=covariance if barred else None,
        labels={"rough": "desk: roughness"},
        image=torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(shifted())),
        surfaces=surfaces("rough", "floor"),
        info={
            "metric": "Glare",
            "method": "VanillaSceneGradient",
            "spp": 64,
            "replicates": 8 if barred else 1,
            **info,
        },
    )


def surfaces(left: str, right: str) -> SurfaceMap:
    pixel = np.arange(24, dtype=np.int32)
    return SurfaceMap(
        shape=(4, 6),
        pixel=pixel,
        object_index=(pixel % 6 >= 3).astype(np.int32),
        fraction=np.ones(24, np.float32),
        objects=("left", "right", "hidden"),
        parameters=((left,), (right,), ("lamp",)),
    )


def all_text(figure: Any) -> str:
    from matplotlib.text import Text

    return "\n".join(text.get_text() for text in figure.findobj(Text))


def outside(figure: Any) -> list[str]:
    """Return the drawn texts that are cut off at the edges of a figure."""
    from matplotlib.text import Text

    with mock.patch.object(Text, "draw", autospec=True, side_effect=Text.draw) as draw:
        figure.canvas.draw()
    drawn = {call.args[0] for call in draw.call_args_list if call.args[0].get_text()}
    assert drawn
    width, height = figure.canvas.get_width_height()
    boxes = {text: text.get_window_extent() for text in drawn}
    return [
        text.get_text()
        for text, box in boxes.items()
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1
    ]
