"""Turn the camera until a classifier no longer sees the sphere that fills the picture.

Gradient descent of the margin of the right class, with respect to the rotation of the camera alone: the room, the
light and the sphere do not change, and the sphere stays in view. The output of a network depends on the position
of a single edge within a pixel. The margin that is lowered is therefore the mean over pictures that are shifted by
up to one pixel, with a little noise.

Prints the margin at every step, what the network alone sees before and after, and how many random turns as large
as the one found lose the sphere too. Draws both views.

    python examples/lost_view.py [--scene 0] [--spp 256] [--out out/lost-view]
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _options import parser
from matplotlib.figure import Figure
from train_shape_classifier import RESOLUTION, random_scene

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.visualization import automatic_exposure, display_image, new_figure

ROTATION = "camera.pose.rotation"
STEP = 0.02  # radians; the picture is 0.7 radians wide
FARTHEST = 0.2  # radians: the sphere stays in view
SHIFTS = 5  # in each direction, half a pixel of the network apart
BRIGHTNESS = 0.3  # mean of the pictures that the network was trained on


class ShiftedViews(torch.nn.Module):
    """The mean logits of a classifier over shifted crops of a picture twice as fine as it needs."""

    def __init__(self, model: metrics.ShapeClassifier) -> None:
        super().__init__()
        self.model = model
        self.classes = model.classes
        self.preprocess = torch.nn.Identity()

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Return the logits, ``(N, 3)``, of pictures ``(N, 3, H, W)``."""
        side = picture.shape[-1] - SHIFTS + 1
        crops = [picture[..., i : i + side, j : j + side] for i in range(SHIFTS) for j in range(SHIFTS)]
        logits = self.model(self.model.preprocess(torch.cat(crops)))
        return logits.reshape(len(crops), -1, len(self.classes)).mean(0)


class View(NamedTuple):
    """A turn of the camera in radians, the margin of the sphere there, its standard error, and the picture."""

    turn: torch.Tensor
    margin: float
    error: float
    image: torch.Tensor


class Search(NamedTuple):
    """The steps of a search, the margins of random turns of the same size, and the network's own at both ends."""

    steps: list[View]
    random: list[float]
    classes: tuple[str, ...]


def main(folder: Path, scene: int = 0, spp: int = 256, steps: int = 20, turns: int = 12) -> Search:
    activate()
    room = random_scene("sphere", np.random.default_rng(scene))
    side = 2 * RESOLUTION + SHIFTS - 1
    renderer = SceneRenderer(room, ROTATION, resolution=(side, side), spp=spp, max_depth=4)
    exposure = BRIGHTNESS / renderer(seed=0).mean().item()
    model = metrics.ShapeClassifier.pretrained()
    logit = metrics.ClassLogit(ShiftedViews(model), "sphere", against="best", exposure=exposure)
    margin = metrics.Smoothed(logit, sigma=0.1, n=16)
    method = VanillaSceneGradient(renderer, margin)

    turn, path = torch.zeros(3), []
    for number in range(steps + 1):
        found = method.attribute({ROTATION: turn}, seed=number)
        assert found.image is not None
        path.append(View(turn, found.metric_value, found.metric_standard_error or 0.0, found.image))
        print(
            f"turned by {degrees(turn):4.1f}°: margin {path[-1].margin:+.2f} ± {path[-1].error:.2f}",
            flush=True,
        )
        if path[-1].margin + 2 * path[-1].error < 0:
            break
        turn = turn - STEP * torch.nn.functional.normalize(found[ROTATION], dim=0)
        turn = turn * min(1.0, FARTHEST / turn.norm().item())

    random = random_margins(renderer, margin, path[-1].turn.norm().item(), turns)
    lost = sum(value < 0 for value in random)
    print(f"Of {turns} random turns by {degrees(path[-1].turn):.1f}°, {lost} lose the sphere.")
    whole = metrics.ClassLogit(model, exposure=exposure)
    classes = tuple(model.classes[int(whole(view.image).argmax())] for view in (path[0], path[-1]))
    print(
        f"The network alone, without shifts and noise, sees a {classes[0]} before and a {classes[1]} after."
    )
    folder.mkdir(parents=True, exist_ok=True)
    plot(path, random, classes).savefig(folder / "lost-view.png", dpi=110)
    print(f"{folder / 'lost-view.png'}  both views, and the margin on the way")
    return Search(path, random, classes)


def random_margins(renderer: SceneRenderer, margin: torch.nn.Module, angle: float, count: int) -> list[float]:
    """Return the margins of turns by an angle about random axes."""
    axes = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    with torch.no_grad():
        return [
            margin(renderer({ROTATION: angle * axis}, seed=k, spp=4 * renderer.spp)).item()
            for k, axis in enumerate(axes)
        ]


def degrees(turn: torch.Tensor) -> float:
    return math.degrees(turn.norm().item())


def plot(path: list[View], random: list[float], classes: tuple[str, ...]) -> Figure:
    """Draw the first and the last view, and the margin on the way between them."""
    figure = new_figure(10, 3.8)
    lost = sum(value < 0 for value in random)
    outcome = "loses" if path[-1].margin < 0 else "does not lose"
    figure.suptitle(
        f"A turn of {degrees(path[-1].turn):.1f}° {outcome} the sphere; of {len(random)} random turns as large, "
        f"{lost} lose it",
        fontsize=12,
    )
    before, after, way = figure.subplots(1, 3, width_ratios=[1, 1, 1.2])
    exposure = automatic_exposure(path[0].image)
    for ax, view, name in ((before, path[0], classes[0]), (after, path[-1], classes[1])):
        ax.imshow(display_image(view.image, exposure).numpy())
        ax.set_title(f"turned by {degrees(view.turn):.1f}°: “{name}”", fontsize=11)
        ax.set_axis_off()
    angles = [degrees(view.turn) for view in path]
    values, errors = [view.margin for view in path], [view.error for view in path]
    way.errorbar(angles, values, errors, marker="o", label="along the gradient")
    way.plot([angles[-1]] * len(random), random, "x", color="0.5", label="random turns")
    way.axhline(0, color="0.4", linewidth=1)
    way.set_title("below 0, the sphere is lost", fontsize=11)
    way.set_xlabel("turn of the camera (degrees)")
    way.set_ylabel("margin of the sphere (logits)")
    way.legend(frameon=False, fontsize=9, loc="upper center")
    return figure


if __name__ == "__main__":
    options = parser(__doc__, spp=256, out="out/lost-view")
    options.add_argument("--scene", type=int, default=0, help="number of the scene")
    chosen = options.parse_args()
    main(chosen.out, chosen.scene, chosen.spp)
