"""Metrics of sensor grids: closed forms, derivatives, and the relaxed minimum against the smallest value."""

from __future__ import annotations

import math

import pytest
import torch

from scenecaptum import SceneCaptumError
from scenecaptum.grid import GridPoints
from scenecaptum.images import LUMINANCE_WEIGHTS
from scenecaptum.metrics import MeanIlluminance, MelanopicEDI, Uniformity, melanopic_ratio


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
    assert Uniformity().verdict(image) == "0.5 by the definition, without relaxation"


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


# --- Melanopic illuminance ------------------------------------------------------------------------

WAVELENGTHS = torch.arange(380.0, 781.0).double()
# Linear R, G and B of Rec. 709 from X, Y and Z (IEC 61966-2-1).
FROM_XYZ = torch.tensor(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
).double()


def illuminant_a() -> torch.Tensor:
    """Return the spectrum of illuminant A by its definition (CIE 015)."""
    return (
        (560 / WAVELENGTHS) ** 5
        * math.expm1(1.435e7 / (2848 * 560))
        / torch.expm1(1.435e7 / (2848 * WAVELENGTHS))
    )


def test_ratios_of_illuminants_are_those_of_the_standard():
    """CIE S 026: 0.496 for A and 0.906 for E; that of D65 is 1 by definition."""
    assert melanopic_ratio(WAVELENGTHS, illuminant_a()) == pytest.approx(0.4958, rel=2e-3)
    assert melanopic_ratio(WAVELENGTHS, torch.ones(401)) == pytest.approx(0.9058, rel=2e-3)
    assert melanopic_ratio(WAVELENGTHS, 7 * illuminant_a()) == pytest.approx(
        melanopic_ratio(WAVELENGTHS, illuminant_a())
    )


def test_a_ratio_of_all_light_is_exact():
    image = picture()
    plain = MeanIlluminance(corner_left_out())(image)
    torch.testing.assert_close(MelanopicEDI(corner_left_out(), ratios=0.45)(image), 0.45 * plain)


def test_each_channel_has_its_own_ratio():
    for channel, weight in enumerate(LUMINANCE_WEIGHTS):
        image = torch.zeros(2, 2, 3, dtype=torch.float64)
        image[..., channel] = 2.0
        found = MelanopicEDI(ratios=(0.1, 0.5, 3.0))(image).item()
        assert found == pytest.approx(179 * 2 * weight * (0.1, 0.5, 3.0)[channel])


@pytest.mark.parametrize(
    ("x", "y", "ratio", "error"),
    [
        (0.31272, 0.32903, 1.0, 0.0),  # D65
        (0.33242, 0.34743, 0.904, -0.02),  # D55
        (1 / 3, 1 / 3, 0.906, 0.02),  # E
        (0.44757, 0.40745, 0.496, -0.06),  # A
        (0.4370, 0.4042, 0.404, 0.23),  # FL12
    ],
)
def test_the_estimate_from_rgb_is_as_wrong_as_stated(x, y, ratio, error):
    """The errors in the documentation, to half a percentage point, for colours and ratios of CIE illuminants."""
    rgb = FROM_XYZ @ torch.tensor([x / y, 1.0, (1 - x - y) / y]).double()
    image = rgb.expand(1, 1, 3)
    found = MelanopicEDI(efficacy=1.0)(image) / MeanIlluminance(efficacy=1.0)(image)
    assert found.item() / ratio - 1 == pytest.approx(error, abs=0.005)


def test_the_estimate_from_rgb_says_what_it_is():
    assert "estimated from RGB" in str(MelanopicEDI().caution)
    assert MelanopicEDI(ratios=0.5).caution is None


def test_melanopic_derivatives():
    assert torch.autograd.gradcheck(MelanopicEDI(), (picture().clamp(min=0.1).requires_grad_(),))


def test_bad_spectra_are_one_clear_line():
    for wrong in (-0.1, (1.0, 2.0), math.nan, "blue"):
        with pytest.raises(SceneCaptumError, match="ratios must be one melanopic ratio"):
            MelanopicEDI(ratios=wrong)
    ones = torch.ones(401)
    for wavelengths, power, message in (
        (WAVELENGTHS[:5], ones, "two tensors"),
        (WAVELENGTHS.flip(0), ones, "must ascend"),
        (WAVELENGTHS, -ones, "not negative"),
        (WAVELENGTHS / 1000, ones, "are its wavelengths in nm"),
    ):
        with pytest.raises(SceneCaptumError, match=message):
            melanopic_ratio(wavelengths, power)
