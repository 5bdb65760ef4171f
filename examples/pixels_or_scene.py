"""Compare the scene attribution of a classifier's logit with Captum's pixel attributions of the same picture.

Captum's Saliency and IntegratedGradients tell which pixels matter to the logit of a cube. Their sums over the
pixels of each object rank the objects, and with them the parameters of the scene. Deletion and insertion render
the scene again, and show which order finds the parameters that matter. Prints the areas of the curves, and draws
them.

    python examples/pixels_or_scene.py [--out out/pixels] [--resolution 64x36] [--spp 128]
"""

from __future__ import annotations

from pathlib import Path

import torch
from _options import parser
from captum.attr import IntegratedGradients, Saliency

from scenecaptum import IntegratedGradientsScene, SceneRenderer, metrics, validation
from scenecaptum.projection import project_pixels


def main(
    folder: Path, resolution: tuple[int, int] = (64, 36), spp: int = 128, draws: int = 64
) -> validation.DeletionInsertion:
    renderer = SceneRenderer(
        "office", ["reflectance", "emitters"], resolution=resolution, spp=spp, max_depth=6
    )
    plain = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube")
    logit = metrics.Smoothed(plain, sigma=0.3, n=draws)  # the gradient of a plain logit is mostly noise
    found = IntegratedGradientsScene(renderer, logit).attribute(seed=0)

    def forward(images: torch.Tensor) -> torch.Tensor:
        """Return the smoothed logit of each picture of Captum's batch."""
        return torch.stack([logit(image) for image in images])

    with torch.no_grad():
        picture = renderer(seed=1)[None]
    picture.requires_grad_()
    pixels = {
        "Captum's Saliency": Saliency(forward).attribute(picture),
        "Captum's IntegratedGradients": IntegratedGradients(forward).attribute(
            picture, internal_batch_size=1
        ),
    }
    orders = {name: project_pixels(renderer, one) for name, one in pixels.items()}
    invisible = next(iter(orders.values())).invisible
    print(
        f"{len(invisible)} of {len(renderer.inputs)} parameters belong to no visible object: "
        f"{', '.join(invisible)}\n"
    )
    curves = validation.deletion_insertion(renderer, logit, found, orders=orders, seed=2)
    print(curves)
    folder.mkdir(parents=True, exist_ok=True)
    curves.plot().savefig(folder / "curves.png")
    print(f"\n{folder / 'curves.png'}  the curves of all orders")
    return curves


if __name__ == "__main__":
    options = parser(__doc__, resolution="64x36", spp=128, out="out/pixels").parse_args()
    main(options.out, options.resolution, options.spp)
