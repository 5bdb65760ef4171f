"""Which poses have no derivative, by changes of their gradients that are made by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from chance import binomial_margin
from seeds import shifted

from scenecaptum.attr._steps import local_poses, step_errors

ADJOINT, RUNS = torch.ones(4, 4, 3), 200


class Moved:
    """A renderer of which only the changes of its gradients are known."""

    def __init__(self, step_changes: Callable[[int], dict[str, torch.Tensor]]) -> None:
        self.made = step_changes

    def step_changes(self, *_: Any, seeds: list[int], **__: Any) -> dict[str, torch.Tensor]:
        return self.made(seeds[0])

    def range_changes(self, *_: Any, seeds: list[int], **__: Any) -> dict[str, torch.Tensor]:
        return {name: rows[:, 0] for name, rows in self.made(seeds[0]).items()}


def skewed(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    """Return noise with mean 0, as skewed as that of renders with few samples: their skewness is up to 1."""
    return torch.rand(4, *shape, generator=generator).log().sum(0) + 4


def normal(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    return torch.randn(shape, generator=generator)


def noisy(noise: Callable[..., torch.Tensor], poses: int) -> Moved:
    def changes(seed: int) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        return {f"{number}": noise((8, 3), generator) for number in range(poses)}

    return Moved(changes)


@pytest.mark.parametrize("noise", [normal, skewed])
@pytest.mark.parametrize("poses", [1, 20])
def test_noise_is_not_called_a_jump(noise, poses):
    """Of any number of poses: each direction is a test that can fail by chance."""
    renderer, names = noisy(noise, poses), [f"{number}" for number in range(poses)]
    gradients = {name: torch.full((3,), 0.1) for name in names}
    alarms = 0
    for seed in range(RUNS):
        found = step_errors(
            renderer, gradients, gradients, ADJOINT, dict.fromkeys(names, 64.0), shifted(seed)
        )
        alarms += bool(found.jumps or found.kept_directions)
    assert alarms / RUNS <= 0.01 + binomial_margin(0.01, RUNS)


@pytest.mark.parametrize("poses", [1, 20])
def test_noise_over_the_range_is_not_called_a_change(poses):
    renderer, names = noisy(normal, poses), [f"{number}" for number in range(poses)]
    gradients = {name: torch.full((3,), 1e-3) for name in names}
    errors = {name: torch.full((3,), 1e-3) for name in names}
    samples = dict.fromkeys(names, 64.0)
    alarms = sum(
        bool(local_poses(renderer, gradients, errors, gradients, ADJOINT, samples, shifted(seed)).marked)
        for seed in range(RUNS)
    )
    assert alarms / RUNS <= 0.01 + binomial_margin(0.01, RUNS)


def test_a_gradient_that_is_lost_in_its_noise_has_an_error_that_reaches_its_mean_over_the_range():
    """Nearly three of its errors are too few for a mark: what is left must be in the error."""
    over_range = Moved(lambda _: {"turn": 0.3 + 1e-3 * torch.randn(8, 3)})
    gradient, error = {"turn": torch.tensor(-9.0)}, {"turn": torch.tensor(3.2)}
    found = local_poses(over_range, gradient, error, gradient, ADJOINT, {"turn": 64.0}, shifted(0))
    assert not found.marked
    # Along the gradient, which is below 0, the renders gain 0.3 where it says 9.
    assert found.errors["turn"].hypot(error["turn"]) == pytest.approx(9 - 0.3, rel=1e-2)
    assert found.errors["turn"] < 0


@pytest.mark.parametrize("poses", [1, 20])
def test_a_jump_among_many_poses_is_found(poses):
    """Across a jump a gradient halves."""
    names = [f"{number}" for number in range(poses)]

    def changes(seed: int) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        found = {name: 0.05 * torch.randn(8, 3, generator=generator) for name in names}
        found["0"][:, 2] -= 0.5
        return found

    gradients = {name: torch.tensor([0.1, 0.1, 1.0]) for name in names}
    for seed in range(20):
        samples = dict.fromkeys(names, 64.0)
        found = step_errors(Moved(changes), gradients, gradients, ADJOINT, samples, shifted(seed))
        assert found.jumps == {"0": "the effect jumps or bends along z within twice the range"}
