"""How far mean and median of the passes are off where samples have heavy tails, and how often that is noticed.

A result of eight passes is made over and over from samples whose mean is known: normal ones, skewed ones, rare
bright ones; and from a mirror ball beside a small bright lamp, against many more samples of it.

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
from scenecaptum.attr._attribution import covariances

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from _pages import replace_table
from extremes.scenes import mean, rgb, room

PASSES = 8
COLUMNS = (
    "samples",
    "in a pass",
    "off: mean",
    "off: median",
    "bias of the median",
    "95 % holds: mean",
    "median",
    "`?` shown",
)


def lognormal(sigma: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    """Return samples of mean 1 whose logarithm has this standard deviation."""
    return lambda rng, count: np.exp(sigma * rng.standard_normal(count) - sigma**2 / 2)


def pareto(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return samples of mean 1 whose variance is infinite: the tail falls as x^−1.5."""
    return (1 + rng.pareto(1.5, count)) / 3


def fireflies(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return samples of mean 1, half of which comes from one in a thousand."""
    return 0.5 + 500 * (rng.random(count) < 1e-3)


CASES: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "normal, σ = 1": lambda rng, count: 1 + rng.standard_normal(count),
    "log-normal, σ = 1": lognormal(1.0),
    "log-normal, σ = 2": lognormal(2.0),
    "Pareto, α = 1.5": pareto,
    "half the light in one of 1000": fireflies,
}


def result(rows: np.ndarray) -> SceneAttribution:
    """Return a result of one parameter from its passes."""
    replicates = {"x": torch.from_numpy(rows)[:, None]}
    covariance = covariances(replicates, None)
    return SceneAttribution(
        attributions={"x": replicates["x"].mean(0)},
        standard_error={"x": covariance["x"].diagonal().sqrt()},
        metric_value=0.0,
        replicates=replicates,
        covariance=covariance,
        info={"passes": PASSES, "degrees_of_freedom": PASSES - 1},
    )


def simulated(runs: int) -> Iterator[tuple[str, int, list[SceneAttribution], str, float]]:
    """Yield a case at a time: what it is, its samples in a pass, its results, a name of theirs, and the truth."""
    rng = np.random.default_rng(0)
    for name, draw in CASES.items():
        for count in (8, 128, 2048):
            rows = (draw(rng, PASSES * count).reshape(PASSES, count).mean(1) for _ in range(runs))
            yield name, count, [result(one) for one in rows], "x", 1.0


def rendered(runs: int) -> Iterator[tuple[str, int, list[SceneAttribution], str, float]]:
    """Yield the same of a mirror ball that throws the light of a small, bright lamp onto a floor."""
    mi = activate()
    name = "ball.bsdf.specular_reflectance.value"
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.8)}
    scene = room(mi, lamp=1000.0, ball=mirror)
    scene["lamp"]["radius"] = 0.1
    method = VanillaSceneGradient(SceneRenderer(scene, inputs=name), mean)
    truth = np.mean([method.attribute(seed=10_000 + k, spp=2**17)[name].sum().item() for k in range(4)])
    for spp in (64, 1024):
        found = [method.attribute(seed=seed, spp=spp) for seed in range(runs)]
        yield "mirror ball, small lamp, floor", spp // PASSES, found, name, float(truth)


def row(case: str, count: int, found: list[SceneAttribution], name: str, truth: float) -> list[str]:
    """Return a line of the table."""
    medians = [one.median_of_means() for one in found]
    values = [np.array([one[name].sum().item() for one in kept]) / truth - 1 for kept in (found, medians)]
    holds = [np.mean([_holds(one, name, truth) for one in kept]) for kept in (found, medians)]
    off = [f"{100 * math.sqrt(np.mean(one**2)):.3g} %" for one in values]
    bias, error = 100 * values[1].mean(), 100 * values[1].std() / math.sqrt(len(found))
    noticed = np.mean([name in one.untrusted_errors() for one in found])
    return [
        case,
        str(count),
        *off,
        f"{bias:+.2g} ± {error if error > 1e-3 else 0:.1g} %",
        *(f"{100 * one:.0f} %" for one in holds),
        f"{100 * noticed:.3g} %",
    ]


def _holds(one: SceneAttribution, name: str, truth: float) -> bool:
    from scenecaptum.attr._student import student_t

    error = one.covariance[name].sum().sqrt().item()  # type: ignore[index]
    return abs(one[name].sum().item() - truth) <= student_t(0.95, one.info["degrees_of_freedom"]) * error


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=2000, help="results made of each distribution")
    parser.add_argument("--rendered", type=int, default=64, help="results rendered, or 0")
    parser.add_argument("--write", type=Path, help="the page whose table is replaced")
    options = parser.parse_args()
    lines: list[list[str]] = [list(COLUMNS)]
    for case in (*simulated(options.runs), *(rendered(options.rendered) if options.rendered else ())):
        lines.append(row(*case))
        print("  ".join(f"{cell:>14s}" for cell in lines[-1]), flush=True)
    if options.write:
        replace_table(options.write, "heavy-tails", lines)


if __name__ == "__main__":
    main()
