"""Measure the efficiency of our backward pass relative to stock prb.

The gain is (variance × time of ``prb``) / (variance × time of ours), for the derivative of one fixed metric with
respect to the parameters for which ``prb`` is correct. Both sides propagate the same adjoint image, that of a
converged render, with the same number of samples. They take turns in one process, with several repeats each, and
reload the scene for every turn: a second loaded scene slows down the first, because Dr.Jit traces them together.
The gain is the geometric mean over all elements of the parameters, with a bootstrap interval over the repeats.

    python benchmarks/variance.py [--repeats 100] [--spp 16] [--scene GLOB] [--metric GLOB]

``--lobes REVISION`` compares with an earlier version of this package instead, on a grid of low roughnesses: see
``_lobes.py``. There the gain is that of this version over the earlier one.

    python benchmarks/variance.py --lobes REVISION [--cells 'ball/metal/*'] [--write docs/performance.md]
"""

from __future__ import annotations

import argparse
import gc
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch
from _lobes import HEADINGS
from _lobes import compare as compare_lobes
from _pages import replace_table

from scenecaptum import SceneRenderer, activate, metrics
from scenecaptum.scene.bundled import BUNDLED

RESOLUTION, DEPTH = (64, 36), 6
SCENES = Path(os.environ.get("SCENECAPTUM_SCENES", Path(__file__).parents[2] / "shared" / "scenes"))
BOOTSTRAPS = 2000
TURNS = 4
ROUGHNESS = 0.05

# Parameters for which stock prb agrees with finite differences (docs/derivatives.md).
RIGHT = {
    "SmoothDiffuse": ("reflectance",),
    "RoughConductor": ("alpha", "alpha_u", "alpha_v", "specular_reflectance", "eta", "k"),
    "RoughPlastic": ("diffuse_reflectance", "specular_reflectance"),
    "AreaLight": ("radiance",),
    "ConstantBackgroundEmitter": ("radiance",),
    "DirectionalEmitter": ("irradiance",),
}


Scene = Any  # a path or a Mitsuba dict


@dataclass
class Case:
    """A scene, and the parameter values at which it is differentiated."""

    name: str
    scene: Scene
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
    """One output of a small convolutional network with random weights, on the tone-mapped image."""

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


Metric = Callable[[torch.Tensor], torch.Tensor]

METRICS: dict[str, Metric] = {
    "mean luminance": mean_luminance,
    "glare rating": glare,
    "network logit": Logit(),
}


def scenes(rough: bool) -> Iterator[tuple[str, Scene]]:
    """Name the scenes that are there; with ``rough``, the box gets something that has a roughness."""
    activate()
    box = BUNDLED["cornell-box"]()
    if rough:
        metal = {"type": "roughconductor", "material": "Al", "distribution": "ggx", "alpha": ROUGHNESS}
        box["tall_box"] = metal
    box["sensor"]["film"] |= dict(zip(("width", "height"), RESOLUTION, strict=True))
    yield "Cornell box", box
    for room in ("living-room", "dining-room"):
        path = SCENES / room / "scene.xml"
        if path.is_file():
            yield room, path
        else:
            print(f"{room}: skipped, {path} does not exist")


def make_case(name: str, scene: Scene, rough: bool) -> Case:
    """Select the parameters for which stock prb is correct, or the roughnesses, all set to 0.05."""
    whole = SceneRenderer(scene, "all", resolution=RESOLUTION, max_depth=DEPTH)
    table = whole.parameters_table()
    right = {
        n: value
        for n, value in whole.inputs.items()
        if table[n].role in RIGHT.get(table[n].plugin, ()) and not table[n].is_texture
    }
    if rough:
        values = {n: torch.full_like(v, ROUGHNESS) for n, v in right.items() if table[n].kind == "roughness"}
    else:
        # At 0, stock prb misses the indirect part.
        values = {n: v for n, v in right.items() if bool((v != 0).all())}
    return Case(name, scene, values)


Backward = Callable[[torch.Tensor, int, int], tuple[torch.Tensor, float]]


def stock_backward(case: Case) -> Backward:
    """Return stock prb's backward pass, from adjoint, seed and samples to gradients and seconds."""
    mi = activate()
    import drjit as dr

    if isinstance(case.scene, Path):
        width, height = RESOLUTION
        scene = mi.load_file(
            str(case.scene), optimize=False, resx=width, resy=height, texture_format="variant"
        )
    else:
        scene = mi.load_dict(case.scene, optimize=False)
    integrator = mi.load_dict({"type": "prb", "max_depth": DEPTH, "rr_depth": DEPTH + 1})
    params = mi.traverse(scene)
    params.keep(list(case.values))
    for name, value in case.values.items():
        kind, flat = type(params[name]), mi.Float(value.flatten())
        params[name] = dr.unravel(kind, flat) if dr.depth_v(kind) > 1 else kind(flat)
        dr.enable_grad(params[name])
    params.update()

    def backward(adjoint: torch.Tensor, seed: int, spp: int) -> tuple[torch.Tensor, float]:
        start = time.perf_counter()
        for name in case.values:
            dr.clear_grad(params[name])
        integrator.render_backward(scene, params, mi.TensorXf(adjoint), 0, seed=seed, spp=spp)
        gradient = torch.cat([mi.Float(dr.ravel(dr.grad(params[name]))).torch() for name in case.values])
        return gradient, time.perf_counter() - start

    return backward


def our_backward(case: Case) -> Backward:
    """Return our backward pass, called through torch."""
    renderer = SceneRenderer(case.scene, list(case.values), resolution=RESOLUTION, max_depth=DEPTH)

    def backward(adjoint: torch.Tensor, seed: int, spp: int) -> tuple[torch.Tensor, float]:
        leaves = {name: value.clone().requires_grad_() for name, value in case.values.items()}
        image = renderer(leaves, seed=seed + 1, seed_grad=seed, spp=spp)
        start = time.perf_counter()
        image.backward(adjoint)
        gradient = torch.cat([leaf.grad.flatten() for leaf in leaves.values()])
        return gradient, time.perf_counter() - start

    return backward


SIDES: dict[str, Callable[[Case], Backward]] = {"prb": stock_backward, "ours": our_backward}


def adjoints(case: Case, chosen: Sequence[Metric]) -> list[torch.Tensor]:
    """Return the derivative of each metric with respect to a converged picture."""
    renderer = SceneRenderer(case.scene, list(case.values), resolution=RESOLUTION, max_depth=DEPTH)
    with torch.no_grad():
        image = torch.stack([renderer(case.values, seed=10**6 + k, spp=256) for k in range(4)]).mean(0)
    image.requires_grad_()
    return [torch.autograd.grad(metric(image), image)[0] for metric in chosen]


def compare(case: Case, chosen: Mapping[str, Metric], repeats: int, spps: Sequence[int]) -> None:
    """Print the gains with their factors."""
    runs = [
        (name, adjoint, spp)
        for name, adjoint in zip(chosen, adjoints(case, list(chosen.values())), strict=True)
        for spp in spps
    ]
    samples: dict[tuple[int, str], list[torch.Tensor]] = defaultdict(list)
    seconds: dict[tuple[int, str], list[float]] = defaultdict(list)
    for turn in range(TURNS):
        for side, start in SIDES.items():
            gc.collect()  # frees the other side's scene
            backward = start(case)
            for run, (_, adjoint, spp) in enumerate(runs):
                for _ in range(2):  # warm-up: compile and record the kernels
                    backward(adjoint, 1, spp)
                for repeat in range(turn * repeats // TURNS, (turn + 1) * repeats // TURNS):
                    gradient, elapsed = backward(adjoint, 2 * repeat + 10, spp)
                    samples[run, side].append(gradient.double())
                    seconds[run, side].append(elapsed)
            del backward
    for run, (name, _, spp) in enumerate(runs):
        prb, ours = (torch.stack(samples[run, side]) for side in SIDES)
        times = [statistics.median(seconds[run, side]) for side in SIDES]
        print(f"{case.name}, {name}, {spp} spp\n  {result(prb, ours, *times)}", flush=True)


def result(prb: torch.Tensor, ours: torch.Tensor, prb_seconds: float, our_seconds: float) -> str:
    """Format the gain, given gradients of shape ``(repeats, elements)``."""
    noisy = (prb.var(0) > 0) & (ours.var(0) > 0)
    low, middle, high = _bootstrap(prb[:, noisy], ours[:, noisy])
    ratio = prb_seconds / our_seconds
    z = (prb.mean(0) - ours.mean(0)) / ((prb.var(0) + ours.var(0)) / len(prb)).sqrt()
    return (
        f"gain {middle * ratio:.2f} [{low * ratio:.2f}, {high * ratio:.2f}]"
        f"  = variance {middle:.2f} [{low:.2f}, {high:.2f}] × time {ratio:.2f}"
        f"  ({int(noisy.sum())} elements, largest |z| {z[noisy].abs().max():.1f};"
        f" prb {1000 * prb_seconds:.0f} ms, ours {1000 * our_seconds:.0f} ms)"
    )


def _bootstrap(prb: torch.Tensor, ours: torch.Tensor) -> tuple[float, float, float]:
    """Return the 95 % interval and median of the geometric mean of variance ratios."""
    generator = torch.Generator().manual_seed(0)
    pooled = []
    for _ in range(BOOTSTRAPS):
        first, second = (
            side[torch.randint(len(side), (len(side),), generator=generator)].var(0) for side in (prb, ours)
        )
        positive = (first > 0) & (second > 0)
        pooled.append((first[positive] / second[positive]).log().mean().exp())
    low, middle, high = torch.stack(pooled).quantile(torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64))
    return low.item(), middle.item(), high.item()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--spp", type=int, nargs="+", default=[16])
    parser.add_argument("--scene", default="*", help="glob over the names of the scenes")
    parser.add_argument(
        "--metric", default="*", help='glob over the names of the metrics, including "roughness"'
    )
    parser.add_argument("--lobes", metavar="REVISION", help="compare low roughnesses with this git revision")
    parser.add_argument("--cells", default="*", help="glob over scene/material/α of that comparison")
    parser.add_argument("--write", type=Path, help="page whose table of that comparison is replaced")
    arguments = parser.parse_args()
    if arguments.lobes:
        rows = compare_lobes(arguments.lobes, arguments.cells, arguments.repeats, _bootstrap)
        if arguments.write:
            replace_table(arguments.write, "lobes", [HEADINGS, *rows])
        return
    print(
        f"{RESOLUTION[0]}×{RESOLUTION[1]}, depth {DEPTH}, {arguments.repeats} repeats; 95 % bootstrap intervals"
    )
    for rough in (False, True):
        chosen = {f"roughness {ROUGHNESS}, mean luminance": mean_luminance} if rough else METRICS
        chosen = {name: metric for name, metric in chosen.items() if fnmatch(name, arguments.metric)}
        for name, scene in scenes(rough):
            if chosen and fnmatch(name, arguments.scene):
                compare(make_case(name, scene, rough), chosen, arguments.repeats, arguments.spp)


if __name__ == "__main__":
    main()
