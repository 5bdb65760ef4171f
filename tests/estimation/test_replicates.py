"""Sample budgets and Student's t."""

from __future__ import annotations

import pytest
from seeds import shifted

from scenecaptum import SceneCaptumError
from scenecaptum.estimation import Budget, student_t


@pytest.mark.parametrize(
    ("spp", "minimum", "replicates", "each"),
    [
        (64, 8, 8, 8),
        (60, 8, 10, 6),
        (1, 8, 1, 1),
        (5, 8, 5, 1),
        (17, 8, 8, 3),
        (64, 1, 1, 64),
        (None, 8, 8, None),
    ],
)
def test_budget_is_split_evenly_and_never_smaller_than_asked(spp, minimum, replicates, each):
    budget = Budget.split(spp, minimum, seed=shifted())
    assert (budget.replicates, budget.spp) == ((replicates,), (each,))
    if spp is not None:
        assert replicates * each >= spp


def test_all_seeds_of_a_budget_differ_and_depend_on_the_seed():
    a, b = Budget.split(64, 8, seed=shifted()), Budget.split(64, 8, seed=shifted(1))
    seeds = [*a.seeds[0], *a.gradient_seeds[0], *b.seeds[0], *b.gradient_seeds[0]]
    assert len(set(seeds)) == len(seeds)
    assert Budget.split(64, 8, seed=shifted()) == a


@pytest.mark.parametrize("replicates", [0, -1, 1.5, True])
def test_bad_number_of_replicates_is_refused(replicates):
    with pytest.raises(SceneCaptumError, match="replicates"):
        Budget.split(64, replicates, seed=shifted())


@pytest.mark.parametrize(("level", "degrees", "expected"), [
    (0.95, 7, 2.364624), (0.95, 1, 12.706205), (0.95, 2, 4.302653), (0.99, 8, 3.355387), (0.5, 30, 0.682756),
])  # fmt: skip
def test_student_quantiles_agree_with_the_tables(level, degrees, expected):
    assert student_t(level, degrees) == pytest.approx(expected, abs=1e-6)
