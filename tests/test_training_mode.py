"""Networks in training mode that functions refer to are named; the library's own metrics and losses are not."""

from __future__ import annotations

import functools
import math
import types
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from toy import ToyRenderer

from scenecaptum import FeatureAblationScene, VanillaSceneGradient, metrics, training_mode

IMAGE = torch.rand(16, 20, 3)
NETWORK = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4), torch.nn.Flatten())
BY_SIZE = {"small": {"first": NETWORK}}


class Scorer:
    """An object with a network, to be called or with a method to be passed."""

    def __init__(self, network: torch.nn.Module) -> None:
        self.network = network

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return self.score(x)

    def score(self, x: torch.Tensor) -> torch.Tensor:
        return self.network(x)


def with_global(x: torch.Tensor) -> torch.Tensor:
    return NETWORK(x)


def through_another_function(x: torch.Tensor) -> torch.Tensor:
    return torch.stack([with_global(one) for one in x[None]])


def with_argument(network: torch.nn.Module, x: torch.Tensor) -> torch.Tensor:
    return network(x)


def with_nested_global(x: torch.Tensor) -> torch.Tensor:
    return BY_SIZE["small"]["first"](x)


class Settings:
    """An object that cannot be called, with a network in a container."""

    def __init__(self, network: torch.nn.Module) -> None:
        self.networks = {"x": [network]}
        self.itself = self


SETTINGS = Settings(NETWORK)


def with_settings(x: torch.Tensor) -> torch.Tensor:
    return SETTINGS.networks["x"][0](x)


def functions(net: torch.nn.Module) -> dict[str, Callable[..., Any]]:
    """Return functions that call a network, by the expression that the warning has for it."""

    def inner(x: torch.Tensor) -> torch.Tensor:
        return net(x)

    listed, weighted, settings = [net], [(1.0, 2.0), (0.5, net)], types.SimpleNamespace(net=net)
    partial = functools.partial(with_argument, [net])
    return {
        "net": inner,
        "net ": lambda x: 2 * inner(x),
        "NETWORK": with_global,
        "NETWORK ": through_another_function,
        "network ": functools.partial(with_argument, net),
        "partial.func": functools.partial(net),
        "partial.args[0]": functools.partial(math.hypot, net),
        "network[0]": lambda image: 2 * partial(image),
        "network": functools.partial(with_argument, network=net),
        "self.network": Scorer(net),
        "self.network ": Scorer(net).score,
        "self": net.forward,
        "default": lambda image, default=net: default(image),
        "keyword": lambda image, *, keyword=net: keyword(image),
        "listed[0]": lambda image: 2 * listed[0](image),
        "weighted[1][1]": lambda image: sum(weight * one(image) for weight, one in weighted),
        "BY_SIZE['small']['first']": with_nested_global,
        "settings.net": lambda image: 2 * settings.net(image),
        "SETTINGS.networks['x'][0]": with_settings,
        "an element of chosen": lambda image, chosen=frozenset([net]): [one(image) for one in chosen],
    }


def said(call: Callable[[], Any]) -> list[str]:
    """Return the warnings of a call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [str(one.message) for one in caught]


@pytest.fixture(autouse=True)
def in_training_mode():
    NETWORK.train()
    yield
    NETWORK.train()


@pytest.mark.parametrize("place", functions(NETWORK))
@pytest.mark.parametrize("make", [metrics.ClassLogit, lambda f: VanillaSceneGradient(ToyRenderer(), f)])
def test_a_network_in_training_mode_is_named_until_it_is_not(place, make):
    function = functions(NETWORK)[place]
    (warning,) = said(lambda: make(function))
    assert f"refers to {place.strip()} (Sequential), which is in training mode" in warning
    assert f"Call .eval() on {place.strip()} first." in warning
    NETWORK.eval()
    assert said(lambda: make(function)) == []


def test_a_metric_that_is_a_network_in_training_mode_is_named():
    (warning,) = said(lambda: FeatureAblationScene(ToyRenderer(), NETWORK))
    assert "Sequential is in training mode" in warning


@pytest.mark.parametrize("wrap", [metrics.Smoothed, metrics.PerCamera])
def test_metrics_of_metrics_look_into_functions(wrap):
    (warning,) = said(lambda: wrap(with_global))
    assert "with_global refers to NETWORK" in warning


def test_numbers_that_a_function_refers_to_are_not_searched_one_by_one(monkeypatch):
    numbers = [list(range(1000)) for _ in range(100)]

    def metric(image: torch.Tensor) -> torch.Tensor:
        return numbers[0][1] * image.mean()

    searched = []
    references = training_mode._references
    monkeypatch.setattr(training_mode, "_references", lambda *one: searched.append(one) or references(*one))
    assert said(lambda: metrics.Smoothed(metric)) == []
    assert 100 < len(searched) < 200, "the function, what is beside it, and the lists"


def test_what_trains_nothing_is_not_named():
    loss, logit = torch.nn.MSELoss(), metrics.ClassLogit(NETWORK, 0)

    class Wrapped(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.logit, self.frozen = logit, torch.nn.Conv2d(3, 4, 3).eval()

    wrapped = Wrapped()

    def metric(image: torch.Tensor) -> torch.Tensor:
        return loss(image, IMAGE) + logit(image) + wrapped(image)

    assert said(lambda: VanillaSceneGradient(ToyRenderer(), metric)) == []
    assert said(lambda: VanillaSceneGradient(ToyRenderer(), logit)) == []


class OwnDropout(torch.nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.dropout(x, training=self.training)


class OwnStatistics(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(3))

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        if getattr(self, "training", False):
            self.mean.lerp_(x.mean(), 0.1)


class OwnNorm(torch.nn.BatchNorm2d):
    """Adds nothing."""


class Weighted(torch.nn.Module):
    """Has a buffer and a parameter, and is the same in both modes."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("weight", torch.ones(3))
        self.gain = torch.nn.Parameter(torch.ones(3))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.weight * self.gain * x


@pytest.mark.parametrize(
    ("layer", "acts_otherwise"),
    [
        (torch.nn.GELU(), False),
        (torch.nn.LayerNorm(3), False),
        (torch.nn.RReLU(), True),
        (torch.nn.Dropout(0.1), True),
        (torch.nn.Dropout(0.0), False),
        (torch.nn.BatchNorm2d(3, affine=False), True),
        (torch.nn.BatchNorm2d(3, track_running_stats=False), False),
        (torch.nn.InstanceNorm2d(3, affine=True), False),
        (torch.nn.InstanceNorm2d(3, track_running_stats=True), True),
        (torch.nn.GRU(3, 3, num_layers=2), False),
        (torch.nn.GRU(3, 3, num_layers=2, dropout=0.1), True),
        (torch.nn.MultiheadAttention(4, 2), False),
        (torch.nn.MultiheadAttention(4, 2, dropout=0.1), True),
        (torch.nn.TransformerEncoderLayer(4, 2, dropout=0.1), True),
        (torch.nn.TransformerEncoderLayer(4, 2, dropout=0.0), False),
        (torch.nn.utils.spectral_norm(torch.nn.Linear(3, 3)), True),
        (torch.nn.utils.parametrizations.spectral_norm(torch.nn.Linear(3, 3)), True),
        (OwnDropout(), True),
        (OwnStatistics(), True),
        (OwnNorm(3), True),
        (Weighted(), False),
        (torch.nn.utils.spectral_norm(Weighted(), "gain", dim=0), True),
    ],
    ids=lambda value: type(value).__name__,
)
def test_only_layers_that_act_otherwise_in_training_mode_are_named(layer, acts_otherwise):
    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.last, self.layer = torch.nn.Conv2d(3, 4, 3), torch.nn.Linear(4, 2), layer

    network = Network()
    function = functions(network)["net"]
    assert len(said(lambda: metrics.ClassLogit(function))) == acts_otherwise
    network.eval()
    assert said(lambda: metrics.ClassLogit(function)) == []


def test_the_warning_is_on_the_line_of_the_caller():
    with pytest.warns(UserWarning, match="training mode") as caught:
        metrics.ClassLogit(with_global)
    assert caught[0].filename == __file__


def test_the_advised_module_runs_in_evaluation_mode():
    class Logits(torch.nn.Module):
        def __init__(self, model: torch.nn.Module) -> None:
            super().__init__()
            self.model = model

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return {"out": self.model(x)}["out"]

    before = NETWORK[1].running_mean.clone()
    metrics.ClassLogit(Logits(NETWORK), 0, lambda x: x)(IMAGE)
    assert torch.equal(NETWORK[1].running_mean, before)
