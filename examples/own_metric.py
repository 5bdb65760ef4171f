"""Define a custom metric: the contrast of the desk with its surroundings.

Any torch function of the image works. This one weights pixels by the object that they show, to measure the
contrast of one object; the gradient includes all light that reaches it. Prints the
ranking, and draws the map beside the render.

    python examples/own_metric.py [--out out/own-metric] [--resolution 160x90] [--spp 128]
"""

from __future__ import annotations

from pathlib import Path

import torch
from _options import parser

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics


class WeberContrast(torch.nn.Module):
    """Luminance of an object against its surroundings: ``(L − L_b) / L_b``.

    Parameters
    ----------
    weight
        ``(H, W)``, the fraction of each pixel that shows the object.
    """

    measure = metrics.Measure("contrast of the desk with the rest")  # its name in tables and figures
    weight: torch.Tensor

    def __init__(self, weight: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("weight", weight)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the contrast in a ``(H, W, 3)`` image."""
        y, rest = metrics.luminance(image), 1 - self.weight
        background = (rest * y).sum() / rest.sum()
        return (self.weight * y).sum() / self.weight.sum() / background - 1


def main(folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 128) -> SceneAttribution:
    renderer = SceneRenderer("office", "all", resolution=resolution, spp=spp, max_depth=6)
    desk = torch.from_numpy(renderer.surfaces.shown(["desk.base_color.value"]))
    found = VanillaSceneGradient(renderer, WeberContrast(desk)).attribute(seed=0)
    print(found)
    folder.mkdir(parents=True, exist_ok=True)
    found.plot_heatmap(signed=True).savefig(folder / "contrast.png")
    print(f"\n{folder / 'contrast.png'}  the render and the map")
    return found


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=128, out="out/own-metric").parse_args()
    main(options.out, options.resolution, options.spp)
