"""Metrics of sensor grids: closed forms, derivatives, and the relaxed minimum against the smallest value."""

from __future__ import annotations

import math

import pytest
import torch

from scenecaptum import SceneCaptumError
from scenecaptum.grid import GridPoints
from scenecaptum.metrics import MeanIlluminance, Uniformity


def grid(inside: torch.Tensor) -> GridPoints:
    positions = torch.zeros(*inside.shape, 3, dtype=torch.float64)
    return GridPoints(positions, positions, inside, positions[..., :2])


def corner_left_out() -> GridPoints:
    inside = torch.ones(3, 4, dtype=torch.bool)
    inside[0, 0] = False
    return grid(inside)


def picture(*, seed: int = 1) -> torch.Tensor:
    """Return a grid's picture in which the pixel outside the room is 0."""
    image = torch.rand(3, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) + 0.1
    image[0, 0] = 0
    return image


def test_the_mean_is_over_the_points_inside():
    image = picture()
    weights = image.new_tensor([0.212671, 0.715160, 0.072169])
    expected = 179 * (image.reshape(-1, 3)[1:] @ weights).mean()
    torch.testing.assert_close(MeanIlluminance(corner_left_out())(image), expected)
    torch.testing.assert_close(MeanIlluminance()(image), expected * 11 / 12)
    torch.testing.assert_close(MeanIlluminance(corner_left_out(), efficacy=1.0)(image), expected / 179)


def test_units():
    assert (MeanIlluminance().measure.unit, MeanIlluminance(efficacy=1.0).measure.unit) == ("lx", "W/m²")
    assert MeanIlluminance().measure.better == Uniformity.measure.better == "higher"


def test_uniformity_is_smallest_over_mean():
    """Two points of 100 and 300: 1/2 by the definition, and the power mean of both over 200."""
    image = torch.tensor([1.0, 3.0]).double().reshape(1, 2, 1).expand(1, 2, 3)
    metric = Uniformity(relaxation=0.5)
    assert metric.hard(image).item() == pytest.approx(0.5)
    power_mean = ((1 + 3.0**-2) / 2) ** -0.5
    assert metric(image).item() == pytest.approx(power_mean / 2)
    assert Uniformity(relaxation=0)(image).item() == pytest.approx(0.5)


def test_an_even_light_has_the_uniformity_one_at_any_relaxation():
    image = torch.full((3, 4, 3), 0.7, dtype=torch.float64)
    for relaxation in (0.0, 0.02, 1.0):
        assert Uniformity(relaxation=relaxation)(image).item() == pytest.approx(1.0)


def test_the_relaxed_minimum_lies_within_its_bounds():
    """``hard ≤ relaxed ≤ hard · n^relaxation``, so that the minimum is the limit."""
    for seed in range(20):
        image = picture(seed=seed)
        for relaxation in (0.3, 0.1, 0.02, 1e-4):
            metric = Uniformity(corner_left_out(), relaxation=relaxation)
            hard, relaxed = metric.hard(image).item(), metric(image).item()
            assert hard * (1 - 1e-8) <= relaxed <= hard * 11**relaxation * (1 + 1e-8)


def test_uniformity_does_not_depend_on_the_exposure():
    image = picture()
    metric = Uniformity(corner_left_out())
    torch.testing.assert_close(metric(1e4 * image), metric(image))
    torch.testing.assert_close(metric.hard(1e-4 * image), metric.hard(image))


def test_derivatives():
    for metric in (MeanIlluminance(corner_left_out()), Uniformity(corner_left_out(), relaxation=0.1)):
        image = picture()
        image[0, 0] = 0.1  # gradcheck lowers each value a little
        image.requires_grad_()
        assert torch.autograd.gradcheck(metric, (image,))
        (gradient,) = torch.autograd.grad(metric(image), image)
        assert (gradient[0, 0] == 0).all(), "the pixel outside does not count"


def test_the_darkest_point_has_the_derivative_of_the_minimum():
    """``d(min / mean) / dE_min = 1 / mean − min / (n mean²)`` as the relaxation goes to 0."""
    image = torch.tensor([1.0, 2.0, 3.0]).double().reshape(1, 3, 1).repeat(1, 1, 3).requires_grad_()
    (gradient,) = torch.autograd.grad(Uniformity(relaxation=1e-3)(image), image)
    # The limit of the power mean: its only term has the weight n^relaxation.
    assert gradient[0, 0].sum().item() == pytest.approx(3**1e-3 * (1 / 2 - 1 / 12), rel=1e-6)


def test_a_point_without_light_has_a_finite_derivative():
    image = picture()
    image[1, 1] = 0
    image.requires_grad_()
    value = Uniformity(corner_left_out())(image)
    assert value.item() == pytest.approx(0, abs=1e-8)
    (gradient,) = torch.autograd.grad(value, image)
    assert gradient.isfinite().all()
    assert gradient[1, 1, 1] > 0


def test_the_verdict_has_the_value_by_the_definition():
    image = torch.tensor([1.0, 3.0]).reshape(1, 2, 1).expand(1, 2, 3)
    assert Uniformity().verdict(image) == "0.5 without relaxation"


def test_bad_input_is_one_clear_line():
    with pytest.raises(SceneCaptumError, match="No point of the grid is inside"):
        MeanIlluminance(grid(torch.zeros(2, 2, dtype=torch.bool)))
    with pytest.raises(SceneCaptumError, match=r"picture is \(2, 2\) .* and the grid \(3, 4\)"):
        MeanIlluminance(corner_left_out())(torch.ones(2, 2, 3))
    with pytest.raises(SceneCaptumError, match="not finite"):
        MeanIlluminance()(torch.full((2, 2, 3), math.nan))
    with pytest.raises(SceneCaptumError, match=r"\(H, W, 3\)"):
        MeanIlluminance()(torch.ones(2, 2))
    with pytest.raises(SceneCaptumError, match="any light"):
        Uniformity()(torch.zeros(2, 2, 3))
    for wrong in (-0.1, math.inf, "0.1"):
        with pytest.raises(SceneCaptumError, match="relaxation must be at least 0"):
            Uniformity(relaxation=wrong)
