"""Settings at the extremes: one pixel, one sample, one bounce, a hundred, very many samples, and odd seeds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneCaptumError, SceneRenderer, VanillaSceneGradient

from .scenes import GREY, furnace, mean, room, total, z

WALLS, GLOW = "walls.bsdf.reflectance.value", "walls.emitter.radiance.value"
BALL = "ball.bsdf.reflectance.value"


@pytest.fixture(scope="module")
def renderer(mi):
    return SceneRenderer(room(mi), inputs="all")


@pytest.fixture(scope="module")
def oven(mi):
    return SceneRenderer(furnace(mi, GREY), inputs="all")


def test_one_pixel(oven):
    found = VanillaSceneGradient(oven.replace(resolution=(1, 1)), mean).attribute(seed=shifted(), spp=4096)
    assert found.image.shape == (1, 1, 3)
    assert abs(z((found.metric_value, found.metric_standard_error), 1.875)) < allowed(8)
    assert abs(z(total(found, WALLS), 2.75)) < allowed(8)


def test_one_sample_is_unbiased_and_has_no_error_bar(oven):
    found = [VanillaSceneGradient(oven, mean).attribute(seed=seed, spp=1) for seed in seeds(16)]
    assert all(one.standard_error is None and one.metric_standard_error is None for one in found)
    assert "no error bars" in str(found[0])
    slopes = torch.stack([one[WALLS].sum() for one in found]).double()
    assert abs(slopes.mean() - 2.75) < allowed(16) * slopes.std() / 16**0.5


def test_depth_of_one_shows_emitters_only(oven):
    found = VanillaSceneGradient(oven.replace(max_depth=1), mean).attribute(seed=shifted())
    assert found.metric_value == pytest.approx(1.0, rel=1e-6)
    assert found.saliency()[WALLS] == 0
    assert total(found, GLOW)[0] == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("reflectance", [0.5, pytest.param(0.9, marks=pytest.mark.long)])
def test_depth_of_a_hundred(oven, reflectance):
    """Russian roulette biases neither the light nor its derivative."""
    deep = oven.replace(max_depth=100)
    values = {**deep.inputs, WALLS: torch.full((3,), reflectance)}
    found = VanillaSceneGradient(deep, mean).attribute(
        values, seed=shifted(), spp=128 if reflectance == 0.5 else 1024
    )
    light = (1 - reflectance**100) / (1 - reflectance)
    slope = sum(k * reflectance ** (k - 1) for k in range(1, 100))
    assert abs(z((found.metric_value, found.metric_standard_error), light)) < allowed(8)
    assert abs(z(total(found, GLOW), light)) < allowed(8)
    assert abs(z(total(found, WALLS), slope)) < allowed(8)


@pytest.mark.parametrize("most", [256, pytest.param(4096, marks=pytest.mark.long)])
def test_error_falls_as_the_root_of_the_samples(oven, most):
    """All pixels have the same light: their spread about it, times √spp, is the same for 1 sample and for 4096."""
    counts = [4**k for k in range(7) if 4**k <= most]
    scaled = []
    for spp in counts:
        images = torch.stack([oven(seed=seed, spp=spp)[..., 0] for seed in seeds(4)]).double()
        scaled.append((images - 1.875).square().mean().sqrt().item() * spp**0.5)
    slope = np.polyfit(np.log(counts), np.log(scaled), 1)[0]  # 0, within the noise of 256 pixels
    assert abs(slope) < 0.06, scaled


def test_a_quarter_of_a_million_samples_of_one_pixel_add_up(oven):
    """Single precision: the error of their sum is below that of the samples."""
    dot = oven.replace(resolution=(1, 1))
    few = torch.stack([dot(seed=seed, spp=4096).mean() for seed in seeds(8)]).double()
    many = dot(seed=shifted(99), spp=2**18).mean().item()
    assert abs(many - 1.875) < allowed(8) * few.std().item() / 8 + 1e-5


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.long), 2**32 - 1])
def test_first_and_last_seed(renderer, seed):
    found = VanillaSceneGradient(renderer, mean).attribute(seed=seed, spp=16)
    assert torch.isfinite(found[BALL]).all()
    torch.testing.assert_close(
        VanillaSceneGradient(renderer, mean).attribute(seed=seed, spp=16)[BALL],
        found[BALL],
        rtol=1e-4,
        atol=1e-8,
    )


@pytest.mark.parametrize("seed", [-1, 2**32, 0.5, True, None, "0", float("nan")])
def test_other_seeds_are_refused(renderer, seed):
    with pytest.raises(SceneCaptumError, match="seed must be a whole number from 0 to 4294967295"):
        VanillaSceneGradient(renderer, mean).attribute(seed=seed)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spp": 0}, "spp must be a whole number of at least 1"),
        ({"max_depth": 0}, "max_depth must be a whole number from 1 to 2147483647"),
        ({"resolution": (0, 8)}, "width must be a whole number of at least 1"),
    ],
)
def test_settings_of_zero_are_refused(mi, options, words):
    with pytest.raises(SceneCaptumError, match=f"{words}, not 0"):
        SceneRenderer(room(mi), **options)


def test_two_samples_are_two_replicates_with_a_warning(renderer):
    found = VanillaSceneGradient(renderer, mean).attribute(seed=shifted(), spp=2)
    assert "with 2 replicates the standard error has about 71 % relative uncertainty" in " ".join(
        str(found).split()
    )
    assert set(found.untrusted_errors()) == set(found)
