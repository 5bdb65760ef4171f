"""The quick half of the table of derivatives, against the finite differences of Mitsuba's own path tracers."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from derivative_table import CASES, GROUPS, QUICK, Case
from derivatives import (
    DIFFERENCE,
    GOOD,
    OURS,
    Estimate,
    MitsubaReference,
    Ours,
    Outcome,
    document,
    estimates,
    overview,
    z_score,
)
from seeds import seeds

SEEDS = 8

# Each plugin with its own rule has a case in the default half: the others take longest to compile, are lit by a
# lamp in the floor at another roughness, or follow Mitsuba's own derivative.
LONG = (
    "roughdielectric/lamp in the floor, alpha 0.01",
    "roughdielectric/lamp in the floor, alpha 0.05",
    "roughdielectric/lamp in the floor, alpha 0.3",
    "roughplastic/lamp in the floor, alpha 0.01",
    "roughplastic/lamp in the floor, alpha 0.05",
    "roughplastic/lamp in the floor, alpha 0.3",
    "principled/lamp in the floor, clearcoat_gloss 0.4",
    "principled/lamp in the floor, clearcoat_gloss 0.9",
    "principled/lamp in the floor, roughness 0.1",
    "principled/lamp in the floor, roughness 0.3",
    "polarizer/ball",
    "circular/ball",
    "spectra/rgb, rawconstant, uniform",
    "area/in a mirror",
    "constant/dark sky beside a lamp",
    "envmap/scale 0 beside a lamp",
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


def test_the_summary_counts_verdicts_by_group() -> None:
    one, half = Estimate(1.0, 0.01, 64), Estimate(0.5, 0.01, 64)

    def outcome(
        plugin: str, verdict: str, difference: Estimate | None, stock: Estimate | str | None
    ) -> Outcome:
        return Outcome("", plugin, "", None, "", verdict, difference=difference, stock=stock)

    text = overview(
        [
            outcome("diffuse", "right", one, one),
            outcome("plastic", "right", one, half),
            outcome("point", "unsupported", None, "not tracked"),
            outcome("fog", "unresolved", one, "raises"),
        ]
    )
    assert "| materials | 2 | 0 | 0 | 0 | 1 | 1 | 0 | 0 |" in text
    assert "| lights | 0 | 0 | 0 | 1 | 0 | 0 | 0 | 0 |" in text
    assert "| media | 0 | 0 | 1 | 0 | 0 | 0 | 0 | 1 |" in text
    assert text.endswith("of: `plastic`, `fog`.")


def test_groups_of_the_summary_are_plugins_of_the_table() -> None:
    assert {plugin for group in GROUPS.values() for plugin in group} <= {case.plugin for case in CASES}


def test_a_page_keeps_the_tables_of_plugins_that_are_not_measured_again() -> None:
    page = (Path(__file__).parents[2] / "docs" / "derivatives.md").read_text()
    again = document([], page)
    assert again.split("## diffuse")[1] == page.split("## diffuse")[1]
    measured = Outcome("mask/new", "mask", "ball.bsdf.opacity", 0.5, "0.05", "wrong")
    changed = document([measured], page)
    assert "| wrong | – | – | – |  | 0.05 | 0.5 | new |" in changed
    assert changed.count("\n## ") == page.count("\n## ")
    assert changed.split("## blendbsdf")[1] == page.split("## blendbsdf")[1]
