"""Lower the glare of the office: move the desk with everything on it, and turn the head of the desk lamp.

Poses are plain inputs of a torch function, so one translation moves desk and lamp together. Prints which poses
matter, with their error bars, and the glare before and after; draws both rooms.

    python examples/move_the_desk.py [--out out/move-the-desk] [--resolution 160x90] [--spp 64]
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from _options import parser
from tqdm import tqdm

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.visualization import automatic_exposure, display_image, new_figure

OBJECTS = {
    "head": ["lamp_shade_*", "bulb"],
    "desk": [
        *("desk_*", "screen_*", "keyboard", "paper_sheet", "book_lower", "book_upper", "mug_*"),
        *("lamp_foot*", "lamp_*_arm", "lamp_elbow"),
    ],
}
DESK, HEAD, TURN = "desk.pose.translation", "head.pose.translation", "head.pose.rotation"
# In metres: to both sides, and to the chair or the window, along the floor.
LOW, HIGH = torch.tensor([-0.5, -0.1, 0.0]), torch.tensor([0.5, 0.2, 0.0])
MOST = math.radians(40)


def together(shift: torch.Tensor, turn: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the poses of the desk and of the lamp's head, which moves with it."""
    return {DESK: shift, HEAD: shift, TURN: turn}


def main(
    folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 64, steps: int = 25
) -> tuple[SceneAttribution, SceneAttribution]:
    renderer = SceneRenderer(
        "office", [DESK, HEAD, TURN], objects=OBJECTS, resolution=resolution, spp=spp, max_depth=4
    )
    glare = metrics.UnifiedGlareRating(renderer.camera)
    method = VanillaSceneGradient(renderer, glare)
    before = method.attribute(seed=0, spp=4 * spp)
    print(before)
    shift, turn = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.Adam([{"params": [shift], "lr": 0.03}, {"params": [turn], "lr": 0.04}])
    for step in tqdm(range(steps), desc="glare", disable=None):
        optimizer.zero_grad()
        glare(renderer(together(shift, turn), seed=2 * step, seed_grad=2 * step + 1)).backward()
        optimizer.step()
        with torch.no_grad():
            shift.copy_(shift.clamp(LOW, HIGH))
            turn.clamp_(-MOST, MOST)
    after = method.attribute(together(shift.detach(), turn.detach()), seed=0, spp=4 * spp)
    for name, result in (("as it is", before), ("moved", after)):
        print(f"UGR {result.metric_value:.2f} ± {result.metric_standard_error:.1g} {name}")
    print(
        f"the desk has moved by {shift.tolist()} m, the lamp has turned by {math.degrees(turn.norm()):.0f}°"
    )
    draw(folder / "move-the-desk.png", before, after)
    return before, after


def draw(path: Path, before: SceneAttribution, after: SceneAttribution) -> None:
    """Draw both rooms at one exposure."""
    figure = new_figure(9, 2.9)
    exposure = automatic_exposure(before.image)
    for axes, name, result in zip(figure.subplots(1, 2), ("as it is", "moved"), (before, after), strict=True):
        axes.imshow(display_image(result.image, exposure).numpy(force=True))
        axes.set_title(f"{name}: UGR {result.metric_value:.1f}", loc="left")
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    print(f"{path}  both rooms")


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=64, out="out/move-the-desk").parse_args()
    main(options.out, options.resolution, options.spp)
