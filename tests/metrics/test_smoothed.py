"""The expectation of a metric over noise of the picture, against closed forms and the metric itself."""

from __future__ import annotations

import math

import pytest
import torch
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import SceneCaptumError, VanillaSceneGradient, metrics
from scenecaptum.estimation import TargetedMetric


def ordinary(height: int = 12, width: int = 16) -> torch.Tensor:
    generator = torch.Generator().manual_seed(shifted(3))
    return torch.rand(height, width, 3, generator=generator, dtype=torch.float64) * 0.8 + 0.1


def squares(image: torch.Tensor) -> torch.Tensor:
    return image.square().mean()


def gradient(metric: torch.nn.Module, image: torch.Tensor) -> torch.Tensor:
    leaf = image.clone().requires_grad_()
    (found,) = torch.autograd.grad(metric(leaf), leaf)
    return found


def test_a_linear_metric_keeps_its_value_and_gradient_within_the_draws():
    image = ordinary()
    n, sigma = 4096, 0.2
    smoothed = metrics.Smoothed(torch.mean, sigma, n=n, seed=shifted())
    # The mean over pixels of one factor each: its variance is that of the factors, weighted by the radiance.
    spread = math.sqrt(math.expm1(sigma**2) * image.mean(-1).square().sum().item()) / image[..., 0].numel()
    assert abs(smoothed(image).item() - image.mean().item()) < 4 * spread / math.sqrt(n)


def test_the_expectation_of_squares_has_a_closed_form():
    image, sigma, n = ordinary(), 0.3, 4096
    value = metrics.Smoothed(squares, sigma, n=n, seed=shifted(1))(image).item()
    exact = squares(image).item() * math.exp(sigma**2)
    variance = math.exp(6 * sigma**2) - math.exp(2 * sigma**2)  # of the square of a factor
    per_pixel = image.square().mean(-1).square().sum().item() / image[..., 0].numel() ** 2
    assert abs(value - exact) < 4 * math.sqrt(variance * per_pixel / n)


def test_gaussian_noise_of_the_picture_has_its_strength():
    gray = torch.full((32, 32, 3), 0.2140, dtype=torch.float64)  # 0.5 in sRGB

    def encoded_variance(image: torch.Tensor) -> torch.Tensor:
        from kornia.color import linear_rgb_to_rgb

        return (linear_rgb_to_rgb(image.movedim(-1, 0)) - 0.5).square().mean()

    n = 64
    value = metrics.Smoothed(encoded_variance, 0.05, n=n, noise="gaussian", seed=shifted())(gray).item()
    # Pairs have the same squares: half of the draws count.
    assert abs(value / 0.05**2 - 1) < 4 * math.sqrt(2 / (gray.numel() * n / 2)) + 1e-3


def test_lognormal_noise_keeps_black_pixels_and_colours():
    image = ordinary()
    image[0, 0] = 0.0
    ratios = []
    metrics.Smoothed(lambda noisy: ratios.append(noisy) or noisy.mean(), n=2)(image)
    for noisy in ratios:
        assert (noisy[0, 0] == 0).all()
        torch.testing.assert_close(
            noisy[1] / noisy[1].mean(-1, keepdim=True), image[1] / image[1].mean(-1, keepdim=True)
        )


def test_draws_are_antithetic_and_the_same_for_all_images():
    seen: list[torch.Tensor] = []
    metric = metrics.Smoothed(lambda noisy: seen.append(noisy) or noisy.mean(), 0.3, n=4, seed=shifted(2))
    first, second = ordinary(), 2 * ordinary()
    metric(first)
    metric(second)
    for a, b in zip(seen[:4], seen[4:], strict=True):
        torch.testing.assert_close(2 * a, b)
    product = seen[0] * seen[2] / first.square()
    torch.testing.assert_close(product, torch.full_like(product, math.exp(-(0.3**2))))


def test_batches_of_draws_give_the_mean_of_all():
    image = ordinary()
    whole = metrics.Smoothed(squares, n=40, seed=shifted(4))
    pairs = [whole.with_draws({shifted(4): 40}), whole.with_draws({shifted(4): 16, shifted(5): 24})]
    torch.testing.assert_close(pairs[0](image), whole(image))
    parts = [whole.with_draws({shifted(4): 16}), whole.with_draws({shifted(5): 24})]
    expected = (16 * parts[0](image) + 24 * parts[1](image)) / 40
    torch.testing.assert_close(pairs[1](image), expected)
    torch.testing.assert_close(
        gradient(pairs[1], image), (16 * gradient(parts[0], image) + 24 * gradient(parts[1], image)) / 40
    )


def test_the_gradient_is_that_of_the_value():
    metric = metrics.Smoothed(squares, 0.3, n=24, seed=shifted())
    assert torch.autograd.gradcheck(metric, ordinary(3, 4).requires_grad_())


@pytest.mark.parametrize("target", [None, "cube"])
def test_a_smoothed_logit_is_the_smoothed_metric(target):
    network = metrics.ShapeClassifier.pretrained()
    image = ordinary(48, 64).float()
    plain = metrics.ClassLogit(network, target)
    smoothed = metrics.ClassLogit(network, target, smoothing=0.3)
    torch.testing.assert_close(smoothed(image), metrics.Smoothed(plain, 0.3)(image))
    loop = metrics.Smoothed(plain.forward, 0.3)  # without batches
    torch.testing.assert_close(smoothed(image), loop(image), rtol=1e-4, atol=1e-5)
    assert smoothed.n_draws == metrics.Smoothed(plain).n_draws
    assert plain.n_draws == 0


def test_a_smoothed_function_has_the_name_of_the_function():
    found = VanillaSceneGradient(ToyRenderer(), metrics.Smoothed(squares, n=2)).attribute()
    assert str(found).startswith("smoothed squares = ")
    of_channels = metrics.Smoothed(lambda image: image.mean((0, 1)), n=2)
    assert TargetedMetric(of_channels, 1).name == "smoothed <lambda>[1]"
    assert metrics.Smoothed.__name__ == "Smoothed"


def test_elements_of_a_smoothed_metric_have_the_names_of_its_classes():
    logits = metrics.ClassLogit(metrics.ShapeClassifier.pretrained())
    smoothed = metrics.Smoothed(logits, 0.3, n=2)
    assert smoothed.target_index("cube") == 1
    assert TargetedMetric(smoothed, "cube").name == "smoothed ClassLogit[cube]"
    assert TargetedMetric(logits, 1).name == "ClassLogit[cube]"
    assert TargetedMetric(smoothed, "cube").label == "smoothed logit of cube"
    with pytest.raises(SceneCaptumError, match="a value for each of 3 classes"):
        TargetedMetric(smoothed).value_of(smoothed(ordinary().float()))
    with pytest.raises(SceneCaptumError, match="The elements of function have no names, such as 'cube'"):
        metrics.Smoothed(squares).target_index("cube")


def test_without_noise_the_expectation_is_the_metric():
    image = ordinary(48, 64).float()
    plain = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube")
    torch.testing.assert_close(
        metrics.ClassLogit(plain.model, "cube", smoothing=1e-6)(image), plain(image), rtol=1e-4, atol=1e-4
    )


def test_names_and_verdicts_say_what_smoothing_changes():
    image = ordinary(48, 64).float()
    metric = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube", smoothing=0.5)
    assert metric.measure.name == "smoothed logit of cube"
    value = metrics.ClassLogit(metric.model, "cube")(image).item()
    text = metric.verdict(image)
    said = f"{value:.2g} without smoothing, on one noisy render; probability"
    assert text.startswith(said.replace("-", "−"))
    of_all = metrics.Smoothed(metrics.ClassLogit(metric.model), 0.5)
    assert of_all.measure_of(1).name == "smoothed logit of cube"
    assert of_all.verdict(image, 1) == text
    assert metrics.Smoothed(metrics.MeanLuminance()).measure.unit == "cd/m²"
    assert metrics.Smoothed(squares).measure is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sigma": 0.0}, "sigma must be a positive number"),
        ({"sigma": True}, "sigma must be a positive number"),
        ({"n": 3}, "n must be even"),
        ({"n": 0}, "n must be a whole number of at least 2"),
        ({"noise": "uniform"}, "'lognormal' or 'gaussian'"),
        ({"seed": -1}, "seed must be"),
    ],
)
def test_bad_settings_are_named(options, message):
    with pytest.raises(SceneCaptumError, match=message):
        metrics.Smoothed(squares, **options)


def test_smoothing_twice_or_nothing_is_an_error():
    with pytest.raises(SceneCaptumError, match="smoothed already"):
        metrics.Smoothed(metrics.Smoothed(squares))
    with pytest.raises(SceneCaptumError, match="must be callable"):
        metrics.Smoothed(0.3)
    with pytest.raises(SceneCaptumError, match=r"\(H, W, 3\)"):
        metrics.Smoothed(squares)(torch.rand(4, 4))
