"""Define a custom metric: the contrast of the desk with its surroundings.

Any torch function of the image works. This one weights pixels by the object that they show, to measure the
contrast of one object; the gradient includes all light that reaches it.

    python examples/own_metric.py [--resolution 160x90] [--spp 128]
"""

from __future__ import annotations

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

    weight: torch.Tensor

    def __init__(self, weight: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("weight", weight)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the contrast in a ``(H, W, 3)`` image."""
        y, rest = metrics.luminance(image), 1 - self.weight
        background = (rest * y).sum() / rest.sum()
        return (self.weight * y).sum() / self.weight.sum() / background - 1


def main(resolution: tuple[int, int] = (160, 90), spp: int = 128) -> SceneAttribution:
    renderer = SceneRenderer("office", "all", resolution=resolution, spp=spp, max_depth=6)
    desk = torch.from_numpy(renderer.surfaces.shown(["desk.base_color.value"]))
    found = VanillaSceneGradient(renderer, WeberContrast(desk)).attribute(seed=0)
    print(found)
    return found


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=128).parse_args()
    main(options.resolution, options.spp)
