"""Effects of poses on a metric that is not linear in the image, with a renderer that is written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneAttribution, VanillaSceneGradient

HALF = 0.05  # of the range
SEEDS = range(8)
TRUTH = 16  # the change of the metric ``fourth`` over the range


class Sliding:
    """Objects that slide, each in four pixels of its own: their light is proportional to ``1 + z / 0.05``.

    At one end of the range the pixels are dark, at the other twice as bright. All are noisy.
    """

    spp, resolution = 64, (12, 4)

    def __init__(self, noise: float, objects: int = 1) -> None:
        self.noise = noise
        self.names = [f"object_{number}.pose.translation" for number in range(objects)]
        self.inputs = {name: torch.zeros(3) for name in self.names}
        self.ranges = dict.fromkeys(self.names, (-HALF, HALF))
        self.vectors = self.names

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int | None) -> torch.Tensor:
        light = torch.stack([1 + inputs[name][2] / HALF for name in self.names]).repeat_interleave(4)
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn((len(light), 1, 3), generator=generator) / (spp or self.spp) ** 0.5
        return light[:, None, None] * (1 + self.noise * noise).clamp_min(0)

    def step_changes(
        self,
        values: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        seeds: Sequence[int],
        spp: int,
        names: Sequence[str],
    ) -> dict[str, torch.Tensor]:
        return {name: torch.zeros(len(seeds), 3) for name in names}


class Turning(Sliding):
    """The same, as a camera that turns: its gradients at the value are compared with those over the range."""

    def step_changes(self, *_: object, **__: object) -> dict[str, torch.Tensor]:
        return {}

    def range_changes(
        self,
        values: Mapping[str, torch.Tensor],
        directions: Mapping[str, torch.Tensor],
        adjoint: torch.Tensor,
        *,
        seeds: Sequence[int],
        spp: int,
    ) -> dict[str, torch.Tensor]:
        def end(name: str, sign: int, seed: int) -> torch.Tensor:
            point = {**values, name: values[name] + sign * HALF * directions[name]}
            return (adjoint * self(point, seed=seed, spp=spp)).sum()

        return {
            name: torch.stack([end(name, 1, seed) - end(name, -1, seed) for seed in seeds]) / (2 * HALF)
            for name in directions
        }


def fourth(image: torch.Tensor) -> torch.Tensor:
    """Return what grows from 0 to 16 where the light does from 0 to 2, and to first order by 8."""
    return image.square().square().mean()


def attribute(renderer: Sliding, metric: object, seed: int) -> SceneAttribution:
    return VanillaSceneGradient(renderer, metric).attribute(seed=seed)


def test_the_error_covers_a_change_that_is_not_clear_of_noise():
    for seed in SEEDS:
        found = attribute(Sliding(1.0), fourth, shifted(seed))
        (row,) = found.ranking()
        assert found.info["nonlinear"] or abs(row.effect - TRUTH) < 2 * row.effect_error


@pytest.mark.parametrize("kind", [Sliding, Turning])
def test_a_large_change_that_is_clear_of_noise_is_marked(kind):
    found = attribute(kind(0.01), fourth, shifted())
    (row,) = found.ranking()
    assert row.effect == pytest.approx(TRUTH / 2, rel=0.03)
    assert row.effect_error < 0.1
    assert found.info["nonlinear"] == [row.name]
    note = "over which fourth is not linear in the picture; the effect may be quite different"
    assert note in " ".join(str(found).split())
    assert note in " ".join(found.explain().text().split())
    other = attribute(Sliding(0.01), torch.mean, shifted())
    assert (found - other).info["nonlinear"] == (other - found).info["nonlinear"] == [row.name]


@pytest.mark.parametrize("kind", [Sliding, Turning])
def test_a_metric_that_is_linear_over_the_range_has_no_mark_and_no_larger_error(kind):
    for seed in SEEDS:
        (row,) = attribute(kind(0.1), torch.mean, shifted(seed)).ranking()
        nearly = attribute(kind(0.1), lambda image: (image + 1e-3 * image**2).mean(), shifted(seed))
        assert not nearly.info["nonlinear"]
        assert nearly.ranking()[0].effect_error < 1.1 * row.effect_error


def test_noise_is_not_called_a_change_beyond_first_order():
    """A square has its derivative in the middle of the range as the mean of it."""
    alarms = [
        attribute(Sliding(1.0, objects=4), lambda image: image.square().mean(), shifted(seed)).info[
            "nonlinear"
        ]
        for seed in range(8)
    ]
    assert not any(alarms)
