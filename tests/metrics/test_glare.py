from __future__ import annotations

import math

import pytest
import torch
from seeds import shifted

from scenecaptum import Camera, SceneCaptumError, SceneRenderer, VanillaSceneGradient
from scenecaptum.metrics import (
    ContrastRatio,
    DaylightGlareIndex,
    DaylightGlareProbability,
    LuminancePercentile,
    UnifiedGlareRating,
    VerticalIlluminance,
    position_index,
)
from scenecaptum.visualization import noise_notes

CAMERA = Camera.perspective(12, 8, 80)
FISHEYE = Camera.fisheye(10, 10)
RATINGS = [UnifiedGlareRating, DaylightGlareProbability, DaylightGlareIndex]
every_rating = pytest.mark.parametrize("rating", RATINGS, ids=lambda rating: rating.__name__)
every_grouping = pytest.mark.parametrize("grouping", ["evalglare", "pixel"])


def ordinary(camera: Camera = CAMERA, *, base: float = 100.0, peak: float = 9_000.0) -> torch.Tensor:
    """Luminance in cd/m² with two sources, and one pixel inside the transition around 2000 cd/m²."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    values = base * (1 + 0.1 * torch.sin(3.0 * rows + columns)).double()
    values[1, 2:4] = peak
    values[6, -3] = 0.7 * peak
    values[4, 5] = 2_150.0
    return values


def picture(luminance: torch.Tensor) -> torch.Tensor:
    return (luminance / 179.0)[..., None].expand(-1, -1, 3)


def of_log_luminance(metric):
    return lambda logarithm: metric(picture(logarithm.exp()))


def gradient(metric, image: torch.Tensor) -> torch.Tensor:
    leaf = image.detach().clone().requires_grad_()
    (result,) = torch.autograd.grad(metric(leaf), leaf)
    return result


# The formulas


def test_ugr_of_one_source_is_the_formula():
    image = torch.full((8, 12), 50.0, dtype=torch.float64)
    image[2, 8] = 10_000.0
    omega, index = CAMERA.solid_angles[2, 8], position_index(CAMERA.directions)[2, 8]
    by_mean = 8 * torch.log10(0.25 / 50 * 10_000.0**2 * omega / index**2)
    torch.testing.assert_close(UnifiedGlareRating(CAMERA)(picture(image)), by_mean, rtol=1e-4, atol=0)
    cosine = CAMERA.solid_angles * CAMERA.directions[..., 2]
    background = 50 * (cosine.sum() - cosine[2, 8]) / math.pi
    by_hemisphere = 8 * torch.log10(0.25 / background * 10_000.0**2 * omega / index**2)
    rating = UnifiedGlareRating(CAMERA, background="hemisphere")
    torch.testing.assert_close(rating(picture(image)), by_hemisphere, rtol=1e-4, atol=0)


def test_auto_background_follows_the_camera():
    for camera, mode in ((CAMERA, "mean"), (FISHEYE, "hemisphere")):
        image = picture(ordinary(camera))
        assert UnifiedGlareRating(camera)(image) == UnifiedGlareRating(camera, background=mode)(image)


def test_exposure_moves_ugr_by_eight_per_decade():
    """L² / Lb grows with the exposure, and the threshold moves along with ``threshold_factor``."""
    rating = UnifiedGlareRating(CAMERA, threshold_factor=5)
    image = picture(ordinary())
    assert rating(10 * image).item() - rating(image).item() == pytest.approx(8, abs=1e-6)


def test_dgp_without_a_source_is_the_illuminance_alone():
    image = picture(torch.full((10, 10), 300.0, dtype=torch.float64))
    illuminance = VerticalIlluminance(FISHEYE)(image).item()
    assert DaylightGlareProbability(FISHEYE)(image).item() == pytest.approx(5.87e-5 * illuminance + 0.159)
    published = DaylightGlareProbability(FISHEYE, constants="published")(image).item()
    assert published == pytest.approx(5.87e-5 * illuminance + 0.16)


def test_dgp_is_at_most_one():
    assert DaylightGlareProbability(FISHEYE)(picture(torch.full((10, 10), 1e5))).item() == 1.0


def test_low_light_correction_reaches_to_1000_lux():
    for level, corrected in ((60.0, True), (400.0, False)):
        image = picture(torch.full((10, 10), level, dtype=torch.float64))
        illuminance = VerticalIlluminance(FISHEYE)(image).item()
        share = 1 / (1 + math.exp(4 - 0.024 * illuminance)) if corrected else 1.0
        plain = DaylightGlareProbability(FISHEYE)(image).item()
        assert DaylightGlareProbability(FISHEYE, low_light=True)(image).item() == pytest.approx(share * plain)


def test_illuminance_of_a_uniform_hemisphere_is_pi_times_its_luminance():
    camera = Camera.fisheye(128, 128)
    lux = VerticalIlluminance(camera)(torch.ones(128, 128, 3)).item()
    assert lux == pytest.approx(179 * math.pi, rel=2e-4)


def test_position_index_grows_away_from_the_line_of_sight():
    angles = torch.arange(0, 90, 1.0, dtype=torch.float64).deg2rad()
    for x, y in ((1, 0), (0, 1), (0, -1), (0.6, 0.8), (0.6, -0.8)):
        ray = torch.stack([x * angles.sin(), y * angles.sin(), angles.cos()], -1)
        index = position_index(ray)
        assert index[0].item() == pytest.approx(1.0)
        assert (index.diff() >= 0).all()
        assert index.max() <= 16


# Detection and grouping


def test_sources_have_position_luminance_solid_angle_and_index():
    rating = UnifiedGlareRating(CAMERA, relaxation=0)
    image = torch.full((8, 12), 50.0, dtype=torch.float64)
    image[2, 8], image[5, 1] = 10_000.0, 20_000.0
    first, second = rating.sources(picture(image))
    assert (first.row, first.column, second.row, second.column) == (5, 1, 2, 8)
    assert first.luminance == pytest.approx(20_000, rel=1e-3)
    assert first.solid_angle == pytest.approx(CAMERA.solid_angles[5, 1].item())
    assert second.position_index == pytest.approx(position_index(CAMERA.directions)[2, 8].item())
    assert second.direction == pytest.approx(tuple(CAMERA.directions[2, 8].tolist()))
    assert second.pixels.tolist() == [[2, 8]]


def test_grouping_by_pixel_makes_each_pixel_a_source():
    camera = Camera.perspective(60, 40, 50)
    image = torch.full((40, 60), 50.0)
    image[10:14, 20:25] = 5_000.0
    assert len(UnifiedGlareRating(camera).sources(picture(image))) == 1
    assert len(UnifiedGlareRating(camera, grouping="pixel").sources(picture(image))) == 20


def test_parts_above_50_000_are_separate_sources():
    camera = Camera.perspective(60, 40, 50)
    image = torch.full((40, 60), 50.0)
    image[10:20, 20:30] = 5_000.0
    image[14, 24] = 60_000.0
    sun, window = UnifiedGlareRating(camera).sources(picture(image))
    assert (len(sun.pixels), len(window.pixels)) == (1, 99)


def test_linking_agrees_with_comparing_every_pair():
    from scenecaptum.metrics._grouping import connected_components

    for seed, (count, angle) in enumerate(
        [(5, 0.1), (60, 0.1), (200, 0.1), (400, 0.1), (300, 0.4), (50, 1.5)]
    ):
        generator = torch.Generator().manual_seed(shifted(seed))
        rays = torch.randn(count, 3, generator=generator, dtype=torch.float64)
        rays = torch.nn.functional.normalize(rays, dim=-1)
        reach = rays @ rays.T >= math.cos(angle)
        for _ in range(count.bit_length()):  # each doubles the length of a path
            reach = (reach.double() @ reach.double()) > 0
        labels = torch.from_numpy(connected_components(rays.numpy(), angle))
        assert torch.equal(labels[:, None] == labels[None], reach)


def test_all_pixels_may_be_one_source():
    camera = Camera.fisheye(64, 64)
    (whole,) = UnifiedGlareRating(camera).sources(picture(torch.full((64, 64), 9_000.0)))
    assert whole.solid_angle == pytest.approx(2 * math.pi, rel=0.02)
    assert math.isfinite(UnifiedGlareRating(camera)(picture(torch.full((64, 64), 9_000.0))).item())


def test_the_check_image_paints_sources_and_keeps_luminance():
    from scenecaptum.metrics import luminance

    image = picture(ordinary()).float()
    rating = UnifiedGlareRating(CAMERA)
    painted = rating.check_image(image)
    torch.testing.assert_close(luminance(painted), luminance(image), rtol=1e-4, atol=1e-5)
    grey = (painted - painted[..., :1]).abs().amax(-1) < 1e-6
    source = torch.zeros(8, 12, dtype=torch.bool)
    for found in rating.sources(image):
        source[found.pixels[:, 0], found.pixels[:, 1]] = True
    assert torch.equal(~grey, source)


def test_the_threshold_may_follow_the_mean_of_the_picture_or_of_a_task_zone():
    image = ordinary()
    task = torch.zeros(8, 12, dtype=torch.bool)
    task[7] = True
    rating = UnifiedGlareRating(CAMERA, threshold_factor=10, task=task, relaxation=0)
    bright = sum(len(found.pixels) for found in rating.sources(picture(image)))
    assert bright == int((image > 10 * image[7].mean()).sum())


def test_a_relative_threshold_is_differentiated_with_the_picture():
    """Against finite differences of the rating, in pixels of sources and in others."""
    image = picture(ordinary())
    rating = UnifiedGlareRating(CAMERA, threshold_factor=5)
    slope = gradient(rating, image)
    for row, column in ((2, 3), (7, 0), (0, 11), (4, 6)):
        step = torch.zeros_like(image)
        step[row, column] = 1e-3 * image.mean()
        exact = (rating(image + step) - rating(image - step)) / (2e-3 * image.mean())
        assert slope[row, column].sum().item() == pytest.approx(exact.item(), rel=1e-2, abs=1e-6)


def test_a_relative_threshold_may_be_frozen():
    image = picture(ordinary())
    omega = CAMERA.solid_angles
    mean = (omega * ordinary()).sum() / omega.sum()
    relative = UnifiedGlareRating(CAMERA, threshold_factor=5)
    fixed = UnifiedGlareRating(CAMERA, threshold=5 * mean.item())
    held = relative.held_at(image)
    torch.testing.assert_close(gradient(held, image), gradient(fixed, image), rtol=1e-3, atol=1e-9)
    assert held(image).item() == pytest.approx(relative(image).item())
    assert held(2 * image).item() == pytest.approx(fixed(2 * image).item(), rel=1e-4)
    assert relative.threshold_factor == 5


# Derivatives


@every_rating
@every_grouping
@pytest.mark.parametrize(
    ("camera", "base", "peak"),
    [
        pytest.param(FISHEYE, 100.0, 9_000.0, id="ordinary-fisheye"),
        pytest.param(CAMERA, 1e-4, 1e10, id="contrast-1e14-perspective"),
        pytest.param(CAMERA, 100.0, 9_000.0, id="ordinary-perspective", marks=pytest.mark.long),
        pytest.param(FISHEYE, 1e-4, 1e10, id="contrast-1e14-fisheye", marks=pytest.mark.long),
    ],
)
def test_gradcheck_as_a_function_of_log_luminance(rating, grouping, camera, base, peak):
    metric = rating(camera, grouping=grouping)
    logarithm = ordinary(camera, base=base, peak=peak).log().requires_grad_()
    assert torch.autograd.gradcheck(of_log_luminance(metric), (logarithm,), eps=1e-6, atol=1e-5, rtol=1e-4)


@every_rating
@every_grouping
def test_gradcheck_where_the_brightest_pixel_is_inside_the_transition(rating, grouping):
    image = torch.full((8, 12), 100.0, dtype=torch.float64)
    image[3, 4], image[5, 9] = 1_900.0, 1_700.0
    logarithm = image.log().requires_grad_()
    assert torch.autograd.gradcheck(of_log_luminance(rating(CAMERA, grouping=grouping)), (logarithm,))


@pytest.mark.parametrize("metric", [ContrastRatio(), LuminancePercentile(80), VerticalIlluminance(CAMERA)])
def test_gradcheck_of_the_luminance_metrics(metric):
    # Distinct values: where two pixels tie, an order statistic has a kink.
    spread = torch.rand(8, 12, generator=torch.Generator().manual_seed(shifted(2)), dtype=torch.float64)
    logarithm = (ordinary().log() + spread).requires_grad_()
    assert torch.autograd.gradcheck(of_log_luminance(metric), (logarithm,))


def flat(level: float) -> torch.Tensor:
    return torch.full((8, 12), level, dtype=torch.float64)


EXTREMES = {
    "black": flat(0.0),
    "dim": flat(100.0),
    "at-threshold": flat(2000.0),
    "all-source": flat(9_000.0),
    "one-source-in-black": torch.where(torch.arange(96).reshape(8, 12) == 40, 9_000.0, 0.0).double(),
    "one-pixel-at-threshold": torch.where(torch.arange(96).reshape(8, 12) == 40, 2_000.0, 100.0).double(),
    "contrast-1e14": ordinary(base=1e-4, peak=1e10),
    "all-1e14": flat(1e14),
}


@every_rating
@every_grouping
@pytest.mark.parametrize("relaxation", [0, 0.1, 0.5])
@pytest.mark.parametrize("background", ["hemisphere", "mean"])
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.long)])
@pytest.mark.parametrize("extreme", EXTREMES)
def test_values_and_gradients_stay_finite(rating, grouping, relaxation, background, dtype, extreme):
    image = picture(EXTREMES[extreme]).to(dtype)
    for setting in ({}, {"threshold_factor": 5}, {"threshold_factor": 1}):
        metric = rating(CAMERA, relaxation=relaxation, grouping=grouping, background=background, **setting)
        value = metric(image)
        assert value.dtype == dtype
        assert torch.isfinite(value)
        assert torch.isfinite(gradient(metric, image)).all()


@pytest.mark.parametrize("rating", [UnifiedGlareRating, DaylightGlareIndex])
@pytest.mark.parametrize("relaxation", [0, 0.1])
@pytest.mark.parametrize("level", [0.0, 100.0, 1_399.0])
def test_without_a_source_the_rating_and_its_gradient_are_zero(rating, relaxation, level):
    metric = rating(CAMERA, relaxation=relaxation)
    assert metric(picture(flat(level))).item() == 0
    assert (gradient(metric, picture(flat(level))) == 0).all()


@every_rating
@pytest.mark.parametrize("extreme", ["black", "dim", "one-pixel-at-threshold"])
@pytest.mark.parametrize("side", [1, -1])
def test_one_sided_derivatives_are_the_gradient(rating, extreme, side):
    """A cubic step has no kink at its ends or at the threshold; at black there is only the brighter side."""
    luminance = EXTREMES[extreme]
    if extreme == "black" and side < 0:
        pytest.skip("there is no darker than black")
    metric = rating(CAMERA)
    image = picture(luminance).contiguous()
    direction = torch.rand(8, 12, 3, generator=torch.Generator().manual_seed(shifted(1)), dtype=torch.float64)
    step = 1e-6
    measured = side * (metric(image + side * step * direction) - metric(image)) / step
    torch.testing.assert_close((gradient(metric, image) * direction).sum(), measured, rtol=1e-3, atol=1e-6)


@every_rating
@pytest.mark.parametrize("side", [1, -1])
def test_one_sided_derivatives_in_hard_mode_hold_membership(rating, side):
    """The pixel at the threshold is not part of the source; if it is darker, it stays outside."""
    metric = rating(CAMERA, relaxation=0)
    luminance = ordinary()
    luminance[4, 5] = 1_990.0
    image = picture(luminance).contiguous()
    direction = torch.rand(8, 12, 3, generator=torch.Generator().manual_seed(shifted(1)), dtype=torch.float64)
    measured = side * (metric(image + side * 1e-6 * direction) - metric(image)) / 1e-6
    torch.testing.assert_close((gradient(metric, image) * direction).sum(), measured, rtol=1e-3, atol=1e-6)


@every_rating
@every_grouping
def test_the_relaxed_rating_and_gradient_tend_to_the_hard_ones(rating, grouping):
    image = picture(ordinary())  # one pixel is 7.5 % above the threshold
    hard = rating(CAMERA, relaxation=0, grouping=grouping)
    gaps = []
    for relaxation in (0.1, 0.05, 0.03, 0.01):
        soft = rating(CAMERA, relaxation=relaxation, grouping=grouping)
        gaps.append((gradient(soft, image) - gradient(hard, image)).norm().item())
    assert gaps[-1] < 1e-9
    assert gaps[0] > 1e-6
    torch.testing.assert_close(rating(CAMERA, relaxation=0.01, grouping=grouping)(image), hard(image))


def test_a_rating_starts_from_zero_without_a_jump():
    levels = torch.linspace(1_390, 2_700, 400, dtype=torch.float64)
    for rating in (UnifiedGlareRating, DaylightGlareIndex):
        metric = rating(CAMERA)
        values = []
        for level in levels:
            image = flat(100.0)
            image[3, 4] = level
            values.append(metric(picture(image)).item())
        steps = torch.tensor(values).diff().abs()
        assert values[0] == 0
        assert steps.max() < 0.02 * max(map(abs, values))


# The luminance metrics


def test_a_percentile_of_width_zero_is_that_of_numpy():
    import numpy as np

    image = torch.rand(9, 7, 3, dtype=torch.float64)
    from scenecaptum.metrics import luminance

    values = luminance(image).numpy()
    for percentile in (0, 3, 50, 95, 100):
        measured = LuminancePercentile(percentile, width=0, efficacy=1.0)(image).item()
        assert measured == pytest.approx(np.percentile(values, percentile))


def test_a_percentile_averages_over_its_band():
    import numpy as np

    ramp = torch.rand(40, 25, generator=torch.Generator().manual_seed(shifted()), dtype=torch.float64)
    image = ramp[..., None].expand(-1, -1, 3)
    white = LuminancePercentile(0, width=0)(torch.ones(1, 1, 3, dtype=torch.float64)).item()
    fine = np.percentile(ramp.numpy(), np.linspace(85, 95, 20_001)).mean()
    assert LuminancePercentile(90, width=5)(image).item() == pytest.approx(white * fine, rel=1e-5)
    reached = (gradient(LuminancePercentile(90, width=5), image).sum(-1) > 0).sum().item()
    assert 100 <= reached <= 103


def test_contrast_does_not_depend_on_the_exposure_and_is_finite_in_black():
    image = torch.rand(20, 20, 3) + 0.01
    torch.testing.assert_close(ContrastRatio()(image), ContrastRatio()(7 * image))
    assert ContrastRatio()(torch.zeros(4, 4, 3)).item() == 1.0
    half = torch.zeros(4, 4, 3)
    half[:2] = 1.0
    assert math.isfinite(ContrastRatio()(half).item())


def test_a_contrast_to_black_has_a_caution():
    half = torch.zeros(4, 4, 3)
    half[:2] = 1.0
    caution = "the 5th percentile is black: the ratio is to the floor of 1e-06 and means nothing"
    assert ContrastRatio().caution_of(half) == caution
    assert ContrastRatio().caution_of(half + 1e-8).startswith("the 5th percentile is below 1e-06: ")
    assert ContrastRatio().caution_of(half + 0.1) == ""
    room = SceneRenderer("cornell-box", "light.emitter.radiance.value", resolution=(8, 8), spp=4, max_depth=2)
    for inputs, texts in ((None, []), ({name: 0 * value for name, value in room.inputs.items()}, [caution])):
        result = VanillaSceneGradient(room, ContrastRatio(50)).attribute(inputs)
        expected = [f"caution: {text.replace('5th', '50th')}" for text in texts]
        assert [note for note in noise_notes(result) if "floor" in note] == expected


def test_a_rating_shows_its_settings():
    assert repr(UnifiedGlareRating(Camera.fisheye(8, 8), threshold_factor=5)) == (
        "UnifiedGlareRating(Camera(width=8, height=8, projection='fisheye', fov=180.0), threshold_factor=5, "
        "relaxation=0.1, grouping='evalglare', background='hemisphere', efficacy=179)"
    )


# Errors


METRICS = [
    *(rating(CAMERA) for rating in RATINGS),
    VerticalIlluminance(CAMERA),
    ContrastRatio(),
    LuminancePercentile(),
]


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
@pytest.mark.parametrize(
    ("value", "message"),
    [(math.nan, "1 values that are not finite"), (math.inf, "not finite"), (-0.5, "negative")],
)
def test_values_that_are_not_radiances_are_refused(metric, value, message):
    image = torch.ones(8, 12, 3)
    image[3, 7, 1] = value
    with pytest.raises(SceneCaptumError, match=rf"{message}.*row 3, column 7, channel 1"):
        metric(image)


@pytest.mark.parametrize("metric", METRICS[:4], ids=lambda metric: type(metric).__name__)
def test_an_image_of_another_size_than_the_camera_is_refused(metric):
    with pytest.raises(SceneCaptumError, match=r"\(12, 8\).*camera \(8, 12\)"):
        metric(torch.ones(12, 8, 3))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threshold": 0}, "threshold must be a finite number above 0"),
        ({"relaxation": -0.1}, "relaxation must be a finite number at least 0"),
        ({"threshold_factor": math.nan}, "threshold_factor must be"),
        ({"grouping": "blob"}, "grouping must be one of 'evalglare', 'pixel'"),
        ({"background": "black"}, "background must be one of"),
        ({"task": torch.ones(8, 12)}, "task needs threshold_factor"),
        ({"task": torch.ones(12, 8), "threshold_factor": 5}, r"task has shape \(12, 8\)"),
        ({"task": torch.zeros(8, 12), "threshold_factor": 5}, "selects no pixel"),
    ],
)
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(SceneCaptumError, match=message):
        UnifiedGlareRating(CAMERA, **settings)


def test_percentages_and_constants_are_checked():
    with pytest.raises(SceneCaptumError, match="percentile must be from 0 to 100"):
        LuminancePercentile(101)
    with pytest.raises(SceneCaptumError, match="low must be below high"):
        ContrastRatio(60, 40)
    with pytest.raises(SceneCaptumError, match="constants must be one of 'evalglare', 'published'"):
        DaylightGlareProbability(CAMERA, constants="mine")
