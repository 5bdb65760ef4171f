"""The arithmetic of the comparison with other tools: equal error, intervals, and the place of the table."""

from __future__ import annotations

import pytest
import torch
from peers import BEGIN, END, TARGET, Case, Errors, Number, Numbers, Samples, cost, interval, write_section
from seeds import shifted


def noisy(runs, sd, bias=0.0, seed=0):
    draws = torch.randn(runs, 5, generator=torch.Generator().manual_seed(shifted(seed)), dtype=torch.float64)
    return sd / 5**0.5 * draws + bias / 5**0.5


def test_samples_to_the_target_follow_variance_and_bias():
    plain = Errors(noisy(400, 2 * TARGET), 0.0)
    assert plain.systematic == 0
    assert plain.times(plain.square(plain.runs)) == pytest.approx(4, rel=0.1)
    # A bias of 2 targets falls with the samples: twice as many are enough without noise.
    biased = Errors(noisy(400, 0.1 * TARGET, bias=2 * TARGET), 0.0)
    assert biased.systematic == pytest.approx(2 * TARGET, rel=0.02)
    assert biased.times(biased.square(biased.runs)) == pytest.approx(2, rel=0.05)


def test_the_error_of_the_reference_is_subtracted():
    shift = torch.full((1, 5), TARGET / 5**0.5, dtype=torch.float64)
    known = TARGET**2
    runs = Errors(noisy(400, 2 * TARGET) + shift, known)
    assert runs.systematic == 0
    assert runs.resolved
    assert runs.square(runs.runs) == pytest.approx((2 * TARGET) ** 2, rel=0.2)
    assert not Errors(runs.runs, 2 * known).resolved


def make(ours=0.1, theirs=0.2):
    reference = torch.tensor([3.0, 4.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    numbers = [Number("a", k, 0.0, 1.0) for k in range(5)]
    case = Case("", {}, {"m": torch.mean}, numbers, {"m": reference}, {"m": torch.zeros(5).double()})
    samples = Samples()
    for k, (peer, sd, seconds) in enumerate((("scenecaptum", ours, 1.0), ("other", theirs, 0.5))):
        for run in reference + 5 * noisy(200, sd, seed=k):
            samples.add(peer, "m", 5, run, seconds)
    return case, samples


def test_cost_is_time_at_equal_error():
    found = cost(*make(), "other", "m", 5)
    assert found.ratio == pytest.approx(2.0, rel=0.2)  # half the seconds, four times the variance
    assert found.low < 2.0 < found.high
    assert found.high < 1.5 * found.low
    assert found.to_target == pytest.approx(0.5 * (0.2 / TARGET) ** 2, rel=0.1)
    assert cost(*make(), "scenecaptum", "m", 5).ratio == 1


def test_runs_with_more_numbers_count_for_fewer():
    case, samples = make()
    samples.add("other", "m", 2, case.reference["m"][:2], 0.1)
    assert samples.errors(case, "other", "m", 2).shape == (201, 2)
    assert samples.errors(case, "other", "m", 5).shape == (200, 5)


def test_single_numbers_are_written_into_their_parameters():
    class Renderer:
        spp = 4

        def __call__(self, values, *, seed, spp, seed_grad):
            return values["a"]

    values = {"a": torch.tensor([0.1, 0.2, 0.3])}
    numbers = [Number("a", 2, 0.0, 1.0), Number("a", 0, 0.0, 1.0), Number("a", 1, 0.0, 1.0)]
    one = Numbers(Renderer(), Case("", values, {}, numbers, {}, {}), 2)
    assert list(one.inputs) == ["a[2]", "a[0]"]
    rendered = one({"a[2]": torch.tensor(0.9), "a[0]": torch.tensor(0.8)}, seed=shifted(), spp=1)
    assert rendered.tolist() == pytest.approx([0.8, 0.2, 0.9])


def test_intervals_are_finite():
    assert interval((0.0, 1.0), 0.3) == (1e-3, 1.0)
    assert interval((0.0, float("inf")), 4.0) == (2.0, 6.0)


def test_the_section_is_replaced_in_place(tmp_path):
    path = tmp_path / "docs" / "performance.md"
    write_section(path, "one\n")
    assert path.read_text() == f"# Performance\n\n{BEGIN}\none\n{END}\n"
    path.write_text(f"# Performance\n\nbefore\n\n{BEGIN}\none\n{END}\n\nafter\n")
    write_section(path, "two\n")
    assert path.read_text() == f"# Performance\n\nbefore\n\n{BEGIN}\ntwo\n{END}\n\nafter\n"
    path.write_text("# Performance\n\nbefore\n")
    write_section(path, "three\n")
    assert path.read_text() == f"# Performance\n\nbefore\n\n{BEGIN}\nthree\n{END}\n"
