"""Renderers in a few lines of torch, quick enough to repeat hundreds of times, and a non-linear metric."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from seeds import shifted


class ToyRenderer:
    """``image = A·x``, ``A`` multiplied by noise that falls as 1/√spp; the backward pass replays the samples."""

    spp = 16

    def __init__(self, noise: float = 0.3) -> None:
        generator = torch.Generator().manual_seed(shifted(1))
        self.noise = noise
        self.matrix = torch.rand(4, 4, 3, 3, generator=generator) + 0.1
        self.inputs = {"x": torch.tensor([0.5, 0.3, 0.8])}

    def exact(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return self.matrix @ inputs["x"]

    def sampled(self, seed: int, spp: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        pixels = torch.randn(self.matrix.shape, generator=generator)
        # Paths through the same lamp correlate the errors of all pixels.
        common = torch.randn(1, generator=generator)
        return self.matrix * (1 + self.noise / math.sqrt(spp) * (pixels + common))

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return self.sampled(seed, spp) @ inputs["x"]


class ReplayingToyRenderer(ToyRenderer):
    """The same, with separate samples for the backward pass, as in path replay."""

    def __call__(
        self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int, seed_grad: int | None = None
    ) -> torch.Tensor:
        primal = self.sampled(seed, spp) @ inputs["x"].detach()
        linear = self.sampled(seed if seed_grad is None else seed_grad, spp) @ inputs["x"]
        return primal + linear - linear.detach()


def log_mean(image: torch.Tensor) -> torch.Tensor:
    return image.mean().log()
