"""Attribution of the expectation of a metric over noise: error bars include the finite number of draws."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from chance import check_error_bars
from seeds import seeds, shifted
from toy import ReplayingToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    IntegratedGradientsScene,
    SceneRenderer,
    VanillaSceneGradient,
    metrics,
)

SIGMA = 0.8
RUNS = 60
PLANNED = {"tolerance": 1e-9, "time_limit": 1e-9}
QUICK = {"spp": 16, "replicates": 2}  # for what is said, whatever the numbers are


def squares(image: torch.Tensor) -> torch.Tensor:
    return image.square().mean()


squares.of_batch = lambda images: images.square().mean((1, 2, 3))  # type: ignore[attr-defined]


def exact(renderer: ReplayingToyRenderer) -> tuple[float, torch.Tensor]:
    """Return value and gradient of the expectation: the square of a factor has the mean ``exp(σ²)``."""
    x = renderer.inputs["x"].double().requires_grad_()
    value = math.exp(SIGMA**2) * squares(renderer.matrix.double() @ x)
    (gradient,) = torch.autograd.grad(value, x)
    return value.item(), gradient


@pytest.mark.parametrize(
    ("noise", "goal"),
    [
        pytest.param(0.02, {}, id="draws dominate-one round"),
        pytest.param(0.5, PLANNED, id="picture and draws-planned", marks=pytest.mark.long),
        pytest.param(0.02, PLANNED, id="draws dominate-planned", marks=pytest.mark.long),
        pytest.param(0.5, {}, id="picture and draws-one round", marks=pytest.mark.long),
    ],
)
def test_error_bars_include_the_draws(noise, goal):
    renderer = ReplayingToyRenderer(noise)
    metric = metrics.Smoothed(squares, SIGMA, n=32)
    value, gradient = exact(renderer)
    method = VanillaSceneGradient(renderer, metric)
    runs = [method.attribute(seed=seed, spp=64, **goal) for seed in seeds(RUNS)]
    values = torch.tensor([run.metric_value for run in runs])
    totals = torch.stack([run["x"].double() for run in runs])
    for found, truth, bars in (
        (values, value, torch.tensor([run.metric_standard_error for run in runs])),
        (totals, gradient, torch.stack([run.standard_error["x"].double() for run in runs])),
    ):
        z = (found.mean(0) - truth) / (found.std(0) / math.sqrt(RUNS))
        assert (z.abs() < 4).all()
        check_error_bars(found, bars)


@pytest.mark.long
def test_rounds_of_a_planned_run_have_their_own_draws():
    renderer = ReplayingToyRenderer(0.5)
    metric = metrics.Smoothed(squares, 0.5 * SIGMA, n=16)
    method = VanillaSceneGradient(renderer, metric)
    runs = [method.attribute(seed=seed, spp=64, tolerance=0.25) for seed in seeds(30)]
    truth = exact(renderer)[1] * math.exp((0.5 * SIGMA) ** 2 - SIGMA**2)
    totals = torch.stack([run["x"].double() for run in runs])
    assert any(len(run.info["planner"]["rounds"]) > 1 for run in runs)
    z = (totals.mean(0) - truth) / (totals.std(0) / math.sqrt(len(runs)))
    assert (z.abs() < 4).all()
    check_error_bars(totals, torch.stack([run.standard_error["x"].double() for run in runs]))


@pytest.mark.long
def test_several_points_split_the_draws():
    renderer = ReplayingToyRenderer(0.02)
    calls: list[int] = []

    def counted(image: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        return squares(image)

    counted.of_batch = lambda images: calls.extend([1] * len(images)) or images.square().mean((1, 2, 3))
    method = IntegratedGradientsScene(renderer, metrics.Smoothed(counted, SIGMA, n=64))
    baselines = {"x": torch.zeros(3)}
    runs = [method.attribute(baselines=baselines, seed=seed, spp=64, n_steps=4) for seed in seeds(24)]
    # The metric is quadratic: the mean gradient is half of that at the end.
    truth = (0.5 * exact(renderer)[1] * renderer.inputs["x"]).double()
    totals = torch.stack([run["x"].double() for run in runs])
    assert (((totals.mean(0) - truth) / (totals.std(0) / math.sqrt(len(runs)))).abs() < 4).all()
    check_error_bars(totals, torch.stack([run.standard_error["x"].double() for run in runs]))


def test_large_errors_come_with_the_advice_of_the_metric():
    def advised(image: torch.Tensor) -> torch.Tensor:
        return squares(image)

    advised.advice = "ask in another way"  # type: ignore[attr-defined]
    for noise, is_told in ((5.0, True), (0.001, False)):
        found = VanillaSceneGradient(ReplayingToyRenderer(noise), advised).attribute(seed=shifted(0), spp=16)
        assert ("ask in another way" in str(found)) is is_told


@pytest.mark.parametrize("is_smoothed", [False, True])
def test_a_metric_that_is_smoothed_is_not_told_to_be(is_smoothed: bool) -> None:
    def own(image: torch.Tensor) -> torch.Tensor:
        return squares(image)

    metric = metrics.Smoothed(own, n=16) if is_smoothed else own
    found = VanillaSceneGradient(ReplayingToyRenderer(5.0), metric).attribute(seed=shifted(0), spp=16)
    assert "the errors are large: use more samples" in str(found)
    assert ("metrics.Smoothed" in str(found)) is not is_smoothed


@pytest.mark.parametrize(
    "create",
    [
        lambda network, **options: metrics.ClassLogit(network, "cube", **options),
        lambda network, **options: metrics.ClassProbability(network, "cube", **options),
        lambda network, **options: metrics.EmbeddingDistance(torch.ones(3), network, **options),
    ],
)
def test_a_network_metric_says_that_its_gradient_is_rough_until_it_is_smoothed(create: Any) -> None:
    network = metrics.ShapeClassifier.pretrained()
    renderer = ReplayingToyRenderer(0.001)
    note = "effects of the rough gradient of a noisy picture, without smoothing"
    for smoothing, is_rough in ((None, True), (0.3, False)):
        asked = create(network, transform=_enlarged, smoothing=smoothing)
        found = VanillaSceneGradient(renderer, asked).attribute(seed=shifted(0), **QUICK)
        assert (note in str(found)) is is_rough
    ablation = FeatureAblationScene(renderer, create(network, transform=_enlarged))
    assert note not in str(ablation.attribute(baselines=0.0, seed=shifted(0), **QUICK))
    smoothed = metrics.Smoothed(create(network, transform=_enlarged), n=16)
    assert note not in str(VanillaSceneGradient(renderer, smoothed).attribute(seed=shifted(0), **QUICK))


@pytest.mark.parametrize(("smoothing", "is_rough"), [(None, True), (0.3, False)])
def test_integrated_gradients_of_a_network_say_so_too(smoothing: float | None, is_rough: bool) -> None:
    network = metrics.ShapeClassifier.pretrained()
    logit = metrics.ClassLogit(network, "cube", transform=_enlarged, smoothing=smoothing)
    path = IntegratedGradientsScene(ReplayingToyRenderer(0.001), logit)
    said = str(path.attribute(n_steps=2, seed=shifted(0), **QUICK))
    assert ("effects of the rough gradient of a noisy picture, without smoothing" in said) is is_rough


def _enlarged(picture: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.interpolate(picture, (64, 64))


def test_integrated_gradients_of_a_network_advise_samples_of_the_pictures_too():
    renderer = ReplayingToyRenderer(0.001)
    logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube", transform=_enlarged)
    for method, more in ((VanillaSceneGradient, False), (IntegratedGradientsScene, True)):
        found = method(renderer, logit).attribute(seed=shifted(0), **QUICK)
        # With errors that are large for certain.
        large = {name: 1e6 * torch.eye(len(one)).double() for name, one in found.covariance.items()}
        found = dataclasses.replace(found, covariance=large)
        text = " ".join(str(found).split())
        assert "smoothing 0.3" in text
        assert ("picture_spp= in Python, --picture-spp on the command line" in text) is more


def test_a_network_advises_smoothing_until_it_is_smoothed():
    network = metrics.ShapeClassifier.pretrained()
    advice = metrics.ClassLogit(network, "cube").advice or ""
    assert "smoothing 0.3" in advice
    assert "--" not in advice, "it is on HTML pages, too"
    assert metrics.ClassLogit(network, "cube", smoothing=0.3).advice is None


def test_large_errors_of_a_metric_of_the_user_advise_to_smooth_it() -> None:
    renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(8, 8), spp=16, max_depth=3)
    jumping = VanillaSceneGradient(renderer, lambda image: torch.sin(1000 * image).mean()).attribute(seed=0)
    assert "metrics.Smoothed(" in str(jumping)
    assert "Smoothed" not in str(VanillaSceneGradient(renderer, lambda image: image.mean()).attribute(seed=0))


@pytest.mark.long
def test_ablation_of_a_network_says_how_many_samples_its_picture_needs() -> None:
    """Noise of a third of that of the smoothing hardly biases the logit; at a few samples the class is another."""
    renderer = SceneRenderer("cornell-box", inputs="short_box*", resolution=(16, 16), spp=16, max_depth=3)
    logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube", smoothing=0.3)
    method = FeatureAblationScene(renderer, logit)
    few, many = (method.attribute(groups="object", spp=spp, seed=shifted()) for spp in (16, 4096))
    assert "and more than 10 % biases it" in few.info["picture"]["caution"]
    assert few.info["picture"]["advice"].startswith("use spp=")
    assert many.info["picture"]["caution"] is None
    assert "each alone" not in str(few)
    assert "the sum of the losses of its channels, each alone" in str(
        method.attribute(seed=shifted(), replicates=2)
    )


@pytest.mark.long
def test_the_gradient_of_a_network_says_how_many_samples_a_very_noisy_picture_needs() -> None:
    """Above that of the smoothing, noise biases the logit by more than two halves of the samples differ."""
    renderer = SceneRenderer("classroom", inputs="reflectance", resolution=(24, 14), max_depth=3)
    plain = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube")
    logit = metrics.Smoothed(plain, sigma=0.3, n=32)
    method = VanillaSceneGradient(renderer, logit)
    few, many = (
        method.attribute(seed=shifted(), spp=8, picture_spp=picture_spp) for picture_spp in (64, 8192)
    )
    assert few.info["picture"]["caution"]
    assert few.info["picture"]["advice"].startswith("use picture_spp=")
    assert int(few.info["picture"]["advice"].split("=")[1].split()[0]) > 64 * 9
    assert "biases it" not in (many.info["picture"]["caution"] or "")


def test_ablation_of_a_network_without_smoothing_cautions_against_a_noisy_picture() -> None:
    renderer = SceneRenderer("cornell-box", inputs="short_box*", resolution=(16, 16), spp=16, max_depth=3)
    logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube")

    def picture(spp: int, **options: bool) -> dict[str, Any]:
        method = FeatureAblationScene(renderer, logit)
        info = method.attribute(groups="object", spp=spp, seed=shifted(), **options).info
        return info["picture"]

    assert "the noise of a pixel is " in picture(64)["caution"]
    assert "the error of a denoised pixel is " in picture(64, denoise=True)["caution"]
    assert picture(16384)["caution"] is None


def test_large_errors_of_differences_of_values_advise_more_samples_not_smoothing() -> None:
    """There is no gradient to smooth."""
    renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(8, 8), spp=16, max_depth=3)

    def jumping(image: torch.Tensor) -> torch.Tensor:
        return torch.sin(1000 * image).mean()

    jumping.advice = "smooth it"  # type: ignore[attr-defined]
    text = " ".join(
        str(FeatureAblationScene(renderer, jumping).attribute(seed=shifted(), denoise=False)).split()
    )
    assert "smooth it" not in text
    assert ("more samples lower them, spp= in Python, --spp on the command line" in text) != (
        "caution" in text
    )
