"""Faithfulness measures against closed forms and Captum, within their stated errors."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    IntegratedGradientsScene,
    ShapleyValueScene,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
)
from scenecaptum.errors import SceneCaptumError
from scenecaptum.estimation import student_t
from scenecaptum.validation import (
    DeletionInsertion,
    Infidelity,
    SensitivityN,
    deletion_insertion,
    infidelity,
    sensitivity_n,
)
from scenecaptum.validation._faithfulness import perturbations
from scenecaptum.validation._faithfulness_result import statistic_with_error

SAMPLES = 40


class Lamps(ToyRenderer):
    """``image = A·x``, every lamp a separate parameter."""

    def __init__(self, noise: float = 0.0, lamps: int = 5) -> None:
        super().__init__(noise)
        generator = torch.Generator().manual_seed(shifted(2))
        self.matrix = torch.rand(4, 4, 3, lamps, generator=generator) + 0.1
        # Some are negative, so that magnitude and sign differ.
        self.inputs = {f"lamp {k}": torch.tensor(0.9 - 0.35 * k) for k in range(lamps)}
        self.bounds = dict.fromkeys(self.inputs, (-2.0, 2.0))

    def __call__(self, inputs, *, seed, spp):
        return self.sampled(seed, spp) @ torch.stack(list(inputs.values()))


def bent(image: torch.Tensor) -> torch.Tensor:
    return image.double().mean().exp()


def product_of_three(image: torch.Tensor) -> torch.Tensor:
    return image[0, 0].double().prod()


# --- infidelity --------------------------------------------------------------------------------------------------


def test_gradients_of_a_linear_function_have_no_infidelity():
    found = infidelity(Lamps(), torch.mean, n_perturb_samples=SAMPLES)
    assert found.normalized == pytest.approx(0, abs=1e-9)
    assert found.value == pytest.approx(0, abs=1e-12)
    assert "noise of the gradients" not in str(found), "there is none"


@pytest.mark.parametrize("metric", [bent, product_of_three])
def test_infidelity_is_that_of_captum(metric):
    captum = pytest.importorskip("captum.metrics", reason="captum is not installed")
    renderer = ToyRenderer(noise=0.0)
    renderer.bounds = {"x": (0.0, 1.0)}
    gradient = VanillaSceneGradient(renderer, metric).attribute()
    found = infidelity(renderer, metric, gradient, stdevs=0.3, n_perturb_samples=SAMPLES, seed=shifted(4))
    drawn = torch.stack(
        [one["x"] for one in perturbations(renderer, renderer.inputs, 0.3, SAMPLES, shifted(4))]
    )
    assert ((drawn >= 0) & (drawn <= 1)).all(), "the perturbations leave the bounds"

    def forward(batch):
        return torch.stack([metric(renderer.exact({"x": row})) for row in batch])

    judge = captum.infidelity(
        forward,
        lambda inputs: (inputs - drawn, drawn),
        renderer.inputs["x"][None],
        gradient["x"][None],
        n_perturb_samples=SAMPLES,
    )
    assert found.value > 1e-6, "nothing to compare"
    assert found.value == pytest.approx(judge.item(), rel=1e-3)


def check_mean(found: list[Infidelity], exact: Infidelity, *, spread: float) -> None:
    """Check that the mean is the exact value, and the errors. They include the draws, which differ as well."""
    right, uncertain = exact.value, exact.standard_error
    values = np.array([one.value for one in found])
    z = (values - right) / np.hypot([one.standard_error for one in found], uncertain)
    error = math.hypot(values.std(ddof=1) / math.sqrt(len(values)), uncertain)
    assert abs(values.mean() - right) < allowed(len(values)) * error, z
    assert 0.3 < np.std(z) < spread, z


def naive_mean(found: list[Infidelity]) -> float:
    """Return the mean square error that includes the noise."""
    return np.mean([(one.predicted - one.measured.mean(1)).square().mean().item() for one in found]).item()


@pytest.fixture(scope="module")
def exact() -> Infidelity:
    """Return the infidelity of exact gradients, of many perturbations."""
    gradient = VanillaSceneGradient(Lamps(), bent).attribute(denoise=False)
    return infidelity(Lamps(), bent, gradient, n_perturb_samples=20 * SAMPLES)


def test_render_noise_is_not_counted_as_infidelity(exact):
    gradient = VanillaSceneGradient(Lamps(), bent).attribute(denoise=False)
    found = [
        infidelity(Lamps(noise=1.0), bent, gradient, n_perturb_samples=SAMPLES, seed=seed, spp=64)
        for seed in seeds(20)
    ]
    check_mean(found, exact, spread=1.9)
    # Noise of this size would have been visible.
    assert naive_mean(found) > 1.05 * np.mean([one.value for one in found])


def test_noise_of_the_gradients_is_not_counted_as_infidelity(exact):
    noisy = Lamps(noise=4.0)
    found = []
    for seed, other in zip(seeds(20), seeds(40)[20:], strict=True):
        gradient = VanillaSceneGradient(noisy, bent).attribute(seed=other, spp=64, denoise=False)
        found.append(infidelity(Lamps(), bent, gradient, n_perturb_samples=SAMPLES, seed=seed))
    check_mean(found, exact, spread=2.2)
    values = [one.value for one in found]
    assert naive_mean(found) - np.mean(values) > 0.3 * exact.value, "the noise would not have been visible"


def test_wrong_gradients_have_a_large_infidelity():
    renderer = Lamps()
    right = VanillaSceneGradient(renderer, bent).attribute()
    # The gradients of another metric, and SmoothGrad's of the same.
    wrong = VanillaSceneGradient(renderer, lambda image: -bent(image)).attribute()
    smooth = SmoothGradScene(renderer, bent).attribute(nt_samples=16)
    missed = [infidelity(renderer, bent, one, stdevs=0.02).normalized for one in (right, smooth, wrong)]
    assert missed[0] < 0.02
    assert missed[1] < 0.1
    assert missed[2] == pytest.approx(4, rel=0.2)  # (1 − (−1))²


def noisy(size: float, noise: float = 1.0, seed: int = 0) -> Infidelity:
    """Predictions of a tenth too little, and changes with noise that the perturbations partly share."""
    generator = torch.Generator().manual_seed(shifted(seed))

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(shape, dtype=torch.float64, generator=generator)

    predicted = size * drawn(8)
    measured = 1.1 * predicted[:, None] + noise * (drawn(8, 8) + drawn(1, 8))
    return Infidelity(predicted, measured, "Glare", "VanillaSceneGradient")


def relative_to_changes(found: Infidelity) -> tuple[str, str]:
    """Return what the table and the figure say of the ratio."""
    [row] = [line for line in str(found).splitlines() if line.startswith("relative")]
    *_, footnote = found.plot().axes[0].texts
    start = "relative to the mean square change"
    note = " ".join(footnote.get_text().split()).removesuffix(" error bars: ± 1 standard error")
    return row.removeprefix(start).strip(), note.removeprefix(f"{start}: ")


def test_a_ratio_to_changes_within_the_noise_is_not_stated():
    said = "too noisy to tell, since the changes are within the noise of rendering; use more samples"
    found = noisy(0.0)
    assert relative_to_changes(found) == (said, said)
    assert math.isnan(found.normalized)
    assert math.isnan(found.normalized_error)
    assert math.isfinite(found.value)
    none = dataclasses.replace(found, measured=torch.zeros(8, 8, dtype=torch.float64))
    assert relative_to_changes(none) == ("not defined, since the metric did not change",) * 2
    assert math.isnan(none.normalized)
    clear = noisy(20.0)
    row, footnote = relative_to_changes(clear)
    assert " ± " in row
    assert " ± " in footnote
    assert footnote.endswith(" %")
    assert clear.normalized == pytest.approx(0.01 / 1.21, abs=0.02)


def test_predictions_that_are_mostly_noise_of_the_gradients_have_no_ratio():
    clear = noisy(20.0)
    deviations = torch.linspace(-1, 1, 8, dtype=torch.float64) * clear.predicted[:, None]
    few = dataclasses.replace(clear, replicates=clear.predicted[:, None] + 0.2 * deviations)
    assert math.isfinite(few.normalized)
    assert few.standard_error > clear.standard_error
    assert "their error from the noise of the gradients" in str(few)
    assert few.plot().axes[0].containers[0].has_xerr
    assert not clear.plot().axes[0].containers[0].has_xerr
    assert "noise of the gradients" not in str(clear)
    many = dataclasses.replace(clear, replicates=clear.predicted[:, None] + 8 * deviations)
    assert math.isnan(many.normalized)
    said = "within the noise of the gradients; use more samples for the attribution"
    assert all(one.endswith(said) for one in relative_to_changes(many))
    within = noisy(0.0)
    both = dataclasses.replace(within, replicates=10 * torch.linspace(-1, 1, 8).double().expand(8, 8))
    assert "noise of rendering and of the gradients; use more samples for both" in str(both)


def test_a_ratio_that_is_stated_has_a_useful_error():
    # From changes far below the noise to changes above it; of those between, only some are clear.
    found = [noisy(size, seed=seed) for size in (0.0, 0.3, 0.6, 1.0, 6.0) for seed in range(8)]
    stated = [one for one in found if not math.isnan(one.normalized)]
    assert 8 <= len(stated) <= 24
    for one in stated:
        assert abs(one.normalized) < 1, one
        assert one.normalized_error < 1, one


def test_few_perturbations_do_not_hide_changes_without_noise():
    for seed in range(8):
        assert noisy(1.0, noise=0.0, seed=seed).normalized == pytest.approx(0.01 / 1.21)


def test_the_jackknife_of_a_mean_is_its_standard_error():
    predicted, measured = torch.randn(30, dtype=torch.float64), torch.zeros(30, 4, dtype=torch.float64)
    value, error = statistic_with_error(lambda p, m: p.mean(), predicted, measured)
    assert value == pytest.approx(predicted.mean().item())
    assert error == pytest.approx(predicted.std().item() / math.sqrt(30))


# --- sensitivity-n -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [IntegratedGradientsScene, ShapleyValueScene, FeatureAblationScene])
def test_correlations_of_a_linear_function_are_perfect(method):
    renderer = Lamps()
    attribution = method(renderer, torch.mean).attribute()
    found = sensitivity_n(renderer, torch.mean, attribution, subsets=8)
    assert found.sizes == (1, 2, 3, 4)
    assert found.correlations == pytest.approx([1.0] * 4, abs=1e-5)
    assert [len(one) for one in found.predicted] == [5, 8, 8, 5]


def test_correlations_are_those_over_all_subsets():
    renderer = Lamps()
    attribution = IntegratedGradientsScene(renderer, bent).attribute()
    found = sensitivity_n(renderer, bent, attribution, subsets=100)
    names = [row.name for row in attribution.ranking()]
    for size, correlation in zip(found.sizes, found.correlations, strict=True):
        pairs = []
        for chosen in itertools.combinations(names, size):
            left = {n: torch.zeros(()) if n in chosen else v for n, v in renderer.inputs.items()}
            change = bent(renderer(renderer.inputs, seed=shifted(), spp=1)) - bent(
                renderer(left, seed=shifted(), spp=1)
            )
            pairs.append((sum(attribution[n].item() for n in chosen), change.item()))
        assert correlation == pytest.approx(np.corrcoef(np.transpose(pairs))[0, 1], abs=1e-4)
        assert correlation < 0.9999, "a linear function shows nothing"


def test_errors_of_correlations_are_right():
    renderer = Lamps(lamps=8)
    attribution = IntegratedGradientsScene(renderer, product_of_three).attribute()
    whole = sensitivity_n(renderer, product_of_three, attribution, sizes=[4], subsets=70)
    assert whole.standard_errors[0] < 1e-6  # all of 8 over 4, without noise
    drawn = [
        sensitivity_n(renderer, product_of_three, attribution, sizes=[4], subsets=20, seed=seed)
        for seed in seeds(20)
    ]
    z = [(one.correlations[0] - whole.correlations[0]) / one.standard_errors[0] for one in drawn]
    assert abs(np.mean(z)) < 1.2, z
    assert 0.4 < np.std(z) < 2.0, z


def test_a_constant_metric_has_no_correlation():
    found = sensitivity_n(Lamps(), lambda image: (image.sum() * 0 + 1) * 3, _zeros(), sizes=[2])
    assert math.isnan(found.correlations[0])
    assert str(found).splitlines()[-1].split() == ["2", "10", "-"]


def _zeros():
    return FeatureAblationScene(Lamps(), lambda image: image.sum() * 0).attribute()


# --- deletion and insertion --------------------------------------------------------------------------------------


def test_curves_of_a_linear_function_are_cumulative_sums():
    renderer = Lamps()
    curves = deletion_insertion(renderer, torch.mean)
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute()
    parts = torch.stack([gradient[name] * renderer.inputs[name] for name in curves.names]).double()
    assert parts.abs().tolist() == sorted(parts.abs().tolist(), reverse=True)
    assert (parts < 0).any()
    deletion = torch.cat([torch.zeros(1), -parts.cumsum(0)]) + parts.sum()
    insertion = torch.cat([torch.zeros(1), parts.cumsum(0)])
    torch.testing.assert_close(curves.deletion.mean(1), deletion.double(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(curves.insertion.mean(1), insertion.double(), rtol=1e-4, atol=1e-5)
    expected = np.trapezoid((deletion - deletion[0]).abs(), dx=1 / 5)
    assert curves.deletion_area[0] == pytest.approx(expected, rel=1e-3)
    backwards = np.trapezoid((insertion - insertion[-1]).abs(), dx=1 / 5)
    assert curves.insertion_area[0] == pytest.approx(backwards, rel=1e-3)


@pytest.mark.parametrize(("steps", "moved"), [(3, [0, 1, 2, 3]), (2, [0, 2, 3])])
def test_random_orders_are_measured_with_the_same_areas(steps, moved):
    renderer = Lamps(lamps=3)
    curves = deletion_insertion(renderer, torch.mean, random_orders=40, steps=steps)
    assert curves.moved.tolist() == moved
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute()
    parts = [gradient[name].item() * renderer.inputs[name].item() for name in curves.names]
    sums = [np.cumsum([0, *order]) for order in itertools.permutations(parts)]
    # A random deletion in reverse is an insertion.
    left = [3 - count for count in reversed(moved)]
    exact = (
        {round(np.trapezoid(np.abs(one[moved]), moved) / 3, 4) for one in sums},
        {round(np.trapezoid(np.abs(one[3] - one[left]), left) / 3, 4) for one in sums},
    )
    assert tuple({round(area, 4) for area in row.tolist()} for row in curves.random_areas) == exact


def test_the_right_order_is_better_than_random_and_the_wrong_one_worse():
    renderer = Lamps(noise=0.3)
    # All lamps are positive: no order is better than that of their sizes.
    renderer.inputs = {name: value.abs() for name, value in renderer.inputs.items()}
    right = IntegratedGradientsScene(renderer, torch.mean).attribute()
    best = deletion_insertion(renderer, torch.mean, right)
    deletions, insertions = best.random_areas
    assert (best.deletion_area[0] >= deletions - 1e-6).all()
    assert (best.insertion_area[0] <= insertions + 1e-6).all()
    worst = deletion_insertion(renderer, torch.mean, _reversed(right))
    assert worst.deletion_area[0] < deletions.mean()
    assert worst.insertion_area[0] > insertions.mean()


def _reversed(attribution):
    names = [row.name for row in attribution.ranking()]
    turned = {name: attribution[other] for name, other in zip(names, reversed(names), strict=True)}
    return dataclasses.replace(attribution, attributions=turned)


def test_errors_of_areas_are_the_spread_over_repeats():
    areas = []
    renderer = Lamps(noise=3.0)
    attribution = IntegratedGradientsScene(Lamps(), torch.mean).attribute()
    exact = deletion_insertion(Lamps(), torch.mean, attribution, random_orders=2)
    for seed in seeds(60):
        curves = deletion_insertion(renderer, torch.mean, attribution, random_orders=2, seed=seed)
        areas += [
            (curves.deletion_area[0] - exact.deletion_area[0], curves.deletion_area[1]),
            (curves.insertion_area[0] - exact.insertion_area[0], curves.insertion_area[1]),
        ]
    off, bars = np.array(areas).reshape(-1, 2).T
    assert 0.6 < np.sqrt(np.mean(off**2) / np.mean(bars**2)) < 1.5, areas
    # The two areas of a run are correlated: 60 are independent. Of 120, 6 may miss by Student's t.
    assert abs(off.mean()) < allowed(60) * off.std() / np.sqrt(60), areas
    assert np.sum(np.abs(off) > student_t(0.95, 7) * bars) <= 20, areas


def test_many_parameters_move_in_few_steps():
    curves = deletion_insertion(Lamps(lamps=7), torch.mean, steps=3, random_orders=2)
    assert curves.moved.tolist() == [0, 2, 5, 7]
    assert len(curves.names) == 7
    assert "+ 1 more" in str(curves)


def test_axes_count_whole_parameters():
    figure = deletion_insertion(Lamps(lamps=3), torch.mean, random_orders=2).plot()
    for ax in figure.axes:
        assert [tick % 1 for tick in ax.get_xticks()] == [0] * len(ax.get_xticks())


def test_parameters_at_their_baselines_are_left_out():
    renderer = Lamps()
    renderer.inputs["lamp 1"] = torch.tensor(0.0)
    curves = deletion_insertion(renderer, torch.mean, random_orders=2)
    assert "lamp 1" not in curves.names
    assert len(curves.names) == 4


# --- bad input, tables and figures -------------------------------------------------------------------------------


def test_invalid_input_is_refused():
    renderer = Lamps()
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute()
    shares = IntegratedGradientsScene(renderer, torch.mean).attribute(n_steps=2)
    grouped = FeatureAblationScene(renderer, torch.mean).attribute(groups={"all": ["lamp*"]})
    grouped_gradient = VanillaSceneGradient(renderer, torch.mean).attribute(groups={"all": ["lamp*"]})
    with pytest.raises(SceneCaptumError, match=r"not IntegratedGradientsScene's .* sensitivity_n"):
        infidelity(renderer, torch.mean, shares)
    for function in (sensitivity_n, deletion_insertion):
        with pytest.raises(
            SceneCaptumError,
            match=r"^VanillaSceneGradient returns .* 'gradient per unit', but .* needs contributions",
        ):
            function(renderer, torch.mean, gradient)
        for of_groups in (grouped, grouped_gradient):  # no method with groups= would do
            with pytest.raises(SceneCaptumError, match=r"'all', which is not an input.* without groups="):
                function(renderer, torch.mean, of_groups)
        with pytest.raises(SceneCaptumError, match="not 1"):
            function(Lamps(lamps=1), torch.mean)
    dark = FeatureAblationScene(renderer, torch.mean).attribute()
    with pytest.raises(SceneCaptumError, match=r"not finite with \d parameters at their baselines"):
        deletion_insertion(renderer, lambda image: image.mean().log(), dark)
    with pytest.raises(SceneCaptumError, match="replicates must be a whole number of at least 3"):
        infidelity(renderer, torch.mean, replicates=2)
    with pytest.raises(SceneCaptumError, match="sizes must be a whole number from 1 to 4"):
        sensitivity_n(renderer, torch.mean, shares, sizes=[5])


def test_tables_and_figures():
    replicates = torch.tensor([-1e-3, 1e-3, 0.0, 0.0], dtype=torch.float64)
    curve = torch.tensor([3.0, 1.0, 0.0], dtype=torch.float64)[:, None]
    curves = DeletionInsertion(
        names=("a", "b"),
        labels=("lamp", "wall"),
        moved=torch.tensor([0, 1, 2]),
        # All share the noise of the complete scene.
        deletion=curve + torch.tensor([[1.0], [0.0], [0.0]]) * replicates,
        insertion=curve.flip(0) + torch.tensor([[0.0], [0.0], [1.0]]) * replicates,
        random=torch.stack([curve + replicates, curve + 0.5 + replicates]),
        metric="Glare",
        method="IntegratedGradientsScene",
    )
    lines = str(curves).splitlines()
    assert "Glare = 3.0000 ± 0.0004" in lines[0]
    assert lines[5].split() == ["1", "lamp", "−2.0000", "±", "0.0004", "−2.0000", "±", "0.0004"]
    assert "random orders by deletion" in lines[-1]
    assert [ax.get_title(loc="left") for ax in curves.plot().axes] == ["Deletion", "Insertion"]
    missed = Infidelity(
        predicted=torch.linspace(-1, 1, 9, dtype=torch.float64),
        measured=torch.linspace(-1, 1, 9, dtype=torch.float64)[:, None] * 1.1 + replicates,
        metric="Glare",
        method="VanillaSceneGradient",
    )
    assert "infidelity of VanillaSceneGradient" in str(missed)
    assert missed.normalized == pytest.approx(0.01 / 1.21, rel=1e-3)
    assert "Glare" in missed.plot().axes[0].get_ylabel()
    ranked = SensitivityN(
        parameters=9,
        sizes=(1, 3),
        predicted=(missed.predicted, missed.predicted),
        measured=(missed.measured, -missed.measured),
        metric="Glare",
        method="ShapleyValueScene",
    )
    assert ranked.correlations == pytest.approx((1, -1), abs=1e-5)
    assert [line.split()[:2] for line in str(ranked).splitlines()[3:]] == [["1", "9"], ["3", "9"]]
    assert ranked.plot().axes[0].get_ylim()[0] < -1


def test_on_the_cornell_box(mi, cornell):
    found = infidelity(cornell, metrics.MeanLuminance(), stdevs=0.02, n_perturb_samples=12)
    assert found.normalized - 3 * found.normalized_error < 0.05, str(found)
