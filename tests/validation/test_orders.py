"""Deletion and insertion of several orders, where the best order and all areas are known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from chance import allowed, binomial_margin, check_error_bars
from seeds import seeds, shifted
from toy import ToyRenderer

from scenecaptum import IntegratedGradientsScene, SceneCaptumError
from scenecaptum.projection import SurfaceMap, project_pixels
from scenecaptum.validation import deletion_insertion

# Changes of the mean by each lamp: "twin a" and "twin b" are equal.
POWERS = {"big": 8.0, "twin a": 4.0, "twin b": 4.0, "small": 2.0, "hidden": 1.0}
TOTAL = sum(POWERS.values())


class Lamps(ToyRenderer):
    """Five lamps; each lights all pixels, so that the mean is the sum of their powers."""

    def __init__(self, noise: float = 0.0) -> None:
        super().__init__(noise)
        self.matrix = (
            torch.rand(4, 4, 3, len(POWERS), generator=torch.Generator().manual_seed(shifted())) + 0.1
        )
        self.matrix /= self.matrix.mean((0, 1, 2))
        self.inputs = {name: torch.tensor(power) for name, power in POWERS.items()}
        self.bounds = dict.fromkeys(POWERS, (0.0, 10.0))
        # The left half shows the first three lamps, the right half one that has two parameters.
        self.surfaces = SurfaceMap(
            shape=(4, 4),
            pixel=np.repeat(np.arange(16, dtype=np.int32), 2),
            object_index=np.tile(np.array([0, 1, 2, 2], np.int32), 8),
            fraction=np.tile(np.array([0.75, 0.25, 1.0, 0.0], np.float32), 8),
            objects=("lamp", "shade", "wall", "behind"),
            parameters=(("big",), ("twin a", "big"), ("twin b", "small"), ("hidden",)),
        )

    def __call__(self, inputs, *, seed, spp):
        return self.sampled(seed, spp) @ torch.stack(list(inputs.values()))


def areas_of(*powers: float) -> tuple[float, float]:
    """Return the exact areas of an order of lamps, whose effects add up."""
    removed = np.cumsum([0.0, *powers])
    return np.trapezoid(removed) / len(powers), np.trapezoid(TOTAL - removed) / len(powers)


def test_areas_and_leads_are_those_of_the_closed_form():
    renderer = Lamps()
    orders = {
        "the same": IntegratedGradientsScene(renderer, torch.mean).attribute(seed=1),
        "backwards": {name: 1 / power for name, power in POWERS.items()},
        "twins": {"twin a": -2.0, "twin b": 2.0, "big": 1.0},
        "equal": dict.fromkeys(POWERS, 3.0),
    }
    curves = deletion_insertion(renderer, torch.mean, orders=orders)
    best = areas_of(8, 4, 4, 2, 1)
    expected = {
        "the same": best,
        "backwards": areas_of(1, 2, 4, 4, 8),
        "twins": areas_of(4, 4, 8, 1.5, 1.5),
        "equal": (TOTAL / 2, TOTAL / 2),
    }
    assert (curves.deletion_area[0], curves.insertion_area[0]) == pytest.approx(best, rel=1e-4)
    for name, areas in expected.items():
        other = curves.others[name]
        assert (other.deletion_area[0], other.insertion_area[0]) == pytest.approx(areas, rel=1e-4), name
        (deletion, _), (insertion, _) = curves.lead(name)
        assert deletion == pytest.approx(best[0] - areas[0], abs=1e-4), name
        assert insertion == pytest.approx(areas[1] - best[1], abs=1e-4), name
    assert set(curves.others["twins"].names[:2]) == {"twin a", "twin b"}
    assert "compared with backwards, it is better by both" in curves.verdict
    turned = deletion_insertion(
        renderer, torch.mean, _attribution(orders["backwards"]), orders={"the best": orders["the same"]}
    )
    assert "compared with the best, it is worse by both" in turned.verdict


def _attribution(importance):
    found = IntegratedGradientsScene(Lamps(), torch.mean).attribute()
    return dataclasses.replace(
        found, attributions={name: torch.tensor(value) for name, value in importance.items()}
    )


def test_orders_that_differ_by_noise_are_equal_within_the_errors():
    exact = IntegratedGradientsScene(Lamps(), torch.mean).attribute()
    swapped = {**POWERS, "twin a": 3.9 if _first_twin(exact) == "twin a" else 4.1}
    worse = {**POWERS, "big": 0.5}
    leads, unclear, found_worse = [], 0, 0
    runs = seeds(30)
    for seed in runs:
        curves = deletion_insertion(
            Lamps(noise=0.5),
            torch.mean,
            exact,
            orders={"swapped": swapped, "worse": worse},
            random_orders=2,
            seed=seed,
        )
        both = curves.lead("swapped")
        leads.append(both)
        unclear += "with swapped, it is equal within the errors" in curves.verdict
        found_worse += "with worse, it is better by both" in curves.verdict
        for (_, error), mine, other in zip(
            both,
            (curves.deletion_area, curves.insertion_area),
            (curves.others["swapped"].deletion_area, curves.others["swapped"].insertion_area),
            strict=True,
        ):
            assert error < math.hypot(mine[1], other[1]), "the seeds are not shared"
    values, bars = torch.tensor(leads, dtype=torch.float64).unbind(-1)
    assert (values.std(0) > 0).all(), "there is no noise"
    check_error_bars(values, bars)
    off = values.mean(0).abs() / (values.std(0) / math.sqrt(len(runs)))
    assert (off < allowed(len(runs), 2)).all(), off
    # In 95 % by each of the two, which are correlated.
    assert unclear / len(runs) >= 0.90 - binomial_margin(0.90, len(runs))
    assert found_worse == len(runs)


def _first_twin(attribution):
    return next(row.name for row in attribution.ranking() if row.name.startswith("twin"))


def test_few_steps_keep_tied_parameters_together():
    tied = {"big": 1.0, "twin a": 1.0, "twin b": 1.0, "small": 0.5}
    curves = deletion_insertion(Lamps(), torch.mean, orders={"tied": tied}, steps=3)
    assert curves.moved.tolist() == [0, 2, 3, 5]
    after = [TOTAL, TOTAL * (1 / 3) + (TOTAL - 16) * (2 / 3), TOTAL - 16, 0]
    assert curves.others["tied"].deletion.mean(1).tolist() == pytest.approx(after, abs=1e-4)


def test_numbers_for_objects_go_to_their_parameters():
    curves = deletion_insertion(
        Lamps(),
        torch.mean,
        orders={
            "objects": {"lamp": 1.0, "shade": 2.0, "behind": 9.0, "wall": -5.0},
            "both": {"lamp": 1.0, "shade": 2.0, "behind": 9.0, "hidden": 0.0},
        },
        random_orders=2,
    )
    assert curves.others["objects"].names == ("hidden", "twin b", "small", "big", "twin a")
    assert curves.others["both"].names == ("big", "twin a", "twin b", "small", "hidden")


def test_projected_pixels_are_an_order():
    renderer = Lamps()
    left = torch.zeros(4, 4, 3)
    left[:, ::2] = 1.0
    projected = project_pixels(renderer, left)
    assert projected.invisible == ("hidden",)
    assert dict(projected) == pytest.approx({"big": 24, "twin a": 6, "twin b": 0, "small": 0, "hidden": 0})
    curves = deletion_insertion(renderer, torch.mean, orders={"pixels": projected}, random_orders=2)
    areas = areas_of(8, 4, 7 / 3, 7 / 3, 7 / 3)
    other = curves.others["pixels"]
    assert (other.deletion_area[0], other.insertion_area[0]) == pytest.approx(areas, rel=1e-4)


def test_invalid_orders_are_refused():
    renderer = Lamps()
    for orders, message in (
        ({"mine": {"bgi": 1.0}}, r"orders\['mine'\] contains 'bgi', which is neither .* 'big'"),
        ({"mine": {"big": math.nan}}, r"orders\['mine'\] must be finite"),
    ):
        with pytest.raises(SceneCaptumError, match=message):
            deletion_insertion(renderer, torch.mean, orders=orders)
    curves = deletion_insertion(renderer, torch.mean, orders={"mine": POWERS}, random_orders=2)
    with pytest.raises(SceneCaptumError, match=r"'mien' is not one of the orders .* 'mine'"):
        curves.lead("mien")


def test_tables_and_figures_show_all_orders():
    orders = {"Captum's pixels": dict(reversed(POWERS.items())), "equal": {}}
    curves = deletion_insertion(Lamps(noise=0.1), torch.mean, orders=orders, random_orders=2)
    lines = str(curves).splitlines()
    start = next(number for number, line in enumerate(lines) if "larger is better" in line)
    heads = [line.split("  ")[0].strip() for line in lines[start + 1 :]]
    assert heads[:6] == [
        "mean size of the change",
        "of Captum's pixels",
        "",
        "of equal",
        "",
        "of random orders",
    ]
    assert [line.split()[:3] for line in lines[start + 3 : start + 6 : 2]] == [["lead", "over", "it"]] * 2
    figure = curves.plot()
    (legend,) = figure.legends
    expected = ["IntegratedGradientsScene", "Captum's pixels", "equal", "random orders"]
    assert [text.get_text() for text in legend.get_texts()] == expected
    for ax in figure.axes:
        # A curve for each order, the mean of the random ones, and the line at 0.
        assert sum(len(line.get_xdata()) == 6 for line in ax.lines if line.get_marker() != "_") >= 4
