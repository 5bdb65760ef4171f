"""The error estimates of quadrature rules, against closed forms and with noisy integrands."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
import torch
from seeds import shifted

from scenecaptum.estimation import Method, quadrature

METHODS = get_args(Method)
STEPS = (2, 3, 4, 5, 8, 12, 16, 32, 64)


def from_black(light: float) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Return the derivative of ``log(light·α + 0.01)``, and its integral."""
    return lambda at: light / (light * at + 0.01), math.log1p(light / 0.01)


def bounces(albedo: float) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Return the derivative of ``1/(1 − albedo·α)``, light after any number of bounces, and its integral."""
    return lambda at: albedo / (1 - albedo * at) ** 2, 1 / (1 - albedo) - 1


SMOOTH = {
    "exp": (np.exp, math.e - 1),
    "bounces 0.3": bounces(0.3),
    "bounces 0.85": bounces(0.85),
    "square root": (np.sqrt, 2 / 3),
}
FROM_BLACK = {f"log, {light}": from_black(light) for light in (0.01, 0.1, 1.0, 3.0, 10.0)}
# At a kink or a jump, the points give little more than its size.
ROUGH = {
    "kink": (lambda at: np.maximum(at - 0.137, 0), 0.863**2 / 2),
    "jump": (lambda at: (at > 0.77) * 1.0, 0.23),
}


def true_and_estimated(method: str, n_steps: int, integrand: Callable) -> tuple[float, float]:
    function, exact = integrand
    rule = quadrature(method, n_steps)
    found = function(np.array(rule.nodes))
    estimate = rule.error([torch.tensor([[one]], dtype=torch.float64) for one in found]).item()
    return abs(np.array(rule.weights) @ found - exact), estimate


@pytest.mark.parametrize("name", [*SMOOTH, *FROM_BLACK])
@pytest.mark.parametrize("method", METHODS)
def test_the_estimate_is_at_least_the_error(method, name):
    for n_steps in STEPS:
        error, estimate = true_and_estimated(method, n_steps, (SMOOTH | FROM_BLACK)[name])
        assert estimate >= 0.85 * error - 1e-14, f"{n_steps} steps: {estimate} for {error}"


@pytest.mark.parametrize("name", ROUGH)
@pytest.mark.parametrize("method", METHODS)
def test_a_kink_or_a_jump_is_detected(method, name):
    """A single rule may miss the error by chance, many rules together may not."""
    errors, estimates = zip(
        *(true_and_estimated(method, n_steps, ROUGH[name]) for n_steps in range(8, 65)), strict=True
    )
    assert np.hypot.reduce(estimates) > np.hypot.reduce(errors)


@pytest.mark.parametrize("name", SMOOTH)
def test_the_estimate_of_a_riemann_sum_is_too_large_by_a_small_factor(name):
    for method in METHODS[1:]:
        error, estimate = true_and_estimated(method, 32, SMOOTH[name])
        assert estimate < 6 * error, f"{method}: {estimate} for {error}"


def test_the_estimate_of_a_gauss_rule_vanishes_with_the_error():
    """It is that of a rule of half the degree."""
    for name, steps in (("exp", 12), ("bounces 0.3", 16), ("bounces 0.85", 24), ("log, 0.1", 32)):
        assert true_and_estimated("gausslegendre", steps, (SMOOTH | FROM_BLACK)[name])[1] < 1e-5
    assert (
        true_and_estimated("gausslegendre", 32, FROM_BLACK["log, 3.0"])[1] < 0.03 * FROM_BLACK["log, 3.0"][1]
    )


def test_a_gauss_rule_of_n_points_estimates_no_error_for_polynomials_of_n_minus_2_points():
    rule = quadrature("gausslegendre", 8)
    for degree in range(6):
        found = [torch.tensor([[place**degree]], dtype=torch.float64) for place in rule.nodes]
        assert rule.error(found).item() < 1e-14
    assert rule.error([torch.tensor([[place**6]], dtype=torch.float64) for place in rule.nodes]).item() > 1e-5


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n_steps", [2, 7, 32])
def test_weights_sum_to_one_and_points_without_weight_are_last(method, n_steps):
    rule = quadrature(method, n_steps)
    assert sum(rule.weights) == pytest.approx(1)
    assert all(rule.weights[:n_steps])
    assert not any(rule.weights[n_steps:])
    assert len(rule.nodes) - n_steps == {"riemann_middle": 2, "riemann_left": 1, "riemann_right": 1}.get(
        method, 0
    )
    assert (min(rule.nodes), max(rule.nodes)) == (
        (0, 1) if "riemann" in method else (rule.nodes[0], 1 - rule.nodes[0])
    )
    assert np.abs(rule.nulls.sum(1)).max() < 1e-12
    if method in ("gausslegendre", "riemann_middle", "riemann_trapezoid"):
        assert np.dot(rule.weights, rule.nodes) == pytest.approx(0.5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("alone", [0, 24])
def test_noise_is_not_counted_as_quadrature_error(method, alone):
    """32 steps, some of them with a single replicate: one alarm in ten, and error bars larger by less than √2."""
    rule, repeats = quadrature(method, 32), 400
    generator = torch.Generator().manual_seed(shifted(7))
    counts = [1 if number >= 32 - alone and number < 32 else 2 for number in range(len(rule.nodes))]
    variance = sum(weight**2 for weight in rule.weights)
    # Each point has equally many samples, split or not.
    noise = [math.sqrt(n) * torch.randn(n, repeats, generator=generator, dtype=torch.float64) for n in counts]
    estimates = rule.error([1 + one for one in noise])
    alarms = (estimates > 0).double().mean().item()
    assert alarms < 0.1 + 4 * math.sqrt(0.1 * 0.9 / repeats)
    assert estimates.square().mean().item() < variance


@pytest.mark.parametrize("method", METHODS)
def test_an_error_beyond_the_noise_is_detected(method):
    """8 steps from black, noise of a twentieth."""
    rule, repeats = quadrature(method, 8), 200
    function, exact = from_black(1.0)
    generator = torch.Generator().manual_seed(shifted(8))
    noise = torch.randn(len(rule.nodes), 2, repeats, generator=generator, dtype=torch.float64)
    found = torch.tensor(function(np.array(rule.nodes)))[:, None, None] * (1 + 0.05 * noise)
    estimates = rule.error(list(found))
    errors = (torch.tensor(rule.weights, dtype=torch.float64) @ found.mean(1) - exact).abs()
    assert (estimates > errors / 2).all()


def test_half_of_the_points_cover_the_whole_path():
    places = quadrature("riemann_middle", 32).nodes
    assert sum(places[:16]) / 16 == pytest.approx(0.5, abs=0.05)
    assert sorted(places) != list(places)


def test_an_interrupted_rule_is_compared_with_its_half():
    rule = quadrature("riemann_middle", 32)
    found = [torch.tensor([[place]]) for place in rule.nodes[:16]]
    assert rule.error(found).item() < 0.05
    assert quadrature("gausslegendre", 8).error([torch.tensor([[3.0]])]).item() == pytest.approx(3.0)
