"""What metrics say of themselves: names, units, classes and cautions."""

from __future__ import annotations

import pytest
import torch

from scenecaptum import Camera, metrics


def test_luminance_is_in_candelas_unless_the_efficacy_is_one():
    image = torch.ones(4, 8, 3)
    assert metrics.MeanLuminance()(image).item() == pytest.approx(179.0)
    assert metrics.MeanLuminance().measure.unit == "cd/m²"
    assert metrics.MeanLuminance(efficacy=1.0)(image).item() == pytest.approx(1.0)
    assert metrics.MeanLuminance(efficacy=1.0).measure.unit == "W/(m² sr)"


OFFICE = "within 19, the limit for offices"


@pytest.mark.parametrize(
    ("measure", "value", "verdict"),
    [
        (
            metrics.UnifiedGlareRating.measure,
            18.9,
            OFFICE,
        ),
        (
            metrics.UnifiedGlareRating.measure,
            19.0,
            OFFICE,
        ),
        (
            metrics.UnifiedGlareRating.measure,
            31.0,
            "above 19, the limit for offices, and above 28, the highest limit",
        ),
        (metrics.DaylightGlareProbability.measure, 0.41, "disturbing glare"),
    ],
)
def test_values_have_a_class(measure, value, verdict):
    assert measure.verdict(value) == verdict


def test_a_limit_has_one_name_in_all_classes():
    measure = metrics.UnifiedGlareRating.measure
    meanings = [measure.verdict(value) for value in (17.0, 21.0, 24.0, 27.0, 31.0)]
    assert all("19, the limit for offices" in meaning for meaning in meanings)


def test_half_a_class_is_that_of_the_narrowest():
    assert metrics.UnifiedGlareRating.measure.half_class == 1.5
    assert metrics.DaylightGlareProbability.measure.half_class == pytest.approx(0.025)
    assert metrics.VerticalIlluminance.measure.half_class is None


def test_dgp_of_a_partial_view_warns():
    with pytest.warns(UserWarning, match="180°"):
        metric = metrics.DaylightGlareProbability(Camera.perspective(16, 9, 60))
    assert "180°" in metric.caution
    assert metrics.DaylightGlareProbability(Camera.fisheye(16, 16)).caution is None


def test_dgp_of_a_partial_view_has_a_class_only_above_a_limit():
    """A value that is too low may be in any higher class."""
    with pytest.warns(UserWarning, match="too low"):
        partial = metrics.DaylightGlareProbability(Camera.perspective(16, 9, 60), threshold_factor=5)
    assert partial.measure.verdict(0.28) == ""
    assert partial.measure.verdict(0.41) == "at least disturbing glare"
    assert partial.measure.verdict(0.6) == "intolerable glare"
    assert "5 times" in partial.measure.definition
    whole = metrics.DaylightGlareProbability(Camera.fisheye(16, 16))
    assert whole.measure.verdict(0.28) == "imperceptible glare"


def test_a_logit_knows_its_class_and_probability():
    model = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 3))
    image = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1))
    logit = metrics.ClassLogit(model, "cube", classes=["sphere", "cube", "cylinder"])
    assert logit.measure.name == "logit of cube"
    probability = metrics.ClassLogit(model)(image).softmax(0)[1].item()
    assert logit.verdict(image).startswith(f"probability {probability:.2g} of cube")
    every = metrics.ClassLogit(model, classes=["sphere", "cube", "cylinder"])
    assert every.measure_of(2).name == "logit of cylinder"
