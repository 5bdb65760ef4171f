"""The cost of accuracy: measured errors and biases are those of renderers with known ones."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import math
import re

import numpy as np
import pandas
import pytest
import torch
from chance import allowed
from results import all_text
from rooms import room
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.ranks import kendall_tau, spearman
from scenecaptum.tradeoff import Bias, Estimate, Measured, Reference, Setting, Tradeoff, measure
from scenecaptum.tradeoff import _statistics as statistics
from scenecaptum.tradeoff._result import _STYLES


class Bounces:
    """An image of ``depth`` bounces, each half as bright as the one before, with noise of 1/√spp.

    The noise is independent for every pixel, and in the backward pass for every parameter.
    """

    spp = 16

    def __init__(self, depth: int = 4, noise: float = 0.2, noise_seen: float = 0.2) -> None:
        self.plan = dataclasses.make_dataclass("Plan", ["max_depth", "integrator"])(depth, "own")
        self.noise = noise
        self.noise_seen = noise_seen
        self.inputs = {f"p{k}": torch.tensor(1.0 + k) for k in range(6)}
        self.weights = torch.tensor([2.0, 1.6, 1.2, 0.8, 0.4, 0.1])
        self.taken: list[tuple[int, int]] = []

    def replace(self, *, max_depth, resolution=None, integrator=None):
        return Bounces(max_depth, self.noise, self.noise_seen)

    @property
    def brightness(self) -> float:
        return 1 - 0.5**self.plan.max_depth

    @property
    def gradient(self) -> torch.Tensor:
        return self.brightness * self.weights

    def __call__(self, inputs, *, seed, spp, seed_grad=None, spp_grad=None):
        spp_grad = spp_grad or spp
        self.taken.append((spp, spp_grad))
        x = torch.stack([inputs[name] for name in self.inputs])
        seen = 1 + self.noise_seen / math.sqrt(spp) * normal(seed, 192).reshape(8, 8, 3)
        primal = (self.gradient @ x.detach()) * seen
        noisy = 1 + self.noise / math.sqrt(spp_grad) * normal(seed if seed_grad is None else seed_grad, 6)
        linear = (self.gradient * noisy) @ x
        return primal + linear - linear.detach()


def normal(seed: int, count: int) -> torch.Tensor:
    return torch.randn(count, generator=torch.Generator().manual_seed(seed))


def cubes(image: torch.Tensor) -> torch.Tensor:
    return (image**3).mean()


def z_of(value: float, error: float, expected: float) -> float:
    return (value - expected) / error


# ------------------------------------------------------------------------------------------------ error and bias


def test_relative_error_is_that_of_the_noise():
    renderer = Bounces()
    trade = measure(renderer, torch.mean, vary={"spp": [4, 256]}, reference_spp=10**6, runs=20)
    for row in trade.rows:
        # The relative noise of each element is the same, and so is that of the whole.
        expected = renderer.noise / math.sqrt(row.setting.gradient_spp)
        assert abs(z_of(*row.relative_error, expected)) < allowed(20, 3), row


def test_gradients_without_bias_show_none():
    rows = [measure(Bounces(), torch.mean, vary={}, runs=4, seed=seed).rows[0] for seed in seeds(12)]
    assert not any(row.bias.significant for row in rows)


def test_the_bias_of_short_paths_is_the_missing_light():
    trade = measure(Bounces(4, 0.05), torch.mean, vary={"max_depth": [1, 2, 8]}, reference_spp=10_000)
    assert trade.reference.setting.max_depth == 8
    for row in trade.rows:
        depth = row.setting.max_depth
        expected = 1 - (1 - 0.5**depth) / (1 - 0.5**8)
        assert row.bias.significant == (depth < 8), row
        assert abs(row.bias.value - expected) < max(4 * row.bias.error, 1e-3), row
        assert row.bias.value - 1e-6 <= row.relative_error.value


def test_noise_biases_a_non_linear_metric_without_the_jackknife():
    renderer = Bounces(noise=0.1, noise_seen=2.0)
    trade = measure(renderer, cubes, vary={"replicates": [1]}, reference_spp=10**6, runs=20)
    jackknifed, naive = trade.rows
    # The adjoint is the square of each pixel, to which noise adds its variance.
    expected = renderer.noise_seen**2 / 16
    assert naive.bias.significant, trade
    assert abs(z_of(naive.bias.value, naive.bias.error, expected)) < allowed(20), naive
    assert not jackknifed.bias.significant, trade
    assert jackknifed.bias.upper_limit < expected / 2


@pytest.mark.long
def test_the_bias_of_smoothing_is_that_of_the_expectation():
    renderer = Bounces(noise_seen=0.0)
    trade = measure(renderer, cubes, vary={"smoothing": [0.1, 0.4]}, reference_spp=10**6, runs=20)
    own, weak, strong = trade.rows
    assert [row.setting.smoothing for row in trade.rows] == [None, 0.1, 0.4]
    assert not own.bias.significant
    # The cube of a log-normal factor with mean 1 has the mean exp(3 σ²).
    for row in (weak, strong):
        bias = math.exp(3 * row.setting.smoothing**2) - 1
        assert abs(z_of(row.bias.value, row.bias.error, bias)) < 4
        parts = math.hypot(row.spread * math.sqrt(1 - 1 / trade.runs), row.bias.value)
        assert row.relative_error.value == pytest.approx(parts, rel=0.1)


def test_samples_of_the_image_and_of_the_gradient_are_separate():
    renderer = Bounces()
    vary = {"primal_spp": [4, 64], "gradient_spp": [4, 64]}
    trade = measure(renderer, torch.mean, vary=vary, reference_spp=10_000, runs=20)
    by_spp = {(row.setting.primal_spp, row.setting.gradient_spp): row for row in trade.rows}
    assert set(by_spp) == {(16, 16), (4, 16), (64, 16), (16, 4), (16, 64)}
    # A weighted sum of squares of normal variables; its error is estimated too small where it is small by chance.
    squares = renderer.gradient.square()
    relative = (squares.norm() / squares.sum()).item() / math.sqrt(2 * 20)
    for (_, gradient_spp), row in by_spp.items():
        # A linear metric has the same adjoint for every image.
        expected = renderer.noise / math.sqrt(gradient_spp)
        assert abs(row.relative_error.value / expected - 1) < 4 * relative, row
        assert 0.3 < row.relative_error.error / (relative * expected) < 2, row
    assert set(renderer.taken) >= {(2, 2), (1, 4), (8, 2), (4, 1), (2, 8)}  # in 4 or 8 replicates


def test_false_alarms_are_rare_under_any_noise():
    generator = torch.Generator().manual_seed(shifted())
    for shape in (torch.eye(12), torch.diag(torch.tensor([5.0] + [0.1] * 11)), torch.ones(12, 12)):
        alarms = 0
        for _ in range(400):
            runs, replicates = (torch.randn(n, 12, generator=generator) @ shape for n in (4, 16))
            spread = (replicates - replicates.mean(0)) / math.sqrt(16 * 15)
            alarms += statistics.relative_bias(runs - replicates.mean(0), spread, 1.0).significant
        assert alarms <= 4  # of 400, where 0.5 are expected; 5 or more have a chance of 2 in 10 000


def test_few_runs_suffice_where_the_noise_is_that_of_the_reference():
    """Two runs tell little of their spread, but 16 replicates tell that of the reference."""
    generator = torch.Generator().manual_seed(shifted())
    shape = torch.zeros(12)
    shape[0] = 1.0  # a single noisy parameter
    alarms, found = 0, 0
    for _ in range(400):
        runs, replicates = (torch.randn(n, 12, generator=generator) * shape for n in (2, 16))
        spread = (replicates - replicates.mean(0)) / math.sqrt(16 * 15)
        deviations = 0.05 * runs - replicates.mean(0)
        alarms += statistics.relative_bias(deviations, spread, 1.0).significant
        found += statistics.relative_bias(deviations + 3 * shape, spread, 1.0).significant
    assert alarms <= 4
    assert found > 380  # the bias is 12 times the noise


def test_a_known_bias_is_measured():
    generator = torch.Generator().manual_seed(shifted())
    nothing = torch.zeros(1, 8, dtype=torch.float64)
    squares = []
    for _ in range(300):
        # The square of the bias is 4 times the variance of the mean.
        noise = torch.randn(8, 8, generator=generator, dtype=torch.float64)
        squares.append((2 * statistics.relative_bias(2 / math.sqrt(8) + noise, nothing, 2.0).value) ** 2)
    mean = torch.tensor(squares)
    assert abs(z_of(mean.mean().item(), mean.std().item() / math.sqrt(300), 4.0)) < allowed(300)

    for runs in (3, 8):
        one = 0.3 + 1e-3 * torch.randn(runs, 1, generator=generator, dtype=torch.float64)
        assert statistics.relative_bias(one, nothing[:, :1], 1.0).significant

    many = 0.3 + torch.randn(100, 8, generator=generator, dtype=torch.float64)
    bias = statistics.relative_bias(many, nothing, 2.0)
    assert bias.significant
    assert abs(z_of(bias.value, bias.error, 0.3 * math.sqrt(8) / 2)) < allowed(100)
    assert bias.value + bias.error < bias.upper_limit < bias.value + 2 * bias.error


# ------------------------------------------------------------------------------------------------ ranks


def test_rank_correlations_are_those_of_pandas():
    generator = torch.Generator().manual_seed(shifted())
    for _ in range(5):
        one, other = (torch.randint(0, 6, (12,), generator=generator).double() for _ in range(2))
        frame = pandas.DataFrame({"one": one.numpy(), "other": other.numpy()})
        expected = frame.corr(method="spearman").loc["one", "other"]
        assert spearman(one, other) == pytest.approx(expected)
    assert math.isnan(spearman(torch.ones(3).double(), torch.arange(3).double()))


def test_ranks_that_the_reference_does_not_resolve_do_not_count():
    reference, error = torch.tensor([3.0, 2.0, 1.9]), torch.full((3,), 0.1)
    swapped, reversed_ = torch.tensor([3.0, 1.9, 2.0]), torch.tensor([1.0, 2.0, 3.0])
    assert kendall_tau(swapped, reference) == pytest.approx(1 / 3)
    assert statistics.kendall_of_resolved(swapped, reference, error) == 1
    assert statistics.kendall_of_resolved(reversed_, reference, error) == -1
    assert math.isnan(statistics.kendall_of_resolved(swapped, reference, 9 * error))


def test_top_agreement_counts_the_first_in_any_order():
    first, other = torch.tensor([9.0, 8.0, 7.0, 1.0, 0.0]), torch.tensor([7.0, 9.0, 1.0, 8.0, 0.0])
    assert statistics.top_agreement(first, other, 3) == pytest.approx(2 / 3)
    assert statistics.top_agreement(first, other, 2) == pytest.approx(1 / 2)


def test_rankings_converge_to_that_of_the_reference():
    trade = measure(Bounces(noise=3.0), torch.mean, vary={"spp": [2, 4096]}, reference_spp=10**6, runs=10)
    _, few, many = trade.rows
    for name in ("spearman", "kendall", "kendall_resolved", "top"):
        assert getattr(few, name).value < getattr(many, name).value == 1, name


def test_gradients_are_compared_at_the_values_that_are_given():
    taken = []

    class Recorded(Bounces):
        def __call__(self, inputs, **more):
            taken.append({name: value.item() for name, value in inputs.items()})
            return super().__call__(inputs, **more)

    changed = {**Recorded().inputs, "p3": torch.tensor(7.0)}
    measure(Recorded(), torch.mean, inputs=changed, vary={"spp": [4]}, reference_spp=64, runs=2)
    assert {tuple(values.items()) for values in taken} == {tuple((n, v.item()) for n, v in changed.items())}


# ------------------------------------------------------------------------------------------------ renderers


def test_a_setting_does_not_depend_on_how_the_renderer_was_made(cornell):
    change = {"resolution": (16, 8), "max_depth": 2}
    replaced = cornell.replace(**change)
    fresh = SceneRenderer("cornell-box", ["reflectance", "emitters"], spp=16, **change)
    assert torch.equal(replaced(seed=shifted(3)), fresh(seed=shifted(3)))
    one, other = (
        VanillaSceneGradient(each, metrics.MeanLuminance()).attribute(replicates=2)
        for each in (replaced, fresh)
    )
    for name in one:
        torch.testing.assert_close(one[name], other[name], rtol=1e-4, atol=1e-7)
    # Its scene is shared, and its image is unchanged.
    assert cornell(seed=shifted(3)).shape == (32, 32, 3)
    assert cornell.plan.max_depth == 4


def test_the_backward_pass_may_have_its_own_sample_count(cornell):
    few, many = cornell.leaves(), cornell.leaves()
    cornell(few, seed=shifted(1), spp=2, seed_grad=shifted(5), spp_grad=32).mean().backward()
    cornell(many, seed=shifted(2), spp=32, seed_grad=shifted(5)).mean().backward()
    for name in few:
        torch.testing.assert_close(few[name].grad, many[name].grad, rtol=1e-4, atol=1e-7)


@pytest.mark.long
def test_the_missing_derivative_of_a_mirror_in_stock_prb_shows_as_bias(mi):
    ball = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": 0.8}}
    scene = room(mi, ball)
    scene["floor"]["bsdf"] = {"type": "diffuse"}
    renderer = SceneRenderer(scene, "reflectance", spp=64, max_depth=3)
    trade = measure(
        renderer, metrics.MeanLuminance(), vary={"integrator": ["prb"]}, runs=4, reference_spp=512
    )
    own, stock = trade.rows
    assert not own.bias.significant, trade
    assert stock.bias.significant, trade
    assert stock.setting.integrator == "prb"
    assert renderer.replace(integrator="prb").plan.integrator == "prb"


def test_coarser_images_get_their_own_metric(cornell):
    def glare(renderer: SceneRenderer) -> metrics.UnifiedGlareRating:
        return metrics.UnifiedGlareRating(renderer.camera, threshold_factor=2)

    trade = measure(
        cornell,
        glare(cornell),
        vary={"resolution": [(16, 16)]},
        metric_for=glare,
        runs=2,
        reference_spp=32,
    )
    assert [row.setting.resolution for row in trade.rows] == [(32, 32), (16, 16)]
    assert trade.reference.setting.resolution == (32, 32)
    with pytest.raises(SceneCaptumError, match="metric_for="):
        measure(cornell, glare(cornell), vary={"resolution": [(16, 16)]}, runs=2, reference_spp=32)


# ------------------------------------------------------------------------------------------------ the result


@pytest.fixture(scope="module")
def trade():
    """A trade of times that are those of the settings, not of a busy machine."""
    vary = {"spp": [4, 4096], "max_depth": [1, 8]}
    measured = measure(Bounces(), torch.mean, vary=vary, reference_spp=10**6)
    rows = [dataclasses.replace(row, seconds=cost(row.setting)) for row in measured.rows]
    return dataclasses.replace(measured, rows=rows)


def cost(setting: Setting) -> float:
    return 0.1 + 1e-3 * setting.primal_spp * setting.max_depth


def test_by_default_every_setting_of_the_renderer_is_varied():
    found = measure(Bounces(), torch.mean, runs=2)
    assert {row.varied for row in found.rows} == {
        "", "spp", "primal_spp", "gradient_spp", "replicates", "max_depth", "integrator"
    }  # fmt: skip
    assert found.rows[0].setting == Setting(16, 16, 8, 4, None, "own")


def test_csv_has_a_line_for_each_setting(trade, tmp_path):
    trade.to_csv(tmp_path / "tradeoff.csv")
    lines = list(csv.DictReader((tmp_path / "tradeoff.csv").open()))
    assert [line["varied"] for line in lines] == ["own", "spp", "spp", "max_depth", "max_depth"]
    assert [int(line["primal_spp"]) for line in lines] == [16, 4, 4096, 16, 16]
    for line, row in zip(lines, trade.rows, strict=True):
        assert float(line["relative_error"]) == row.relative_error.value
        assert float(line["bias_z"]) == row.bias.z
        assert line["on_front"] == str(row in trade.front)


def test_no_setting_dominates_the_front(trade):
    front = trade.front
    for row in trade.rows:
        beaten = any(
            one.seconds <= row.seconds and one.relative_error.value < row.relative_error.value
            for one in front
        )
        assert beaten == (row not in front)


def test_the_cheapest_setting_within_a_tolerance_is_recommended(trade):
    cheapest = trade.cheapest(0.2)
    good = [row for row in trade.rows if sum(row.relative_error) <= 0.2]
    assert cheapest.seconds == min(row.seconds for row in good)
    assert "For an error of 20 %" in trade.recommendation(0.2)
    # Depth 4 leaves out a sixteenth, which more samples cannot recover.
    short = dataclasses.replace(trade, rows=tuple(row for row in trade.rows if row.setting.max_depth == 4))
    (bias,) = re.findall(r"has a bias of (\S+) %", short.recommendation(0.01))
    assert float(bias) == pytest.approx(100 / 17, abs=0.5)  # a sixteenth of sixteen parts and one
    few = dataclasses.replace(trade, rows=tuple(row for row in trade.rows if row.setting.max_depth == 8))
    assert "spp should suffice" in few.recommendation(0.01)


@pytest.mark.parametrize(
    ("changes", "has_error_bars"), [({}, True), ({"replicates": 1}, False), ({"gradient_spp": 1}, False)]
)
def test_a_recommendation_says_that_one_replicate_has_no_error_bars(trade, changes, has_error_bars):
    own = trade.rows[0]
    row = dataclasses.replace(own, setting=dataclasses.replace(own.setting, **changes))
    said = dataclasses.replace(trade, rows=(row,)).recommendation(0.9)
    assert said.startswith("For an error of 90 %: 16 spp")
    assert said.endswith(
        " % of the top five correct." if has_error_bars else " (1 replicate: no error bars)."
    )


def spp_row(row, spp, error, noise):
    """Return a row with so many samples and such an error, and no significant bias."""
    return dataclasses.replace(
        row,
        setting=row.setting.changed("spp", spp),
        relative_error=statistics.Estimate(error, noise),
        bias=statistics.Bias(0.0, 0.01, 0.0),
    )


def test_no_number_of_samples_is_advised_that_was_tried_without_success(trade):
    own = trade.rows[0]

    def advice(*rows):
        rows = tuple(spp_row(own, *row) for row in rows)
        return dataclasses.replace(trade, rows=rows, runs=3).recommendation(0.05)

    # The best is below the tolerance, but its limit is not: 16 and 32 samples were no better.
    unclear = advice((16, 0.055, 0.02), (8, 0.04, 0.02), (32, 0.05, 0.03))
    assert "No setting is certainly within 5 %: the best, 8 spp" in unclear
    assert "error of 4 ± 2 %" in unclear
    assert "upper limit, of one standard error, is 6 %" in unclear
    assert "more than 3 runs" in unclear
    assert "suffice" not in unclear
    # By the law of samples 13 would do, but 32 did not.
    tried = advice((8, 0.06, 0.002), (32, 0.07, 0.01))
    assert "about 13 spp should suffice, but 32 spp did not: measure with more than 3 runs" in tried
    assert advice((8, 0.06, 0.002), (12, 0.07, 0.01)).endswith("; about 13 spp should suffice.")
    # The limit is never rounded down to the tolerance itself.
    assert "is 5.1 %" in advice((8, 0.04, 0.0101))


def test_an_error_far_above_its_noise_that_is_no_significant_bias_has_a_note(trade):
    assert "measure more" not in str(trade)
    deviations = torch.tensor([[0.075], [0.076]])
    bias = statistics.relative_bias(deviations, torch.zeros(1, 1), 1.0)
    assert not bias.significant  # with two runs, whose spread is hardly known
    row = dataclasses.replace(
        trade.rows[0],
        relative_error=statistics.relative_error(deviations, 1.0),
        spread=statistics.relative_spread(deviations, 1.0),
        bias=bias,
    )
    reference = dataclasses.replace(trade.reference, relative_error=0.001)
    few = dataclasses.replace(trade, rows=(row,), reference=reference, runs=2)
    assert "not significant with 2 runs" in str(few)


def test_table_and_figure_show_every_setting(trade):
    text = str(trade)
    for words in ("16 spp, depth 4", "spp 4096", "max depth 1", "reference: 1000000 spp, depth 8", "≤"):
        assert words in text
    figure = trade.plot()
    (axes,) = figure.axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    texts = all_text(figure)
    for words in ("own: 16 spp, depth 4", "spp", "depth", "4096", "dashed", "mean"):
        assert words in texts


def test_the_figure_names_a_line_only_if_it_has_one(trade):
    assert "grey line: Pareto front" in all_text(trade.plot())
    single = dataclasses.replace(trade, rows=trade.rows[:1])
    assert "grey line" not in all_text(single.plot())


@pytest.mark.parametrize("seed", range(8))
def test_values_in_the_figure_cover_no_error_bar_and_no_other_value(trade, seed):
    """Whatever the times are: they are those of a busy machine."""
    random = np.random.default_rng(seed)
    rows = [dataclasses.replace(row, seconds=10 ** random.uniform(0, 0.3)) for row in trade.rows]
    trade = dataclasses.replace(trade, rows=rows)
    figure = trade.plot()
    figure.canvas.draw()
    (axes,) = figure.axes
    values = [row.value_text for row in trade.rows[1:]]
    boxes = [text.get_window_extent() for text in axes.texts if text.get_text() in values]
    assert len(boxes) == len(values)
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    for row in trade.rows:
        value, error = row.relative_error
        (x, low), (_, high) = (
            axes.transData.transform((row.seconds, y))
            for y in (value - min(error, 0.9 * value), value + error)
        )
        for box in boxes:
            assert x < box.x0 or x > box.x1 or box.y0 > high or box.y1 < low


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"vary": {"sp": [4]}}, "'sp' cannot be varied.*'spp'"),
        ({"vary": {"spp": [0]}}, "spp must be a whole number"),
        ({"vary": {"spp": 4}}, "must be a list of values, not 4"),
        ({"vary": {"max_depth": [-2]}}, "max_depth must be a whole number"),
        ({"vary": {"resolution": [64]}}, "resolution must be"),
        ({"vary": {"integrator": ["path"]}}, "prb.*'path'"),
        ({"vary": {"smoothing": [0]}}, "smoothing must be a positive number"),
        ({"runs": 1}, "runs must be a whole number of at least 2"),
        ({"reference_spp": 1}, "reference_spp"),
        ({"seed": -1}, "seed"),
    ],
)
def test_bad_options_are_refused_before_anything_is_rendered(options, words):
    renderer = Bounces()
    with pytest.raises(SceneCaptumError, match=words):
        measure(renderer, torch.mean, **options)
    assert not renderer.taken


def test_settings_that_a_renderer_cannot_vary_are_named():
    def bare(inputs, *, seed, spp):
        return inputs["x"].expand(2, 2, 3)

    with pytest.raises(SceneCaptumError, match="no attribute `spp`"):
        measure(bare, torch.mean)
    bare.spp, bare.inputs = 4, {"x": torch.tensor(1.0)}
    for key in ("max_depth", "resolution", "integrator", "primal_spp", "gradient_spp"):
        with pytest.raises(SceneCaptumError, match=f"Varying '{key}' needs"):
            measure(bare, torch.mean, vary={key: [2]})
    with pytest.raises(SceneCaptumError, match="All gradients are 0"):
        measure(bare, lambda image: 0 * image.mean(), runs=2)


def test_a_tolerance_that_is_not_positive_is_refused(trade):
    with pytest.raises(SceneCaptumError, match="tolerance"):
        trade.cheapest(0.0)


def test_marks_and_labels_are_dark_enough_to_read_on_white():
    """A contrast of 4.5, as the Web Content Accessibility Guidelines ask of text."""
    for _, _, color, _ in _STYLES.values():
        encoded = torch.tensor([int(color[start : start + 2], 16) / 255 for start in (1, 3, 5)])
        linear = torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        luminance = linear @ torch.tensor([0.2126, 0.7152, 0.0722])
        assert 1.05 / (luminance + 0.05) >= 4.5, color


def compared(*errors: float, reference: float) -> Tradeoff:
    """Settings with these errors, and a reference with its own."""
    one, bias = Estimate(0.9, 0.01), Bias(0.0, 0.01, 0.1)
    rows = [
        Measured("smoothing", Setting(16, 16), 1.0, Estimate(error, 0.01), error, bias, *4 * [one])
        for error in errors
    ]
    return Tradeoff(tuple(rows), Reference(Setting(512, 512), 9.0, reference, 1.0), 4, 3, "logit", "office")


@pytest.mark.parametrize(
    ("errors", "reference", "is_comparable"),
    [
        ((0.99, 1.5, 1.06), 2.0, False),
        ((3.0, 9.0), 0.6, False),
        ((0.2, 0.22), 0.15, False),
        ((0.2, 0.22), 0.05, True),
        ((0.2, 0.5), 0.15, True),
        ((0.2,), 0.15, True),
    ],
)
def test_a_noisy_reference_is_said_first_and_nothing_is_recommended(errors, reference, is_comparable):
    trade = compared(*errors, reference=reference)
    text = trade.text()
    if is_comparable:
        assert "too noisy" not in text
        assert "* on the Pareto front" in text
        assert "should suffice" in text
        return
    assert text.startswith("The reference is too noisy to compare these settings: its error is ")
    assert "reference_spp=" in text.splitlines()[0]
    assert "*" not in text
    assert "should suffice" not in text
    assert not any(record["on_front"] for record in trade.records())
    assert "the reference is too noisy" in all_text(trade.plot())
