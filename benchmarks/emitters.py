"""Compare the noise of derivatives with respect to lights with differences of ±20 % with common random numbers.

The image is linear in the brightness of each light, so such a difference is exact. Both use the same adjoint
image, that of a converged render, and each side of the difference has as many samples as our backward pass. The
script prints for each light: the derivative with respect to its brightness (a radiance or a texture is scaled as a
whole), standard deviations over the repeats, and the ratio of variances with a 95 % interval (bootstrap over the
repeats). Below 1, our derivative is less noisy.

    python benchmarks/emitters.py [--repeats 32] [--spp 16] [--scene GLOB] [--metric GLOB] [--inputs emitters|all]
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import torch
from _hall import hall

from scenecaptum import SceneRenderer, activate, metrics

RESOLUTION, DEPTH = (48, 27), 6
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
ROOMS = ("classroom", "kitchen", "living-room", "hall", "office")
BRIGHTNESS = ("radiance", "intensity", "irradiance", "data", "scale", "sky_scale", "sun_scale")
STEP = 0.2  # relative change, to both sides
CONVERGED = 512  # samples per pixel
BOOTSTRAPS = 2000


def rooms(pattern: str) -> Iterator[tuple[str, object]]:
    """Yield the available rooms by name."""
    activate()
    for name in ROOMS:
        path = SCENES / name / "scene.xml"
        if not fnmatch(name, pattern):
            continue
        if name == "hall":
            yield name, hall()
        elif name == "office" or path.is_file():
            yield name, name if name == "office" else path
        else:
            print(f"{name}: skipped, {path} does not exist")


def lights(renderer: SceneRenderer) -> list[str]:
    """Return the inputs in which the image is linear."""
    table = renderer.parameters_table()
    return [n for n in renderer.inputs if table[n].kind == "emitters" and table[n].role in BRIGHTNESS]


def adjoint_of(renderer: SceneRenderer, metric: torch.nn.Module) -> torch.Tensor:
    with torch.no_grad():
        parts = [renderer(renderer.inputs, seed=9000 + k, spp=CONVERGED // 8) for k in range(8)]
    image = torch.stack(parts).mean(0).requires_grad_()
    (adjoint,) = torch.autograd.grad(metric(image), image)
    return adjoint


def ours(
    renderer: SceneRenderer, names: list[str], adjoint: torch.Tensor, seed: int, spp: int
) -> torch.Tensor:
    leaves = renderer.leaves()
    renderer(leaves, seed=seed, seed_grad=10_000 + seed, spp=1, spp_grad=spp).backward(adjoint)
    return torch.stack([(leaves[name].grad * leaves[name].detach()).sum() for name in names])


def difference(
    renderer: SceneRenderer, names: list[str], adjoint: torch.Tensor, seed: int, spp: int
) -> torch.Tensor:
    def moved(name: str, factor: float) -> torch.Tensor:
        with torch.no_grad():
            image = renderer({name: factor * renderer.inputs[name]}, seed=20_000 + seed, spp=spp)
        return (adjoint.double() * image).sum()

    return torch.stack([(moved(n, 1 + STEP) - moved(n, 1 - STEP)) / (2 * STEP) for n in names])


def interval(mine: torch.Tensor, theirs: torch.Tensor) -> tuple[float, float]:
    """Return a 95 % bootstrap interval of the ratio of variances of two ``(repeats,)`` samples."""
    generator = torch.Generator().manual_seed(0)

    def variances(draws: torch.Tensor) -> torch.Tensor:
        index = torch.randint(len(draws), (BOOTSTRAPS, len(draws)), generator=generator)
        return draws[index].var(1)

    low, high = (variances(mine) / variances(theirs)).quantile(torch.tensor([0.025, 0.975], dtype=mine.dtype))
    return low.item(), high.item()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=32)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--scene", default="*")
    parser.add_argument("--metric", default="*")
    parser.add_argument("--inputs", default="emitters")
    options = parser.parse_args()
    width, height = RESOLUTION
    print(f"{width}×{height}, depth {DEPTH}, {options.spp} spp, {options.repeats} repeats, {options.inputs}")
    for name, scene in rooms(options.scene):
        renderer = SceneRenderer(scene, options.inputs, resolution=RESOLUTION, max_depth=DEPTH)
        rated = {
            "mean luminance": metrics.MeanLuminance(),
            "UGR": metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5.0),
        }
        names = lights(renderer)
        for title, metric in rated.items():
            if not fnmatch(title, options.metric):
                continue
            adjoint = adjoint_of(renderer, metric)
            print(f"{name}, {title}")
            mine, theirs = (
                torch.stack([side(renderer, names, adjoint, k, options.spp) for k in range(options.repeats)])
                .double()
                .T
                for side in (ours, difference)
            )
            for light, a, b in zip(names, mine, theirs, strict=True):
                low, high = interval(a, b)
                print(
                    f"  {renderer.labels[light]:28s} ours {a.mean():+.4g}, σ {a.std():.2g};"
                    f" difference {b.mean():+.4g}, σ {b.std():.2g};"
                    f" ratio of variances {a.var() / b.var():.3g} ({low:.2g} to {high:.2g})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
