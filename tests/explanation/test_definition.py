"""The value by the definition: its error, of a mean and of a share of points, and what it consists of."""

from __future__ import annotations

import math

import pytest
import torch
from seeds import seeds, shifted

from scenecaptum import Camera, SceneRenderer, VanillaSceneGradient, daylight, metrics
from scenecaptum.denoising import denoise
from scenecaptum.estimation import (
    TargetedMetric,
    difference_by_definition,
    error_of_denoiser,
    half_sample_error,
    value_by_definition,
)
from scenecaptum.explanation import (
    definition_of,
    photometric_premises,
    rated_image,
    states_definition,
)


def test_the_noise_of_both_values_cancels_in_their_difference():
    """Of renders with common random numbers: without, the error of the change would be that of both values."""
    patches = daylight.SkyPatches.tregenza()
    sky = daylight.SkyMatrix.from_weather(daylight.synthetic_weather(), patches)
    metric = TargetedMetric(daylight.DaylightAutonomy(sky))
    generator = torch.Generator().manual_seed(shifted())
    noise = torch.rand(8, 12, 1, 1, generator=generator)
    coefficients = torch.linspace(0.001, 0.02, 12)[:, None, None].expand(12, patches.count, 3)
    before, after = (scale * (0.5 + noise) * coefficients for scale in (1.0, 1.1))
    change, error = difference_by_definition(metric, metric, (before, after))
    values = [definition_of(metric, images) for images in (before, after)]
    assert change == pytest.approx(values[1].value - values[0].value)
    assert 0 < error < 0.5 * math.hypot(*(value.error for value in values))
    assert difference_by_definition(metric, metric, (before, before)) == (0, 0)
    brightness = TargetedMetric(metrics.MeanLuminance())
    assert difference_by_definition(brightness, brightness, (before, after)) is None


def test_a_room_without_light_of_the_sky_is_named_so() -> None:
    patches = daylight.SkyPatches.tregenza()
    sky = daylight.SkyMatrix.from_weather(daylight.synthetic_weather(), patches)
    dark = torch.zeros(4, patches.count, 3)
    for metric in (
        daylight.SpatialDaylightAutonomy(sky),
        daylight.DaylightFactor(daylight.SkyMatrix.cie_overcast()),
    ):
        assert "what covers the windows?" in photometric_premises(metric, dark, 0.0, None)[0]
        assert photometric_premises(metric, dark + 0.1 * math.pi / patches.count, 10.0, None) == ()
    # Of direct light alone, which may reach no point of a bright room.
    assert photometric_premises(daylight.AnnualSunlightExposure(sky), dark, 0.0, None) == ()
    shares = photometric_premises(daylight.DaylightProvision(sky), dark + 9.0, 0.0, None)
    assert shares == (
        "300 lx at 100 % of the points (50 required), 100 lx at 100 % of the points (95 required): "
        "100 lx decides",
    )


def test_of_uniformity_it_is_the_smallest_over_the_mean_with_an_error() -> None:
    """Points of 2 to 4 with noise of 2 % in each of eight pictures: 2/3, to 2 % / √8."""
    noise = torch.randn(8, 1, 9, 1, generator=torch.Generator().manual_seed(shifted()))
    images = torch.linspace(2, 4, 9)[None, None, :, None] * (1 + 0.02 * noise).expand(8, 1, 9, 3)
    metric = TargetedMetric(metrics.Uniformity())
    found = definition_of(metric, images)
    assert found.value == pytest.approx(metrics.Uniformity().hard(images.mean(0)).item())
    assert found.value == pytest.approx(2 / 3, rel=0.03)
    assert 0.3 < found.error / (2 / 3 * 0.02 / 8**0.5) < 2.5
    assert (found.verdict, found.points) == ("", None)
    assert definition_of(TargetedMetric(metrics.Uniformity(relaxation=0)), images) is None
    change, error = difference_by_definition(metric, metric, (images, 2 * images))
    assert change == pytest.approx(0, abs=1e-6)
    assert error == pytest.approx(0, abs=1e-6)


def test_a_glare_rating_near_its_threshold_is_stated_by_the_definition() -> None:
    """A source of 2200 cd/m² counts in full, where the relaxed rating gives it a part of its weight."""
    camera = Camera.perspective(16, 16, fov_x=60)
    images = torch.full((8, 16, 16, 3), 0.5)
    images[:, 4:6, 7:9] = 2200 / 179
    metric = TargetedMetric(metrics.UnifiedGlareRating(camera))
    assert states_definition(metric, images[0])
    found = definition_of(metric, images)
    hard = metrics.UnifiedGlareRating(camera, relaxation=0)
    assert found.value == pytest.approx(hard(images[0]).item())
    assert found.value > metric.value(images[0]) + 1
    assert found.error == 0
    dimmed = images.clone()
    dimmed[:, 4:6, 7:9] = 1950 / 179
    change, _ = difference_by_definition(metric, metric, (images, dimmed))
    assert change == pytest.approx(hard(dimmed[0]).item() - found.value)
    bright = images.clone()
    bright[:, 4:6, 7:9] = 9000 / 179
    assert not states_definition(metric, bright[0])
    assert metric.value(bright[0]) == pytest.approx(hard(bright[0]).item())
    assert not states_definition(TargetedMetric(hard), images[0])


@pytest.mark.parametrize("luminance", [1950, 1990, 2005, 2050])
def test_the_error_of_a_rating_near_its_threshold_includes_pixels_on_the_wrong_side(luminance: float) -> None:
    """Noise takes a share of the pixels across, nearly the same in each render: repeats do not show that error."""
    camera = Camera.perspective(32, 32, fov_x=60)
    true = torch.full((32, 32, 3), 0.5)
    true[16, 8:12] = 9000 / 179  # a lamp far from the threshold
    true[4:12, 8:24] = luminance / 179
    metric = TargetedMetric(metrics.UnifiedGlareRating(camera))
    exact = metrics.UnifiedGlareRating(camera, relaxation=0)(true).item()
    for seed in seeds(8):
        noise = torch.randn(8, 32, 32, 1, generator=torch.Generator().manual_seed(seed))
        images = true * (1 + 0.05 * noise).expand(-1, -1, -1, 3)  # of 2 % in their mean
        found = definition_of(metric, images)
        assert abs(found.value - exact) < 2 * found.error
        change, error = difference_by_definition(metric, metric, (images, 4 * images))
        assert abs(change - (metric.by_definition().value(4 * true) - exact)) < 3 * error
    bright = definition_of(metric, 1.5 * images)
    repeats = half_sample_error(lambda kept: metric.by_definition().value(1.5 * images[kept].mean(0)), 8)
    assert bright.error == pytest.approx(repeats, rel=1e-4), (
        "far from the threshold the repeats show the whole error"
    )


def test_errors_of_a_rating_include_what_the_denoiser_takes_from_a_bulb_of_one_pixel() -> None:
    """It does so in every half of the samples alike, so repeats do not show that error."""
    camera = Camera.perspective(32, 32, fov_x=60)
    true = torch.full((32, 32, 3), 0.5)
    true[16, 8:12] = 9000 / 179  # a lamp far from the threshold
    bulb = torch.zeros_like(true)
    bulb[5, 15] = 2300 / 179

    def denoised(image: torch.Tensor) -> torch.Tensor:
        spread = image.clone()
        spread[5, 16] += 0.4 * image[5, 15]
        spread[5, 15] -= 0.4 * image[5, 15]
        return spread

    relaxed = metrics.UnifiedGlareRating(camera)
    metric = TargetedMetric(relaxed).with_transform(denoised)
    for seed in seeds(8):
        noise = torch.randn(8, 32, 32, 1, generator=torch.Generator().manual_seed(seed))
        noise = (1 + 0.05 * noise).expand(-1, -1, -1, 3)
        images, dimmed = (true + bulb) * noise, (true + 0.75 * bulb) * noise
        value, error = value_by_definition(metric, images)
        assert abs(value - relaxed.hard(true + bulb).item()) < 2 * error
        change, error = difference_by_definition(metric, metric, (images, dimmed))
        truth = relaxed.hard(true + 0.75 * bulb) - relaxed.hard(true + bulb)
        assert truth < -0.05
        assert abs(change - truth.item()) < 2 * error
        changes = [metric.value(b) - metric.value(a) for a, b in zip(images, dimmed, strict=True)]
        repeats = torch.tensor(changes).std().item() / 8**0.5
        change = metric.value(dimmed.mean(0)) - metric.value(images.mean(0))
        truth = (relaxed(true + 0.75 * bulb) - relaxed(true + bulb)).item()
        error = math.hypot(repeats, error_of_denoiser(metric, metric, (images, dimmed)))
        assert abs(change - truth) > 4 * repeats
        assert abs(change - truth) < 3 * error
    assert error_of_denoiser(TargetedMetric(torch.mean), TargetedMetric(torch.mean), (images, dimmed)) == 0


def test_the_rated_image_is_the_denoised_one_of_the_camera_of_the_values(mi):
    """What is said of the threshold is of the picture whose rating is quoted, not of its bright single samples."""
    renderer = SceneRenderer(
        "cornell-box", ["camera.pose.*", "emitters"], resolution=(16, 16), spp=8, max_depth=3
    )
    turned = {**renderer.inputs, "camera.pose.rotation": torch.tensor([0.0, 0.0, 0.3])}
    glare = metrics.UnifiedGlareRating(renderer.camera)
    options = {"seed": shifted(), "replicates": 2}
    result = VanillaSceneGradient(renderer, glare).attribute(turned, denoise=True, **options)
    rated = rated_image(result, renderer)
    torch.testing.assert_close(rated, denoise(result.image, renderer.guides_of(turned)))
    assert not torch.equal(rated, denoise(result.image, renderer.guides_of({})))
    plain = VanillaSceneGradient(renderer, glare).attribute(turned, denoise=False, **options)
    assert rated_image(plain, renderer) is plain.image
