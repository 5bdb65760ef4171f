"""The ablation test: it accepts correct gradients and detects wrong ones."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from chance import allowed
from results import all_text
from seeds import shifted
from toy import log_mean

from scenecaptum import IntegratedGradientsScene, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.validation import AblationTest, ablation_test


class Curved:
    """``image = A·[a², √b, e^c, d]`` noise 1/√spp: every parameter with a different non-linearity."""

    spp = 64
    bounds = {"a": (0.0, 1.0), "b": (0.0, math.inf), "c": (-1.0, 1.0), "d": (0.0, 1.0)}  # noqa: RUF012

    def __init__(self, noise: float = 0.1) -> None:
        self.noise = noise
        self.matrix = torch.rand(6, 6, 3, 4, generator=torch.Generator().manual_seed(shifted(3))) + 0.2
        self.inputs = {n: torch.tensor(v) for n, v in {"a": 1.0, "b": 4.0, "c": 0.5, "d": 0.0}.items()}

    def __call__(self, inputs, *, seed, spp):
        a, b, c, d = (inputs[name] for name in "abcd")
        noise = torch.randn(self.matrix.shape, generator=torch.Generator().manual_seed(seed)) / math.sqrt(spp)
        return self.matrix * (1 + self.noise * noise) @ torch.stack([a**2, b.sqrt(), c.exp(), d])


@pytest.mark.parametrize("metric", [torch.mean, log_mean])
def test_right_gradients_agree_in_size_and_order(metric):
    test = ablation_test(Curved(), metric)
    assert [row.agrees for row in test.rows] == [True] * 4, str(test)
    assert test.kendall_tau == 1.0
    assert test.is_confirmed
    z = [
        (row.measured - row.predicted) / math.hypot(row.measured_error, row.predicted_error)
        for row in test.rows
    ]
    assert max(map(abs, z)) < allowed(8, 4), f"z = {z}"


@pytest.mark.parametrize(
    ("predicted", "measured", "outcome"),
    [
        ((0.28, 0.24), (20.0, 5.0), "too noisy"),  # by the noise of this difference, both signs would agree
        ((0.6, 1.2), (-16.0, 6.0), "too noisy"),
        ((5.0, 0.1), (0.0, 0.1), "contradicted"),
        ((5.0, 0.1), (-5.0, 0.1), "contradicted"),
        ((5.0, 0.1), (4.8, 0.2), "as predicted"),
    ],
)
def test_only_what_exceeds_the_noise_of_the_difference_confirms_or_contradicts(predicted, measured, outcome):
    (row, *_) = ablation_test(Curved(), torch.mean, top=1).rows
    row = dataclasses.replace(
        row,
        predicted=predicted[0],
        predicted_error=predicted[1],
        measured=measured[0],
        measured_error=measured[1],
    )
    test = AblationTest((row,), "brightness")
    assert row.above_noise == (outcome != "too noisy")
    assert test.is_confirmed == (outcome == "as predicted"), "what was not tested is not confirmed"
    assert ("measured: opposite sign" in all_text(test.plot())) == (measured[0] < 0)
    assert (
        test.verdict.split(":")[0]
        == {
            "too noisy": "Too noisy to tell",
            "contradicted": "Not confirmed",
            "as predicted": "Confirmed",
        }[outcome]
    )


def test_steps_are_fractions_of_the_range_and_stay_inside():
    steps = {row.name: row.step for row in ablation_test(Curved(), torch.mean).rows}
    # Down the gradient; "d" cannot go below 0 and goes up instead.
    assert steps["a"] == pytest.approx(-0.1)
    assert steps["b"] == pytest.approx(-0.4)
    assert steps["c"] == pytest.approx(-0.2)
    assert steps["d"] == pytest.approx(0.1)


def test_a_strongly_non_linear_metric_gets_a_shorter_step():
    def sharp(image: torch.Tensor) -> torch.Tensor:
        return (20 * (image.mean() - 1)).exp()

    (row,) = [row for row in ablation_test(Curved(0.0), sharp).rows if row.name == "c"]
    assert abs(row.step) < 0.1
    assert row.measured == pytest.approx(row.predicted, rel=0.1)
    assert row.curvature > 0


def test_wrong_gradients_are_detected():
    renderer = Curved()
    right = VanillaSceneGradient(renderer, torch.mean).attribute()
    wrong = dataclasses.replace(
        right, attributions={n: 1.3 * right[n] if n == "a" else right[n] for n in right}
    )
    rows = {row.name: row.agrees for row in ablation_test(renderer, torch.mean, wrong).rows}
    assert rows == {"a": False, "b": True, "c": True, "d": True}
    names = [row.name for row in right.ranking(scale="unit")]
    swapped = dict(zip(names, (right[name] for name in reversed(names)), strict=True))
    assert ablation_test(
        renderer, torch.mean, dataclasses.replace(right, attributions=swapped)
    ).kendall_tau == pytest.approx(-1.0)
    flipped = dataclasses.replace(right, attributions={name: -right[name] for name in right})
    assert not any(row.agrees for row in ablation_test(renderer, torch.mean, flipped).rows)


def test_changes_below_the_noise_are_marked():
    def faint(image: torch.Tensor) -> torch.Tensor:
        return image[0, 0, 0] - image[0, 0, 0].detach() + image.mean()

    test = ablation_test(Curved(noise=30.0), faint, spp=8)
    assert not all(row.above_noise for row in test.rows)
    assert "below the noise" in str(test)


def test_the_jumps_of_a_metric_are_part_of_its_noise():
    """As those of a percentile of a denoised picture; a delete-one jackknife misses or multiplies them."""

    def in_steps(image: torch.Tensor, step: float = 0.2) -> torch.Tensor:
        mean = image.mean()
        return mean + ((mean / step).round() * step - mean).detach()

    rows = [
        row
        for seed in range(10)
        for row in ablation_test(Curved(noise=3.0), in_steps, seed=shifted(seed)).rows
    ]
    contradicted = [row for row in rows if row.above_noise and not row.agrees]
    assert len(contradicted) <= 0.05 * len(rows), contradicted


@pytest.mark.parametrize("metric", [pytest.param(metrics.MeanLuminance(), marks=pytest.mark.long), log_mean])
def test_on_the_cornell_box(mi, metric):
    renderer = SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=256)
    test = ablation_test(renderer, metric, top=4)
    assert all(row.above_noise and row.agrees for row in test.rows), str(test)
    assert test.kendall_tau == 1.0


def test_other_attributions_are_refused():
    renderer = Curved()
    shares = IntegratedGradientsScene(renderer, torch.mean).attribute(n_steps=2)
    with pytest.raises(SceneCaptumError, match="plain gradients"):
        ablation_test(renderer, torch.mean, shares)
    bare = VanillaSceneGradient(renderer, torch.mean).attribute(replicates=1)
    with pytest.raises(SceneCaptumError, match="error bars"):
        ablation_test(renderer, torch.mean, bare)
    with pytest.raises(SceneCaptumError, match="at least 2 samples per pixel"):
        ablation_test(renderer, torch.mean, spp=1)


def test_table_and_figure_show_what_agrees():
    renderer = Curved()
    right = VanillaSceneGradient(renderer, torch.mean).attribute()
    wrong = dataclasses.replace(
        right, attributions={n: 2 * right[n] if n == "a" else right[n] for n in right}
    )
    test = ablation_test(renderer, torch.mean, wrong)
    lines = {line.split()[0]: line for line in str(test).splitlines() if line}
    assert lines["a"].endswith("not as predicted")
    assert not test.is_confirmed
    assert test.verdict.startswith("Not confirmed: 3 of 4 parameters above the noise")
    (axes,) = test.plot().axes
    assert [label.get_text() for label in axes.get_yticklabels()] == [row.label for row in test.rows]
    texts = {text.get_text() for text in axes.get_legend().get_texts()}
    assert {"predicted: the saliency", "measured: not as predicted", "noise"} < texts


def test_a_test_of_nothing_is_drawn_with_its_verdict():
    test = ablation_test(Curved(), lambda image: 0 * image.sum(), top=2)
    assert not test.rows
    assert not test.is_confirmed
    assert "Nothing to test" in str(test)
    assert "Nothing to test" in " ".join(all_text(test.plot()).split())


@pytest.mark.parametrize(
    ("predicted", "measured", "remark"),
    [
        ((5.0, 0.1), (0.5, 1.7), "below the noise, but unlike predicted"),
        ((5.0, 0.1), (4.0, 1.7), "below the noise: prediction not confirmed"),
        ((5.0, 2.0), (0.5, 1.7), "below the noise"),
    ],
)
def test_a_clear_prediction_below_the_noise_is_not_hidden(predicted, measured, remark):
    row, other, *_ = ablation_test(Curved(noise=0.0), torch.mean, top=2).rows
    names = ("predicted", "predicted_error"), ("measured", "measured_error")
    given = {
        name: n
        for pair, side in zip(names, (predicted, measured), strict=True)
        for name, n in zip(pair, side, strict=True)
    }
    test = AblationTest((dataclasses.replace(row, **given), other), "brightness")
    assert str(test).splitlines()[1].endswith(f"  {remark}")
    assert ("1 of them unlike predicted at 95 %" in test.verdict) == ("unlike" in remark)


def test_derivatives_that_are_known_to_be_wrong_are_marked():
    right = VanillaSceneGradient(Curved(), torch.mean).attribute()
    marked = dataclasses.replace(right, info={**right.info, "cautions": {"b": "biased here"}})
    test = ablation_test(Curved(), torch.mean, marked)
    assert {row.name: row.caution for row in test.rows} == {"a": "", "b": "biased here", "c": "", "d": ""}
    lines = str(test).splitlines()
    assert [line.split()[0] for line in lines if line.split()[1:2] == ["!"]] == ["b"]
    assert "! biased here" in lines
    drawn = all_text(test.plot())
    assert "! b" in drawn.splitlines()
    assert "! biased here" in drawn


def test_the_fixed_step_of_the_paper_is_measured_too():
    test = ablation_test(Curved(noise=0.0), torch.mean)
    rows = {row.name: row for row in test.rows}
    renderer = Curved(noise=0.0)
    for name in "abc":
        step = 0.01 * rows[name].predicted
        values = {**renderer.inputs, name: renderer.inputs[name] - step}
        fall = (
            renderer(renderer.inputs, seed=shifted(), spp=1).mean()
            - renderer(values, seed=shifted(), spp=1).mean()
        )
        assert rows[name].fixed == pytest.approx(fall.item() / step, rel=1e-2), name
    # "d" is at its lower bound, and rises.
    assert rows["d"].fixed is None
    assert "measured with a step of 0.01 of the gradient" in {
        text.get_text() for text in test.plot().axes[0].get_legend().get_texts()
    }


def test_no_step_reaches_a_bound():
    """For example of a roughness, whose bound at 0 is outside its range."""

    class Open(Curved):
        def __call__(self, inputs, *, seed, spp):
            assert inputs["a"] > 0
            return super().__call__(inputs, seed=seed, spp=spp)

    near = Open()
    near.inputs["a"] = torch.tensor(0.5)  # closer than a hundredth of its gradient
    rows = {row.name: row for row in ablation_test(near, lambda image: 1e5 * image.mean()).rows}
    assert rows["a"].predicted > 100 * 0.5
    assert rows["a"].fixed is not None


def test_a_fixed_step_below_the_rounding_of_the_metric_is_left_out():
    """A hundredth of a small gradient changes a float32 by chance only."""
    renderer = Curved(noise=0.0)
    test = ablation_test(renderer, lambda image: 1e-4 * image.mean() + 1)
    assert all(row.fixed is None for row in test.rows)
    assert "0.01 of the gradient" not in str(test.plot().axes[0].get_legend().get_texts())


class Textured(Curved):
    """A texture with a black and a white quarter, one of black and white halves, and a sky with a sun."""

    bounds = {"wall": (0.0, 1.0), "chess": (0.0, 1.0), "sky": (0.0, math.inf)}  # noqa: RUF012

    def __init__(self, noise: float = 0.1) -> None:
        super().__init__(noise)
        wall = torch.tensor([[0.0, 0.3], [0.6, 1.0]])[..., None].repeat(1, 1, 3)
        chess = torch.tensor([[0.0, 1.0], [1.0, 0.0]])[..., None].repeat(1, 1, 3)
        sky = torch.full((4, 4, 3), 0.5)
        sky[0, 0] = 50.0  # the sun
        self.inputs = {"wall": wall, "chess": chess, "sky": sky}

    def __call__(self, inputs, *, seed, spp):
        noise = torch.randn(self.matrix.shape, generator=torch.Generator().manual_seed(seed)) / math.sqrt(spp)
        means = torch.stack([inputs[name].mean((0, 1)) for name in self.inputs], -1) * torch.tensor(
            [2.0, 1.0, 0.1]
        )
        return (self.matrix[..., :3] * (1 + self.noise * noise[..., :3]) * (1 + means) ** 2).sum(
            -1, keepdim=True
        )


def test_textures_move_only_texels_inside_their_bounds():
    test = ablation_test(Textured(), torch.mean)
    rows = {row.name: row for row in test.rows}
    assert rows["wall"].agrees, str(test)
    assert abs(rows["wall"].step) == pytest.approx(0.1)
    # The sun does not limit how far the sky may be moved.
    assert rows["sky"].agrees
    assert abs(rows["sky"].step) < 0.5
    assert rows["wall"].fixed == pytest.approx(rows["wall"].predicted, rel=0.05)
    # Each half can move in one direction only.
    assert rows["chess"].agrees
