"""Effects of poses on a metric that is not linear in the image, with a renderer that is written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
import torch
from chance import allowed
from seeds import shifted

from scenecaptum import SceneAttribution, VanillaSceneGradient, metrics
from scenecaptum.attr import checked_over_ranges
from scenecaptum.estimation import TargetedMetric
from scenecaptum.visualization import signed_with_error

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


def on_one_line(text: object) -> str:
    return " ".join(str(text).split())


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
    change, error = found.info["range_changes"][row.name]
    assert abs(change - TRUTH) < allowed(16) * error < 0.4
    over = "over ±0.05 units towards (0.0, 0.0, 1.0), fourth changes by"
    note = f"over which fourth is not linear in the picture: as rendered {over} {signed_with_error(change, error)}"
    assert note in on_one_line(found)
    assert note in on_one_line(found.explain().text())
    other = attribute(Sliding(0.01), torch.mean, shifted())
    for difference in (found - other, other - found):
        assert difference.info["nonlinear"] == [row.name]
        assert "the effect may be quite different, or in the other direction" in " ".join(
            str(difference).split()
        )


def test_an_effect_that_renders_contradict_ranks_last():
    """Of the first object the metric rises at its value, and falls over the range; of the second it rises less."""

    def bent(image: torch.Tensor) -> torch.Tensor:
        first, second = image[:4] - 1, image[4:] - 1
        return (first - 1.5 * first**3).mean() + 0.1 * second.mean()

    renderer = Sliding(0.01, objects=2)
    found = attribute(renderer, bent, shifted())
    bending, straight = renderer.names
    assert found.saliency()[bending] > found.saliency()[straight]
    assert [row.name for row in found.ranking()] == [straight, bending]
    assert found.ranked_last() == {bending}
    assert not found.ranked_last("unit")
    change, error = found.info["range_changes"][bending]
    assert abs(change + 1) < allowed(16) * error < 0.1
    last = f"bent changes by {signed_with_error(change, error)}; so ranked last, without a bar or a colour"
    assert last in on_one_line(found)
    assert last in on_one_line(found.explain().text())


def test_noise_is_not_called_a_change_beyond_first_order():
    """A square has its derivative in the middle of the range as the mean of it."""
    alarms = [
        attribute(Sliding(1.0, objects=4), lambda image: image.square().mean(), shifted(seed)).info[
            "nonlinear"
        ]
        for seed in range(8)
    ]
    assert not any(alarms)


def test_an_exact_gradient_of_a_smoothed_metric_says_that_its_range_is_not_tested():
    smoothed = metrics.Smoothed(fourth, 0.1)
    found = attribute(Turning(0.01), smoothed, shifted())
    assert "not tested over the range, over which the picture moves by several pixels" in on_one_line(found)
    moved = attribute(Sliding(0.01), smoothed, shifted())
    assert "not tested" not in on_one_line(moved)


def test_so_does_one_whose_gradient_deviates_to_first_order_in_the_picture():
    class Bending(Turning):
        def range_changes(self, *args, **options):
            return {name: 3 * rows for name, rows in super().range_changes(*args, **options).items()}

    renderer = Bending(0.01)
    (name,) = renderer.names
    assert attribute(renderer, fourth, shifted()).info["local"] == [name]
    found = attribute(renderer, metrics.Smoothed(fourth, 0.1), shifted())
    assert (found.info["local"], found.info["untested"]) == ([], [name])
    assert "not tested over the range" in on_one_line(found)
    assert "does not hold" not in on_one_line(found)


def test_gradients_along_an_adjoint_get_what_the_metric_does_over_the_range():
    renderer = Sliding(0.01)
    image = torch.stack([renderer(renderer.inputs, seed=seed, spp=64) for seed in range(8)]).mean(0)
    adjoint = 4 * image**3 / image.numel()
    along = attribute(renderer, lambda image: (adjoint * image).sum(), shifted())
    assert not along.info["nonlinear"]
    checked, errors = checked_over_ranges(
        along, renderer, TargetedMetric(fourth), renderer.inputs, image=image, adjoints=[adjoint] * 8, spp=64
    )
    (name,) = renderer.names
    assert checked.info["nonlinear"] == [name]
    change, error = checked.info["range_changes"][name]
    assert abs(change - TRUTH) < allowed(16) * error
    assert not errors
    unclear, errors = checked_over_ranges(
        along,
        renderer,
        TargetedMetric(lambda image: (image + 0.02 * (image - 1) ** 3).mean()),
        renderer.inputs,
        image=image,
        adjoints=[torch.full_like(image, 1 / image.numel())] * 8,
        spp=64,
    )
    assert not unclear.info["nonlinear"]
    beyond = 0.02 * 2 / (2 * HALF)  # the cube grows from −1 to 1
    assert errors[name].norm() == pytest.approx(beyond, rel=0.2)
    assert unclear.ranking()[0].effect_error == pytest.approx(2 * HALF * beyond, rel=0.2)
