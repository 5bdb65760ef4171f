from __future__ import annotations

import pytest
import torch
from kornia.color import rgb_to_xyz

from scenecaptum import SceneCaptumError
from scenecaptum.metrics import MeanLuminance, luminance


def test_luminance_has_the_weights_of_rec_709():
    primaries = torch.eye(3).reshape(3, 1, 3)
    torch.testing.assert_close(
        luminance(primaries).flatten(), torch.tensor([0.2126, 0.7152, 0.0722]), atol=1e-4, rtol=0
    )


def test_luminance_is_that_of_kornia():
    image = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(luminance(image), rgb_to_xyz(image.movedim(-1, 0)[None])[0, 1])


def test_luminance_of_white_is_one():
    assert luminance(torch.ones(1, 1, 3)).item() == pytest.approx(1.0, abs=1e-4)


def test_mean_luminance_is_linear_and_scales_with_the_efficacy():
    a, b = torch.rand(5, 7, 3), torch.rand(5, 7, 3)
    metric = MeanLuminance(efficacy=1.0)
    torch.testing.assert_close(metric(2 * a + b), 2 * metric(a) + metric(b))
    torch.testing.assert_close(MeanLuminance(efficacy=179.0)(a), 179 * metric(a))


def test_mask_selects_pixels_and_may_weight_them():
    image = torch.rand(5, 7, 3)
    mask = torch.zeros(5, 7, dtype=torch.bool)
    mask[2, 3] = True
    torch.testing.assert_close(MeanLuminance(1.0, mask)(image), luminance(image)[2, 3])
    torch.testing.assert_close(MeanLuminance(1.0, torch.full((5, 7), 0.3))(image), MeanLuminance(1.0)(image))


def test_derivative_is_uniform_over_the_pixels():
    image = torch.rand(4, 6, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(MeanLuminance(), (image,))
    (gradient,) = torch.autograd.grad(MeanLuminance()(image), image)
    torch.testing.assert_close(gradient, gradient[:1, :1].expand_as(gradient))


@pytest.mark.parametrize("shape", [(3, 4, 6), (4, 6), (4, 6, 4)])
def test_other_layouts_are_refused(shape):
    with pytest.raises(SceneCaptumError, match=r"\(H, W, 3\)"):
        MeanLuminance()(torch.ones(shape))


def test_a_mask_of_another_shape_is_refused():
    with pytest.raises(SceneCaptumError, match="selects no pixel"):
        MeanLuminance(mask=torch.zeros(2, 2))
    with pytest.raises(SceneCaptumError, match=r"mask has shape \(2, 2\); the image is \(4, 6\)"):
        MeanLuminance(mask=torch.ones(2, 2))(torch.ones(4, 6, 3))
