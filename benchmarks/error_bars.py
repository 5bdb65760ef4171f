"""Whether the error bars of an attribution cover the truth, and whether propagating pseudo-values matters.

On a small Cornell box, for a linear and two non-linear metrics, many independent attributions are compared with a
reference of far more samples. Each attribution is computed twice from the same images: each backward pass gets the
jackknife's pseudo-value of the adjoint (what the library does), or the adjoint at the mean of the other images.

    python benchmarks/error_bars.py [--repeats 100]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch

from scenecaptum import SceneRenderer, metrics
from scenecaptum.attr._jackknife import jackknife
from scenecaptum.attr._metric import TargetedMetric
from scenecaptum.attr._passes import Budget, covariance_of_mean
from scenecaptum.attr._student import student_t

PASSES, SPP = 8, 64
Image = torch.Tensor


def metric_of(name: str) -> Callable[[Image], torch.Tensor]:
    mean = metrics.MeanLuminance()
    return {
        "mean luminance": mean,
        "log of it": lambda image: mean(image).log(),
        "share of pixels over 0.15": lambda image: torch.sigmoid(
            (metrics.luminance(image) - 0.15) / 0.05
        ).mean(),
    }[name]


def passes(
    renderer: SceneRenderer, metric: TargetedMetric, spp: int, seed: int, leaves: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return ``(passes, parameters)`` gradients for both choices of adjoint."""
    budget = Budget.split(spp, PASSES, seed)
    images = [
        renderer(leaves, seed=a, seed_grad=b, spp=budget.spp[0])
        for a, b in zip(budget.seeds[0], budget.gradient_seeds[0], strict=True)
    ]
    detached = [image.detach() for image in images]
    total = torch.stack(detached).sum(0)
    choices = {
        "pseudo-values": jackknife(metric, detached).passes,
        "leave-one-out": [metric.value_and_adjoint((total - one) / (PASSES - 1))[1] for one in detached],
    }

    def gradient(image: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        parts = torch.autograd.grad(image, list(leaves.values()), adjoint, retain_graph=True)
        return torch.cat([part.flatten() for part in parts])

    return {
        name: torch.stack([gradient(image, one) for image, one in zip(images, adjoints, strict=True)])
        for name, adjoints in choices.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=100)
    repeats = parser.parse_args().repeats

    renderer = SceneRenderer(
        "cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=SPP, max_depth=4
    )
    leaves = renderer.leaves()
    width = student_t(0.95, PASSES - 1)
    print(
        f"Cornell box 16×16, {SPP} spp in {PASSES} passes, {repeats} repeats, 95 % intervals of every channel"
    )
    for name in ("mean luminance", "log of it", "share of pixels over 0.15"):
        metric = TargetedMetric(metric_of(name))
        truth = passes(renderer, metric, 8192, 10**6, leaves)["pseudo-values"].mean(0)
        found: dict[str, list[torch.Tensor]] = {}
        for seed in range(repeats):
            for choice, gradients in passes(renderer, metric, SPP, seed, leaves).items():
                error = covariance_of_mean(gradients).diagonal().sqrt()
                # A reflectance that cannot matter (the far side of the lamp) has neither value nor error.
                live = truth != 0
                covered = ((gradients.mean(0) - truth).abs() <= width * error)[live]
                found.setdefault(choice, []).append(covered.float().mean())
        for choice, shares in found.items():
            print(f"{name:26s} {choice}: {torch.stack(shares).mean().item():6.1%} cover the reference")


if __name__ == "__main__":
    main()
