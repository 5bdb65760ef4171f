"""Melanopic illuminance: ratios of standard illuminants, and the errors of the estimate from RGB."""

from __future__ import annotations

import math

import pytest
import torch

from scenecaptum import SceneCaptumError
from scenecaptum.images import LUMINANCE_WEIGHTS
from scenecaptum.metrics import MeanIlluminance, MelanopicEDI, melanopic_ratio

WAVELENGTHS = torch.arange(380.0, 781.0).double()
# Linear R, G and B of Rec. 709 from X, Y and Z (IEC 61966-2-1).
FROM_XYZ = torch.tensor(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
).double()


def picture() -> torch.Tensor:
    return torch.rand(3, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) + 0.1


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
    torch.testing.assert_close(MelanopicEDI(ratios=0.45)(image), 0.45 * MeanIlluminance()(image))


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
    assert torch.autograd.gradcheck(MelanopicEDI(), (picture().requires_grad_(),))


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
