"""Where the samples of a backward pass go, and that it costs no truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneRenderer
from scenecaptum.rendering._choice import choose_pixels
from scenecaptum.rendering._passes import SAMPLES, passes

EVEN = torch.ones(6, 8)


def counts(pixel: torch.Tensor) -> torch.Tensor:
    return torch.bincount(pixel, minlength=48)


def test_an_even_adjoint_gives_every_pixel_its_samples() -> None:
    for seed in seeds(20):
        pixel, weight = choose_pixels(torch.full((6, 8), 0.3), [(0.7, EVEN)], 5, seed)
        assert (counts(pixel) == 5).all()
        torch.testing.assert_close(weight, torch.full((48,), 1 / 5))


def test_a_black_adjoint_is_spread_evenly() -> None:
    pixel, weight = choose_pixels(torch.zeros(6, 8), [(0.7, EVEN)], 4, 0)
    assert (counts(pixel) == 4).all()
    assert torch.isfinite(weight).all()


def test_samples_follow_adjoint_and_interest_in_strata() -> None:
    magnitude = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(1)))
    interest = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(2)))
    strength = (magnitude * interest).flatten()
    expected = 48 * 16 * (0.7 * strength / strength.sum() + 0.3 / 48)
    for seed in seeds(20):
        pixel, weight = choose_pixels(magnitude, [(0.7, interest)], 16, seed)
        assert len(pixel) == 48 * 16
        assert ((counts(pixel) - expected).abs() < 1.001).all()
        torch.testing.assert_close(weight, 1 / expected)


def test_the_expected_count_is_the_share() -> None:
    magnitude = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(3)))
    drawn = [choose_pixels(magnitude, [(0.7, EVEN)], 2, seed) for seed in seeds(2000)]
    mean = torch.stack([counts(pixel).float() for pixel, _ in drawn]).mean(0)
    error = torch.stack([counts(pixel).float() for pixel, _ in drawn]).std(0) / 2000**0.5
    expected = 1 / drawn[0][1]
    # The shift of the strata keeps a thousandth off both ends.
    assert ((mean - expected).abs() < allowed(2000, 48) * error + 1e-3).all()


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "lanczos"])
def test_chosen_pixels_give_the_derivative_of_the_picture(mi: Any, rfilter: str) -> None:
    from scenecaptum.scene.bundled import cornell_box

    scene = cornell_box()
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 12, "height": 10, "rfilter": {"type": rfilter}}
    renderer = SceneRenderer(scene, "all", spp=16, max_depth=3)
    adjoint = torch.rand(10, 12, 3, generator=torch.Generator().manual_seed(shifted())) ** 4
    adjoint[:, :6] *= 0.05

    def gradients(seed: int, seed_grad: int | None) -> torch.Tensor:
        leaves = renderer.leaves()
        renderer(leaves, seed=seed, seed_grad=seed_grad).backward(adjoint)
        return torch.cat([leaf.grad.flatten() for leaf in leaves.values()]).double()

    own = torch.stack([gradients(seed, None) for seed in seeds(40)])
    chosen = torch.stack([gradients(shifted(), 100 + seed) for seed in seeds(40)])
    z = (own.mean(0) - chosen.mean(0)) / ((own.var(0) + chosen.var(0)) / 40).sqrt()
    assert z.abs().max() < allowed(79, z.numel()), z
    assert (own.var(0) / chosen.var(0)).log().mean().exp() > 1.1


def test_pixels_are_chosen_alike_whatever_was_rendered_before() -> None:
    """The pilots that tell where the noise is see the scene's own values, and not those of the first gradient."""

    def gradients(*factors: float) -> torch.Tensor:
        renderer = SceneRenderer("cornell-box", "reflectance", resolution=(8, 8), spp=4, max_depth=3)
        for factor in factors:
            x = {name: (factor * value).requires_grad_() for name, value in renderer.inputs.items()}
            renderer(x, seed=shifted(1), seed_grad=shifted(2)).mean().backward()
        return torch.cat([leaf.grad.flatten() for leaf in x.values()])

    torch.testing.assert_close(gradients(1.0, 0.2), gradients(0.2), rtol=1e-5, atol=1e-8)


def test_passes_share_out_all_samples() -> None:
    for resolution, spp in (((64, 64), 16), ((1280, 720), 64), ((3840, 2160), 7), ((1280, 720), 5)):
        split = list(passes(3, spp, resolution))
        assert sum(one.spp for one in split) == spp
        np.testing.assert_allclose([one.share for one in split], [one.spp / spp for one in split])
        assert len({one.seed for one in split}) == len(split)
        pixels = resolution[0] * resolution[1]
        assert all(one.spp * pixels <= SAMPLES or one.spp == 1 for one in split)
    assert [one.seed for one in passes(3, 16, (64, 64))] == [3]


def test_passes_add_up_to_one_picture_and_its_derivative(
    cornell: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scenecaptum.rendering import _passes

    monkeypatch.setattr(_passes, "SAMPLES", 32 * 32 * 4)
    split = list(passes(9, 16, (32, 32)))
    assert [one.spp for one in split] == [4, 4, 4, 4]

    def gradient(seed: int, spp: int) -> tuple[torch.Tensor, torch.Tensor]:
        x = cornell.leaves()
        image = cornell(x, seed=seed, spp=spp)
        image.mean().backward()
        return image.detach(), torch.cat([leaf.grad.flatten() for leaf in x.values()])

    whole = gradient(9, 16)
    parts = [gradient(one.seed, one.spp) for one in split]
    for found, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        torch.testing.assert_close(found, torch.stack(pieces).mean(0), rtol=1e-4, atol=1e-6)
