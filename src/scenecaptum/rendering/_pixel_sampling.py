"""Importance sampling of pixels: where the samples of a backward pass go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch


def sample_pixels(
    magnitude: torch.Tensor, importance_maps: Sequence[tuple[float, torch.Tensor]], samples: int, seed: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distribute a number of samples over the pixels according to ``pixel_probabilities``.

    The samples are stratified: a pixel with an expected count of ``n`` samples gets ``n``, rounded up or down at
    random. A constant adjoint with constant importance therefore loses nothing: each pixel gets equally many.

    Returns
    -------
    pixel : Tensor
        ``(samples,)`` int32: the pixel of each sample, in ascending order.
    weight : Tensor
        ``(H·W,)`` float32: the weight of a sample in each pixel; ``Σ weight·f`` estimates ``Σ f`` over pixels.
    """
    probability = pixel_probabilities(magnitude, importance_maps)
    ends = np.minimum(probability.cumsum() * samples, samples)
    ends[-1] = samples
    # Kept away from 0 and 1, where the rounding errors of the sum would move samples between neighbours.
    shift = np.random.default_rng(seed).uniform(1e-3, 1 - 1e-3)
    counts = np.diff(np.ceil(ends - shift), prepend=0).astype(np.int64)
    pixel = np.repeat(np.arange(probability.size, dtype=np.int32), counts)
    weight = (1 / (samples * probability)).astype(np.float32)
    return torch.from_numpy(pixel).to(magnitude.device), torch.from_numpy(weight).to(magnitude.device)


def pixel_probabilities(
    magnitude: torch.Tensor, importance_maps: Sequence[tuple[float, torch.Tensor]]
) -> npt.NDArray[np.float64]:
    """Return the probability of each pixel, ``(H·W,)``: a mixture of ``|∂M/∂I| · importance`` and uniform.

    ``magnitude`` is ``|∂M/∂I|``, ``(H, W)``. ``importance_maps`` are pairs of a mixture weight and a map
    ``(H, W)`` of how much the derivatives vary at each pixel. The rest is uniform, which bounds sample weights.

    References
    ----------
    Owen and Zhou, "Safe and Effective Importance Sampling", Journal of the American Statistical Association
    95(449), 2000 (such mixtures).
    """
    # NumPy, because torch's threads would wait for Dr.Jit's, and this is little work.
    adjoint = magnitude.cpu().double().numpy()
    probability, remaining = np.zeros(adjoint.size), 1.0
    for mixture_weight, importance in importance_maps:
        density = (adjoint * importance.cpu().numpy()).ravel()
        if density.any():
            probability += mixture_weight * density / density.sum()
            remaining -= mixture_weight
    return probability + remaining / adjoint.size
