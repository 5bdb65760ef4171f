"""Which pixels the samples of a backward pass go to, where they need not be those of the picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch


def choose_pixels(
    strength: torch.Tensor, interests: Sequence[tuple[float, torch.Tensor]], spp: int, seed: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Spread ``spp`` samples per pixel as ``sample_shares`` says.

    The samples are stratified: a pixel whose share is ``n`` samples gets ``n``, rounded up or down at random. So
    an even adjoint of even interest loses nothing, each pixel getting exactly ``spp``.

    Parameters
    ----------
    strength, interests
        As for ``sample_shares``.
    spp
        Samples per pixel on average.
    seed
        Seed of the rounding.

    Returns
    -------
    pixel : Tensor
        ``(H·W·spp,)`` int32: the pixel of each sample, in rising order.
    weight : Tensor
        ``(H·W,)`` float32: what a sample of each pixel counts; ``Σ weight·f`` estimates ``Σ f`` over pixels.
    """
    share = sample_shares(strength, interests)
    pixels, samples = share.size, share.size * spp
    ends = np.minimum(share.cumsum() * samples, samples)
    ends[-1] = samples
    # Kept off 0 and 1, where the rounding of a sum would decide between neighbours.
    shift = np.random.default_rng(seed).uniform(1e-3, 1 - 1e-3)
    counts = np.diff(np.ceil(ends - shift), prepend=0).astype(np.int64)
    pixel = np.repeat(np.arange(pixels, dtype=np.int32), counts)
    weight = (1 / (samples * share)).astype(np.float32)
    return torch.from_numpy(pixel).to(strength.device), torch.from_numpy(weight).to(strength.device)


def sample_shares(
    strength: torch.Tensor, interests: Sequence[tuple[float, torch.Tensor]]
) -> npt.NDArray[np.float64]:
    """Return each pixel's share of the samples, ``(H·W,)``: in proportion to ``|∂M/∂I| · interest``, or even.

    Parameters
    ----------
    strength
        Magnitude of the adjoint, ``|∂M/∂I|``, of shape ``(H, W)``.
    interests
        Pairs of a share of the samples, and how much their derivatives vary from pixel to pixel, ``(H, W)``. What
        the shares leave is spread evenly, so that no pixel's weight grows without bound.

    References
    ----------
    Owen and Zhou, "Safe and Effective Importance Sampling", Journal of the American Statistical Association
    95(449), 2000 (such mixtures).
    """
    # In NumPy: torch's threads would wait for Dr.Jit's, and this is little work.
    magnitude = strength.cpu().double().numpy()
    share, left = np.zeros(magnitude.size), 1.0
    for part, interest in interests:
        wanted = (magnitude * interest.cpu().numpy()).ravel()
        if wanted.any():
            share += part * wanted / wanted.sum()
            left -= part
    return share + left / magnitude.size
