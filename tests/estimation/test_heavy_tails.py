"""Rare bright paths: the error bar says when it cannot be trusted, and a median moves less than the mean."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from chance import binomial_margin
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import IntegratedGradientsScene, SceneAttribution, SceneCaptumError, VanillaSceneGradient
from scenecaptum.estimation._heavy_tails import FALSE_ALARM_RATE, _critical_fraction

RUNS = 100


class Fireflies(ToyRenderer):
    """The same, but one in ``one_in`` samples of an image is brighter by a factor."""

    def __init__(self, brighter: float = 0.0, one_in: int = 400, noise: float = 0.3) -> None:
        super().__init__(noise)
        self.brighter, self.one_in = brighter, one_in
        self.inputs = {"x": self.inputs["x"], "texture": torch.full((4, 4, 3), 0.5)}

    def exact(self, inputs):
        return self.matrix @ inputs["x"] + inputs["texture"]

    def __call__(self, inputs, *, seed, spp):
        generator = torch.Generator().manual_seed(seed + 1)
        flies = torch.rand(spp, generator=generator) < 1 / self.one_in
        bright = 1 + self.brighter * flies.float().mean()
        return bright * (super().__call__(inputs, seed=seed, spp=spp) + inputs["texture"])


def attribute(renderer, seed, **options):
    return VanillaSceneGradient(renderer, torch.mean).attribute(seed=seed, **{"spp": 64, **options})


def test_errors_of_few_replicates_are_marked():
    few = attribute(Fireflies(), shifted(), spp=3, replicates=3)
    reason = "with 3 replicates the standard error has about 50 % relative uncertainty"
    assert few.untrusted_errors() == dict.fromkeys(few, reason)
    assert f"all parameters: {reason}" in " ".join(str(few).split())
    assert not attribute(Fireflies(), shifted(), spp=4, replicates=4).untrusted_errors()
    # Points that contribute unequally: few degrees of freedom of many replicates, whose number is in the heading.
    for degrees, counted in ((1, "1 degree of freedom"), (2, "2 degrees of freedom")):
        info = {**few.info, "replicates": 8, "degrees_of_freedom": degrees}
        [reason] = set(dataclasses.replace(few, info=info).untrusted_errors().values())
        assert reason.startswith(f"with {counted} the standard error has about"), reason
    alone = attribute(Fireflies(), shifted(), replicates=1)
    assert alone.untrusted_errors() == {}  # there is no error bar


def test_a_dominating_replicate_is_marked(tmp_path):
    """64 samples in 8 replicates; one in 400 is 1000 times as bright, so that some runs contain one."""
    renderer = Fireflies(brighter=1000.0)
    found = [attribute(renderer, seed) for seed in seeds(60)]
    met = [one for one in found if sum(row.norm() > 10 for row in one.replicates["x"]) == 1]
    assert len(met) > 3
    for one in met:
        assert set(one.untrusted_errors()) == {"x", "texture"}
        assert "all parameters: one replicate has nearly all of the spread" in str(one)
    met[0].save(tmp_path / "met.npz")
    assert SceneAttribution.load(tmp_path / "met.npz").untrusted_errors() == met[0].untrusted_errors()


def test_only_parameters_with_doubtful_errors_are_marked():
    rows = torch.linspace(-1, 1, 8)[:, None] * 0.01 + 1.0
    one = attribute(ToyRenderer(), shifted())
    spiky = rows.clone()
    spiky[3] += 5
    made = dataclasses.replace(
        one,
        attributions={"even": torch.ones(1), "spiky": torch.ones(1)},
        standard_error={"even": torch.ones(1), "spiky": torch.ones(1)},
        replicates={"even": rows, "spiky": spiky},
        covariance={"even": torch.ones(1, 1), "spiky": torch.ones(1, 1)},
        bias=None,
    )
    assert set(made.untrusted_errors()) == {"spiky"}
    marked = {line.split()[1]: "?" in line for line in str(made).splitlines() if line[:1].isdigit()}
    assert marked == {"even": False, "spiky": True}
    assert "spiky" in made._repr_html_()


def test_normal_replicates_are_trusted():
    """False alarms are no more frequent than the set rate of one in a hundred results."""
    alarms = sum(bool(attribute(Fireflies(), seed).untrusted_errors()) for seed in seeds(RUNS))
    assert alarms <= RUNS * FALSE_ALARM_RATE + 4 * math.sqrt(RUNS * FALSE_ALARM_RATE)


def test_the_limit_is_that_of_grubbs_test():
    """The critical value for 8 observations at 1 %, two-sided: G = 2.274 (Grubbs and Beck, 1972)."""
    fraction = _critical_fraction(8, 0.01)
    assert math.sqrt(fraction * 7) == pytest.approx(2.274, abs=2e-3)


def test_rounding_is_not_counted_as_spread():
    assert not attribute(Fireflies(noise=0.0), shifted()).untrusted_errors()


def test_median_of_means_is_the_median():
    mean = attribute(Fireflies(), shifted(3))
    median = mean.median_of_means()
    for name in mean:
        expected = mean.replicates[name].double().quantile(0.5, dim=0)
        total = median[name].reshape(-1, 3).sum(0)
        torch.testing.assert_close(total.double(), expected, rtol=1e-5, atol=1e-6)
        assert median[name].shape == mean[name].shape
        torch.testing.assert_close(
            median.covariance[name].diagonal().sqrt()[: total.numel()].float(),
            median.standard_error[name] if name == "x" else median.covariance[name].diagonal().sqrt().float(),
        )
    assert median.info["combination"] == "median of means"
    assert median.metric_value == mean.metric_value


def test_median_moves_less_than_the_mean_and_its_error_includes_the_difference():
    """A firefly moves the mean by an eighth of its replicate and the median hardly at all."""
    renderer = Fireflies(brighter=1000.0)
    clean = torch.stack([attribute(Fireflies(), seed)["x"] for seed in seeds(60)])
    means = [attribute(renderer, seed) for seed in seeds(60)]
    medians = [one.median_of_means() for one in means]
    of_means, of_medians = (torch.stack([one["x"] for one in kept]).std(0) for kept in (means, medians))
    assert bool((of_means > 10 * clean.std(0)).all())
    assert bool((of_medians < of_means / 2).all())
    flies = [(m, r) for m, r in zip(means, medians, strict=True) if (m["x"] - clean.mean(0)).norm() > 1]
    assert len(flies) > 3
    for mean, median in flies:
        assert (median["x"] - clean.mean(0)).norm() < (mean["x"] - clean.mean(0)).norm()
        assert bool((median.standard_error["x"] >= (mean["x"] - median["x"]).abs() * 0.999).all())


def test_intervals_of_the_median_cover_the_truth_for_normal_replicates():
    renderer = Fireflies()
    leaves = {name: value.clone().requires_grad_() for name, value in renderer.inputs.items()}
    (truth,) = torch.autograd.grad(renderer.exact(leaves).mean(), [leaves["x"]])
    inside = 0
    for seed in seeds(RUNS):
        low, high = attribute(renderer, seed).median_of_means().interval(0.95)["x"]
        inside += bool(low[0] <= truth[0] <= high[0])
    assert inside / RUNS > 0.95 - binomial_margin(0.95, RUNS)


def test_equal_replicates_do_not_hide_the_error():
    """A parameter that only rare paths reach: the median is 0, and its error is not."""
    rows = torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0])[:, None]
    made = dataclasses.replace(
        attribute(ToyRenderer(), shifted()),
        attributions={"rare": rows.mean(0)},
        standard_error={"rare": torch.tensor([0.375])},
        replicates={"rare": rows},
        covariance={"rare": torch.tensor([[0.375**2]])},
        bias=None,
    )
    median = made.median_of_means()
    assert median["rare"].item() == 0
    assert median.standard_error["rare"].item() > 0.375


def test_a_median_needs_several_replicates_of_one_scene():
    steps = IntegratedGradientsScene(ToyRenderer(), torch.mean).attribute(
        baselines={"x": torch.zeros(3)}, n_steps=4
    )
    with pytest.raises(SceneCaptumError, match="several scenes or rounds"):
        steps.median_of_means()
    with pytest.raises(SceneCaptumError, match="1 replicate"):
        attribute(ToyRenderer(), shifted(), replicates=1).median_of_means()
    goal = attribute(Fireflies(), shifted(), tolerance=0.02)
    if len(goal.info["planner"]["rounds"]) > 1:
        with pytest.raises(SceneCaptumError, match="rounds"):
            goal.median_of_means()
