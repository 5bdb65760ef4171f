"""Measure the coverage of an attribution's error bars, with and without jackknife pseudo-values of the adjoint.

On a small Cornell box, for a linear and two non-linear metrics, many independent attributions are compared with a
reference of far more samples. Each attribution is computed twice from the same images: each backward pass gets
either the jackknife's pseudo-value of the adjoint, as in the library, or the adjoint at the mean of the other
images.

    python benchmarks/error_bars.py [--repeats 100]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch

from scenecaptum import SceneRenderer, metrics
from scenecaptum.estimation import Budget, TargetedMetric, covariance_of_mean, jackknife, student_t

REPLICATES, SPP = 8, 64
Image = torch.Tensor


def metric_of(name: str) -> Callable[[Image], torch.Tensor]:
    mean = metrics.MeanLuminance()
    return {
        "mean luminance": mean,
        "log of mean luminance": lambda image: mean(image).log(),
        "share of pixels over 0.15": lambda image: torch.sigmoid(
            (metrics.luminance(image) - 0.15) / 0.05
        ).mean(),
    }[name]


def replicate_gradients(
    renderer: SceneRenderer, metric: TargetedMetric, spp: int, seed: int, leaves: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Return ``(replicates, parameters)`` gradients for both kinds of adjoint."""
    budget = Budget.split(spp, REPLICATES, seed)
    images = [
        renderer(leaves, seed=a, seed_grad=b, spp=budget.spp[0])
        for a, b in zip(budget.seeds[0], budget.gradient_seeds[0], strict=True)
    ]
    detached = [image.detach() for image in images]
    total = torch.stack(detached).sum(0)
    adjoints_by_kind = {
        "pseudo-values": jackknife(metric, detached).per_replicate,
        "leave-one-out": [
            metric.value_and_adjoint((total - image) / (REPLICATES - 1))[1] for image in detached
        ],
    }

    def gradient(image: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        parts = torch.autograd.grad(image, list(leaves.values()), adjoint, retain_graph=True)
        return torch.cat([part.flatten() for part in parts])

    return {
        kind: torch.stack([gradient(image, adjoint) for image, adjoint in zip(images, adjoints, strict=True)])
        for kind, adjoints in adjoints_by_kind.items()
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
    width = student_t(0.95, REPLICATES - 1)
    print(
        f"Cornell box 16×16, {SPP} spp in {REPLICATES} replicates, {repeats} repeats, "
        "95 % intervals of every channel"
    )
    for name in ("mean luminance", "log of mean luminance", "share of pixels over 0.15"):
        metric = TargetedMetric(metric_of(name))
        truth = replicate_gradients(renderer, metric, 8192, 10**6, leaves)["pseudo-values"].mean(0)
        found: dict[str, list[torch.Tensor]] = {}
        for seed in range(repeats):
            for kind, gradients in replicate_gradients(renderer, metric, SPP, seed, leaves).items():
                error = covariance_of_mean(gradients).diagonal().sqrt()
                # A reflectance without effect (the far side of the lamp) has neither value nor error.
                live = truth != 0
                covered = ((gradients.mean(0) - truth).abs() <= width * error)[live]
                found.setdefault(kind, []).append(covered.float().mean())
        for kind, shares in found.items():
            print(f"{name:26s} {kind}: {torch.stack(shares).mean().item():6.1%} cover the reference")


if __name__ == "__main__":
    main()
