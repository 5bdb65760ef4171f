"""Attribute with a custom renderer: Gaussian splats in a few dozen lines of torch, without Mitsuba.

python examples/gaussian_splats.py

scenecaptum only needs a callable ``renderer(inputs, *, seed, spp)`` that torch can differentiate; the attributes
``inputs`` and ``bounds`` are optional defaults. Prints which parameters make a small still life red.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping

import torch

from scenecaptum import IntegratedGradientsScene, VanillaSceneGradient


class SplatRenderer:
    """A still life of round Gaussians in space, seen by a pinhole camera and composited front to back.

    Example
    -------
    >>> renderer = SplatRenderer()
    >>> renderer(renderer.inputs, seed=0, spp=None).shape
    torch.Size([32, 32, 3])

    Positions and radii of the Gaussians are fixed. Each object has an emitted colour, ``(3,)`` or one for each of
    its Gaussians, and an opacity. The image has no noise, and neither do its attributions.

    References
    ----------
    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023.
    """

    def __init__(self, size: int = 32) -> None:
        rows, columns = torch.linspace(-1.5, 1.5, 4), torch.linspace(-2, 2, 6)
        wall = torch.cartesian_prod(rows, columns)
        objects = {  # centres (right, down, away from the camera), radius, colour, opacity
            "apple": ([(0.0, 0.3, 2.5), (0.15, 0.25, 2.4), (-0.1, 0.4, 2.4)], 0.3, (0.9, 0.1, 0.1), 0.8),
            "leaf": ([(0.1, -0.2, 2.3), (0.3, -0.3, 2.3)], 0.12, (0.2, 0.6, 0.1), 0.9),
            "glass": ([(0.5, 0.3, 1.8), (0.5, 0.0, 1.8)], 0.25, (0.5, 0.7, 0.8), 0.5),
            "wall": ([(x, y, 4.0) for y, x in wall.tolist()], 0.5, _wallpaper(rows, columns), 0.7),
        }
        self.inputs: dict[str, torch.Tensor] = {}
        self.bounds: dict[str, tuple[float, float]] = {}
        for name, (_, _, colour, opacity) in objects.items():
            self.inputs[f"{name}.colour"] = torch.as_tensor(colour)
            self.inputs[f"{name}.opacity"] = torch.tensor(opacity)
            self.bounds |= {f"{name}.colour": (0.0, math.inf), f"{name}.opacity": (0.0, 1.0)}

        self.counts = {name: len(centres) for name, (centres, *_) in objects.items()}
        centres = torch.tensor([centre for centres, *_ in objects.values() for centre in centres])
        radii = torch.tensor([radius for centres, radius, *_ in objects.values() for _ in centres])
        self.nearest_first = centres[:, 2].argsort(stable=True)
        self.footprints = _footprints(centres, radii, size)[self.nearest_first]

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int | None) -> torch.Tensor:
        """Return an ``(H, W, 3)`` image, which does not depend on the seed or the samples."""
        values = {**self.inputs, **inputs}
        colours = [values[f"{name}.colour"].reshape(-1, 3).expand(n, 3) for name, n in self.counts.items()]
        opacities = [values[f"{name}.opacity"].expand(n) for name, n in self.counts.items()]
        alphas = torch.cat(opacities)[self.nearest_first, None, None] * self.footprints
        transmittance = torch.cumprod(1 - alphas, 0)
        transmittance = torch.cat([torch.ones_like(transmittance[:1]), transmittance[:-1]])
        return torch.einsum("nhw,nc->hwc", transmittance * alphas, torch.cat(colours)[self.nearest_first])


def _wallpaper(rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Return a colour for each Gaussian of the wall, ``(4, 6, 3)``: blue at the top, and warmer on the left."""
    warmth, height = torch.sigmoid(-columns).expand(len(rows), -1), -rows[:, None].expand(-1, len(columns))
    return torch.stack([0.1 + 0.5 * warmth, 0.3 + 0.1 * warmth, 0.5 + 0.1 * height], -1)


def _footprints(centres: torch.Tensor, radii: torch.Tensor, size: int) -> torch.Tensor:
    """Return the footprint of each Gaussian in the pixels, ``(N, H, W)``: 1 at its centre."""
    across = (torch.arange(size) + 0.5) / size * 2 - 1
    x, y = (centres[:, :2] / centres[:, 2:]).mul(2).T[..., None]
    width = (2 * radii / centres[:, 2])[:, None]
    right, down = (torch.exp(-(((across - middle) / width) ** 2) / 2) for middle in (x, y))
    return down[:, :, None] * right[:, None, :]


def redness(image: torch.Tensor) -> torch.Tensor:
    """Return the excess of red over the mean of green and blue, averaged over the image."""
    return image[..., 0].mean() - image[..., 1:].mean()


def main() -> None:
    renderer = SplatRenderer()
    print("Change of the redness per unit of each parameter:\n")
    print(VanillaSceneGradient(renderer, redness).attribute())
    print("\nCompared with an empty, black image, contributions to the redness:\n")
    print(IntegratedGradientsScene(renderer, redness).attribute())


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()  # --help
    main()
