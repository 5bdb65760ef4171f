"""Attribute a ResNet-50's logit of a chair to materials and lights of the office.

The camera looks at the office chair. torchvision downloads the weights on first use; ``--random`` uses random
weights instead, as a smoke test. Prints the ranking, and draws the render beside the map.

The gradient of the plain logit is rough: where the errors are large, use ``--smoothing 0.3``. The network then
sees 256 noisy copies of each picture, for which a ResNet-50 needs a GPU or patience.

    python examples/chair_logit.py [--out out/chair] [--resolution 224x224] [--spp 256] [--smoothing 0.3]
        [--random]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from _options import parser

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, activate, metrics
from scenecaptum.scene import bundled

FOLDING_CHAIR = 559


def scene() -> dict[str, Any]:
    """Return the office with the camera in front of the chair."""
    mi = activate()
    office = bundled.office()
    pose = mi.ScalarTransform4f().look_at(origin=(0.9, 0.7, 1.35), target=(-0.22, 2.42, 0.6), up=(0, 0, 1))
    office["sensor"] |= {"to_world": pose}
    return office


def classifier(exposure: float, smoothing: float | None, *, random: bool) -> metrics.ClassLogit:
    """Return the logit of the folding chair, ImageNet's class 559."""
    options: dict[str, Any] = {"exposure": exposure, "smoothing": smoothing}
    if not random:
        return metrics.ClassLogit.pretrained("resnet50", "IMAGENET1K_V2", FOLDING_CHAIR, **options)
    from torchvision.models import resnet18

    torch.manual_seed(0)
    return metrics.ClassLogit(resnet18(), FOLDING_CHAIR, **options)


def main(
    folder: Path,
    resolution: tuple[int, int] = (224, 224),
    spp: int = 256,
    *,
    smoothing: float | None = None,
    random: bool = False,
) -> SceneAttribution:
    renderer = SceneRenderer(scene(), ["materials", "emitters"], resolution=resolution, spp=spp, max_depth=6)
    with torch.no_grad():
        brightness = metrics.MeanLuminance()(renderer(seed=1, spp=16)).item()
    logit = classifier(0.4 / brightness, smoothing, random=random)
    found = VanillaSceneGradient(renderer, logit).attribute(seed=0)
    print(found)
    folder.mkdir(parents=True, exist_ok=True)
    figure = found.plot_heatmap(signed=True)
    if random:  # in place of a title that states a finding
        figure.texts[0].set_text("With random weights, the map says nothing about chairs")
    figure.savefig(folder / "chair.png")
    print(f"\n{folder / 'chair.png'}  the render and the map")
    return found


if __name__ == "__main__":
    arguments = parser(__doc__, resolution="224x224", spp=256, out="out/chair")
    arguments.add_argument("--random", action="store_true", help="a ResNet-18 with random weights")
    arguments.add_argument(
        "--smoothing", type=float, metavar="SIGMA", help="average the logit over noisy copies of the picture"
    )
    given = arguments.parse_args()
    main(given.out, given.resolution, given.spp, smoothing=given.smoothing, random=given.random)
