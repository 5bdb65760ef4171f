"""Whether attributions add up: the errors of integrals, and the verdict, on renderers of a few lines."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import (
    GradientShapScene,
    IntegratedGradientsScene,
    SceneAttribution,
    ShapleyValueScene,
    metrics,
)
from scenecaptum.attr._convergence import TOLERANCE, verdict
from scenecaptum.visualization import table_text

REPEATS = 12
SURE = 1 - 1e-4  # for each of about a hundred elements, most of them correlated


def log_mean(image: torch.Tensor) -> torch.Tensor:
    return torch.log(image.mean() + 0.01)


class Sheet(ToyRenderer):
    """The same, seen through a sheet with a tint for each texel."""

    def __init__(self, noise: float = 0.3) -> None:
        super().__init__(noise)
        self.inputs = {**self.inputs, "tint": torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(2))}

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return super().__call__(inputs, seed=seed, spp=spp) * (1 + inputs["tint"])


def exact(renderer: ToyRenderer, **settings) -> SceneAttribution:
    quiet = type(renderer)(0.0)
    return IntegratedGradientsScene(quiet, log_mean).attribute(n_steps=128, baselines=0.0, **settings)


@pytest.mark.parametrize(
    ("n_steps", "groups"),
    [
        (4, None),
        (8, {"all": "*"}),
        (32, None),
        *(
            pytest.param(*one, marks=pytest.mark.long)
            for one in ((4, {"all": "*"}), (8, None), (32, {"all": "*"}))
        ),
    ],
)
def test_each_integral_lies_within_its_error_from_black(n_steps, groups):
    """With 8 steps the quadrature error is many times the noise."""
    renderer = Sheet(noise=0.1)
    truth = exact(renderer, groups=groups)
    method = IntegratedGradientsScene(renderer, log_mean)
    for seed in seeds(REPEATS):
        found = method.attribute(n_steps=n_steps, baselines=0.0, spp=4096, groups=groups, seed=seed)
        for name, (low, high) in found.interval(SURE).items():
            assert ((low <= truth[name]) & (truth[name] <= high)).all(), (
                f"{name}: {low} to {high}, {truth[name]}"
            )
            error, width = found.saliency_error()[name], (high - low).sum() / found.standard_error[name].sum()
            assert abs(found.saliency()[name] - truth.saliency()[name]) < width / 2 * error
        assert abs(found.convergence_delta) < allowed(8) * found.convergence_delta_error
        assert found.info["convergence"] == ("adds up" if n_steps == 32 else "inconclusive")
    assert n_steps != 8 or abs(found.convergence_delta) > 4 * noise_of(found)


def noise_of(found: SceneAttribution) -> float:
    return math.sqrt(found.convergence_delta_error**2 - found.info["quadrature_error"] ** 2)


def test_the_error_of_a_quadrature_is_a_part_of_each_error():
    found = IntegratedGradientsScene(Sheet(), log_mean).attribute(n_steps=8, baselines=0.0, seed=shifted())
    own = found.quadrature_error["x"]
    assert (found.standard_error["x"] >= own).all()
    assert (found.covariance["x"].diagonal().sqrt() >= own).all()
    # The texels of a channel are wrong together, and in proportion to their attributions.
    assert (found.standard_error["tint"].sum((0, 1)) >= found.quadrature_error["tint"]).all()
    assert found.info["quadrature_error"] == pytest.approx(
        sum(one.sum().item() for one in found.quadrature_error.values()), rel=0.2
    )


def test_a_difference_includes_the_quadrature_errors_of_both():
    renderer = Sheet()
    one, other = (
        IntegratedGradientsScene(renderer, metric).attribute(n_steps=8, baselines=0.0, seed=shifted())
        for metric in (log_mean, lambda image: log_mean(image[:2]))
    )
    both = one - other
    for name, error in both.quadrature_error.items():
        torch.testing.assert_close(error, one.quadrature_error[name].hypot(other.quadrature_error[name]))
        assert (both.covariance[name].diagonal().sqrt() >= error).all()
    assert both.info["explained"] == pytest.approx(one.info["explained"] - other.info["explained"])
    assert both.info["convergence"] == "inconclusive"
    assert "quadrature_error" not in both.info


def test_quadrature_errors_are_saved(tmp_path):
    found = IntegratedGradientsScene(Sheet(), log_mean).attribute(n_steps=4, baselines=0.0)
    found.save(tmp_path / "found.npz")
    loaded = SceneAttribution.load(tmp_path / "found.npz")
    assert loaded.quadrature_error.keys() == found.quadrature_error.keys()
    assert torch.equal(loaded.quadrature_error["tint"], found.quadrature_error["tint"])
    assert str(loaded) == str(found)


@pytest.mark.parametrize(
    ("delta", "error", "explained", "said"),
    [
        (0.01, 0.019, 1.0, "adds up"),
        (-0.01, 0.019, -1.0, "adds up"),
        (0.01, 0.021, 1.0, "inconclusive"),
        (5.81, 7.25, 0.92, "inconclusive"),
        (0.14, 0.026, 1.0, "does not add up"),  # of 1000 degrees of freedom: 3.30 errors
        (-0.14, 0.028, 1.0, "inconclusive"),
        (0.0, 0.0, 0.0, "adds up"),
        (0.0, 0.1, 0.0, "inconclusive"),
        (0.2, 0.01, 0.0, "does not add up"),
        (math.inf, 0.1, -math.inf, "inconclusive"),
        (math.nan, 0.1, math.nan, "inconclusive"),
        (0.0, None, 1.0, "adds up"),
        (0.01, None, 1.0, "inconclusive"),
    ],
)
def test_the_verdict_has_three_values(delta, error, explained, said):
    assert verdict(delta, error, explained, 1000) == said


def test_the_error_of_few_draws_is_no_proof_that_attributions_do_not_add_up():
    # Student's t at 0.1 %: 8.61 of 4 degrees of freedom, 5.41 of 7, 3.75 of 24.
    for freedom, errors in ((4, 8.61), (7, 5.41), (24, 3.75)):
        assert verdict(0.05 + 0.101 * errors, 0.1, 1.0, freedom) == "does not add up"
        assert verdict(0.05 + 0.099 * errors, 0.1, 1.0, freedom) == "inconclusive"


def test_rounding_is_allowed_for():
    assert verdict(1e-6, 0.0, 0.0, 7, rounding=1e-5) == "adds up"
    assert verdict(1e-6, None, 1.0, 7, rounding=1e-5) == "adds up"


def test_the_verdict_is_printed_with_its_reasons():
    found = IntegratedGradientsScene(ToyRenderer(), log_mean).attribute(
        n_steps=8, baselines=0.0, seed=shifted()
    )
    info = {**found.info, "convergence": "inconclusive", "quadrature_error": 0.3}
    made = dataclasses.replace(found, convergence_delta=-0.52, convergence_delta_error=0.31, info=info)
    text = " ".join(str(made).split())
    assert "inconclusive whether the effects add up: delta −0.52 ± 0.31 of" in text
    assert "mostly quadrature error: use more steps" in text
    noisy = dataclasses.replace(made, info={**made.info, "quadrature_error": 0.1})
    assert "quadrature" not in str(noisy)
    assert "mostly noise: use more samples" in " ".join(str(noisy).split())
    assert "mostly noise" not in text
    added_up = dataclasses.replace(made, info={**made.info, "convergence": "adds up"})
    assert "use more" not in str(added_up)
    assert f"adds up within {100 * TOLERANCE:g} %: delta −0.52 ± 0.31 of" in str(added_up)


def test_completeness_is_undecided_if_the_metric_is_infinite_at_the_baseline():
    """The gradient there is infinite too; a Riemann sum uses it for its error only."""

    def log_of_black(image: torch.Tensor) -> torch.Tensor:
        return torch.log(image.mean())

    found = IntegratedGradientsScene(ToyRenderer(), log_of_black).attribute(
        n_steps=8, baselines=0.0, method="riemann_middle", seed=shifted()
    )
    assert found.info["explained"] is None
    assert found.info["convergence"] == "inconclusive"
    assert "inconclusive whether the effects add up: the metric is not finite at the baseline" in " ".join(
        table_text(found).split()
    )
    assert (found.standard_error["x"] > 0).all()


def test_shapley_values_add_up_by_construction():
    found = ShapleyValueScene(Sheet(), log_mean).attribute(baselines=0.0, replicates=4, seed=shifted())
    assert found.info["convergence"] == "adds up"
    text = " ".join(str(found).split())
    assert f"adds up to {found.info['explained']:.3f} by construction" in text
    assert "delta" not in text


def test_the_error_of_gradient_shap_includes_the_choice_of_scenes():
    found = GradientShapScene(ToyRenderer(noise=0.1), metrics.MeanLuminance()).attribute(
        baselines=[0.1, 0.2], n_samples=200, spp=4000, seed=shifted()
    )
    assert found.quadrature_error is None
    assert abs(found.convergence_delta) < allowed(8) * found.convergence_delta_error
    assert found.info["convergence"] == "adds up"
