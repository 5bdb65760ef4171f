"""What noise does to the gradient of a metric that is not linear: removed, or in the error bars."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from seeds import shifted

from scenecaptum import SmoothGradScene, metrics

SEEDS = 12


class NoisyDisc:
    """A bright disc before a wall, whose light one lamp scales, with the noise of a few samples."""

    y, x = torch.meshgrid(torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 24), indexing="ij")
    disc = torch.sigmoid((0.5 - (x**2 + y**2).sqrt()) * 10)[..., None]

    def __init__(self) -> None:
        self.inputs = {
            "disc": torch.tensor([0.7, 0.3, 0.2]),
            "wall": torch.full((3,), 0.5),
            "lamp": torch.tensor(3.0),
        }
        self.bounds = {"disc": (0.0, 1.0), "wall": (0.0, 1.0), "lamp": (0.0, float("inf"))}

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int | None) -> torch.Tensor:
        values = {**self.inputs, **inputs}
        generator = torch.Generator().manual_seed(seed)
        noise = 1 + 0.3 * torch.randn(24, 24, 1, generator=generator) / (spp or 16) ** 0.5
        shown = self.disc * values["disc"] + (1 - self.disc) * values["wall"]
        return values["lamp"] * shown * (1 + values["wall"] / 2) * noise.clamp(min=0)


def contrast(image: torch.Tensor) -> torch.Tensor:
    luminance = metrics.luminance(image)
    return luminance.std() / luminance.mean()


@pytest.mark.parametrize("denoise", [False, "auto"])
def test_the_error_bars_of_few_samples_hold_the_bias_of_both_causes(denoise: Any) -> None:
    """The contrast does not depend on the lamp. Both biases are of the same noise, and must not cancel."""
    held = []
    for seed in range(SEEDS):
        result = SmoothGradScene(NoisyDisc(), contrast).attribute(
            nt_samples=8, spp=256, seed=shifted(seed), denoise=denoise
        )
        low, high = (bound.item() for bound in result.interval(0.95)["lamp"])
        held.append(low <= 0 <= high)
    assert sum(held) >= SEEDS - 2, held
