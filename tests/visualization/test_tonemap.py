"""Tone mapping, exposure and saved renders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from seeds import shifted

from scenecaptum import SceneCaptumError
from scenecaptum.visualization import display_image, save_render


@pytest.mark.parametrize(
    "fill", [0.0, 1e-38, 1e-6, 1.0, 1e8, 3e38, float("inf"), float("nan"), -1.0], ids=str
)
@pytest.mark.parametrize("exposure", [None, 1.0, 1e30])
def test_display_is_finite_and_in_range(fill: float, exposure: float | None) -> None:
    image = torch.full((3, 4, 3), fill)
    image[0, 0] = 0.5
    shown = display_image(image, exposure)
    assert shown.shape == (3, 4, 3)
    assert torch.isfinite(shown).all()
    assert shown.min() >= 0
    assert shown.max() <= 1


def test_display_is_monotone_and_smooth_at_the_knee() -> None:
    grey = torch.logspace(-6, 4, 4000)[None, :, None].expand(1, -1, 3)
    steps = display_image(grey, exposure=1.0)[0, :, 0].diff()
    assert (steps >= 0).all()
    assert steps.max() < 0.01  # 0.6 % brighter: no jump anywhere


def test_display_keeps_the_hue_of_lamps() -> None:
    import kornia

    lamp = torch.tensor([30.0, 20.0, 5.0])
    shown = display_image(lamp.expand(2, 2, 3), exposure=1.0)
    linear = kornia.color.rgb_to_linear_rgb(shown.permute(2, 0, 1)).permute(1, 2, 0)[0, 0]
    torch.testing.assert_close(linear / linear.max(), lamp / lamp.max(), atol=1e-4, rtol=1e-4)
    assert 0.95 < linear.max() < 1


def test_exposure_is_one_factor_and_the_dark_is_srgb() -> None:
    image = torch.tensor([0.0, 0.1, 0.5]).expand(1, 1, 3)
    torch.testing.assert_close(display_image(image / 4, exposure=4.0), display_image(image, exposure=1.0))
    expected = torch.tensor([0.0, 0.349190, 0.735357])  # IEC 61966-2-1
    torch.testing.assert_close(display_image(image, exposure=1.0)[0, 0], expected, atol=1e-5, rtol=0)


def test_automatic_exposure_ignores_borders_and_scale() -> None:
    room = 0.02 + torch.rand(20, 20, 3, generator=torch.Generator().manual_seed(shifted(1)))
    black, dim = torch.zeros(100, 100, 3), torch.full((22, 22, 3), 1e-7)
    for border in (black, dim):  # black ones may cover most of the image
        border[1:21, 1:21] = room
        inside = display_image(border)[1:21, 1:21]
        torch.testing.assert_close(inside, display_image(room), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(display_image(1e4 * room), display_image(room), atol=1e-5, rtol=1e-5)
    assert 0.3 < display_image(room).mean() < 0.65


def test_automatic_exposure_does_not_clip_windows() -> None:
    room = torch.full((10, 10, 3), 0.01)
    room[:2], room[2:4] = 5.0, 2.5
    shown = display_image(room)[:, 0, 0]
    assert shown[9] < display_image(torch.full((10, 10, 3), 0.01))[9, 0, 0]
    assert shown[0] - shown[2] > 2 / 255  # details in the window are still distinguishable


@pytest.mark.parametrize("shape", [(3, 4), (3, 8, 8), (2, 4, 4, 3)])
def test_display_refuses_other_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(SceneCaptumError, match=r"\(H, W, 3\)"):
        display_image(torch.zeros(shape))


def test_display_refuses_a_negative_exposure() -> None:
    with pytest.raises(SceneCaptumError, match="exposure"):
        display_image(torch.zeros(2, 2, 3), exposure=-1.0)


def test_saved_render_has_its_own_size_and_values(tmp_path: Path) -> None:
    from PIL import Image

    image = torch.rand(7, 13, 3, requires_grad=True)
    save_render(image, tmp_path / "render.png", exposure=0.8)
    with Image.open(tmp_path / "render.png") as saved:
        assert (saved.format, saved.size, saved.mode) == ("PNG", (13, 7), "RGB")
        expected = (display_image(image, 0.8) * 255).round()
        np.testing.assert_array_equal(np.asarray(saved), expected.numpy())


def test_save_render_names_an_unwritable_path(tmp_path: Path) -> None:
    with pytest.raises(SceneCaptumError, match="cannot be written"):
        save_render(torch.zeros(2, 2, 3), tmp_path / "missing" / "render.png")
