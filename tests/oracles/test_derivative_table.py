"""The quick half of the table of derivatives, against the finite differences of Mitsuba's own path tracers."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
import pytest
from derivative_table import CASES, QUICK, Case
from derivatives import DIFFERENCE, GOOD, OURS, Estimate, MitsubaReference, Ours, estimates, z_score
from seeds import seeds

SEEDS = 8

# The cases that take longest to compile; the others cover the same code.
LONG = (
    "principled/opaque",
    "principled/specular",
    "roughplastic/roughness",
    "hair/polyline",
    "hair/dyed",
    "hair/white",
    "pplastic/ball",
    "mesh_attribute/vertex colours",
    "normalmap/over roughplastic",
    "envmap/smooth",
)


def quick_cases() -> list[Any]:
    return [
        pytest.param(case, id=case.name, marks=[pytest.mark.long] if case.name in LONG else [])
        for case in CASES
        if case.name in QUICK
    ]


@pytest.mark.parametrize("case", quick_cases())
def test_derivatives_agree_with_finite_differences(mi: Any, case: Case) -> None:
    spp = QUICK[case.name]
    judge = MitsubaReference(case)
    targets = {name: row for name, row in judge.targets.items() if row.step is not None}
    theirs = {name: difference(judge, name, spp) for name in targets}
    del judge
    gc.collect()  # Dr.Jit's calls include every live scene
    ours = Ours(case, targets)
    draws = np.array([ours.replayed(OURS + seed, spp) for seed in seeds(SEEDS)])
    found = estimates(draws, spp)
    faults = [fault(name, mine, theirs[name]) for name, mine in zip(targets, found, strict=True)]
    assert not any(faults), "\n".join(filter(None, faults))


def difference(judge: MitsubaReference, name: str, spp: int) -> Estimate:
    draws = [[judge.quotient(name, DIFFERENCE + seed, spp)] for seed in seeds(SEEDS)]
    judge.restore(name)
    return estimates(np.array(draws), spp)[0]


def fault(name: str, ours: Estimate, theirs: Estimate) -> str | None:
    """Return the fault of a row with the measured and the allowed value, or None."""
    if ours.is_zero and theirs.is_zero:
        return None
    if max(ours.relative_error, theirs.relative_error) > GOOD:
        return f"{name}: the errors of {ours} and {theirs} exceed {GOOD:.0%}: the case shows nothing"
    z = z_score(ours, theirs)
    return (
        None
        if abs(z) < 4
        else f"{name}: derivative {ours}, difference quotient {theirs}: z = {z:+.1f}, allowed ±4"
    )
