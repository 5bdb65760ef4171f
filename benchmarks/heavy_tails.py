"""Measure the errors of the mean and the median over replicates for heavy-tailed samples.

Many results of eight replicates are computed from samples with a known mean: normal, skewed, and rare bright ones;
and from a mirror ball beside a small bright lamp, compared with many more samples of the same scene.

    python benchmarks/heavy_tails.py [--runs 2000] [--rendered 64] [--write docs/extremes.md]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, activate
from scenecaptum.attr._data import covariances

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from _pages import replace_table
from extremes.scenes import mean, rgb, room

REPLICATES = 8
COLUMNS = (
    "samples",
    "per replicate",
    "RMS error of the mean",
    "RMS error of the median",
    "bias of the median",
    "95 % coverage of the mean",
    "95 % coverage of the median",
    "`?` shown",
)


def lognormal(sigma: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    """Return a sampler of mean 1 whose logarithm has this standard deviation."""
    return lambda rng, count: np.exp(sigma * rng.standard_normal(count) - sigma**2 / 2)


def pareto(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return samples of mean 1 whose variance is infinite: the tail falls as x^−1.5."""
    return (1 + rng.pareto(1.5, count)) / 3


def fireflies(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return samples of mean 1, half of which comes from one sample in a thousand."""
    return 0.5 + 500 * (rng.random(count) < 1e-3)


CASES: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "normal, σ = 1": lambda rng, count: 1 + rng.standard_normal(count),
    "log-normal, σ = 1": lognormal(1.0),
    "log-normal, σ = 2": lognormal(2.0),
    "Pareto, α = 1.5": pareto,
    "half the light in one of 1000": fireflies,
}


def result(rows: np.ndarray) -> SceneAttribution:
    """Return a result with one parameter from its replicates."""
    replicates = {"x": torch.from_numpy(rows)[:, None]}
    covariance = covariances(replicates, None)
    return SceneAttribution(
        attributions={"x": replicates["x"].mean(0)},
        standard_error={"x": covariance["x"].diagonal().sqrt()},
        metric_value=0.0,
        replicates=replicates,
        covariance=covariance,
        info={"replicates": REPLICATES, "degrees_of_freedom": REPLICATES - 1},
    )


def simulated(runs: int) -> Iterator[tuple[str, int, list[SceneAttribution], str, float]]:
    """Yield for each case its title, samples per replicate, results, the parameter's name, and the true value."""
    rng = np.random.default_rng(0)
    for name, draw in CASES.items():
        for count in (8, 128, 2048):
            rows = (draw(rng, REPLICATES * count).reshape(REPLICATES, count).mean(1) for _ in range(runs))
            yield name, count, [result(values) for values in rows], "x", 1.0


def rendered(runs: int) -> Iterator[tuple[str, int, list[SceneAttribution], str, float]]:
    """Yield the same for a mirror ball that reflects a small, bright lamp onto a floor."""
    mi = activate()
    name = "ball.bsdf.specular_reflectance.value"
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.8)}
    scene = room(mi, lamp=1000.0, ball=mirror)
    scene["lamp"]["radius"] = 0.1
    method = VanillaSceneGradient(SceneRenderer(scene, inputs=name), mean)
    truth = np.mean([method.attribute(seed=10_000 + k, spp=2**17)[name].sum().item() for k in range(4)])
    for spp in (64, 1024):
        found = [method.attribute(seed=seed, spp=spp) for seed in range(runs)]
        yield "mirror ball, small lamp, floor", spp // REPLICATES, found, name, float(truth)


def row(case: str, count: int, found: list[SceneAttribution], name: str, truth: float) -> list[str]:
    """Return a line of the table."""
    medians = [attribution.median_of_means() for attribution in found]
    deviations = [
        np.array([attribution[name].sum().item() for attribution in estimates]) / truth - 1
        for estimates in (found, medians)
    ]
    coverage = [
        np.mean([_covers(attribution, name, truth) for attribution in estimates])
        for estimates in (found, medians)
    ]
    errors = [f"{100 * math.sqrt(np.mean(values**2)):.3g} %" for values in deviations]
    bias, bias_error = 100 * deviations[1].mean(), 100 * deviations[1].std() / math.sqrt(len(found))
    marked = np.mean([name in attribution.untrusted_errors() for attribution in found])
    return [
        case,
        str(count),
        *errors,
        f"{bias:+.2g} ± {bias_error if bias_error > 1e-3 else 0:.1g} %",
        *(f"{100 * share:.0f} %" for share in coverage),
        f"{100 * marked:.3g} %",
    ]


def _covers(attribution: SceneAttribution, name: str, truth: float) -> bool:
    """Return whether the 95 % interval of a parameter contains the true value."""
    from scenecaptum.estimation import student_t

    error = attribution.covariance[name].sum().sqrt().item()  # type: ignore[index]
    half_width = student_t(0.95, attribution.info["degrees_of_freedom"]) * error
    return abs(attribution[name].sum().item() - truth) <= half_width


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2000, help="results of each distribution")
    parser.add_argument("--rendered", type=int, default=64, help="rendered results, or 0")
    parser.add_argument("--write", type=Path, help="replace the table in this page")
    options = parser.parse_args()
    lines: list[list[str]] = [list(COLUMNS)]
    for case in (*simulated(options.runs), *(rendered(options.rendered) if options.rendered else ())):
        lines.append(row(*case))
        print("  ".join(f"{cell:>14s}" for cell in lines[-1]), flush=True)
    if options.write:
        replace_table(options.write, "heavy-tails", lines)


if __name__ == "__main__":
    main()
