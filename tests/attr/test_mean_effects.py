"""Mean and spread over results: errors with shared renders, noise, closed forms."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from chance import allowed, check_error_bars
from seeds import seeds, shifted
from toy import ReplayingToyRenderer

from scenecaptum import SceneCaptumError, VanillaSceneGradient, metrics
from scenecaptum.attr import mean_effects

TARGETS = [0, 1, 2]


def quarters(image: torch.Tensor) -> torch.Tensor:
    """Return the means of three rows and, as the last element, their mean."""
    rows = image[:3].mean((1, 2))
    return torch.cat([rows, rows.mean()[None]])


def squares(image: torch.Tensor) -> torch.Tensor:
    return image.square().mean()


def results(noise: float, seed: int, targets: list[int]):
    method = VanillaSceneGradient(ReplayingToyRenderer(noise), quarters)
    return method.attribute(target=targets, seed=seed, replicates=8)


def exact() -> torch.Tensor:
    return ReplayingToyRenderer().matrix[:3].double().mean((1, 2)).sum(-1)


def test_mean_and_error_are_those_of_the_mean_metric():
    *rows, whole = results(0.5, shifted(), [*TARGETS, 3])
    [row] = mean_effects(rows).rows
    assert row.mean == pytest.approx(whole.effects()["x"], rel=1e-5)
    assert row.mean_error == pytest.approx(whole.effects_error()["x"], rel=1e-4)
    independent = math.hypot(*(result.effects_error()["x"] for result in rows)) / 3
    assert row.mean_error > 1.2 * independent  # the toy's noise is common to all rows


def test_spread_is_the_standard_deviation_of_the_effects():
    table = mean_effects(results(0.0, shifted(), TARGETS))
    [row] = table.rows
    with pytest.raises(SceneCaptumError, match="top must be a whole number of at least 1, not 0"):
        table.text(top=0)
    truth = torch.stack([result["x"].double().sum() for result in results(0.0, shifted(), TARGETS)])
    torch.testing.assert_close(torch.tensor(row.effects).double(), truth)
    assert row.spread == pytest.approx(truth.std().item(), rel=1e-5)
    assert row.noise == pytest.approx(0.0, abs=1e-6)


def test_a_table_of_few_replicates_says_so():
    method = VanillaSceneGradient(ReplayingToyRenderer(0.5), quarters)
    table = mean_effects(method.attribute(target=TARGETS, seed=shifted(), replicates=2))
    assert "all parameters: with 2 replicates the standard error has about 71 % relative uncertainty" in str(
        table
    )
    [row] = table.rows
    some = dataclasses.replace(table, rows=(row, row._replace(name="y", label="y")), untrusted={"y": "why"})
    marks = ["?" in line for line in str(some).splitlines()[1:3]]
    assert marks == [False, True]
    assert "?  why (y)" in str(some)
    assert "?" not in str(mean_effects(results(0.5, shifted(), TARGETS)))


def test_noise_is_the_part_of_the_spread_that_renders_cause():
    runs = [mean_effects(results(2.0, seed, TARGETS)).rows[0] for seed in seeds(60)]
    [clean] = mean_effects(results(0.0, shifted(), TARGETS)).rows
    excess = torch.tensor([run.spread**2 - run.noise**2 - clean.spread**2 for run in runs])
    assert abs(excess.mean()) < allowed(len(runs)) * excess.std() / math.sqrt(len(runs))
    assert torch.tensor([run.noise for run in runs]).mean() > 0.2 * clean.spread


class Pair(ReplayingToyRenderer):
    """A stack of the picture and its half: two cameras with the same noise."""

    def __call__(self, *arguments: Any, **options: Any) -> torch.Tensor:
        image = super().__call__(*arguments, **options)
        return torch.stack([image, 0.5 * image])


@pytest.mark.long
def test_error_bars_include_the_draws_that_cameras_share():
    metric = metrics.PerCamera(metrics.Smoothed(squares, 0.8, n=16))
    method = VanillaSceneGradient(Pair(0.1), metric)
    runs = [mean_effects(method.attribute(target=[0, 1], seed=seed, spp=64)).rows[0] for seed in seeds(30)]
    means = torch.tensor([[run.mean] for run in runs], dtype=torch.float64)
    check_error_bars(means, torch.tensor([[run.mean_error] for run in runs], dtype=torch.float64))
    x = Pair().inputs["x"].double().requires_grad_()
    (slope,) = torch.autograd.grad(squares(Pair().matrix.double() @ x), x)
    truth = math.exp(0.8**2) * slope.sum() * (1 + 0.25) / 2
    assert abs(means.mean() - truth) < allowed(len(runs)) * means.std() / math.sqrt(len(runs))


def test_results_with_other_seeds_are_independent():
    first, second = results(0.5, shifted(1), [0]) + results(0.5, shifted(2), [0])
    [row] = mean_effects([first, second]).rows
    assert row.mean_error == pytest.approx(
        math.hypot(first.effects_error()["x"], second.effects_error()["x"]) / 2, rel=1e-5
    )


def test_rows_are_printed_by_descending_mean():
    text = str(mean_effects(results(0.5, shifted(), TARGETS)))
    assert text.splitlines()[0].split() == ["parameter", "mean", "effect", "spread", "by", "noise", "alone"]
    assert "in 3 results" in text
    without = mean_effects(
        VanillaSceneGradient(ReplayingToyRenderer(), quarters).attribute(target=TARGETS, replicates=1)
    )
    assert without.rows[0].mean_error is None
    assert "noise" not in str(without)


def test_one_result_has_no_spread():
    for wrong in (results(0.5, 1, [0]), [1.0, 2.0]):
        with pytest.raises(SceneCaptumError, match="at least two results"):
            mean_effects(wrong)
