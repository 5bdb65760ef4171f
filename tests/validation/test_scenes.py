"""The change of a metric between renders with common random numbers, and its error."""

from __future__ import annotations

import pytest
import torch
from seeds import shifted
from toy import ToyRenderer

from scenecaptum.validation import Scenes

RUNS = 150
CHANGES = {"x": torch.tensor([0.6, 0.4, 0.9])}


def brightest(image: torch.Tensor) -> torch.Tensor:
    """Return the sum of the pixels above a threshold, which jumps as a glare rating does."""
    return (image * (image > 1.2)).sum()


def differences(metric, replicates: int) -> torch.Tensor:
    renderer, found = ToyRenderer(), []
    for seed in range(RUNS):
        scenes = Scenes(renderer, metric, None, seed=shifted(seed), spp=16, replicates=replicates)
        found.append(scenes.difference(scenes.render(CHANGES), CHANGES))
    return torch.tensor(found, dtype=torch.float64)


@pytest.mark.parametrize("replicates", [5, 8])
@pytest.mark.parametrize("metric", [brightest, torch.mean])
def test_the_error_of_a_change_is_the_spread_between_seeds(metric, replicates: int):
    found = differences(metric, replicates)
    assert 1 / 1.5 < found[:, 1].square().mean().sqrt() / found[:, 0].std() < 1.5


def test_the_error_of_a_linear_metric_is_the_usual_one():
    scenes = Scenes(ToyRenderer(), torch.mean, None, seed=shifted(), spp=16, replicates=8)
    images = scenes.render(CHANGES)
    usual = scenes.measure_in(images, CHANGES) - scenes.unmodified
    change, error = scenes.difference(images, CHANGES)
    assert change == pytest.approx(usual.mean().item(), rel=1e-4)
    assert error == pytest.approx(usual.std().item() / 8**0.5, rel=1e-3)
