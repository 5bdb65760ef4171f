"""The image that a metric is evaluated on: denoised where that is measured to be closer to the truth."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

import scenecaptum as sc
from scenecaptum import Camera, FeatureAblationScene, SmoothGradScene, VanillaSceneGradient, metrics
from scenecaptum.denoising import denoise, straight_through
from scenecaptum.errors import SceneCaptumError
from scenecaptum.estimation import (
    ImageTransform,
    SampleOption,
    TargetedMetric,
    _image_info,
    _metric_image,
    choose_transform,
    describe_picture,
    pixel_error,
    student_t,
    value_by_definition,
)
from scenecaptum.estimation._jackknife import jackknife
from scenecaptum.estimation._linearity import is_linear
from scenecaptum.estimation._transform_errors import denoiser_bias

SIZE = 32
CAMERA = Camera.perspective(SIZE, SIZE, fov_x=60)


class Fireflies:
    """A room with a window; its walls get part of their light from rare, bright paths."""

    spp = 16

    def __init__(self, chance: float = 0.001) -> None:
        self.chance = chance
        y, x = torch.meshgrid(torch.linspace(0, 1, SIZE), torch.linspace(0, 1, SIZE), indexing="ij")
        self.wall = (0.5 + 0.3 * x + 0.2 * y)[..., None].expand(-1, -1, 3).clone()
        self.window = torch.zeros(SIZE, SIZE, 3)
        self.window[8:14, 10:20] = 20.0
        self.wall[8:14, 10:20] = 0.0
        self.inputs = {"wall": torch.tensor(1.0), "window": torch.tensor(1.0)}

    def exact(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return inputs["wall"] * self.wall + inputs["window"] * self.window

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        hits = torch.binomial(
            torch.full((SIZE, SIZE, 1), float(spp)), torch.tensor(self.chance), generator=generator
        )
        light = 0.2 + 0.8 * hits / (spp * self.chance)
        return inputs["wall"] * self.wall * light + inputs["window"] * self.window


def glare() -> Any:
    return metrics.UnifiedGlareRating(CAMERA, threshold_factor=5, efficacy=179.0)


def test_choice_and_errors_are_measured():
    noisy, calm = Fireflies(), Fireflies(chance=1.0)
    images = [noisy(noisy.inputs, seed=seed, spp=4) for seed in seeds(8)]
    transform = choose_transform("auto", images, None, None)
    assert transform.denoises
    truth = noisy.exact(noisy.inputs)
    halves = [torch.stack(images[start::2]).mean(0) for start in (0, 1)]
    seen = (denoise(halves[0]) + denoise(halves[1])) / 2
    weight = 1 / (seen.mean(-1, keepdim=True) ** 2 + (0.1 * seen.mean()) ** 2)

    def error(made: list[torch.Tensor]) -> float:
        return sum((weight * (one - truth) ** 2).mean().item() for one in made) / 2

    assert transform.raw_error == pytest.approx(error(halves), rel=0.2)
    assert error([denoise(one) for one in halves]) < 0.2 * transform.raw_error
    assert transform.denoised_error < 0.5 * transform.raw_error

    clean = [
        calm(calm.inputs, seed=seed, spp=4)
        + 1e-5 * torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(seed))
        for seed in seeds(8)
    ]
    assert not choose_transform("auto", clean, None, None).denoises


def test_intervals_contain_the_converged_rating_or_carry_a_caution():
    renderer, rating = Fireflies(), glare()
    exact = rating(renderer.exact(renderer.inputs)).item()
    held = raw_held = near = cautions = 0
    for seed in seeds(20):
        denoised, raw = (
            VanillaSceneGradient(renderer, rating).attribute(seed=seed, spp=32, denoise=mode)
            for mode in ("auto", False)
        )
        assert denoised.info["picture"]["denoised"]
        low, high = denoised.metric_interval(0.95)
        held += low <= exact <= high
        raw_low, raw_high = raw.metric_interval(0.95)
        raw_held += raw_low <= exact <= raw_high
        near += abs(raw.metric_value - exact) < 1
        cautions += raw.info["picture"]["caution"] is not None
    assert held >= 16  # with 95 % each, fewer in 1 of 3000 cases
    assert near <= 12, "the noise shall matter, or the test says nothing"  # 23 of 100
    assert raw_held >= 16
    assert cautions >= 16


class Gray(ImageTransform):
    """A denoiser whose output is uniformly gray."""

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        return torch.full_like(image, 0.5)


def test_the_bias_of_a_denoiser_is_part_of_the_error():
    renderer = Fireflies(0.1)
    metric = TargetedMetric(lambda image: image.square().mean(), transform=Gray(True))
    truth = renderer.exact(renderer.inputs)
    shares = torch.tensor([0.4, 0.2, 0.2, 0.1, 0.1], dtype=torch.float64)
    found, held = [], 0
    for seed in seeds(20):
        images = [
            renderer(renderer.inputs, seed=20 * seed + k, spp=int(640 * share))
            for k, share in enumerate(shares.tolist())
        ]
        _, adjoint = metric.value_and_adjoint(images[0])
        found.append(denoiser_bias(metric, torch.stack(images), shares, adjoint)[0])
        seen = jackknife(metric, images, [640 * share for share in shares.tolist()])
        held += abs(seen.value - truth.square().mean().item()) <= student_t(0.95, 4) * seen.standard_error
    # The metric is a square: its error is exactly the second-order term.
    expected = (truth - 0.5).square().mean().item()
    each = torch.tensor(found)
    assert abs(each.mean() - expected) < allowed(20) * each.std() / math.sqrt(20)
    assert each.std() < 0.1 * expected
    assert held == 20


def test_equal_images_do_not_make_a_metric_linear():
    image = Fireflies()(Fireflies().inputs, seed=shifted(), spp=64)
    squares, mean = (TargetedMetric(one) for one in (lambda image: image.square().mean(), torch.mean))
    for images in ([image], [image, image], [image, image, 2 * image]):
        assert not is_linear(squares, images)
        assert is_linear(mean, images)


def test_gradients_at_a_denoised_image_are_those_of_the_converged_one():
    renderer, rating = Fireflies(), glare()
    leaves = {name: value.clone().requires_grad_() for name, value in renderer.inputs.items()}
    exact = torch.autograd.grad(rating(renderer.exact(leaves)), list(leaves.values()))
    misses = 0
    for seed in seeds(10):
        found = VanillaSceneGradient(renderer, rating).attribute(seed=seed, spp=64)
        for (name, value), true in zip(found.items(), exact, strict=True):
            misses += bool(abs(value - true) > 4 * found.standard_error[name] + 1e-4 * abs(true))
    assert misses <= 1


def test_images_of_linear_metrics_are_not_denoised():
    renderer = Fireflies()
    plain, other = (
        VanillaSceneGradient(renderer, torch.mean).attribute(seed=shifted(3), denoise=mode)
        for mode in (False, True)
    )
    assert not other.info["picture"]["denoised"]
    assert other.info["picture"]["spp"] == 16
    for name in plain:
        assert torch.equal(plain[name], other[name])


@pytest.mark.parametrize("view", [True, False])
def test_the_caution_says_that_differences_of_values_are_biased_too(view):
    def noisy(inputs, *, seed, spp):
        noise = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(seed)) / math.sqrt(spp)
        return inputs["light"] * (0.5 + noise)

    def glaring(image):
        return (image - 1).relu().mean()

    noisy.shows_a_view = view
    light = {"light": torch.tensor(1.0)}
    found, gradients = (
        method(noisy, glaring).attribute(light, seed=shifted(0), spp=16, denoise=False, **options)
        for method, options in ((FeatureAblationScene, {"baselines": 0.0}), (VanillaSceneGradient, {}))
    )
    biased = "; the effects are biased, too"
    caution = found.info["picture"]["caution"]
    noisy_one = f"the {'picture' if view else 'result'} is too noisy for this metric: "
    assert caution.startswith(noisy_one)
    assert caution.endswith(biased)
    assert caution in " ".join(str(found).split())
    assert gradients.info["picture"]["caution"].startswith(noisy_one)
    assert biased not in gradients.info["picture"]["caution"]


@pytest.mark.parametrize(
    ("drift", "denoised", "compares", "said"),
    [
        ((0.008, 0.001), None, False, None),  # in the error of the value, and below a percent of it
        ((0.008, 0.001), None, True, "1.792 at 64 spp, 1.784 at 128 spp: use spp=2100 or more"),
        ((0.05, 0.012), None, False, "1.834 at 64 spp, 1.784 at 128 spp: use spp=360 or more"),
        ((0.05, 0.005), None, False, "1.834 at 64 spp, 1.784 at 128 spp: use spp=360 or more"),
        ((0.05, 0.02), None, False, "1.834 at 64 spp, 1.784 at 128 spp: use spp=200 or more"),
        ((0.05, 0.03), None, False, None),
        ((0.0, 0.001), 1.79, False, None),
        ((0.0, 0.001), 1.9, False, "1.784 as rendered, 1.9 denoised"),
    ],
)
def test_a_difference_below_a_percent_of_the_value_needs_no_caution(drift, denoised, compares, said):
    asked = SampleOption("spp", 128)
    found = describe_picture(ImageTransform(), 1.784, drift, 128, denoised, compares=compares, option=asked)
    if said is None:
        assert found["caution"] is found["advice"] is None
        return
    caution = found["caution"].removeprefix("the picture is too noisy for this metric: ").partition(";")[0]
    assert ": ".join(filter(None, [caution, found["advice"]])) == said


def test_a_caution_counts_samples_only_where_the_picture_has_as_many_as_were_asked_for():
    drift = (0.05, 0.02)
    for option, said in (
        (SampleOption("picture_spp", 128), "1.834 at 64 spp, 1.784 at 128 spp"),
        (SampleOption("spp", 32.1, " in place of a goal"), "1.834 at half of the samples, 1.784 at all"),
        (None, "1.834 at half of the samples, 1.784 at all"),
    ):
        found = describe_picture(ImageTransform(), 1.784, drift, 128, option=option)
        assert found["caution"] == f"the picture is too noisy for this metric: {said}"
        assert (
            found["advice"]
            == {
                "picture_spp": "use picture_spp=200 or more",
                "spp": "use spp=51 or more in place of a goal",
                None: "use at least 1.6 times the samples",
            }[option and option.keyword]
        )


class Counting(Fireflies):
    """A renderer that counts the samples of the pictures at its own inputs."""

    def __init__(self):
        super().__init__(
            chance=0.01
        )  # brighter fireflies raise the threshold above the window: no glare at all
        self.samples = 0
        self.bounds = dict.fromkeys(self.inputs, (0.0, 2.0))

    def __call__(self, inputs, *, seed, spp):
        is_own = all(torch.equal(value, inputs[name]) for name, value in self.inputs.items())
        self.samples += spp if is_own and not torch.is_grad_enabled() else 0
        return super().__call__(inputs, seed=seed, spp=spp)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (VanillaSceneGradient, {}),
        (VanillaSceneGradient, {"denoise": True}),
        (VanillaSceneGradient, {"spp": 3}),
        (VanillaSceneGradient, {"spp": 4, "picture_spp": 20}),
        (VanillaSceneGradient, {"tolerance": 0.9}),
        (SmoothGradScene, {"spp": 4, "nt_samples": 4, "noise_free_last": False}),
        (SmoothGradScene, {"spp": 8, "nt_samples": 4, "picture_spp": 64, "noise_free_last": False}),
        (SmoothGradScene, {"spp": 32, "nt_samples": 2, "picture_spp": 40, "noise_free_last": False}),
        (SmoothGradScene, {"spp": 128, "nt_samples": 8, "noise_free_last": False}),
        (SmoothGradScene, {"spp": 120, "nt_samples": 8, "noise_free_last": False}),
        (sc.IntegratedGradientsScene, {"baselines": 0.0, "spp": 100, "n_steps": 8}),
        (sc.IntegratedGradientsScene, {"baselines": 0.0, "spp": 256, "n_steps": 8}),
        (FeatureAblationScene, {"baselines": 0.0, "spp": 3}),
    ],
)
@pytest.mark.parametrize("factor", [pytest.param(1.01, marks=pytest.mark.long), 4])
def test_the_advised_option_gives_the_picture_as_many_times_the_samples(method, options, factor, monkeypatch):
    """Whatever defaults, rounding up, denoising, a goal or many points have made of what was set."""

    def attributed(**options):
        renderer = Counting()
        found = method(renderer, glare()).attribute(seed=shifted(), **{"denoise": False, **options})
        return renderer.samples, found.info["picture"]["advice"]

    monkeypatch.setattr(_image_info, "_differs", lambda *_, **__: ("differs", factor))
    before, advice = attributed(**options)
    keyword, value, instead = re.fullmatch(r"use (\w+)=(\d+) or more(.*)", advice).groups()
    assert instead == (" in place of a goal" if "tolerance" in options else "")
    kept = {name: one for name, one in options.items() if name != "tolerance"}
    after, _ = attributed(**{**kept, keyword: int(value)})
    assert factor * before <= after <= max(1.5 * factor, 2) * before  # every replicate takes whole samples
    assert int(value) > (0 if instead else options.get(keyword, 0))


def test_the_caution_is_printed_and_saved(tmp_path):
    found = VanillaSceneGradient(Fireflies(), glare()).attribute(seed=shifted(0), denoise=False)
    caution = found.info["picture"]["caution"]
    assert caution.startswith("the picture is too noisy for this metric: ")
    assert caution in " ".join(str(found).split())
    assert caution in " ".join(found._repr_html_().split())
    found.save(tmp_path / "found.npz")
    assert sc.SceneAttribution.load(tmp_path / "found.npz").info["picture"]["caution"] == caution
    bars = found.plot_bars()
    written = " ".join(text.get_text() for text in bars.findobj() if hasattr(text, "get_text"))
    assert "too noisy" in " ".join(written.split())


@pytest.mark.parametrize(
    ("value", "view", "said"), [(40.0, False, None), (9.5, False, "result"), (9.5, True, "picture")]
)
def test_the_caution_on_a_wide_interval_is_made_only_where_the_class_is_in_doubt(value, view, said):
    rated = SimpleNamespace(
        measure=metrics.Measure(
            "a", bands=(metrics.Band(7.0, "good"), metrics.Band(10.0, "fair")), above="poor"
        )
    )
    found = describe_picture(
        ImageTransform(),
        value,
        (0.0, 1.0),
        64,
        interval=(value - 2, value + 2),
        metric=TargetedMetric(rated),
        shows_a_view=view,
    )
    noisy = f"the {said} is too noisy for this metric"
    caution = f"{noisy}: its 95 % interval is ± 2, and half the width of a class is 1.5"
    assert found["caution"] == (caution if said else None)


@pytest.mark.parametrize(
    ("denoises", "noise", "error", "said"),
    [
        (
            False,
            0.12,
            0.0,
            "the noise of a pixel is 12 %, and more than 5 % biases it: use spp=370 or more",
        ),
        (False, 0.04, 0.1, None),
        (
            True,
            0.12,
            0.08,
            "the error of a denoised pixel is 8 %, and more than 5 % biases it: use spp=370 or",
        ),
        (True, 0.12, 0.04, None),
        (
            True,
            0.04,
            0.08,
            "the error of a denoised pixel is 8 %, and more than 5 % biases it: do not denoise",
        ),
        (False, 0.052, 0.0, "the noise of a pixel is 5.2 %, and more than 5 % biases it: use spp=70"),
        (False, 0.0503, 0.0, "the noise of a pixel is 5.03 %, and more than 5 % biases it: use spp=65"),
        (
            True,
            0.12,
            0.0516,
            "the error of a denoised pixel is 5.2 %, and more than 5 % biases it: use spp=370",
        ),
    ],
)
def test_the_caution_is_about_the_picture_that_is_used(denoises, noise, error, said):
    plain = TargetedMetric(SimpleNamespace(tolerated_noise=0.05))
    transform = ImageTransform(denoises, denoised_error=error**2)
    option = SampleOption("spp", 64)
    found = describe_picture(transform, 0.5, None, 64, noise=noise, metric=plain, option=option)
    if said is None:
        assert found["caution"] is found["advice"] is None
    else:
        assert said in f"{found['caution']}: {found['advice']}"


@pytest.mark.parametrize(("noise", "spp"), [(None, 400), (0.2, 1100)])
def test_the_advice_is_for_what_needs_more_samples(noise, spp):
    """Two halves that differ say how many make them alike, and the noise of a pixel how many the metric needs."""
    plain = TargetedMetric(SimpleNamespace(tolerated_noise=0.05))
    found = describe_picture(
        ImageTransform(False), 1.0, (0.1, 0.02), 64, noise=noise, metric=plain, option=SampleOption("spp", 64)
    )
    assert "1.1 at 32 spp, 1 at 64 spp" in found["caution"]
    assert int(found["advice"].split("=")[1].split()[0]) == spp


def test_images_can_have_a_separate_sample_budget():
    renderer, rating = Fireflies(), glare()
    method, errors = VanillaSceneGradient(renderer, rating), {}
    for spp in (16, 512):
        found = [method.attribute(seed=seed, picture_spp=spp) for seed in seeds(4)]
        assert {one.info["picture"]["spp"] for one in found} == {spp}
        errors[spp] = sum(one.metric_standard_error for one in found)
    assert errors[512] < errors[16]
    by_goal = VanillaSceneGradient(renderer, rating).attribute(
        seed=shifted(0), tolerance=0.5, spp=16, picture_spp=64
    )
    assert by_goal.info["picture"]["spp"] == 4 * by_goal.info["spp"]


@pytest.mark.parametrize("method", [sc.IntegratedGradientsScene, sc.SmoothGradScene, FeatureAblationScene])
def test_every_method_obeys_the_denoise_option(method):
    renderer, rating = Fireflies(), glare()
    half = dict.fromkeys(renderer.inputs, 0.5)
    options = {
        sc.IntegratedGradientsScene: {"baselines": half, "n_steps": 4},
        sc.SmoothGradScene: {},
        FeatureAblationScene: {"baselines": half},
    }
    renderer.bounds = dict.fromkeys(renderer.inputs, (0.0, 2.0))
    found = method(renderer, rating).attribute(seed=shifted(0), spp=64, denoise=True, **options[method])
    assert found.info["picture"]["denoised"]
    exact = rating(renderer.exact(renderer.inputs)).item()
    assert abs(found.metric_value - exact) < 5 * found.metric_standard_error


def test_a_metric_without_derivatives_gets_the_denoised_image():
    def bright(image: torch.Tensor) -> torch.Tensor:
        return (image.mean(-1) > 5).sum().float()

    renderer = Fireflies()
    exact = bright(renderer.exact(renderer.inputs)).item()
    baselines = {"wall": 0.0, "window": 0.0}
    found = {
        mode: FeatureAblationScene(renderer, bright).attribute(
            seed=shifted(0), spp=192, denoise=mode, baselines=baselines
        )
        for mode in (True, "auto", False)
    }
    # Of 1000 pixels of the wall 62 ± 8 have a bright path in 64 samples.
    assert found[False].metric_value > exact + 30
    assert abs(found[True].metric_value - exact) < 8
    assert abs(found["auto"].metric_value - exact) < 8


def test_invalid_options_are_refused():
    renderer = Fireflies()
    with pytest.raises(
        SceneCaptumError, match=r'denoise must be "auto", True or False, not "yes"|not \'yes\''
    ):
        VanillaSceneGradient(renderer, glare()).attribute(denoise="yes")
    with pytest.raises(SceneCaptumError, match="picture_spp=8 is less than spp=16"):
        VanillaSceneGradient(renderer, glare()).attribute(picture_spp=8)

    def flat(inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        return renderer(inputs, seed=seed, spp=spp).flatten()

    def bent(image: torch.Tensor) -> torch.Tensor:
        return image.square().mean()

    with pytest.raises(SceneCaptumError, match=r"Denoising requires an image \(H, W, 3\)"):
        VanillaSceneGradient(flat, bent).attribute(renderer.inputs, spp=16, denoise=True)
    assert not VanillaSceneGradient(flat, bent).attribute(renderer.inputs, spp=16).info["picture"]["denoised"]
    with pytest.raises(SceneCaptumError, match="Only an image"):
        denoise(torch.zeros(5, 5))


def test_a_transform_that_remembers_denoises_no_image_twice(monkeypatch):
    view, denoised = Fireflies(), []
    images = torch.stack([view(view.inputs, seed=seed, spp=4) for seed in seeds(4)])
    monkeypatch.setattr(
        _metric_image, "denoise", lambda image, guides: denoised.append(image) or denoise(image, guides)
    )
    rating = TargetedMetric(metrics.UnifiedGlareRating(CAMERA), transform=ImageTransform(denoises=True))
    expected, often = value_by_definition(rating, images), len(denoised)
    denoised.clear()
    assert value_by_definition(rating.with_transform(rating.transform.remembering()), images) == expected
    assert len(denoised) == 7 < often, "the mean, and the halves of three splits"


@pytest.mark.parametrize("factor", [2.0**-100, 1e-30, 0.7, 1e30])
def test_denoising_is_independent_of_exposure(factor):
    renderer = Fireflies()
    image = renderer(renderer.inputs, seed=shifted(), spp=8)
    expected = denoise(image)
    assert (expected - image).norm() > 0.1 * image.norm()
    torch.testing.assert_close(denoise(image * factor) / factor, expected, rtol=1e-3, atol=1e-4)
    assert not denoise(torch.zeros_like(image)).any()


def test_the_denoiser_is_a_straight_through_estimator():
    image = Fireflies()(Fireflies().inputs, seed=shifted(0), spp=4).requires_grad_()
    seen = straight_through(image)
    torch.testing.assert_close(seen.detach(), denoise(image))
    (gradient,) = torch.autograd.grad(seen.square().sum(), image)
    torch.testing.assert_close(gradient, 2 * seen.detach())


def test_the_error_of_a_pixel_is_that_of_the_mean_image():
    generator = torch.Generator().manual_seed(shifted())
    images = [1 + 0.3 * torch.randn(100, 100, 1, generator=generator).expand(-1, -1, 3) for _ in range(6)]
    for image in images:
        image[:50] = 0  # points that are left out
    assert pixel_error(images) == pytest.approx(0.3 / math.sqrt(6), rel=0.03)
    # An image of five times the samples.
    several = [torch.stack(images[:5]).mean(0), images[5]]
    of_samples = pixel_error(several, torch.tensor([5 / 6, 1 / 6]))
    assert of_samples == pytest.approx(0.3 / math.sqrt(6), rel=0.06)
    assert pixel_error(images[:1]) is None
