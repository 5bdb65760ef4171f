"""Reflection at bounds: always inside, the identity for values inside, and never with a derivative of zero."""

from __future__ import annotations

import math

import pytest
import torch
from seeds import shifted
from torch.autograd import gradcheck

from scenecaptum.errors import SceneCaptumError
from scenecaptum.scene import OPEN_MARGIN, reflect

INTERVALS = [(0.0, 1.0), (-1.0, 1.0), (0.25, 180.0), (0.0, math.inf), (-math.inf, 2.0), (-math.inf, math.inf)]


def bounced(value: float, low: float, high: float) -> float:
    """Reflect at one bound after the other until the value is inside: the definition of reflection."""
    while not low <= value <= high:
        value = 2 * low - value if value < low else 2 * high - value
    return value


@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_a_value_bounces_between_the_bounds_until_it_is_inside(low: float, high: float) -> None:
    values = torch.linspace(-500, 700, 1201, dtype=torch.float64) + 0.3
    expected = torch.tensor([bounced(v, low, high) for v in values.tolist()], dtype=torch.float64)
    torch.testing.assert_close(reflect(values, low, high), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("open_low", [False, True])
@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_float32_never_lands_outside(low: float, high: float, open_low: bool) -> None:
    generator = torch.Generator().manual_seed(shifted())
    wide = 10 ** (6 * torch.rand(100_000, generator=generator) - 3)
    values = wide * torch.randn(100_000, generator=generator)
    found = reflect(values, low, high, open_low=open_low)
    assert found.dtype == torch.float32
    assert (found > low).all() if open_low else (found >= low).all()
    assert (found <= high).all()


@pytest.mark.parametrize("open_low", [False, True])
@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_values_inside_are_returned_bit_for_bit(low: float, high: float, open_low: bool) -> None:
    finite_low, finite_high = max(low, -3.0), min(high, 3.0)
    values = torch.linspace(finite_low, finite_high, 1001)[1:-1]
    values = torch.cat([values, torch.tensor([finite_high, finite_low + 1e-7])])
    values = values[(values > low) & (values <= high)]
    assert torch.equal(reflect(values, low, high, open_low=open_low), values)


def test_an_open_bound_is_excluded_and_a_closed_one_is_included() -> None:
    at = torch.tensor([0.0, -0.0, -1e-9, 2.0, 4.0])
    assert reflect(at, 0.0, 1.0).tolist() == pytest.approx([0] * 5, abs=1e-6)
    assert reflect(at, 0.0, 1.0, open_low=True).tolist() == pytest.approx([OPEN_MARGIN] * 5)
    assert reflect(at, 0.0, 2.0, open_low=True)[4].item() == pytest.approx(2 * OPEN_MARGIN)
    assert reflect(at[:3], 0.0, math.inf, open_low=True).tolist() == pytest.approx([OPEN_MARGIN] * 3)


def test_symmetric_noise_keeps_its_spread_at_a_bound() -> None:
    noise = 0.3 * torch.randn(100_000, generator=torch.Generator().manual_seed(shifted(1)))
    folded = reflect(noise, 0.0, 1.0)
    assert folded.std().item() == pytest.approx(noise.abs().std().item(), rel=1e-2)
    assert ((folded == 0) | (folded == 1)).float().mean() < 1e-3


@pytest.mark.parametrize("open_low", [False, True])
@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_gradcheck_away_from_the_kinks(low: float, high: float, open_low: bool) -> None:
    values = torch.tensor([-400.3, -7.3, -2.6, -0.4, 0.3, 0.6, 1.7, 5.4, 366.6], dtype=torch.float64)
    assert gradcheck(lambda v: reflect(v, low, high, open_low=open_low), values.requires_grad_())


@pytest.mark.parametrize("open_low", [False, True])
@pytest.mark.parametrize(("low", "high"), INTERVALS)
def test_the_derivative_is_never_zero_not_even_at_a_kink(low: float, high: float, open_low: bool) -> None:
    values = torch.tensor([-4.0, -3.0, -1.0, -0.0, 0.25, 1.0, 2.0, 3.0, 180.0, 1e6, 1e-9]).requires_grad_()
    reflect(values, low, high, open_low=open_low).sum().backward()
    assert torch.equal(values.grad.abs(), torch.ones_like(values))


@pytest.mark.parametrize(("low", "high"), INTERVALS[:-1])
def test_values_that_are_not_finite_stay_so(low: float, high: float) -> None:
    assert not reflect(torch.tensor([math.nan]), low, high).isfinite().any()
    outside = [v for v in (-math.inf, math.inf) if not low <= v <= high]
    assert not reflect(torch.tensor(outside), low, high).isfinite().any()


@pytest.mark.parametrize(("low", "high"), [(1.0, 0.0), (0.5, 0.5), (math.nan, 1.0)])
def test_empty_bounds_are_refused(low: float, high: float) -> None:
    with pytest.raises(SceneCaptumError, match="lower bound must be below"):
        reflect(torch.zeros(2), low, high)
