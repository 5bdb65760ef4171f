"""Checks of an attribution render the scene at the values for which it was made, with its baselines."""

from __future__ import annotations

import math

import pytest
import torch
from seeds import shifted
from toy import log_mean

from scenecaptum import (
    GradientShapScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    VanillaSceneGradient,
)
from scenecaptum.errors import SceneCaptumError
from scenecaptum.validation import ablation_test, deletion_insertion, infidelity, interactions, sensitivity_n

BRIGHT = 5.0


class Lit:
    """``image = light·A·[wall, floor², mean(texture)]``, without noise."""

    spp = 16

    def __init__(self) -> None:
        self.matrix = torch.rand(4, 4, 3, 3, generator=torch.Generator().manual_seed(shifted(3))) + 0.2
        self.inputs = {
            "light": torch.tensor(1.0),
            "wall": torch.tensor(0.5),
            "floor": torch.tensor(0.3),
            "texture": torch.linspace(0.2, 0.8, 12).reshape(2, 2, 3),
        }
        self.bounds = {**dict.fromkeys(self.inputs, (0.0, 1.0)), "light": (0.0, math.inf)}

    def __call__(self, inputs, *, seed, spp):
        light, wall, floor, texture = inputs.values()
        return light * self.matrix @ torch.stack([wall, floor**2, texture.mean((0, 1, 2))])


@pytest.fixture
def renderer() -> Lit:
    return Lit()


@pytest.fixture
def brighter(renderer: Lit) -> dict[str, torch.Tensor]:
    """Return values that are not those of the renderer."""
    return {**renderer.inputs, "light": torch.tensor(BRIGHT), "floor": torch.tensor(0.6)}


def test_the_values_to_test_may_be_given_with_a_texture(renderer, brighter):
    changed = {**brighter, "texture": renderer.inputs["texture"] / 2}
    test = ablation_test(renderer, torch.mean, inputs=changed)
    assert test.is_confirmed
    floor = next(row for row in test.rows if row.name == "floor")
    expected = BRIGHT * 2 * 0.6 * renderer.matrix.mean((0, 1, 2))[1]
    assert floor.predicted == pytest.approx(expected.item(), rel=1e-4)


def test_gradients_are_checked_where_they_were_computed(renderer, brighter):
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute(brighter)
    assert ablation_test(renderer, torch.mean, gradient).is_confirmed
    assert infidelity(renderer, torch.mean, gradient, stdevs=0.01).normalized < 0.01
    # Of the logarithm of the mean, which is one of the light: −1 / light².
    logarithmic = VanillaSceneGradient(renderer, log_mean).attribute(brighter)
    found = interactions(renderer, log_mean, logarithmic)
    light = found.names.index("light")
    assert found.matrix[light, light].item() == pytest.approx(-1 / BRIGHT**2, rel=0.02)


def test_contributions_are_checked_where_they_were_computed(renderer, brighter):
    baselines = {**brighter, "wall": 0.9, "floor": 0.9, "texture": 0.1}
    contributions = IntegratedGradientsScene(renderer, torch.mean).attribute(brighter, baselines=baselines)
    found = sensitivity_n(renderer, torch.mean, contributions, baselines=baselines)
    assert min(found.correlations) > 0.999
    curves = deletion_insertion(renderer, torch.mean, contributions, baselines=baselines)
    original = renderer(brighter, seed=0, spp=1).mean()
    assert curves.deletion[0].tolist() == pytest.approx([original.item()] * 8)


@pytest.mark.parametrize("check", [sensitivity_n, deletion_insertion])
def test_other_baselines_than_those_of_the_attribution_are_refused(renderer, check):
    baselines = {"light": 2.0, "wall": 0.9, "floor": 0.9}
    contributions = IntegratedGradientsScene(renderer, torch.mean).attribute(baselines=baselines)
    message = (
        r"with the baseline \S+, and this check with \S+ \(\d more differ\)\. Give the check the baselines="
    )
    with pytest.raises(SceneCaptumError, match=message):
        check(renderer, torch.mean, contributions)
    check(renderer, torch.mean, contributions, baselines=baselines)


def test_input_times_gradient_is_relative_to_0(renderer):
    contributions = InputXGradientScene(renderer, torch.mean).attribute()
    with pytest.raises(SceneCaptumError, match=r"with the baseline 0, and this check with 0\.1"):
        sensitivity_n(renderer, torch.mean, contributions, baselines=0.1)
    sensitivity_n(renderer, torch.mean, contributions)


def test_contributions_relative_to_several_baselines_are_refused(renderer):
    several = GradientShapScene(renderer, torch.mean).attribute(baselines=[0.1, 0.9], n_samples=2)
    with pytest.raises(SceneCaptumError, match=r"relative to 2 baselines, and .* replaces .* by one"):
        deletion_insertion(renderer, torch.mean, several)


@pytest.mark.parametrize("check", [ablation_test, infidelity, interactions])
def test_an_attribution_of_another_texture_is_refused(renderer, check):
    other = {**renderer.inputs, "texture": renderer.inputs["texture"].flip(0)}  # of the same mean
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute(other)
    with pytest.raises(SceneCaptumError, match="another 'texture' than that of the renderer"):
        check(renderer, torch.mean, gradient)
