"""How much less our backward pass costs than stock prb's at equal error.

The gain is (variance × time of ``prb``) / (variance × time of ours), for the derivative of one fixed metric with
respect to the parameters for which ``prb`` is right. Both sides propagate the same adjoint image, that of a
converged render, with the same number of samples, taking turns in one process; the gain of the parameters is
pooled as the geometric mean over all their elements, and its interval is a bootstrap over the repeats.

    python benchmarks/variance.py [--repeats 100] [--spp 16] [--scene GLOB] [--metric GLOB]
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch

from scenecaptum import SceneRenderer, activate, metrics
from scenecaptum.scene.bundled import BUNDLED

RESOLUTION, DEPTH = (64, 36), 6
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
BOOTSTRAPS = 2000
ROUGHNESS = 0.05

# Where stock prb agrees with finite differences (docs/derivatives.md).
RIGHT = {
    "SmoothDiffuse": ("reflectance",),
    "RoughConductor": ("alpha", "alpha_u", "alpha_v", "specular_reflectance", "eta", "k"),
    "RoughPlastic": ("diffuse_reflectance", "specular_reflectance"),
    "AreaLight": ("radiance",),
    "ConstantBackgroundEmitter": ("radiance",),
    "DirectionalEmitter": ("irradiance",),
}


@dataclass
class Case:
    """A scene, what is differentiated in it, and at which values."""

    name: str
    ours: SceneRenderer
    stock: Any
    values: dict[str, torch.Tensor]


def mean_luminance(image: torch.Tensor) -> torch.Tensor:
    return metrics.MeanLuminance()(image)


def glare(image: torch.Tensor, threshold_factor: float = 5.0) -> torch.Tensor:
    """Return a glare rating: 8 log₁₀(0.25/L_b Σ L² ω), over pixels brighter than a multiple of the mean."""
    luminance = image @ image.new_tensor([0.2126, 0.7152, 0.0722])
    threshold = threshold_factor * luminance.mean().detach()
    source = torch.sigmoid((luminance / threshold - 1) / 0.1)
    background = ((1 - source) * luminance).sum() / (1 - source).sum()
    return 8 * torch.log10(0.25 / background * (source * luminance**2).mean() + 1e-6)


class Logit(torch.nn.Module):
    """One output of a small convolutional network with random weights, on the tone-mapped picture."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.layers = torch.nn.Sequential(
                torch.nn.Conv2d(3, 16, 5, stride=2),
                torch.nn.ReLU(),
                torch.nn.Conv2d(16, 32, 5, stride=2),
                torch.nn.ReLU(),
                torch.nn.Flatten(),
                torch.nn.LazyLinear(10),
            )
            self.layers(torch.zeros(1, 3, RESOLUTION[1], RESOLUTION[0]))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the logit of an ``(H, W, 3)`` image."""
        shown = (image.clamp_min(1e-4) ** (1 / 2.2)).clamp_max(1)
        logits: torch.Tensor = self.layers(shown.permute(2, 0, 1)[None])
        return logits[0, 3]


METRICS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "mean luminance": mean_luminance,
    "glare rating": glare,
    "network logit": Logit(),
}


def cases(rough: bool) -> Iterator[Case]:
    """Load each scene for both sides."""
    mi = activate()
    width, height = RESOLUTION
    box = BUNDLED["cornell-box"]()
    if rough:
        box["tall_box"] = {
            "type": "roughconductor",
            "material": "Al",
            "distribution": "ggx",
            "alpha": ROUGHNESS,
        }
    box["sensor"]["film"] |= {"width": width, "height": height}
    yield _case("Cornell box", box, mi.load_dict(box, optimize=False), rough)
    for room in ("living-room", "dining-room"):
        path = SCENES / room / "scene.xml"
        if not path.is_file():
            print(f"{room}: skipped, {path} does not exist")
            continue
        stock = mi.load_file(str(path), optimize=False, resx=width, resy=height, texture_format="variant")
        yield _case(room, path, stock, rough)


def _case(name: str, scene: Any, stock: Any, rough: bool) -> Case:
    whole = SceneRenderer(scene, "all", resolution=RESOLUTION, max_depth=DEPTH)
    table = whole.parameters_table()
    names = [
        n
        for n in whole.inputs
        if table[n].role in RIGHT.get(table[n].plugin, ()) and not table[n].is_texture
        # At 0 stock prb loses the indirect part.
        if rough or bool((whole.inputs[n] != 0).all())
        if not rough or table[n].kind == "roughness"
    ]
    ours = SceneRenderer(scene, names, resolution=RESOLUTION, max_depth=DEPTH)
    values = {n: torch.full_like(v, ROUGHNESS) if rough else v for n, v in ours.inputs.items()}
    return Case(name, ours, stock, values)


Backward = Callable[[torch.Tensor, int, int], tuple[torch.Tensor, float]]


def stock_backward(case: Case) -> Backward:
    """Return stock prb's backward pass: gradients and seconds from adjoint, seed and samples."""
    mi = activate()
    import drjit as dr

    integrator = mi.load_dict({"type": "prb", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
    params = mi.traverse(case.stock)
    params.keep(list(case.values))
    for name, value in case.values.items():
        kind, flat = type(params[name]), mi.Float(value.flatten())
        params[name] = dr.unravel(kind, flat) if dr.depth_v(kind) > 1 else kind(flat)
    params.update()

    def backward(adjoint: torch.Tensor, seed: int, spp: int) -> tuple[torch.Tensor, float]:
        for name in case.values:
            dr.enable_grad(params[name])
        params.update()
        start = time.perf_counter()
        integrator.render_backward(case.stock, params, mi.TensorXf(adjoint), 0, seed=seed, spp=spp)
        gradient = torch.cat([mi.Float(dr.ravel(dr.grad(params[name]))).torch() for name in case.values])
        seconds = time.perf_counter() - start
        for name in case.values:
            # Another scene's tracked parameters would be differentiated along.
            params[name] = dr.detach(params[name])
        params.update()
        return gradient, seconds

    return backward


def our_backward(case: Case) -> Backward:
    """Return our backward pass, called as any user of torch would."""

    def backward(adjoint: torch.Tensor, seed: int, spp: int) -> tuple[torch.Tensor, float]:
        leaves = {name: value.clone().requires_grad_() for name, value in case.values.items()}
        image = case.ours(leaves, seed=seed + 1, seed_grad=seed, spp=spp)
        start = time.perf_counter()
        image.backward(adjoint)
        seconds = time.perf_counter() - start
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]), seconds

    return backward


def converged_adjoint(case: Case, metric: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    with torch.no_grad():
        image = torch.stack([case.ours(case.values, seed=10**6 + k, spp=256) for k in range(4)]).mean(0)
    image.requires_grad_()
    metric(image).backward()
    assert image.grad is not None
    return image.grad


def compare(case: Case, metric: Callable[[torch.Tensor], torch.Tensor], repeats: int, spp: int) -> None:
    """Print the gain and what it is made of."""
    adjoint = converged_adjoint(case, metric)
    sides = {"prb": stock_backward(case), "ours": our_backward(case)}
    samples: dict[str, list[torch.Tensor]] = {side: [] for side in sides}
    seconds: dict[str, list[float]] = {side: [] for side in sides}
    for repeat in range(-2, repeats):  # two to compile and to record
        for side, backward in sides.items():
            gradient, took = backward(adjoint, 2 * repeat + 10, spp)
            if repeat >= 0:
                samples[side].append(gradient.double())
                seconds[side].append(took)
    prb, ours = (torch.stack(samples[side]) for side in ("prb", "ours"))
    reached = (prb.var(0) > 0) & (ours.var(0) > 0)
    ratio = statistics.median(seconds["prb"]) / statistics.median(seconds["ours"])
    low, middle, high = _bootstrap(prb[:, reached], ours[:, reached])
    z = (prb.mean(0) - ours.mean(0)) / ((prb.var(0) + ours.var(0)) / repeats).sqrt()
    print(
        f"  {spp:4d} spp  gain {middle * ratio:6.2f} [{low * ratio:.2f}, {high * ratio:.2f}]"
        f"   variance {middle:.2f} [{low:.2f}, {high:.2f}] × time {ratio:.2f}"
        f"   ({int(reached.sum())} numbers, largest |z| {z[reached].abs().max():.1f},"
        f" prb {statistics.median(seconds['prb']):.3f} s)",
        flush=True,
    )


def _bootstrap(prb: torch.Tensor, ours: torch.Tensor) -> tuple[float, float, float]:
    """Return the 95 % interval and median of the geometric mean of variance ratios."""
    generator = torch.Generator().manual_seed(0)
    pooled = []
    for _ in range(BOOTSTRAPS):
        first, second = (
            side[torch.randint(len(side), (len(side),), generator=generator)].var(0) for side in (prb, ours)
        )
        known = (first > 0) & (second > 0)
        pooled.append((first[known] / second[known]).log().mean().exp())
    low, middle, high = torch.stack(pooled).quantile(torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64))
    return low.item(), middle.item(), high.item()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--spp", type=int, nargs="+", default=[16])
    parser.add_argument("--scene", default="*", help="glob over the names of the scenes")
    parser.add_argument("--metric", default="*", help='glob over the metrics, "roughness" being one')
    arguments = parser.parse_args()
    print(
        f"{RESOLUTION[0]}×{RESOLUTION[1]}, depth {DEPTH}, {arguments.repeats} repeats; 95 % bootstrap intervals"
    )
    for rough in (False, True):
        chosen = {f"roughness {ROUGHNESS}, mean luminance": mean_luminance} if rough else METRICS
        chosen = {name: metric for name, metric in chosen.items() if fnmatch(name, arguments.metric)}
        if not chosen:
            continue
        for case in cases(rough):
            if not fnmatch(case.name, arguments.scene):
                continue
            for name, metric in chosen.items():
                print(f"{case.name}, {name}")
                for spp in arguments.spp:
                    compare(case, metric, arguments.repeats, spp)


if __name__ == "__main__":
    main()
