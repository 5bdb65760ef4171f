"""The randomization check distinguishes attributions that depend on a network's weights from those that do not."""

from __future__ import annotations

import copy

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import InputXGradientScene, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.ranks import mean_ranks
from scenecaptum.validation import RandomizationCheck, randomization_check
from scenecaptum.validation._randomization import _reset


class Lamps(ToyRenderer):
    """Twelve lamps, each of which lights separate pixels."""

    def __init__(self, noise: float = 0.1) -> None:
        super().__init__(noise)
        self.matrix = torch.rand(4, 4, 3, 12, generator=torch.Generator().manual_seed(shifted(2))) ** 4
        self.inputs = {f"lamp {k}": torch.tensor(0.1) for k in range(12)}

    def __call__(self, inputs, *, seed, spp):
        return self.sampled(seed, spp) @ torch.stack(list(inputs.values()))


class Network(torch.nn.Module):
    """A linear layer on all pixels, and a scale that has no ``reset_parameters``."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(shifted(1))
            self.first = torch.nn.Linear(48, 8)
            self.last = torch.nn.Linear(8, 1)
        self.scale = torch.nn.Parameter(torch.tensor([1.0, 2.0]))

    def forward(self, image):
        return self.scale.abs().sum() * self.last(self.first(image.flatten()).tanh()).squeeze()


class Deaf(Network):
    """A network whose output ignores its weights."""

    def forward(self, image):
        return (image * torch.linspace(0.1, 2, 48).reshape(image.shape)).sum() + 0 * self.scale.sum()


def test_a_trained_network_differs_from_random_ones():
    check = randomization_check(Lamps(), Network())
    assert check.ranking_changes, str(check)
    assert check.signs_change, str(check)
    assert check.verdict.startswith("the attribution depends on the learnt weights"), str(check)
    assert check.magnitudes[0].min() > 0.9
    assert check.magnitudes[-1].mean() < 0.7
    assert "the attribution depends on the learnt weights, in its ranking and its signs" in check.verdict


def test_a_metric_that_ignores_its_weights_is_detected():
    checks = [randomization_check(Lamps(noise=1.0), Deaf(), stages=1, seed=seed) for seed in seeds(4)]
    # Each has a probability of 1 in 70 by chance.
    assert sum(check.ranking_changes + check.signs_change for check in checks) <= 2
    for check in checks:
        own, random = check.magnitudes
        assert abs(own.mean() - random.mean()) < allowed(8) * own.std(), str(check)
    assert any("shows no dependence" in check.verdict for check in checks)


def test_signs_may_differ_where_magnitudes_do_not():
    class Either(Deaf):
        """A network whose last layer only determines the sign."""

        def forward(self, image):
            return super().forward(image) * self.last.bias.sign().squeeze()

    check = randomization_check(Lamps(), Either(), stages=1, draws=6)
    assert set(check.signed[1].sign().tolist()) == {1.0, -1.0}, "draw more"
    assert check.magnitudes.min() > 0.9


def test_noise_is_not_counted_as_change():
    check = randomization_check(Lamps(noise=100.0), Deaf(), seed=shifted(1))
    assert check.magnitudes[0].mean() < 0.9, "there is too little noise for this test"
    assert not check.ranking_changes
    assert not check.signs_change


class OnlyLast(Network):
    """A network whose first layer does not matter."""

    def forward(self, image):
        return self.last(image.reshape(8, 6).sum(1)).squeeze() + 0 * self.scale.sum()


class OnlyFirst(Network):
    """A network with a fixed readout."""

    def forward(self, image):
        return self.first(image.flatten()).tanh().sum() + 0 * self.scale.sum()


@pytest.mark.parametrize(("network", "layer"), [(OnlyLast, "last"), (OnlyFirst, "first"), (Deaf, None)])
def test_the_first_layer_that_matters_is_named(network, layer):
    check = randomization_check(Lamps(), network(), stages=None, draws=6)
    assert check.randomized == (0, 1, 2, 3)
    assert check.first_change == layer, str(check)
    assert not check.too_noisy
    expected = (
        f"once the layers back to {layer} are randomized: with"
        if layer
        else "shows no dependence on the learnt weights: with"
    )
    assert expected in check.verdict


def test_a_change_must_last_and_must_not_be_noise():
    own, same, other = 2 * [0.9, 0.95], 2 * [0.92, 0.91], 2 * [0.1, 0.2]

    def check(*rows, signed=None):
        magnitudes = torch.tensor([own, *rows])
        signed = torch.tensor([own] * len(magnitudes)) if signed is None else torch.tensor(signed)
        layers = ("c", "b", "a")
        return RandomizationCheck(layers, (0, 1, 2, 3), magnitudes, signed, metric="M", method="V")

    assert check(other, same, other).first_change == "a"
    assert check(other, other, other).first_change == "c"
    assert check(other, other, same).first_change is None
    assert check(same, same, other, signed=[own, same, other, other]).first_change == "b"
    noisy = [2 * [0.6, 0.7], other, other, other]
    unclear = check(same, same, same, signed=noisy)
    assert unclear.signs_change
    assert unclear.first_change is None, "noise is no evidence"
    assert unclear.verdict.startswith("too noisy to tell: use smoothing= or more samples")
    assert "in its ranking, once the layers back to b are" in check(same, other, other, signed=noisy).verdict


def test_layers_are_randomized_from_the_output_on():
    seen = []

    class Watching(Network):
        def forward(self, image):
            state = {name: tuple(value.flatten().tolist()) for name, value in self.named_parameters()}
            if state not in seen:
                seen.append(state)
            return super().forward(image)

    check = randomization_check(Lamps(), Watching(), draws=2)
    assert check.layers == ("last", "first", "")
    assert check.randomized == (0, 1, 2, 3)
    own, *stages = seen
    changed = [{name for name in own if stage[name] != own[name]} for stage in stages]
    last, first = {"last.weight", "last.bias"}, {"first.weight", "first.bias"}
    assert changed == [last, last | first, last | first | {"scale"}] * 2
    assert all(stages[0][name] == stages[2][name] for name in last), "randomized layers stay as they are"
    assert stages[0]["last.weight"] != stages[3]["last.weight"], "draws differ"


def test_the_metric_and_the_generator_are_not_changed():
    network = Network()
    before, torch_state = copy.deepcopy(network.state_dict()), torch.get_rng_state()
    first, second = (randomization_check(Lamps(), network, draws=2, seed=shifted(3)) for _ in range(2))
    torch.testing.assert_close(network.state_dict(), before, rtol=0, atol=0)
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert torch.equal(first.signed, second.signed)


def test_weights_without_a_reset_keep_their_scale():
    layer = torch.nn.Module()
    layer.weights = torch.nn.Parameter(3 + 0.5 * torch.randn(4000))
    _reset(layer, 0)
    assert layer.weights.mean().item() == pytest.approx(3, abs=0.05)
    assert layer.weights.std().item() == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("affine", [True, False])
def test_statistics_of_batch_normalization_are_reset_with_its_weights(affine):
    class Normalized(Network):
        def __init__(self):
            super().__init__()
            self.norm = torch.nn.BatchNorm1d(8, affine=affine)
            self.norm.running_mean += 5
            self.norm.running_var *= 100

        def forward(self, image):
            hidden = self.first(image.flatten())[None]
            mean, variance = self.norm.running_mean, self.norm.running_var
            statistics.append((mean.mean().item(), variance.mean().item()))
            return self.last(self.norm.eval()(hidden).tanh()).squeeze() + 0 * self.scale.sum()

    statistics = []
    check = randomization_check(Lamps(), Normalized(), stages=1, draws=2)
    assert check.layers == ("norm", "last", "first", "")
    assert set(statistics) == {(5.0, 100.0), (0.0, 1.0)}


def test_ranks_of_ties_are_their_mean():
    assert mean_ranks(torch.tensor([3.0, 1.0, 3.0, 2.0])).tolist() == [3.5, 1.0, 3.5, 2.0]


def test_other_methods_can_be_checked():
    check = randomization_check(Lamps(), Network(), method=InputXGradientScene, stages=1, draws=2)
    assert check.method == "InputXGradientScene"
    assert check.magnitudes.shape == check.signed.shape == (2, 2)


def test_invalid_input_is_refused():
    class Few(Lamps):
        def __init__(self):
            super().__init__()
            self.inputs = {name: self.inputs[name] for name in ("lamp 0", "lamp 1", "lamp 2")}
            self.matrix = self.matrix[..., :3]

    with pytest.raises(SceneCaptumError, match=r"mean has none\. Pass a torch\.nn\.Module"):
        randomization_check(Lamps(), torch.mean)
    with pytest.raises(SceneCaptumError, match="MeanLuminance has none"):
        randomization_check(Lamps(), metrics.MeanLuminance())
    with pytest.raises(SceneCaptumError, match="at least 4 parameters, not 3"):
        randomization_check(Few(), Network())
    with pytest.raises(SceneCaptumError, match="draws must be a whole number of at least 2"):
        randomization_check(Lamps(), Network(), draws=1)


def test_table_and_figure():
    check = randomization_check(Lamps(), Network(), draws=2)
    lines = str(check).splitlines()
    assert "Network, VanillaSceneGradient" in lines[0]
    assert lines[3].split()[:4] == ["0", "of", "3", "none"]
    assert lines[4].split()[:4] == ["1", "of", "3", "last"]
    assert check.verdict.startswith("2 draws of random weights cannot tell: use 4 or more")
    (axes,) = check.plot().axes
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["0", "1", "2", "3"]


def test_correlations_have_minus_signs_and_no_negative_zero():
    check = RandomizationCheck(
        layers=("last",),
        randomized=(0, 1),
        magnitudes=torch.tensor([[1.0, 0.9], [-0.001, 0.0]]),
        signed=torch.tensor([[1.0, 0.9], [-0.02, -0.4]]),
        metric="logit",
        method="VanillaSceneGradient",
    )
    assert "0.00 (0.00 to 0.00)" in str(check)
    assert "−0.21 (−0.40 to −0.02)" in check.verdict
    assert "-0" not in str(check)
    assert "−0.00" not in str(check)


def test_on_the_shape_classifier(mi, cornell):
    logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), target="cube")
    metric = metrics.Smoothed(logit, 0.3, n=16)
    check = randomization_check(cornell, metric, stages=1, draws=4, spp=64, replicates=4)
    assert len(check.layers) == 9
    assert check.layers[0] == "metric.model.head"
    assert check.signs_change, str(check)
    assert check.verdict.startswith("the attribution depends on the learnt weights"), str(check)
