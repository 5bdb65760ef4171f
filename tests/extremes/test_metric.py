"""Metrics at the extremes: constant, discontinuous, huge, NaN, random, keeping memory, on other devices."""

from __future__ import annotations

import hypothesis
import numpy as np
import pytest
import torch
from chance import allowed
from hypothesis import given, settings
from hypothesis import strategies as st
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import FeatureAblationScene, SceneCaptumError, SceneRenderer, VanillaSceneGradient

from .scenes import mean, room, total

BALL = "ball.bsdf.reflectance.value"


@pytest.fixture(scope="module")
def renderer(mi):
    return SceneRenderer(room(mi), inputs="all")


@pytest.fixture(scope="module")
def plain(renderer):
    return VanillaSceneGradient(renderer, mean).attribute(seed=shifted())


def by(renderer, metric, **options):
    return VanillaSceneGradient(renderer, metric).attribute(**{"seed": shifted(), **options})


def test_constant_in_effect(renderer):
    """A constant that is computed from the image has a derivative, which is 0."""
    found = by(renderer, lambda image: 0 * image.sum() + 3)
    assert found.metric_value == 3
    assert set(found.saliency().values()) == {0.0}


@pytest.mark.parametrize(
    "metric",
    [
        lambda image: torch.tensor(3.0, requires_grad=True),
        lambda image: (image > 0.1).sum(),
        lambda image: (image > 0.1).float().mean(),
        lambda image: image.mean().round().long(),
        lambda image: image.detach().mean(),
    ],
    ids=["constant", "integer", "discontinuous", "rounded", "detached"],
)
def test_metrics_without_a_derivative_are_refused(renderer, metric):
    with pytest.raises(SceneCaptumError, match="does not depend on the image through differentiable"):
        by(renderer, metric)


def test_jump_beside_the_image(renderer, plain):
    """On either side of a jump the derivative is that of the side; only ablation measures the jump."""
    found = by(renderer, lambda image: image.mean() * (image.mean() > 1e-3))
    torch.testing.assert_close(found[BALL], plain[BALL], rtol=1e-4, atol=0)

    def lit(image):
        return (image.mean() > 0.015).float() + 0 * image.sum()

    lamp = "lamp.emitter.radiance.value"
    ablated = FeatureAblationScene(renderer, lit).attribute(
        seed=shifted(), spp=64, baselines={lamp: torch.zeros(3)}, groups={"lamp": lamp}
    )
    assert by(renderer, lit).saliency()[lamp] == 0
    assert ablated["lamp"].item() == 1


@hypothesis.seed(shifted())
@settings(max_examples=4, deadline=None, database=None)
@given(exponent=st.integers(-30, 36))
def test_huge_and_tiny(renderer, plain, exponent):
    """A metric times 10ⁿ has gradients, errors and saliencies times 10ⁿ."""
    factor = 10.0**exponent
    found = by(renderer, lambda image: image.mean() * factor)
    assert found.metric_value == pytest.approx(plain.metric_value * factor, rel=1e-5)
    for ours, theirs in (
        (found.saliency(), plain.saliency()),
        (found.saliency_error(), plain.saliency_error()),
    ):
        assert ours[BALL] == pytest.approx(theirs[BALL] * factor, rel=5e-3)


def test_beyond_single_precision(renderer):
    with pytest.raises(SceneCaptumError, match="is inf on the rendered image, which is finite"):
        by(renderer, lambda image: (1e30 * image).square().mean())


def test_not_a_number_on_a_few_pixels(renderer):
    """Refused, with the place; if a metric skips these pixels, its derivative is checked too."""

    def spoilt(image):
        holes = torch.zeros_like(image)
        holes[2:4, 5] = torch.nan
        return (image + holes).sqrt().mean()

    def skipped(image):
        roots = (image - (torch.arange(8)[:, None, None] == 3).float()).sqrt()
        return roots.nansum()

    with pytest.raises(SceneCaptumError, match=r"spoilt is nan on the rendered image.*row"):
        by(renderer, spoilt)
    with pytest.raises(
        SceneCaptumError, match=r"skipped has a derivative .* on \d+ of 64 pixels: rows? \d.*channels 0 to 2"
    ):
        by(renderer, skipped)


def test_not_a_number_in_one_replicate_is_located():
    """For any renderer, the error names the replicate, its seed and the pixels."""

    class Spoilt(ToyRenderer):
        def __call__(self, inputs, *, seed, spp):
            image = super().__call__(inputs, seed=seed, spp=spp)
            image = image.clone()
            if seed % 8 == 5:
                image[1:3, 2, 0] = torch.inf
            return image

    with pytest.raises(
        SceneCaptumError,
        match=r"In replicate \d+ of \d+: The render with seed \d+ is inf on 2 of 16 pixels: rows 1 to 2, column 2",
    ):
        by(Spoilt(), mean, spp=64, replicates=64)
    with pytest.raises(
        SceneCaptumError, match=r"On the unchanged scene: In replicate \d+ of 64: .* rows 1 to 2"
    ):
        FeatureAblationScene(Spoilt(), mean).attribute(
            baselines={"x": torch.zeros(3)}, seed=shifted(), spp=128, replicates=64
        )


def test_gradient_that_is_not_a_number_is_named():
    """The parameter and the texel."""

    class Root(ToyRenderer):
        def __init__(self):
            super().__init__()
            self.inputs = {"x": torch.ones(3), "texture": torch.ones(4, 4, 3)}
            self.inputs["texture"][3, 1, 2] = 0

        def __call__(self, inputs, *, seed, spp):
            return super().__call__(inputs, seed=seed, spp=spp) + inputs["texture"].sqrt()

    with pytest.raises(
        SceneCaptumError,
        match=r"In backward pass 1 of 8: The gradient of 'texture' is inf at row 3, column 1, channel 2",
    ):
        by(Root(), mean)


def test_plain_torch_code_gets_the_same_errors(renderer):
    x = renderer.leaves()
    loss = renderer(x, seed=shifted(4)).log().mean()
    with pytest.raises(
        SceneCaptumError,
        match=rf"derivative with respect to the render with seed {shifted(4)} is inf on \d+ of 64 pixels",
    ):
        loss.backward()


def test_metric_that_keeps_its_graph(renderer, plain):
    """Later results do not change."""
    kept = []

    def greedy(image):
        kept.append((image, image.mean()))
        return kept[-1][1]

    for _ in range(2):
        torch.testing.assert_close(by(renderer, greedy)[BALL], plain[BALL], rtol=1e-4, atol=0)
    assert len(kept) >= 16

    first = []

    def stale(image):
        first.append(image.mean())
        return first[0]

    with pytest.raises(SceneCaptumError, match="does not depend on the image"):
        by(renderer, stale)


def test_metric_that_changes_its_image(renderer):
    def doubled(image):
        with torch.no_grad():
            image.mul_(2)
        return image.mean()

    def scaled(image):
        image *= 2
        return image.mean()

    for metric in (doubled, scaled):
        with pytest.raises(SceneCaptumError, match="modifies its input image in place"):
            by(renderer, metric)
        with pytest.raises(SceneCaptumError, match="modifies its input image in place"):
            FeatureAblationScene(renderer, metric).attribute(seed=shifted())


def test_random_metric(renderer, plain):
    """Its noise is part of the errors: additive noise of the value's, multiplicative noise of the gradient's."""
    torch.manual_seed(shifted())
    added = by(renderer, lambda image: image.mean() + torch.randn(()))
    assert 0.5 < added.metric_standard_error < 10
    torch.testing.assert_close(added[BALL], plain[BALL], rtol=1e-4, atol=0)
    scores = []
    for seed in seeds(8):
        found = by(renderer, lambda image: (image * 2 * torch.rand(image.shape)).mean(), seed=seed)
        value, error = total(found, BALL)
        scores.append((value - total(plain, BALL)[0]) / error)
    assert max(map(abs, scores)) < allowed(8, 8)


def test_other_devices(renderer, plain):
    with pytest.raises(SceneCaptumError, match="must return a real number; it returned one on the meta"):
        by(renderer, lambda image: image.to("meta").mean())
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device: a metric that computes there is not tried")
    found = by(renderer, lambda image: image.cuda().mean())
    torch.testing.assert_close(found[BALL], plain[BALL], rtol=1e-4, atol=0)


def test_other_number_types(renderer, plain):
    found = by(renderer, lambda image: image.double().mean())
    torch.testing.assert_close(found[BALL], plain[BALL], rtol=1e-4, atol=0)
    with pytest.raises(SceneCaptumError, match="must return a real number; it returned one complex"):
        by(renderer, lambda image: torch.complex(image, image).mean())


@pytest.mark.parametrize(
    "layer",
    [
        torch.nn.Linear(3, 2).double(),
        torch.nn.Sequential(torch.nn.LayerNorm(3)).half(),
        lambda image: image.reshape(-1) @ torch.ones(image.numel(), dtype=torch.float64),
        lambda image: torch.nn.functional.conv2d(image.movedim(-1, 0)[None], torch.ones(1, 3, 1, 1).double()),
    ],
    ids=["matrix", "normalization", "product", "convolution"],
)
def test_a_network_of_another_precision_is_named(renderer, layer):
    with pytest.raises(
        SceneCaptumError, match=r"mixes numbers of different precision; the image is torch\.float32"
    ):
        by(renderer, lambda image: layer(image).mean())


@pytest.mark.parametrize(
    "metric",
    [lambda image: torch.tensor(image.numpy()).mean(), np.mean, np.log],
    ids=["numpy()", "mean", "logarithm"],
)
def test_a_metric_in_numpy_is_refused(renderer, metric):
    with pytest.raises(SceneCaptumError, match="leaves torch for NumPy, which has no derivatives"):
        by(renderer, metric)
