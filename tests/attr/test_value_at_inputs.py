"""Methods with gradients at other points render the inputs with as many samples as all of these points."""

import math

import pytest
import torch
from chance import allowed
from seeds import seeds
from toy import ToyRenderer

from scenecaptum import GradientShapScene, IntegratedGradientsScene, SmoothGradScene

METHODS = {
    IntegratedGradientsScene: {"n_steps": 2, "denoise": False},
    SmoothGradScene: {"nt_samples": 4, "stdevs": 0.1, "denoise": False},
    GradientShapScene: {"n_samples": 4, "stdevs": 0.0, "denoise": False},
}


class Bounded(ToyRenderer):
    def __init__(self, noise=0.3):
        super().__init__(noise)
        self.bounds = {"x": (0.0, 1.0)}


class Wave(torch.nn.Module):
    """A metric that noise pulls towards 0, far beyond what is known to first order; like a network's logit."""

    tolerated_noise = 0.04

    def forward(self, image):
        return (3 * image).sin().mean()


@pytest.mark.parametrize("method", METHODS)
def test_more_samples_of_the_pictures_correct_the_value(method):
    renderer = Bounded(noise=1.0)
    truth = Wave()(renderer.exact(renderer.inputs)).item()
    replicates, tried = 8, seeds(4)
    for seed in tried:
        found = method(renderer, Wave()).attribute(
            seed=seed, spp=128, picture_spp=4096, replicates=replicates, **METHODS[method]
        )
        z = (found.metric_value - truth) / found.metric_standard_error
        assert found.metric_standard_error < 0.1
        assert abs(z) < allowed(replicates, len(tried))
        assert found.info["picture"]["caution"] is None


@pytest.mark.parametrize("method", METHODS)
def test_a_noisy_picture_of_the_inputs_is_cautioned_against(method):
    found = method(Bounded(noise=0.5), Wave()).attribute(spp=16, seed=seeds(1)[0], **METHODS[method])
    assert "more than 4 % biases it" in found.info["picture"]["caution"]


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_metric_takes_an_eighth_of_the_samples(method):
    rendered = []

    class Counting(Bounded):
        def __call__(self, inputs, *, seed, spp):
            rendered.append(spp)
            return super().__call__(inputs, seed=seed, spp=spp)

    method(Counting(), torch.mean).attribute(spp=128, replicates=8, seed=seeds(1)[0], **METHODS[method])
    ends = rendered[-8:]
    assert ends == [math.ceil(128 / 8 / 8)] * 8
