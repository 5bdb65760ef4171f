"""Sampling until a goal is reached, on toy renderers of known noise whose runs are cheap enough to repeat."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from chance import allowed, binomial_margin
from seeds import seeds, shifted
from toy import ToyRenderer, log_mean

from scenecaptum import SceneCaptumError, SceneRenderer, VanillaSceneGradient, activate, cli, metrics
from scenecaptum.attr import AttributionInterrupted
from scenecaptum.estimation import (
    Budget,
    Compared,
    Goal,
    Planner,
    Point,
    PointGradient,
    Progress,
    Quantity,
    ReplicateStatistics,
    Rounds,
    RoundSum,
    Sampling,
    TargetedMetric,
    TimeLimit,
    TransformSelector,
    _goal,
    _planner,
    jackknife,
    simultaneous_quantile,
    student_t,
)
from scenecaptum.scene.bundled import cornell_box

RUNS = 30


class SpikyRenderer:
    """Six parameters lit by few bright paths: a mean of n samples is gamma distributed with shape ``n/spikes``."""

    spp = 16

    def __init__(self, spikes: float = 10.0, tied: bool = False) -> None:
        generator = torch.Generator().manual_seed(shifted(1))
        self.spikes = spikes
        names = [f"p{i}" for i in range(6)]
        self.weights = {
            n: (torch.rand(4, 4, 3, generator=generator) + 0.5) / (1 + 0.4 * i) for i, n in enumerate(names)
        }
        self.inputs = {n: torch.rand(3, generator=generator) + 0.3 for n in names}
        if tied:
            self.weights["p1"], self.inputs["p1"] = self.weights["p0"], self.inputs["p0"]

    def exact(self, inputs):
        return sum(self.weights[n] * inputs[n] for n in inputs)

    def sampled(self, inputs, seed, spp):
        shape = spp / self.spikes
        noise = np.random.default_rng(seed).gamma(shape, 1 / shape, (len(inputs) + 1, 4, 4, 1))
        noise = torch.from_numpy(noise).float()
        return sum(
            self.weights[n] * value * (noise[i] + noise[-1]) / 2
            for i, (n, value) in enumerate(inputs.items())
        )

    def __call__(self, inputs, *, seed, spp, seed_grad=None):
        linear = self.sampled(inputs, seed if seed_grad is None else seed_grad, spp)
        return self.sampled(inputs, seed, spp).detach() + linear - linear.detach()


def contrast(image):
    """Non-linear within the noise of a pixel, as a glare threshold is."""
    return torch.sigmoid((image - image.mean()) * 4).mean() + log_mean(image)


METRICS = {"linear": torch.mean, "log": log_mean, "contrast": contrast}


def truth_of(renderer, metric):
    leaves = {n: value.clone().requires_grad_() for n, value in renderer.inputs.items()}
    metric(renderer.exact(leaves)).backward()
    return {n: leaf.grad for n, leaf in leaves.items()}


def worst_error(attribution, truth, names=None):
    return max(((attribution[n] - truth[n]).norm() / truth[n].norm()).item() for n in names or truth)


# ------------------------------------------------------------------------------------------ the statistics


def quantity(noise, total=1.0, bias=0.0, target=0.0):
    noise = torch.as_tensor(noise, dtype=torch.float32).reshape(len(noise), -1)
    return Quantity(
        ("x",), torch.full(noise.shape[1:], total), noise, torch.full(noise.shape[1:], bias), target
    )


@pytest.mark.parametrize("degrees", [7, 23])
def test_quantile_of_one_number_is_that_of_student(degrees):
    found = simultaneous_quantile([quantity(torch.ones(degrees + 1))], degrees)
    assert found == pytest.approx(student_t(0.95, degrees), rel=0.05)  # of 2000 draws


def test_quantile_depends_on_the_correlation_of_parameters():
    waves = torch.arange(1, 7)[:, None] * torch.arange(24) * math.pi / 12
    rows = torch.cos(waves + 1)  # without heavy tails
    apart = simultaneous_quantile([quantity(row) for row in rows], 23)
    together = simultaneous_quantile([quantity(rows[0]) for _ in rows], 23)
    assert together == pytest.approx(student_t(0.95, 23), rel=0.04)
    # Independent errors: each has nearly the sixth root of the level (their estimates vary, too).
    assert apart == pytest.approx(student_t(0.95 ** (1 / 6), 23), rel=0.05)


def test_simultaneous_half_widths_hold_for_all_parameters_at_once():
    renderer, truth = SpikyRenderer(spikes=0.5), truth_of(SpikyRenderer(), torch.mean)
    inside = 0
    for seed in seeds(RUNS):
        found = VanillaSceneGradient(renderer, torch.mean).attribute(tolerance=9.0, share=0.0, seed=seed)
        widths = found.info["planner"]["half_widths"]
        assert set(widths) == set(truth)
        inside += all((found[n] - truth[n]).norm() <= widths[n] for n in truth)
    margin = binomial_margin(0.95, RUNS)
    assert abs(inside / RUNS - 0.95) < margin, f"{inside} of {RUNS}, allowed 95 % ± {margin:.1%}"


def test_predicted_growth_reaches_the_half_width():
    noise = 0.1 * torch.ones(4)
    for bias in (0.0, 0.3):
        one = quantity(noise, bias=bias, target=0.05)
        growth = one.required_growth(2.5)
        then = quantity(noise / math.sqrt(growth), bias=bias / growth, target=0.05)
        assert 2.5 * then.error == pytest.approx(0.05, rel=1e-5)
        assert not one.meets_target(2.5)


def test_jackknife_of_unequal_groups_removes_the_bias():
    """The bias of a log is −var/2, however the samples are grouped."""
    metric, generator = TargetedMetric(log_mean), torch.Generator().manual_seed(shifted(2))
    sizes, biases = [8, 8, 4, 4, 4, 2, 2], []
    for _ in range(400):
        images = [1 + 0.2 * torch.randn(1, 1, 3, generator=generator) / math.sqrt(n) for n in sizes]
        biases.append(jackknife(metric, images, sizes).bias)
    found = torch.tensor(biases)
    expected = -(0.2**2) / 3 / sum(sizes) / 2
    z = (found.mean() - expected) / (found.std() / math.sqrt(len(found)))
    assert abs(z) < allowed(400), f"mean {found.mean():.2e}, expected {expected:.2e}, z = {z:.1f}"


def test_degrees_of_freedom_are_those_of_normal_rows_on_average():
    generator, free = torch.Generator().manual_seed(shifted(5)), 47
    shapes = {"a number": (free + 1, 1), "a vector": (free + 1, 3)}
    for what, shape in shapes.items():
        rows = torch.randn(400, *shape, generator=generator)
        found = [quantity(row - row.mean(0)).degrees_of_freedom(10**6) for row in rows]
        uncertainty = np.mean([2 / one for one in found])
        allowed = 4 * np.std([2 / one for one in found]) / math.sqrt(len(found))
        # The relative variance of a variance is 2 over its degrees of freedom; the channels are independent.
        assert abs(uncertainty - 2 / free / shape[1]) < allowed, f"{what}: {uncertainty:.4f} ± {allowed:.4f}"


def test_one_row_with_all_of_the_spread_leaves_few_degrees_of_freedom():
    rows = torch.zeros(8)
    rows[3] = 1.0
    assert quantity(rows - rows.mean()).degrees_of_freedom(7) == 2
    assert quantity(rows[:3]).degrees_of_freedom(2) == 2  # too few to estimate more
    calm, wild = quantity(torch.cos(torch.arange(8.0) * 2.4)), quantity(rows - rows.mean())
    assert simultaneous_quantile([wild], 7) > 1.5 * simultaneous_quantile([calm], 7)


def test_few_effective_samples_give_no_reliable_error():
    rows = torch.cos(torch.arange(8.0) * 2.4) / 1e3
    reliable, rare = (
        Quantity(("x",), torch.ones(1), rows[:, None], torch.zeros(1), 0.1, n) for n in (4.0, 2.0)
    )
    assert reliable.meets_target(3.0)
    assert not rare.meets_target(3.0)
    assert (reliable.required_growth(3.0), rare.required_growth(3.0)) == (1.0, 1.5)
    assert reliable.degrees_of_freedom(7) == round(2 / (1 / 4 + 2 / 7))


def test_effective_samples_of_a_group_are_summed_over_correlated_members():
    noise = {"a": torch.ones(8, 1), "b": -torch.ones(8, 1), "dark": torch.zeros(8, 1)}
    groups = {"both": ("a", "b"), "one": ("a", "dark"), "unknown": ("a", "c")}
    noise["c"] = torch.ones(8, 1)
    found = _goal._group_effective_samples({"a": 10.0, "b": 10.0}, noise, groups)
    assert found == pytest.approx({"both": 20.0, "one": 10.0})


# ------------------------------------------------------------------------------------------ tolerance


@pytest.fixture(scope="module", params=["linear", "log", pytest.param("contrast", marks=pytest.mark.long)])
def runs(request):
    """Runs whose first images are far too noisy for the metric."""
    renderer, metric = SpikyRenderer(), METRICS[request.param]
    found = [VanillaSceneGradient(renderer, metric).attribute(tolerance=0.1, seed=s) for s in seeds(RUNS)]
    return truth_of(renderer, metric), found


def test_tolerance_is_kept_in_95_percent_of_runs_also_by_rare_bright_samples(runs):
    """Stopping where errors happen to be underestimated would keep it less often."""
    truth, found = runs
    kept = sum(worst_error(one, truth) <= 0.1 for one in found)
    least = 0.95 - binomial_margin(0.95, RUNS)
    assert kept / RUNS >= least, f"kept in {kept} of {RUNS}, allowed {least:.1%}"
    for one in found:
        assert one.info["planner"]["reached"]
        assert one.info["planner"]["relative_half_width"] <= 0.1


@pytest.mark.parametrize("name", ["p0", "p5"])
def test_rounds_together_are_unbiased_and_their_bars_honest(runs, name):
    truth, found = runs
    values = torch.stack([one[name] for one in found])
    bars = torch.stack([one.standard_error[name] for one in found]).square().mean(0).sqrt()
    z = (values.mean(0) - truth[name]) / (values.std(0) / math.sqrt(RUNS))
    assert (z.abs() < allowed(RUNS, 3)).all(), f"bias in standard errors {z.tolist()}"
    ratio, most = values.std(0) / bars, 1 + 4 / math.sqrt(2 * RUNS)
    assert (ratio < most).all(), f"spread over bar {ratio.tolist()}, allowed {most:.2f}"


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)
@pytest.mark.parametrize("spikes", [1.0, 30.0])
def test_tolerance_is_kept_in_95_percent_of_a_thousand_runs(metric, spikes):
    renderer, count = SpikyRenderer(spikes), 1000
    truth = truth_of(renderer, metric)
    errors = [
        worst_error(VanillaSceneGradient(renderer, metric).attribute(tolerance=0.1, seed=seed), truth)
        for seed in seeds(count)
    ]
    kept = sum(one <= 0.1 for one in errors) / count
    least = 0.95 - binomial_margin(0.95, count)
    assert kept >= least, f"kept in {kept:.1%}, allowed {least:.1%}"


def test_a_fifth_of_the_tolerance_takes_25_times_the_samples():
    renderer = SpikyRenderer()
    spent = {
        tolerance: np.mean(
            [
                VanillaSceneGradient(renderer, log_mean).attribute(tolerance=tolerance, seed=s).info["spp"]
                for s in seeds(6)
            ]
        )
        for tolerance in (0.05, 0.01)
    }
    # The first rounds, whose errors are uncertain, ask for up to twice as many as necessary.
    assert 25 / 2 < spent[0.01] / spent[0.05] < 25 * 2, spent


def test_rounds_together_propagate_the_adjoint_of_all_pictures():
    """Where backward passes have no noise, the sum is that of the corrected adjoint after the last round."""
    pictures = []

    class NoisyPictures(SpikyRenderer):
        def __call__(self, inputs, *, seed, spp, seed_grad=None):
            pictures.append((self.sampled(inputs, seed, spp).detach(), spp))
            exact = self.exact(inputs)
            return pictures[-1][0] + exact - exact.detach()

    renderer, metric = NoisyPictures(), TargetedMetric(contrast)
    raw = TransformSelector(False, renderer, {}, smoothed=False)
    with Progress("", show=False) as bar:
        rounds, total = (
            Rounds(renderer, [metric], raw, bar, seed=shifted(), time=TimeLimit(), picture_ratio=1.0),
            RoundSum(renderer.inputs),
        )
        for replicates, spp in ((4, 16), (12, 40)):  # as many as are stored separately
            (found,), _ = rounds.add_round(Point(renderer.inputs), replicates, spp)
            total.add(found)
    samples = torch.tensor([spp for _, spp in pictures])
    seen = jackknife(metric, [picture for picture, _ in pictures], samples.tolist())
    corrected = torch.tensordot(samples / samples.sum(), torch.stack(seen.per_replicate), 1)
    leaves = {n: value.clone().requires_grad_() for n, value in renderer.inputs.items()}
    expected = torch.autograd.grad(renderer.exact(leaves), list(leaves.values()), corrected)
    for name, gradient in zip(leaves, expected, strict=True):
        torch.testing.assert_close(total.mean[name] / total.weight, gradient)


def test_replicates_of_unequal_rounds_give_the_standard_error():
    found = VanillaSceneGradient(SpikyRenderer(), torch.mean).attribute(tolerance=0.05, seed=shifted(1))
    assert len({one["replicates"] for one in found.info["planner"]["rounds"]}) > 1
    torch.testing.assert_close(found.covariance["p0"].diagonal().sqrt().float(), found.standard_error["p0"])


@pytest.mark.parametrize("options", [{"tolerance": 1e-3}, {"time_limit": 60.0}, {"top": 1}])
def test_without_noise_one_round_is_enough(options):
    found = VanillaSceneGradient(ToyRenderer(noise=0.0), log_mean).attribute(**options)
    assert len(found.info["planner"]["rounds"]) == 1
    assert found.info["planner"]["relative_half_width"] < 1e-5
    assert found.info["planner"]["stopped"] == "goal"


def test_same_seed_same_result_and_first_round_as_large_as_asked():
    def attribute(**options):
        return VanillaSceneGradient(SpikyRenderer(), log_mean).attribute(tolerance=0.1, **options)

    one, other = attribute(seed=shifted(3)), attribute(seed=shifted(3))
    assert torch.equal(one["p0"], other["p0"])
    first = attribute(seed=shifted(3), spp=160, replicates=10).info["planner"]["rounds"][0]
    assert (first["replicates"], first["spp_per_replicate"]) == (10, 16)


def test_seeds_of_all_rounds_differ():
    budget = Budget((), (), ()).with_round(8, 4, 0).with_round(24, 9, 0)
    seeds = [seed for rows in (*budget.seeds, *budget.gradient_seeds) for seed in rows]
    assert len(set(seeds)) == len(seeds) == 64
    assert budget.total == 8 * 4 + 24 * 9


def test_every_target_reaches_the_goal():
    def channels(image):
        return image.mean((0, 1))

    found = VanillaSceneGradient(SpikyRenderer(), channels).attribute(target=[0, 2], tolerance=0.1)
    assert [one.info["planner"]["reached"] for one in found] == [True, True]
    assert found[0].info["spp"] == found[1].info["spp"]


def test_goal_holds_for_groups_if_there_are_groups():
    groups = {"first": ["p0", "p1"], "rest": ["p[2-5]"]}
    found = VanillaSceneGradient(SpikyRenderer(), torch.mean).attribute(tolerance=0.1, groups=groups)
    planner, error = found.info["planner"], found.saliency_error()
    assert set(planner["half_widths"]) == {"first", "rest"}
    for name, width in planner["half_widths"].items():
        assert 1.9 < width / error[name] < 3.5  # a quantile of Student's t, for two at once


# ------------------------------------------------------------------------------------------ any noise

ROOM = {"wall": 3, "floor": 3, "ball": 1, "tiny": 1}  # channels
SALIENCY = {"wall": 3**0.5, "floor": 3**0.5 / 2, "ball": 0.6, "tiny": 0.02}  # the ball has 19 % of all


def lognormal(sigma):
    return lambda rng, count, spp: np.exp(sigma * rng.standard_normal((count, spp)) - sigma**2 / 2).mean(1)


def gamma(spikes):
    """The mean of ``spikes`` samples is exponentially distributed."""
    return lambda rng, count, spp: rng.gamma(spp / spikes, spikes / spp, count)


def few_paths(each):
    """Half of the mean comes from paths of which a sample has ``each`` on average."""
    return lambda rng, count, spp: 0.5 + 0.5 * rng.poisson(each * spp, count) / (each * spp)


def both_signs(each):
    """Rare paths of both signs, with a standard deviation of 5 for one sample."""
    return lambda rng, count, spp: (
        1 + 5 * rng.standard_normal(count) * np.sqrt(rng.poisson(each * spp, count) / each) / spp
    )


NOISES = {
    "normal": lambda rng, count, spp: 1 + 3 / math.sqrt(spp) * rng.standard_normal(count),
    "gamma": gamma(100),
    "log-normal": lognormal(1.5),
    "few paths": few_paths(0.03),
    "both signs": both_signs(0.1),
}


def calm_paths(rng, count, spp):
    return 1 + 1e-3 * rng.standard_normal(count)


class SyntheticRounds:
    """Rounds whose replicates are drawn instead of rendered: with little noise, and with that of the ball."""

    seen = SimpleNamespace(is_linear=True)
    mean_adjoints = (None,)

    def __init__(self, ball, tiny, ball_size, seed):
        self.ball, self.tiny, self.ball_size = ball, tiny, ball_size
        self.rng = np.random.default_rng(seed)

    def add_round(self, point, replicates, spp):
        def calm(size, deviation, channels):
            return size * (1 + deviation / math.sqrt(spp) * self.rng.standard_normal((replicates, channels)))

        rows = {
            "wall": calm(1.0, 0.3, 3),
            "floor": calm(0.5, 0.3, 3),
            "ball": self.ball_size * np.asarray(self.ball(self.rng, replicates, spp))[:, None],
            "tiny": calm(0.02, self.tiny, 1),
        }
        statistics = {name: ReplicateStatistics() for name in rows}
        for name, values in rows.items():
            for row in torch.from_numpy(values):
                statistics[name].add(row)
        return [PointGradient(statistics, self.seen, float(replicates * spp), spp, {})], False


def search(monkeypatch, ball, seed, tiny=5.0, ball_size=0.6, renderer=None, **goal):
    """Run the search for a goal on synthetic rounds, and return it."""
    rounds = SyntheticRounds(ball, tiny, ball_size, seed)
    monkeypatch.setattr(_planner, "Rounds", lambda *_, **__: rounds)
    asked = {"tolerance": 0.1, "share": 0.05, "top": None, "time_limit": None, **goal}
    found = Planner(
        renderer,
        [TargetedMetric(torch.mean)],
        None,
        Point({name: torch.zeros(channels) for name, channels in ROOM.items()}),
        Compared(),
        Goal(**asked),
        Sampling(seed, 128, replicates=8),
    )
    found.run()
    return found


def is_within(found, tolerance=0.1):
    total = found.sums[0]
    exact = {"wall": 1.0, "floor": 0.5, "ball": 0.6}
    return all(
        (total.mean[name] / total.weight - value).norm() <= tolerance * SALIENCY[name]
        for name, value in exact.items()
    )


def kept(monkeypatch, noise, runs):
    """Return how many of so many runs report a tolerance as reached, and how many of these are within it."""
    found = [search(monkeypatch, noise, seed) for seed in seeds(runs)]
    reached = [one for one in found if one.stopped(interrupted=False) == "goal"]
    return len(reached), sum(map(is_within, reached))


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(noise, id=name, marks=pytest.mark.long if name in ("normal", "gamma") else ())
        for name, noise in NOISES.items()
    ],
)
def test_reached_goals_are_met_under_any_noise(monkeypatch, noise):
    """The first estimates of the ball are mostly noise; half of them are below its share."""
    reached, within = kept(monkeypatch, noise, RUNS)
    assert reached >= 0.9 * RUNS
    least = 0.95 - binomial_margin(0.95, reached)
    assert within / reached >= least, f"{within} of {reached}, allowed {least:.1%}"


@pytest.mark.long
@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)
def test_reached_goals_are_met_in_500_runs(monkeypatch, noise):
    reached, within = kept(monkeypatch, noise, 500)
    least = 0.95 - binomial_margin(0.95, reached)
    assert within / reached >= least, f"{within} of {reached}, allowed {least:.1%}"


def test_parameter_leaves_the_goal_by_its_upper_limit_only(monkeypatch):
    """A tiny saliency with a large error keeps the search going only until it is known to be tiny."""
    calm = search(monkeypatch, NOISES["normal"], shifted(), tiny=1.0)
    assert "tiny" not in calm.assessments[0].half_widths
    unsure = search(monkeypatch, NOISES["normal"], shifted(), tiny=400.0)
    assessment = unsure.assessments[0]
    assert unsure.stopped(interrupted=False) == "goal"
    tiny = next(one for one in assessment.criteria if one.names == ("tiny",))
    # It is 0.6 % of the sum, and would need (400 × 1.96 / 0.1)² samples for an error of 10 %.
    assert tiny.upper(assessment.quantiles[1]) < 0.05 * sum(SALIENCY.values())
    assert 2 * calm.sums[0].weight < unsure.sums[0].weight < 10**5


@pytest.mark.long
def test_rough_metal_whose_first_estimates_are_noise_stays_in_the_goal(monkeypatch):
    """Alpha has a quarter of all saliency, and needs about 10 000 samples for an error of 10 %."""
    activate()
    scene = cornell_box()
    del scene["short_box"], scene["short_box_shape"]
    scene["ball"] = {"type": "roughconductor", "alpha": 0.1}
    ball = {"type": "sphere", "center": [0.335, -0.38, -0.5], "radius": 0.5}
    scene["ball_shape"] = {**ball, "bsdf": {"type": "ref", "id": "ball"}}
    renderer = SceneRenderer(scene, ["reflectance", "roughness"], resolution=(32, 32), max_depth=4)
    metric = metrics.UnifiedGlareRating(renderer.camera, threshold_factor=5)
    monkeypatch.setattr(_planner, "MAX_SPP", 256)
    for seed in seeds(2):
        planner = VanillaSceneGradient(renderer, metric).attribute(tolerance=0.1, seed=seed).info["planner"]
        assert "ball.alpha.value" in planner["half_widths"]
        assert (planner["reached"], planner["stopped"]) == (False, "the number of samples")


def test_unreachable_goal_is_reported(monkeypatch):
    found = search(monkeypatch, lambda rng, count, spp: 1e4 * rng.standard_normal(count), shifted())
    assert found.stopped(interrupted=False) == "the number of samples"
    assert 2**17 - 128 < found.sums[0].weight <= 2**17
    assert not found.is_reached(found.assessments[0])


def test_first_round_is_not_the_last_without_a_pilot(monkeypatch):
    found = search(monkeypatch, calm_paths, shifted())
    assert found.stopped(interrupted=False) == "goal"
    assert len(found.round_seconds) == 2
    assert found.sums[0].weight == 1.5 * 128


@pytest.mark.parametrize(("effective", "rounds"), [(100.0, 1), (10.0, 2), (1.0, 2)])
def test_paths_of_a_pilot_render_decide_whether_a_round_is_trusted(monkeypatch, effective, rounds):
    """Many paths: the first round is trusted. A few: a second round. Hardly any: at least three paths."""

    class Pilot:
        def effective_samples(self, values, adjoint, *, spp, replicates):
            return dict.fromkeys(values, effective * spp * replicates / 128)

    calm = search(monkeypatch, calm_paths, shifted(), renderer=Pilot())
    assert calm.stopped(interrupted=False) == "goal"
    assert len(calm.round_seconds) == rounds
    assert calm.sums[0].weight >= 3 / effective * 128


def test_resolved_order_is_right_under_any_noise(monkeypatch):
    """The ball is second, although many of its first estimates are not."""
    wrong = 0
    for seed in seeds(RUNS):
        found = search(monkeypatch, gamma(40), seed, ball_size=1.2, tolerance=None, top=2)
        assert found.stopped(interrupted=False) == "goal"
        wrong += found.assessments[0].tiers(2) != [["wall"], ["ball"]]
    assert wrong / RUNS < 0.05 + binomial_margin(0.05, RUNS), f"{wrong} of {RUNS}"


def test_possible_members_of_the_top_keep_their_whole_error():
    """Noise may have rotated a vector: the error along the estimate is only a part of it."""
    rows = torch.randn(24, 3, generator=torch.Generator().manual_seed(6))
    known = Quantity(("known",), torch.tensor([1.0, 0, 0]), torch.zeros(24, 3), torch.zeros(3), 0.0)
    unknown = Quantity(
        ("unknown",), torch.tensor([0.05, 0, 0]), (rows - rows.mean(0)) / 24, torch.zeros(3), 0.0
    )
    (difference,) = _goal._saliency_differences([known, unknown], top=1, tie=0.05)
    assert difference.error == pytest.approx(unknown.error)


# ------------------------------------------------------------------------------------------ order and time


def test_resolved_order_is_right():
    renderer, wrong = SpikyRenderer(), 0
    truth = truth_of(renderer, torch.mean)
    order = sorted(truth, key=lambda n: -truth[n].norm())[:3]
    for seed in seeds(RUNS // 3):
        found = VanillaSceneGradient(renderer, torch.mean).attribute(top=3, seed=seed)
        assert found.info["planner"]["reached"]
        wrong += found.info["planner"]["order"] != [[name] for name in order]
    assert wrong / (RUNS // 3) < 0.05 + binomial_margin(0.05, RUNS // 3)


def test_equal_parameters_are_reported_as_ties():
    found = VanillaSceneGradient(SpikyRenderer(tied=True), torch.mean).attribute(top=3)
    planner = found.info["planner"]
    assert planner["reached"]
    assert [sorted(tier) for tier in planner["order"]] == [["p0", "p1"], ["p2"]]


class Clock:
    """A clock that advances only by rendering."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


class SlowRenderer(SpikyRenderer):
    """Compiles once, then takes time per call and per sample; backward passes take three times as long."""

    def __init__(self, clock, each, overhead):
        super().__init__()
        self.clock, self.each, self.overhead, self.compile = clock, each, overhead, 30.0
        self.calls, self.slow_after = 0, math.inf

    def __call__(self, inputs, *, seed, spp, seed_grad=None):
        self.calls += 1
        seconds = (self.overhead + self.each * spp) * (2 if self.calls > self.slow_after else 1)
        self.clock.now += self.compile + seconds
        self.compile = 0.0
        image = super().__call__(inputs, seed=seed, spp=spp, seed_grad=seed_grad)
        return Slow.apply(image, self.clock, 3 * seconds)


class Slow(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, clock, seconds):
        ctx.clock, ctx.seconds = clock, seconds
        return image.view_as(image)

    @staticmethod
    def backward(ctx, adjoint):
        ctx.clock.now += ctx.seconds
        return adjoint, None, None


@pytest.mark.parametrize("metric", [torch.mean, log_mean], ids=["linear", "log"])
@pytest.mark.parametrize(("each", "overhead"), [(0.001, 0.05), (0.02, 0.0), (0.0001, 0.01), (1.0, 0.0)])
def test_time_limit_is_kept_within_a_tenth_or_one_replicate(monkeypatch, metric, each, overhead):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    found = VanillaSceneGradient(SlowRenderer(clock, each, overhead), metric).attribute(time_limit=10.0)
    planner = found.info["planner"]
    spent = clock.now - planner["setup_seconds"]
    last = planner["rounds"][-1]
    one_replicate = 4 * (overhead + each * last["spp_per_replicate"])
    assert planner["setup_seconds"] >= 30
    assert 10 - max(1.0, 2 * one_replicate) <= spent <= 10 + max(1.0, one_replicate), (
        f"{spent:.2f} s, rounds {planner['rounds']}"
    )
    assert sum(one["replicates"] for one in planner["rounds"]) >= 2
    assert planner["reached"] is None


def test_time_is_filled_with_samples_if_replicates_have_an_overhead(monkeypatch):
    """At least an eighth of the samples of eight replicates, if their cost were known in advance."""
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    each, overhead, limit = 0.001, 0.1, 10.0
    found = VanillaSceneGradient(SlowRenderer(clock, each, overhead), log_mean).attribute(time_limit=limit)
    possible = 8 * (limit / 8 - 5 * overhead) / 7 / each  # a non-linear metric needs more images
    assert found.info["spp"] > possible / 8, (
        f"rounds {found.info['planner']['rounds']}, possible {possible:.0f}"
    )


def test_time_limit_is_kept_if_replicates_become_slower(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    renderer = SlowRenderer(clock, 0.01, 0.0)
    renderer.slow_after = 20  # two warm-ups and the first round, of two images each
    planner = VanillaSceneGradient(renderer, log_mean).attribute(time_limit=10.0).info["planner"]
    spent = clock.now - planner["setup_seconds"]
    assert 8 <= spent <= 11, f"{spent:.2f} s, rounds {planner['rounds']}"


def test_time_limit_ends_an_unreachable_goal(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    renderer = SlowRenderer(clock, 0.01, 0.0)
    found = VanillaSceneGradient(renderer, torch.mean).attribute(tolerance=1e-4, time_limit=5.0)
    planner = found.info["planner"]
    assert (planner["reached"], planner["stopped"]) == (False, "the time limit")
    assert planner["relative_half_width"] > 1e-4


def test_ctrl_c_keeps_the_finished_rounds():
    calls = []

    class Stopped(SpikyRenderer):
        def __call__(self, inputs, **options):
            calls.append(options["spp"])
            if len(calls) == 20:
                raise KeyboardInterrupt
            return super().__call__(inputs, **options)

    with pytest.raises(AttributionInterrupted) as stopped:
        VanillaSceneGradient(Stopped(), torch.mean).attribute(tolerance=0.01)
    partial = stopped.value.partial
    assert partial.info["spp"] == 64
    assert partial.info["planner"]["stopped"] == "interrupted"


# ------------------------------------------------------------------------------------------ other renderers


def test_effect_of_another_renderer_is_measured_within_its_half_width():
    class Brighter(SpikyRenderer):
        """3 % more light, as from longer paths, and the same noise under the same seeds."""

        def sampled(self, inputs, seed, spp):
            return 1.03 * super().sampled(inputs, seed, spp)

    renderer = SpikyRenderer()
    found = VanillaSceneGradient(renderer, torch.mean).attribute(tolerance=0.1, against=Brighter())
    against, truth = found.info["planner"]["against"], truth_of(renderer, torch.mean)
    assert against["relative_half_width"] < 0.02
    for name in truth:
        error = abs(against["changes"][name] - 0.03 * truth[name].norm().item())
        assert error <= against["half_widths"][name]
    assert " changes ≤ 3" in str(found)
    same = VanillaSceneGradient(renderer, log_mean).attribute(tolerance=0.1, against=SpikyRenderer())
    assert same.info["planner"]["against"]["relative_change"] < 1e-5


@pytest.mark.long
def test_effect_of_depth_is_that_of_separate_renders(cornell):
    deeper, finer = cornell.replace(max_depth=8), cornell.replace(resolution=(40, 40))
    assert list(deeper.inputs) == list(cornell.inputs)
    assert (deeper.plan.max_depth, deeper.resolution) == (8, (32, 32))
    assert (finer.plan.max_depth, finer.resolution) == (4, (40, 40))
    metric = metrics.MeanLuminance()
    found = VanillaSceneGradient(cornell, metric).attribute(tolerance=0.5, against=deeper)
    against = found.info["planner"]["against"]
    name = "floor.reflectance.value"
    long, short = (
        VanillaSceneGradient(one, metric).attribute(seed=shifted(7), spp=512).effects()[name]
        for one in (deeper, cornell)
    )
    # Longer paths add light, by several standard errors; separate renders agree on how much.
    assert against["changes"][name] > 3 * against["half_widths"][name] > 0
    assert against["changes"][name] == pytest.approx(long - short, abs=2 * against["half_widths"][name])
    assert "depth 8 at 32×32 changes" in str(found)


# ------------------------------------------------------------------------------------------ bad input, files


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0}, "tolerance must be a positive number, not 0"),
        ({"tolerance": "5 %"}, "tolerance must be a positive number, not '5 %'"),
        ({"time_limit": math.inf}, "time_limit must be a positive number, not inf"),
        ({"top": 0}, "top must be a whole number"),
        ({"tolerance": 0.1, "share": 5}, "share must lie between 0 and 1, not 5"),
        ({"tolerance": 0.1, "spp": 0}, "spp must be a whole number"),
        ({"tolerance": 0.1, "replicates": 1}, "replicates"),
        ({"against": ToyRenderer()}, "against= requires a goal"),
    ],
)
def test_bad_goals_are_refused(options, message):
    with pytest.raises(SceneCaptumError, match=message):
        VanillaSceneGradient(ToyRenderer(), torch.mean).attribute(**options)


def test_result_saves_and_loads_the_planner_report(tmp_path):
    found = VanillaSceneGradient(SpikyRenderer(), torch.mean).attribute(tolerance=0.2, top=2)
    found.save(tmp_path / "planned.npz")
    assert type(found).load(tmp_path / "planned.npz").info["planner"] == found.info["planner"]


def test_command_line_takes_a_tolerance(tmp_path, capsys):
    small = ["--resolution", "24x24", "--max-depth", "3", "--no-progress", "--inputs", "emitters"]
    assert cli.main(["attribute", "cornell-box", *small, "--tolerance", "0.5", "--out", str(tmp_path)]) == 0
    assert "(target: 50 %)" in capsys.readouterr().out
