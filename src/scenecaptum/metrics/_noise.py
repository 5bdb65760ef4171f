"""Draws of noise of a picture, and the mean of a function over them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch.utils.checkpoint import checkpoint

from ..backend import trim_heap
from ..errors import SceneCaptumError, check_seed, whole_number
from ..images import check_image_shape
from ..visualization import rounded
from ._measure import Measure

NoiseKind: TypeAlias = "Literal['lognormal', 'gaussian']"
OfBatch: TypeAlias = Callable[[torch.Tensor], torch.Tensor]

DEFAULT_DRAWS = 256

_BATCH = 8  # noisy pictures that are in memory at the same time
# Bytes of a batch of pictures from which its memory is returned to the system before the next. For small pictures
# it would take as long as a small network.
_LARGE_BATCH = 2**22


@dataclass(frozen=True)
class PictureNoise:
    """Noise of a picture: its strength, its kind, and the number of draws of each seed; see ``Smoothed``."""

    sigma: float
    kind: NoiseKind
    draws: Mapping[int, int]

    @classmethod
    def create(
        cls, sigma: float, n: int = DEFAULT_DRAWS, kind: NoiseKind = "lognormal", seed: int = 0
    ) -> PictureNoise:
        """Check the settings of a user; raise if one is invalid."""
        if isinstance(sigma, bool) or not isinstance(sigma, int | float) or not 0 < sigma < math.inf:
            raise SceneCaptumError(f"sigma must be a positive number, not {sigma!r}.")
        if kind not in _APPLY:
            raise SceneCaptumError(f"noise must be 'lognormal' or 'gaussian', not {kind!r}.")
        if whole_number("n", n, 2) % 2:
            raise SceneCaptumError(f"n must be even, because each draw is used with both signs, not {n}.")
        return cls(float(sigma), kind, {check_seed("seed", seed): int(n)})

    @property
    def n(self) -> int:
        """Number of draws."""
        return sum(self.draws.values())

    @property
    def tolerated(self) -> float | None:
        """Relative noise of a render that hardly adds to this noise; None if this one is not relative."""
        return SMOOTHED_TOLERANCE * self.sigma if self.kind == "lognormal" else None

    def with_draws(self, draws: Mapping[int, int]) -> PictureNoise:
        """Return the same noise with so many draws of each seed, rounded up to an even number."""
        return dataclasses.replace(
            self, draws={seed: 2 * math.ceil(count / 2) for seed, count in draws.items()}
        )

    def mean(self, of_batch: OfBatch, image: torch.Tensor) -> torch.Tensor:
        """Return the mean of a function over noisy copies of an ``(H, W, 3)`` image, which it gets in batches."""
        check_image_shape(image)
        pairs = [(seed, number) for seed, count in self.draws.items() for number in range(count // 2)]
        batches = [pairs[start : start + _BATCH // 2] for start in range(0, len(pairs), _BATCH // 2)]

        def sum_over(batch: list[tuple[int, int]]) -> torch.Tensor:
            if _BATCH * image.nbytes >= _LARGE_BATCH:
                trim_heap()
            return of_batch(self._noisy(image, batch)).sum(0)

        if len(batches) == 1:
            return sum_over(pairs) / self.n
        # Each batch is evaluated again in the backward pass, so that the activations of one are in memory.
        sums = [checkpoint(sum_over, batch, use_reentrant=False) for batch in batches]
        return torch.stack(sums).sum(0) / self.n

    def _noisy(self, image: torch.Tensor, pairs: list[tuple[int, int]]) -> torch.Tensor:
        height, width, channels = image.shape
        shape = (height, width, 1 if self.kind == "lognormal" else channels)
        # A generator for each pair, so that a draw does not depend on how many there are.
        normals = [np.random.default_rng(pair).standard_normal(shape, dtype=np.float32) for pair in pairs]
        draws = torch.from_numpy(np.stack(normals)).to(image)
        return _APPLY[self.kind](image, torch.cat([draws, -draws]), self.sigma)


def smoothed_measure(measure: Measure) -> Measure:
    """Return the measure of the mean over noise."""
    return dataclasses.replace(measure, name=f"smoothed {measure.name}")


# Relative noise of the pixels that moves a network's logit by at most 0.2, in the Cornell box and the office: up
# to a third of the noise of the smoothing, and without smoothing 5 %.
SMOOTHED_TOLERANCE, PLAIN_TOLERANCE = 1 / 3, 0.05
# What the derivatives of a network metric are without smoothing.
ROUGH = "effects of the rough gradient of a noisy picture, without smoothing"


def without_smoothing(value: float, meaning: str) -> str:
    """Return the verdict on the value of one picture without smoothing, and what it means.

    One picture has no spread, so that few digits are shown, and the text says that its noise is in them.
    """
    text = f"{rounded(value, 2)} without smoothing, on one noisy render"
    return f"{text}; {meaning}" if meaning else text


def _lognormal(image: torch.Tensor, normal: torch.Tensor, sigma: float) -> torch.Tensor:
    return image * torch.exp(sigma * normal - sigma**2 / 2)


def _gaussian(image: torch.Tensor, normal: torch.Tensor, sigma: float) -> torch.Tensor:
    from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

    encoded = linear_rgb_to_rgb(image.movedim(-1, 0)) + sigma * normal.movedim(-1, 1)
    decoded: torch.Tensor = rgb_to_linear_rgb(encoded.abs())
    return decoded.movedim(1, -1)


_APPLY = {"lognormal": _lognormal, "gaussian": _gaussian}
