"""The rooms and the metrics for the paper's claims."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from _figures import MapRow, clean_render

from scenecaptum import SceneAttribution, SceneRenderer, activate, metrics
from scenecaptum.protocols import RankedParameter
from scenecaptum.scene import bundled

SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[3] / "shared" / "scenes"))
DEPTH = 6  # as in the paper
FOLDING_CHAIR = 559
TURNED = "office from the window"
LEADERS = 5  # number of leading parameters
HEADINGS = {
    "mean luminance": "mean luminance, effects in cd/m²",
    "UGR": "UGR",
    "logit": "logit of the network",
}


@dataclass(frozen=True)
class Size:
    """Amount of rendering: images ``width`` pixels wide, with ``spp`` samples per pixel.

    ``small`` is the width of images that are rendered many times, ``reference`` the samples of a reference.
    """

    width: int
    spp: int
    small: int
    reference: int
    top: int
    resnet: bool = False


FULL = Size(width=192, spp=128, small=64, reference=1024, top=10)
QUICK = Size(width=16, spp=8, small=16, reference=32, top=2)


@dataclass
class Room:
    """A room, rendered at one size, with the three metrics of the paper."""

    name: str
    renderer: SceneRenderer
    metrics: dict[str, Any]


def names() -> list[str]:
    """Return the office and the other available rooms; print the missing ones."""
    found = ["office"]
    for name in ("living-room", "dining-room", "kitchen"):
        if (SCENES / name / "scene.xml").is_file():
            found.append(name)
        else:
            print(f"{name}: skipped, {SCENES / name / 'scene.xml'} does not exist")
    return found


def quick_rooms(rooms: list[str]) -> list[str]:
    """Return the rooms for claims that render each of them hundreds of times."""
    return [room for room in rooms if room != "kitchen"]


def load(name: str, inputs: Any, width: int, spp: int, *, resnet: bool = False) -> Room:
    """Load a room with 16:9 images."""
    scene = turned() if name == TURNED else name if name == "office" else SCENES / name / "scene.xml"
    renderer = SceneRenderer(scene, inputs, resolution=(width, 9 * width // 16), spp=spp, max_depth=DEPTH)
    glare = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    with torch.no_grad():
        mean = metrics.MeanLuminance()(renderer(seed=1, spp=max(1, spp // 4))).item()
    exposure = 0.4 / mean  # an image of medium brightness
    network = (
        metrics.ClassLogit.pretrained("resnet50", "IMAGENET1K_V2", FOLDING_CHAIR, exposure=exposure)
        if resnet
        else metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "sphere", exposure=exposure)
    )
    return Room(name, renderer, {"mean luminance": metrics.MeanLuminance(), "UGR": glare, "logit": network})


def turned() -> dict[str, Any]:
    """Return the office seen from its window, which is then not visible."""
    mi = activate()
    scene = bundled.office()
    pose = mi.ScalarTransform4f().look_at(origin=(0.3, 4.2, 1.5), target=(-0.4, -0.9, 1.2), up=(0, 0, 1))
    scene["sensor"] |= {"to_world": pose}
    return scene


def map_row(room: Room, results: list[SceneAttribution], size: Size) -> MapRow:
    """Return a room's row of the grid of maps."""
    luminance, glare = (result.metric_value for result in results[:2])
    lines = [
        f"{room.name}: {len(room.renderer.inputs)} parameters",
        f"mean luminance {luminance:.3g} cd/m²",
        f"UGR {glare:.3g}",
    ]
    return MapRow(clean_render(room.renderer, 2 * size.spp), lines, results)


def clear_sign(row: RankedParameter) -> int:
    """Return the sign of an effect that exceeds two standard errors, otherwise 0."""
    return 0 if abs(row.effect) <= 2 * (row.effect_error or 0.0) else 1 if row.effect > 0 else -1
