"""Weighted means of independent images, at which the jackknife evaluates a metric."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch

from ._metric import TargetedMetric


def weighted_mean(images: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return a weighted mean that is exact for equal images, and never below their minimum despite rounding."""
    first = images[0]
    return (first + torch.einsum("r,r...->...", weights.to(images), images - first)).clamp_min(images.amin(0))


def evaluate_at_means(
    metric: TargetedMetric, images: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the metric's values and adjoints at the weighted mean of the images for each row of weights."""
    values, adjoints = zip(
        *(metric.value_and_adjoint(weighted_mean(images, row)) for row in weights), strict=True
    )
    return torch.tensor(values, dtype=torch.float64), torch.stack(adjoints)


def second_order(stepped: torch.Tensor, centre: torch.Tensor | float, step: float) -> torch.Tensor:
    """Return the second-order effect of the noise of the mean image, from steps of ``step`` times that noise."""
    count = len(stepped)
    return (stepped.mean(0) - centre) / (step**2 * (count - 1) / count)


def deviations_of_mean(values: torch.Tensor) -> torch.Tensor:
    """Return the deviations from the mean, scaled so that their norm is the standard deviation."""
    return (values - values.mean()) / math.sqrt(len(values) - 1)


def steps(fractions: torch.Tensor) -> tuple[torch.Tensor, float, torch.Tensor]:
    """Return the changes of the weights for a step of 1, the step, and what turns steps into deviations."""
    roots = fractions.sqrt()
    directions, step = orthogonal_directions(tuple(roots.tolist()))
    return roots * directions, step, (directions / roots).T


@lru_cache(maxsize=64)
def orthogonal_directions(roots: tuple[float, ...]) -> tuple[torch.Tensor, float]:
    """Return ``V``, ``(n, n)`` with ``VᵀV = 1 − s sᵀ`` and rows that sum to 0, and the step ``t``.

    ``t`` is the largest step for which no element of ``s ± t·v`` is negative, for any row. If all elements of
    ``s`` are equal, the cyclic shifts of any sequence with a flat spectrum (except for the mean) are a solution; a
    reflection maps them to any other ``s``. Takes the best of many sequences with random phases.
    """
    count = len(roots)
    random = np.random.default_rng(0)
    tries = min(200, 1 + 10**6 // count**2)  # limits memory; many replicates need few tries
    spectra = np.exp(2j * np.pi * random.uniform(size=(tries, count // 2 + 1)))
    spectra[:, 0] = 0
    if count % 2 == 0:
        spectra[:, -1] = np.sign(spectra[:, -1].real)
    shifts = (np.arange(count) - np.arange(count)[:, None]) % count
    directions = np.fft.irfft(spectra, count)[:, shifts] @ _reflection(np.array(roots))
    steps = (roots / np.abs(directions).max(1)).min(1)
    best = steps.argmax()
    return torch.from_numpy(directions[best]), float(steps[best])


def _reflection(direction: np.ndarray) -> np.ndarray:
    """Return the Householder reflection that maps the unit vector with equal elements to ``direction``."""
    normal = len(direction) ** -0.5 - direction
    square = normal @ normal
    identity: np.ndarray = np.eye(len(direction))
    return identity if square < 1e-24 else identity - 2 / square * np.outer(normal, normal)
