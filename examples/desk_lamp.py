"""Turn the office's desk lamp and move the desk until the lamp no longer dazzles the person on the chair.

It is evening: the sky is dark and the luminaires are dimmed. The eye is that of somebody on the chair, 1.2 m above
the floor. The desk carries everything on it, the lamp too; the shade of the lamp turns on its arm, within limits
that keep its light on the desk. `optimize.minimize` moves both until UGR, measured with independent samples, is
below 19, the limit of EN 12464-1 for offices.

Prints the moves in degrees and centimetres, and draws both rooms.

    python examples/desk_lamp.py [--out out/desk-lamp] [--resolution 160x90] [--spp 64]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from _options import parser

from scenecaptum import SceneRenderer, activate, metrics, optimize
from scenecaptum.denoising import denoise
from scenecaptum.scene import bundled
from scenecaptum.visualization import automatic_exposure, display_image, new_figure

LIMIT = 19.0
DESK, SHADE = "desk.pose.translation", "shade.pose.rotation"
OBJECTS = {
    "desk": [
        *("desk_*", "screen_*", "keyboard", "paper_sheet", "book_lower", "book_upper", "mug_*"),
        *("lamp_*", "bulb"),
    ],
    "shade": ["lamp_shade_*", "bulb"],
}
# To the left, to the right and towards the window, in metres; about each axis, in radians.
LIMITS = {DESK: ((-0.6, 0.0, 0.0), (0.1, 0.3, 0.0)), SHADE: (-0.2, 0.2)}
PICTURE = (480, 270)


def evening_office() -> dict[str, Any]:
    """Return the bundled office in the evening, seen from its chair."""
    look_at = activate().ScalarTransform4f().look_at
    room = bundled.office()
    (camera,) = (part for part in room.values() if isinstance(part, dict) and part["type"] == "perspective")
    camera["to_world"] = look_at(origin=[-0.22, 2.35, 1.2], target=[-0.22, 3.45, 1.05], up=[0, 0, 1])
    camera["fov"] = 70.0
    dim = {"sky": 0.002, "luminaire_left": 0.1, "luminaire_right": 0.1, "luminaire_back": 0.1}
    for name, factor in dim.items():
        radiance = room[name]["emitter"]["radiance"]
        radiance["value"] = [factor * value for value in radiance["value"]]
    return room


def main(
    folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 64, steps: int = 40
) -> optimize.Optimization:
    def renderer_of(size: tuple[int, int], spp: int) -> SceneRenderer:
        return SceneRenderer(evening_office(), [DESK, SHADE], objects=OBJECTS, resolution=size, spp=spp)

    renderer = renderer_of(resolution, spp)
    glare = metrics.UnifiedGlareRating(renderer.camera)
    found = optimize.minimize(
        renderer, glare, LIMIT, limits=LIMITS, steps=steps, show_progress=sys.stderr.isatty()
    )
    print(found)
    print(in_words(found))
    folder.mkdir(parents=True, exist_ok=True)
    draw(renderer_of(PICTURE, 2 * spp), found, folder / "desk-lamp.png")
    print(f"{folder / 'desk-lamp.png'}  before and after")
    return found


def in_words(found: optimize.Optimization) -> str:
    """Say what to do with desk and lamp."""
    x, y, _ = (100 * found.values[DESK]).tolist()
    angle = torch.rad2deg(found.values[SHADE].norm()).item()
    side = "left" if x < 0 else "right"
    return (
        f"Move the desk {abs(x):.0f} cm to the {side} and {y:.0f} cm towards the window, and turn the lamp's "
        f"shade by {angle:.0f}°."
    )


def draw(renderer: SceneRenderer, found: optimize.Optimization, path: Path) -> None:
    """Draw both rooms, denoised, at the same exposure."""
    figure = new_figure(10, 3.2)
    exposure = None
    rooms = (({}, found.before, "before"), (found.values, found.after, "after"))
    for ax, (values, measured, name) in zip(figure.subplots(1, 2), rooms, strict=True):
        with torch.no_grad():
            picture = denoise(renderer(values, seed=1), renderer.guides_of(values))
        exposure = exposure or automatic_exposure(picture)
        ax.imshow(display_image(picture, exposure).numpy())
        ax.set_title(f"{name}: UGR {measured.value:.1f} ± {measured.error:.1f}", fontsize=11)
        ax.set_axis_off()
    figure.suptitle(in_words(found), fontsize=12)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=64, out="out/desk-lamp").parse_args()
    main(options.out, options.resolution, options.spp)
