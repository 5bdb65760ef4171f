"""The arithmetic of the comparison with other tools: equal error, intervals, and the place of the table."""

from __future__ import annotations

import math

import pytest
import torch
from peers import (
    DIFFERENCES,
    OURS,
    TIME,
    Case,
    Errors,
    Number,
    Numbers,
    Samples,
    cost,
    interval,
    marks,
    section_name,
    step_error,
    write_section,
)
from seeds import shifted


def noisy(runs, sd, bias=0.0, seed=0):
    draws = torch.randn(runs, 5, generator=torch.Generator().manual_seed(shifted(seed)), dtype=torch.float64)
    return sd / 5**0.5 * draws + bias / 5**0.5


def test_samples_to_the_target_follow_variance_and_bias():
    target = 0.05
    plain = Errors(noisy(400, 2 * target), 0.0)
    assert plain.systematic == 0
    assert plain.times(target) == pytest.approx(4, rel=0.1)
    # A bias of 2 targets falls with the samples: twice as many are enough without noise.
    biased = Errors(noisy(400, 0.1 * target, bias=2 * target), 0.0)
    assert biased.systematic == pytest.approx(2 * target, rel=0.02)
    assert biased.times(target) == pytest.approx(2, rel=0.05)
    for errors in (plain, biased):
        assert errors.after(errors.times(target)) == pytest.approx(target)


def test_no_samples_remove_a_constant_error():
    errors = Errors(noisy(400, 0.2, bias=0.1), 0.0, constant=0.1)
    assert errors.after(10**9) == pytest.approx(0.1)
    assert errors.times(0.099) == math.inf
    target = math.hypot(0.1, 0.02)  # 100 times less variance than in a run
    assert errors.times(target) == pytest.approx(100, rel=0.1)


def test_the_error_from_a_step_is_measured_by_another():
    steps = [0.02, 0.08]
    runs = [torch.tensor([[3 + 5 * step**2]]) for step in steps]
    assert step_error(*runs, *steps).item() == pytest.approx(5 * steps[0] ** 2, rel=1e-3)
    assert step_error(*runs[::-1], *steps[::-1]).item() == pytest.approx(5 * steps[1] ** 2, rel=1e-3)


def test_the_error_of_the_reference_is_subtracted():
    sd = 0.1
    known = sd**2 / 4
    runs = Errors(noisy(400, sd) + torch.full((1, 5), (known / 5) ** 0.5, dtype=torch.float64), known)
    assert runs.systematic == 0
    assert runs.resolved
    assert runs.square(runs.runs) == pytest.approx(sd**2, rel=0.2)
    assert not Errors(runs.runs, 2 * known).resolved


def make(ours=0.1, theirs=0.2, other="other"):
    reference = torch.tensor([3.0, 4.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    numbers = [Number("a", k, 0.0, 1.0) for k in range(5)]
    case = Case("", {}, {"m": torch.mean}, numbers, {"m": reference}, {"m": torch.zeros(5).double()})
    samples = Samples()
    for k, (peer, sd, seconds) in enumerate(((OURS, ours, 1.0), (other, theirs, 0.5))):
        for run in reference + 5 * noisy(200, sd, seed=k):
            samples.add(peer, "m", 5, run, seconds)
    return case, samples


def test_cost_is_time_to_our_error_after_10_seconds():
    found = cost(*make(), "other", "m", 5)
    assert found.target == pytest.approx(0.1 / TIME**0.5, rel=0.1)
    assert found.times == pytest.approx(4 * TIME, rel=0.2)
    assert found.ratio == pytest.approx(2.0, rel=0.2)  # half the seconds, four times the variance
    assert found.low < 2.0 < found.high
    assert found.high < 1.5 * found.low
    assert found.to_target == pytest.approx(found.ratio * TIME)
    ours = cost(*make(), OURS, "m", 5)
    assert ours.ratio == pytest.approx(1)
    assert ours.to_target == pytest.approx(TIME)


def test_differences_with_a_large_error_from_their_step_never_get_there():
    case, samples = make(other=DIFFERENCES)
    samples.step_errors["m"] = 5 * noisy(4, 1e-3, bias=0.2, seed=3)
    found = cost(case, samples, DIFFERENCES, "m", 5)
    assert found.constant == pytest.approx(0.2, rel=0.05)
    assert found.ratio == found.low == found.high == math.inf
    samples.step_errors["m"] = 5 * noisy(4, 1e-3, seed=3)
    assert cost(case, samples, DIFFERENCES, "m", 5).ratio == pytest.approx(2.0, rel=0.2)


def test_differences_of_few_scalars_are_scaled():
    case, samples = make()
    samples.seconds[OURS, "m", 2] = [1.0]
    for run in case.reference["m"][:2] + 5 * noisy(200, 0.2, seed=2)[:, :2]:
        samples.add(DIFFERENCES, "m", 2, run, 0.4)
    samples.step_errors["m"] = torch.zeros(4, 2).double()
    found, measured = (cost(case, samples, DIFFERENCES, "m", count) for count in (5, 2))
    assert (found.scaled, measured.scaled) == (True, False)
    assert found.seconds == pytest.approx(2.5 * measured.seconds)
    assert found.error == measured.error


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
    begin, end = marks("peers")
    write_section(path, "one\n")
    assert path.read_text() == f"# Performance\n\n{begin}\none\n{end}\n"
    path.write_text(f"# Performance\n\nbefore\n\n{begin}\none\n{end}\n\nafter\n")
    write_section(path, "two\n")
    assert path.read_text() == f"# Performance\n\nbefore\n\n{begin}\ntwo\n{end}\n\nafter\n"
    path.write_text("# Performance\n\nbefore\n")
    write_section(path, "three\n")
    assert path.read_text() == f"# Performance\n\nbefore\n\n{begin}\nthree\n{end}\n"


def test_another_scene_has_its_own_section_after_the_first(tmp_path):
    path = tmp_path / "performance.md"
    office, room = (marks(section_name(scene)) for scene in ("office", "kitchen"))

    def page(first, second):
        return f"# P\n\n{office[0]}\n{first}\n{office[1]}\n\n{room[0]}\n{second}\n{room[1]}\n\nafter\n"

    path.write_text(f"# P\n\n{office[0]}\none\n{office[1]}\n\nafter\n")
    for text in ("two", "three"):
        write_section(path, f"{text}\n", section_name("kitchen"))
        assert path.read_text() == page("one", text)
    write_section(path, "four\n")
    assert path.read_text() == page("four", "three")
