"""Importance sampling of pixels is unbiased and stratified, and chunks add up to one render."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneRenderer
from scenecaptum.rendering._chunks import MAX_SAMPLES, chunks
from scenecaptum.rendering._pixel_sampling import sample_pixels

UNIFORM = torch.ones(6, 8)


def counts(pixel: torch.Tensor) -> torch.Tensor:
    return torch.bincount(pixel, minlength=48)


def test_a_uniform_adjoint_gives_every_pixel_the_same_samples() -> None:
    for seed in seeds(20):
        pixel, weight = sample_pixels(torch.full((6, 8), 0.3), [(0.7, UNIFORM)], 5 * 48, seed)
        assert (counts(pixel) == 5).all()
        torch.testing.assert_close(weight, torch.full((48,), 1 / 5))


def test_a_zero_adjoint_samples_uniformly() -> None:
    pixel, weight = sample_pixels(torch.zeros(6, 8), [(0.7, UNIFORM)], 4 * 48, 0)
    assert (counts(pixel) == 4).all()
    assert torch.isfinite(weight).all()


def test_samples_are_stratified_by_adjoint_and_importance() -> None:
    magnitude = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(1)))
    importance = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(2)))
    density = (magnitude * importance).flatten()
    expected = 48 * 16 * (0.7 * density / density.sum() + 0.3 / 48)
    for seed in seeds(20):
        pixel, weight = sample_pixels(magnitude, [(0.7, importance)], 16 * 48, seed)
        assert len(pixel) == 48 * 16
        assert ((counts(pixel) - expected).abs() < 1.001).all()
        torch.testing.assert_close(weight, 1 / expected)


def test_the_expected_count_is_in_proportion_to_the_probability() -> None:
    magnitude = torch.rand(6, 8, generator=torch.Generator().manual_seed(shifted(3)))
    drawn = [sample_pixels(magnitude, [(0.7, UNIFORM)], 2 * 48, seed) for seed in seeds(2000)]
    mean = torch.stack([counts(pixel).float() for pixel, _ in drawn]).mean(0)
    error = torch.stack([counts(pixel).float() for pixel, _ in drawn]).std(0) / 2000**0.5
    expected = 1 / drawn[0][1]
    # The shift of the strata stays at least a thousandth from 0 and 1.
    assert ((mean - expected).abs() < allowed(2000, 48) * error + 1e-3).all()


@pytest.mark.parametrize(
    "rfilter", ["box", pytest.param("tent", marks=pytest.mark.long), "gaussian", "lanczos"]
)
def test_importance_sampled_pixels_give_the_derivative_of_the_image(mi: Any, rfilter: str) -> None:
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

    replayed = torch.stack([gradients(seed, None) for seed in seeds(40)])
    sampled = torch.stack([gradients(shifted(), 100 + seed) for seed in seeds(40)])
    z = (replayed.mean(0) - sampled.mean(0)) / ((replayed.var(0) + sampled.var(0)) / 40).sqrt()
    assert z.abs().max() < allowed(79, z.numel()), z
    assert (replayed.var(0) / sampled.var(0)).log().mean().exp() > 1.1


def test_sampled_pixels_do_not_depend_on_earlier_renders() -> None:
    """The noise map is estimated at the scene's own values, not at those of the first gradient."""

    def gradients(*factors: float) -> torch.Tensor:
        renderer = SceneRenderer("cornell-box", "reflectance", resolution=(8, 8), spp=4, max_depth=3)
        for factor in factors:
            x = {name: (factor * value).requires_grad_() for name, value in renderer.inputs.items()}
            renderer(x, seed=shifted(1), seed_grad=shifted(2)).mean().backward()
        return torch.cat([leaf.grad.flatten() for leaf in x.values()])

    torch.testing.assert_close(gradients(1.0, 0.2), gradients(0.2), rtol=1e-5, atol=1e-8)


def test_an_adjoint_that_the_caller_changes_is_sampled_as_it_is_now() -> None:
    """The renderer remembers the sampling of the latest adjoint, which may be the caller's own memory."""

    def gradient(renderer: SceneRenderer, adjoint: torch.Tensor) -> torch.Tensor:
        leaves = renderer.leaves()
        image = renderer(leaves, seed=shifted(1), seed_grad=shifted(2))
        return torch.autograd.grad(image, list(leaves.values()), adjoint)[0]

    used, fresh = (SceneRenderer("cornell-box", "floor.*", resolution=(16, 16), spp=4) for _ in range(2))
    adjoint = torch.zeros(16, 16, 3)
    adjoint[:4] = 1.0
    gradient(used, adjoint)
    adjoint.copy_(adjoint.flip(0))
    torch.testing.assert_close(gradient(used, adjoint), gradient(fresh, adjoint), rtol=1e-4, atol=1e-7)


def test_chunks_contain_all_samples() -> None:
    for resolution, spp in (((64, 64), 16), ((1280, 720), 64), ((3840, 2160), 7), ((1280, 720), 5)):
        split = list(chunks(3, spp, resolution))
        assert sum(chunk.spp for chunk in split) == spp
        np.testing.assert_allclose([chunk.weight for chunk in split], [chunk.spp / spp for chunk in split])
        assert len({chunk.seed for chunk in split}) == len(split)
        pixels = resolution[0] * resolution[1]
        assert all(chunk.spp * pixels <= MAX_SAMPLES or chunk.spp == 1 for chunk in split)
    assert [chunk.seed for chunk in chunks(3, 16, (64, 64))] == [3]


def test_chunks_add_up_to_one_image_and_its_derivative(
    cornell: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scenecaptum.rendering import _chunks

    monkeypatch.setattr(_chunks, "MAX_SAMPLES", 32 * 32 * 4)
    split = list(chunks(9, 16, (32, 32)))
    assert [chunk.spp for chunk in split] == [4, 4, 4, 4]

    def gradient(seed: int, spp: int) -> tuple[torch.Tensor, torch.Tensor]:
        x = cornell.leaves()
        image = cornell(x, seed=seed, spp=spp)
        image.mean().backward()
        return image.detach(), torch.cat([leaf.grad.flatten() for leaf in x.values()])

    whole = gradient(9, 16)
    parts = [gradient(chunk.seed, chunk.spp) for chunk in split]
    for found, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        torch.testing.assert_close(found, torch.stack(pieces).mean(0), rtol=1e-4, atol=1e-6)
