"""Annual metrics: by hand, against plain loops, relaxed and exact, and their gradients."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from refusals import message
from seeds import seeds, shifted

from scenecaptum.daylight import (
    BY_NAME,
    AnnualSunlightExposure,
    ContinuousDaylightAutonomy,
    DaylightAutonomy,
    DaylightFactor,
    DaylightMetric,
    DaylightProvision,
    SkyMatrix,
    SkyPatches,
    SpatialDaylightAutonomy,
    TotalAnnualIllumination,
    UsefulDaylightIlluminance,
    illuminance,
)
from scenecaptum.estimation import TargetedMetric

from . import published
from .side_lit import side_lit_room

TREGENZA = SkyPatches.tregenza()
BANDS = ("fell-short", "supplementary", "autonomous", "exceeded")

# Each metric on a sky, all hours; with few hours, 2.5 of sun stand for 250. No number of hours is that, or half of
# all: a number at the limit counts one half however narrow the transition is.
RELAXED: dict[str, Callable[..., DaylightMetric]] = {
    "DA": lambda sky, **more: DaylightAutonomy(sky, during="all", **more),
    **{
        f"UDI-{band}": lambda sky, band=band, **more: UsefulDaylightIlluminance(
            sky, band, during="all", **more
        )
        for band in BANDS
    },
    "sDA": lambda sky, **more: SpatialDaylightAutonomy(sky, during="all", **more),
    "ASE": lambda sky, **more: AnnualSunlightExposure(sky, hours=2.5, during="all", **more),
    **{
        f"provision-{level}": lambda sky, level=level, **more: DaylightProvision(
            sky, level, during="all", **more
        )
        for level in ("minimum", "medium", "high")
    },
}
CONTINUOUS: dict[str, Callable[[SkyMatrix], DaylightMetric]] = {
    "cDA": lambda sky: ContinuousDaylightAutonomy(sky, during="all"),
    "TAI": TotalAnnualIllumination,
}
LOOPS: dict[str, Callable[[np.ndarray], float]] = {
    "DA": published.daylight_autonomy,
    **{f"UDI-{band}": lambda e, band=band: published.useful_daylight_illuminance(e, band) for band in BANDS},
    "sDA": published.spatial_daylight_autonomy,
    "ASE": lambda e: published.annual_sunlight_exposure(e, limit=2.5),
    "provision-minimum": lambda e: published.daylight_provision(e, 300, 100),
    "provision-medium": lambda e: published.daylight_provision(e, 500, 300),
    "provision-high": lambda e: published.daylight_provision(e, 750, 500),
    "cDA": published.continuous_daylight_autonomy,
    "TAI": published.total_annual_illumination,
}


def setup(values: object) -> tuple[torch.Tensor, SkyMatrix]:
    """Return coefficients and a sky that give the illuminances ``(points, hours)``, up to 145 hours.

    Hour h has one patch only, of 1 / 179 W·m⁻²·sr⁻¹, and the coefficients of this patch are the illuminances.
    """
    table = torch.as_tensor(np.asarray(values, dtype=np.float64))
    radiance = torch.zeros(146, table.shape[1], 3)
    radiance[torch.arange(1, table.shape[1] + 1), torch.arange(table.shape[1])] = 1.0
    coefficients = torch.zeros(len(table), 146, 3, dtype=torch.float64)
    coefficients[:, 1 : table.shape[1] + 1] = table[..., None] / 179
    return coefficients, SkyMatrix.from_radiance(radiance)


def random_illuminance(seed: int, points: int = 12, hours: int = 41) -> np.ndarray:
    """Log-normal illuminances around points of very different brightness, some of them 0."""
    generator = np.random.default_rng(seed)
    level = np.exp(generator.uniform(math.log(60), math.log(4000), (points, 1)))
    values = level * np.exp(1.3 * generator.normal(size=(points, hours)))
    return np.where(generator.random((points, hours)) < 0.2, 0.0, values)


@pytest.fixture(scope="module")
def year(radiance, weather) -> SkyMatrix:
    return SkyMatrix.from_weather(weather)


def test_the_setup_gives_the_illuminances():
    values = random_illuminance(shifted(1))
    coefficients, sky = setup(values)
    np.testing.assert_allclose(illuminance(coefficients, sky), values, rtol=1e-12)


# Two points, four hours; no value is at a limit.
TABLE = [[50.0, 150.0, 450.0, 3500.0], [0.0, 290.0, 310.0, 1200.0]]
BY_HAND = {
    "DA": 50.0,
    "UDI-fell-short": 25.0,
    "UDI-supplementary": 25.0,
    "UDI-autonomous": 37.5,
    "UDI-exceeded": 12.5,
    "sDA": 100.0,  # two of four hours each
    "ASE": 0.0,
    "provision-minimum": 100 * 1 / 0.95,
    "provision-medium": 0.0,  # nobody has 500 lx for two hours
    "provision-high": 0.0,
    "cDA": 100 * (50 / 300 + 150 / 300 + 2 + 290 / 300 + 2) / 8,
    "TAI": (50 + 150 + 450 + 3500 + 290 + 310 + 1200) / 2,
}


@pytest.mark.parametrize("name", BY_HAND)
def test_values_by_hand(name):
    coefficients, sky = setup(TABLE)
    metric = (RELAXED | CONTINUOUS)[name](sky)
    assert metric.hard(coefficients).item() == pytest.approx(BY_HAND[name], rel=1e-9)


def test_at_least_means_at_least_and_above_means_above():
    # sky and coefficients of which the products are exact
    radiance = torch.zeros(146, 4, 3)
    radiance[1:5] = torch.eye(4)[..., None]
    sky = SkyMatrix.from_radiance(radiance)
    limits = torch.tensor([100.0, 300.0, 1000.0, 3000.0], dtype=torch.float64)
    coefficients = torch.zeros(1, 146, 3, dtype=torch.float64)
    coefficients[0, 1:5] = 1.0
    one = illuminance(coefficients, sky)[0, 0]
    coefficients[0, 1:5] = (limits / one)[:, None]
    coefficients[0, 1:5] *= (limits / illuminance(coefficients, sky)[0])[:, None]
    values = illuminance(coefficients, sky)[0]
    thresholds = values.tolist()  # whatever rounding left of them
    low, middle, sun, high = thresholds
    assert DaylightAutonomy(sky, middle, during="all").hard(coefficients) == 75
    shares = [
        UsefulDaylightIlluminance(sky, band, (low, middle, high), during="all").hard(coefficients).item()
        for band in BANDS
    ]
    assert shares == [0, 25, 75, 0]
    assert SpatialDaylightAutonomy(sky, middle, 0.75, during="all").hard(coefficients) == 100
    assert SpatialDaylightAutonomy(sky, middle, 0.76, during="all").hard(coefficients) == 0
    # above 1000 lx is one hour: more than 0.5, not more than 1
    assert AnnualSunlightExposure(sky, sun, 0.5, during="all").hard(coefficients) == 100
    assert AnnualSunlightExposure(sky, sun, 1, during="all").hard(coefficients) == 0


@pytest.mark.parametrize("seed", seeds(3))
@pytest.mark.parametrize("name", LOOPS)
def test_exact_values_are_those_of_the_published_definition(name, seed):
    values = random_illuminance(seed)
    coefficients, sky = setup(values)
    metric = (RELAXED | CONTINUOUS)[name](sky)
    expected = LOOPS[name](values)
    assert metric.hard(coefficients).item() == pytest.approx(expected, rel=1e-9)
    if name in RELAXED:
        assert RELAXED[name](sky, relaxation=0)(coefficients).item() == pytest.approx(expected, rel=1e-9)
    else:
        assert metric(coefficients).item() == pytest.approx(expected, rel=1e-9)


def test_the_random_points_pass_and_fail():
    values = random_illuminance(seeds(1)[0])
    for name, loop in LOOPS.items():
        assert loop(values) > 0, name
    assert LOOPS["sDA"](values) < 100 > LOOPS["ASE"](values)


@pytest.mark.parametrize("name", RELAXED)
def test_relaxed_values_approach_the_exact_one(name):
    values = random_illuminance(shifted(2))
    coefficients, sky = setup(values)
    hard = RELAXED[name](sky).hard(coefficients).item()
    errors = [
        abs(RELAXED[name](sky, relaxation=width)(coefficients).item() - hard)
        for width in (0.3, 0.03, 1e-3, 1e-6)
    ]
    assert errors[-1] < 1e-9 * max(hard, 1)
    assert errors[0] > errors[-1]


@pytest.mark.parametrize("name", RELAXED)
def test_a_relaxed_value_is_close_to_the_exact_one_by_default(name):
    values = random_illuminance(shifted(7), points=300, hours=101)
    coefficients, sky = setup(values)
    metric = RELAXED[name](sky)
    spatial = name in ("sDA", "ASE") or name.startswith("provision")
    assert abs(metric(coefficients) - metric.hard(coefficients)) < (4 if spatial else 0.5)


@pytest.mark.parametrize("name", RELAXED | CONTINUOUS)
def test_gradients_are_the_limits_of_differences(name):
    values = random_illuminance(shifted(3), points=4, hours=8) + 5  # a difference may not go below 0
    coefficients, sky = setup(values)
    make = (RELAXED | CONTINUOUS)[name]
    # Wide enough that every metric has some gradient on 4 points.
    metric = make(sky, relaxation=0.8) if name in RELAXED else make(sky)
    part = coefficients[:, 1:9].clone().requires_grad_()

    def value(part: torch.Tensor) -> torch.Tensor:
        return metric(torch.cat([coefficients[:, :1], part, coefficients[:, 9:]], dim=1))

    assert torch.autograd.gradcheck(value, (part,), eps=1e-7, atol=1e-4, rtol=1e-4)
    (gradient,) = torch.autograd.grad(value(part), part)
    assert gradient.abs().max() > 0


@pytest.mark.parametrize("name", RELAXED)
def test_a_dark_room_has_a_finite_gradient(name):
    coefficients, sky = setup(np.zeros((3, 5)))
    coefficients.requires_grad_()
    RELAXED[name](sky)(coefficients).backward()
    assert torch.equal(coefficients.grad, torch.zeros_like(coefficients))


@pytest.mark.parametrize("name", RELAXED | CONTINUOUS)
def test_values_have_the_dtype_of_the_coefficients(name):
    coefficients, sky = setup(random_illuminance(shifted(4)))
    metric = (RELAXED | CONTINUOUS)[name](sky)
    assert metric(coefficients.float()).dtype == torch.float32
    assert metric(coefficients.float()).shape == ()
    assert metric(coefficients.float()).item() == pytest.approx(
        metric(coefficients).item(), rel=1e-4, abs=1e-4
    )
    assert copy.deepcopy(metric)(coefficients) == metric(coefficients)


@pytest.mark.parametrize("name", ["DA", "UDI-autonomous", "sDA", "ASE", "cDA", "TAI"])
def test_a_metric_is_the_mean_over_the_points(name):
    coefficients, sky = setup(random_illuminance(shifted(5)))
    metric = (RELAXED | CONTINUOUS)[name](sky)
    points = metric.of_points(coefficients)
    exact = metric.hard_of_points(coefficients.detach().requires_grad_())
    assert exact.mean().item() == pytest.approx(metric.hard(coefficients).item())
    assert not exact.requires_grad
    assert points.shape == (12,)
    assert points.mean() == pytest.approx(metric(coefficients))
    assert metric(coefficients[3:4]) == pytest.approx(points[3])


@pytest.mark.parametrize(
    ("name", "values", "label", "levels"),
    [
        ("DA", [50, 50], "daylight autonomy at 300 lx in %", (25, 50, 75)),
        ("UDI-exceeded", [25, 0], "hours with more than 3000 lx in %", (25, 50, 75)),
        ("sDA", [50, 50], "hours with at least 300 lx in %", (50,)),
        ("ASE", [1, 1], "hours with more than 1000 lx of direct sun", (2.5,)),
        ("provision-medium", [25, 25], "hours with at least 500 lx in %", (50,)),
        ("TAI", [4150, 1800], "total annual illumination in lx·h", (2e5, 5e5, 1e6, 2e6, 5e6, 1e7)),
    ],
)
def test_a_map_shows_what_is_compared_with_the_limit(name, values, label, levels):
    coefficients, sky = setup(TABLE)
    shown = (RELAXED | CONTINUOUS)[name](sky).on_plan(coefficients.requires_grad_())
    assert shown.values.tolist() == pytest.approx(values)
    assert (shown.label, shown.levels) == (label, levels)
    assert bool(shown.counts) == (len(levels) == 1), "a limit is explained"


def test_the_bands_of_useful_illuminance_add_up():
    coefficients, sky = setup(random_illuminance(shifted(6)))
    for value in ("__call__", "hard"):
        total = sum(getattr(RELAXED[f"UDI-{band}"](sky), value)(coefficients) for band in BANDS)
        assert total.item() == pytest.approx(100)


@pytest.mark.parametrize(
    ("level", "target", "minimum"), [("minimum", 300, 100), ("medium", 500, 300), ("high", 750, 500)]
)
def test_levels_of_daylight_provision_want_half_at_the_target_and_nearly_all_at_the_minimum(
    level, target, minimum
):
    def value(*brightness: float) -> float:
        coefficients, sky = setup([[one, one, 0.0] for one in brightness])  # two of three hours
        return DaylightProvision(sky, level, during="all").hard(coefficients).item()

    assert value(1.01 * target, 1.01 * minimum) == pytest.approx(100)  # half, and 100 / 0.95
    assert value(0.99 * target, 0.99 * target) == 0
    assert value(1.01 * target, 0.99 * minimum) == pytest.approx(100 * 0.5 / 0.95)
    assert value(*[1.01 * target] * 19, 0.0) == pytest.approx(100)


@pytest.mark.parametrize(
    ("brightness", "one_more", "required"),
    [((310, 310, 90, 90), (310, 310, 120, 90), 0.95), ((310, 120, 120, 120), (310, 310, 120, 120), 0.5)],
)
def test_a_point_of_daylight_provision_is_a_step_of_the_smaller_ratio(brightness, one_more, required):
    (before, sky), (after, _) = (
        setup([[one, one, 0.0] for one in map(float, lux)]) for lux in (brightness, one_more)
    )
    metric = DaylightProvision(sky, during="all")
    step = metric.step_of_a_point(before)
    assert step == pytest.approx(100 / (4 * required))
    assert metric.hard(after).item() - metric.hard(before).item() == pytest.approx(step)
    assert DaylightAutonomy(sky, during="all").step_of_a_point(before) is None
    assert SpatialDaylightAutonomy(sky, during="all").step_of_a_point(before) == 25


@pytest.mark.parametrize(
    ("brightness", "target"), [((310, 310, 90, 90), 100), ((310, 120, 120, 120), 300), ((310, 310, 310), 100)]
)
def test_the_plan_and_the_words_of_daylight_provision_are_of_the_target_that_decides(brightness, target):
    coefficients, sky = setup([[one, one, 0.0] for one in map(float, brightness)])
    metric = DaylightProvision(sky, during="all")
    assert metric.in_words(coefficients).endswith(f": {target} lx decides")
    shown = metric.on_plan(coefficients)
    assert shown.label == f"hours with at least {target} lx in %"
    assert shown.counts == "from 50 % on (line), a point reaches the target that decides"
    assert (metric.hard(coefficients).item() == pytest.approx(metric.greatest)) == (min(brightness) > 300)


def test_daylight_provision_says_how_many_points_have_what_light():
    coefficients, sky = setup([[one, one, 0.0] for one in (310.0, 310.0, 120.0, 90.0)])
    assert DaylightProvision(sky, during="all").in_words(coefficients) == (
        "300 lx at 50 % of the points (50 required), 100 lx at 75 % of the points (95 required)"
        ": 100 lx decides"
    )
    assert DaylightAutonomy(sky, during="all").in_words(coefficients) == ""


# Daylight factors


@pytest.mark.parametrize("make", [SkyMatrix.cie_overcast, SkyMatrix.uniform])
def test_the_daylight_factor_outdoors_is_100(make):
    outdoors = TREGENZA.projected_solid_angles[None, :, None].expand(3, -1, 3)
    for statistic in ("mean", "median"):
        assert DaylightFactor(make(horizontal_illuminance=777), statistic)(outdoors).item() == pytest.approx(
            100
        )


def test_daylight_factors_by_hand():
    outdoors = TREGENZA.projected_solid_angles[None, :, None].expand(4, -1, 3)
    coefficients = outdoors * torch.tensor([0.08, 0.01, 0.02, 0.03], dtype=torch.float64)[:, None, None]
    sky = SkyMatrix.cie_overcast()
    assert DaylightFactor(sky)(coefficients).item() == pytest.approx(3.5)
    assert DaylightFactor(sky, "median")(coefficients).item() == pytest.approx(2.5)
    assert DaylightFactor(sky, "median")(coefficients[:3]).item() == pytest.approx(2)
    assert DaylightFactor(sky).of_points(coefficients).tolist() == pytest.approx([8, 1, 2, 3])


@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_the_daylight_factor_has_its_gradient(statistic):
    coefficients = side_lit_room(TREGENZA, 3, 2)
    metric = DaylightFactor(SkyMatrix.cie_overcast(), statistic)
    part = coefficients[:, 40:46].clone().requires_grad_()
    whole = lambda part: torch.cat([coefficients[:, :40], part, coefficients[:, 46:]], 1)  # noqa: E731
    assert torch.autograd.gradcheck(lambda part: metric(whole(part)), (part,), eps=1e-7, atol=1e-4)


# A year in a room


def test_occupied_hours_count_by_default(year):
    for metric in (
        DaylightAutonomy(year),
        ContinuousDaylightAutonomy(year),
        UsefulDaylightIlluminance(year),
        SpatialDaylightAutonomy(year),
        AnnualSunlightExposure(year),
    ):
        assert metric.sky.hours == 3650
        assert set(metric.sky.weather.hour.tolist()) == set(range(9, 19))
    assert DaylightProvision(year).sky.hours == 4380
    assert TotalAnnualIllumination(year).sky.hours == 8760


@pytest.mark.parametrize("name", ["DA", "UDI-supplementary", "UDI-exceeded", "sDA", "cDA"])
def test_a_year_in_a_room_is_that_of_the_published_definition(year, name):
    coefficients = side_lit_room(TREGENZA, 5, 2)
    occupied = year.weather.occupied()
    metric = (RELAXED | CONTINUOUS)[name](year.select(occupied))
    values = illuminance(coefficients, year).numpy()[:, occupied.numpy()]
    assert metric.hard(coefficients).item() == pytest.approx(LOOPS[name](values), rel=1e-9)


def test_the_relaxed_metrics_of_a_room_are_close_to_the_exact_ones(year):
    coefficients = side_lit_room(TREGENZA, depths=40)
    for metric, allowed in (
        (DaylightAutonomy(year), 0.15),
        (UsefulDaylightIlluminance(year), 0.15),
        (SpatialDaylightAutonomy(year), 3),
        (DaylightProvision(year), 3),
    ):
        assert abs(metric(coefficients) - metric.hard(coefficients)) < allowed, metric


def test_the_derivative_predicts_the_change_of_the_exact_metric(year):
    coefficients = side_lit_room(TREGENZA)
    metric = DaylightAutonomy(year)
    scale = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(metric(coefficients * scale.exp()), scale)
    difference = (
        metric.hard(coefficients * math.exp(0.1)) - metric.hard(coefficients * math.exp(-0.1))
    ) / 0.2
    assert slope.item() == pytest.approx(difference.item(), rel=0.08)


def test_exposure_to_the_sun_is_near_the_window(radiance, weather):
    sky = SkyMatrix.from_weather(weather, SkyPatches.reinhart(), sun="only")
    coefficients = side_lit_room(sky.patches, direct_only=True)
    metric = AnnualSunlightExposure(sky)
    exposed = AnnualSunlightExposure(sky, relaxation=0).of_points(coefficients).view(5, 8)
    assert metric.hard(coefficients) == exposed.mean()
    assert (exposed[:, 0] == 100).all()
    assert (exposed[:, -1] == 0).all()
    values = illuminance(coefficients, sky).numpy()[:, weather.occupied().numpy()]
    assert metric.hard(coefficients).item() == pytest.approx(published.annual_sunlight_exposure(values))


# Names and refusals


def test_measures_have_names_and_units():
    sky = SkyMatrix.uniform()
    described = {name: make(sky).measure.describe() for name, make in (RELAXED | CONTINUOUS).items()}
    assert {name: one["unit"] for name, one in described.items()} == {
        name: "lx·h" if name == "TAI" else "%" for name in described
    }
    assert described["sDA"]["name"] == "spatial daylight autonomy without blinds"
    assert described["sDA"]["symbol"] == "sDA300/50%"
    assert (
        described["sDA"]["definition"]
        == "share of the points with at least 300 lx in at least 50 % of the hours"
    )
    assert described["ASE"]["definition"] == (
        "share of the points with more than 1000 lx of direct sun in more than 2.5 hours of a year"
    )
    assert all(one["definition"] for one in described.values())
    assert DaylightFactor(sky, "median").measure.name == "median daylight factor"
    assert AnnualSunlightExposure(sky, during="all").measure.symbol == "ASE1000,250h"


@pytest.mark.parametrize(
    ("value", "start"),
    [(54.9, "below 55"), (55.0, "at least 55"), (74.9, "at least 55"), (75.0, "at least 75")],
)
def test_a_limit_that_is_reached_counts(value, start):
    metric = SpatialDaylightAutonomy(SkyMatrix.uniform(), during="all")
    assert metric.measure.verdict(value).startswith(start)


def test_other_verdicts():
    sky = SkyMatrix.uniform()
    assert DaylightProvision(sky, during="all").measure.verdict(100.0) == "at least the minimum level"
    assert DaylightProvision(sky, "high", during="all").measure.verdict(99.9) == "below the high level"
    exposure = AnnualSunlightExposure(sky, during="all").measure
    assert [exposure.verdict(v)[:10] for v in (3, 7, 10, 10.1)] == [
        "up to 3 %,", "up to 7 %,", "above 7 %,", "above 10 %",
    ]  # fmt: skip
    autonomy = SpatialDaylightAutonomy(sky, during="all").measure
    assert (
        autonomy.verdict(55)
        == "at least 55 %, which would be 'nominally accepted' if it were sDA with blinds"
    )
    assert autonomy.verdict(75) == "at least 75 %, which would be 'preferred' if it were sDA with blinds"
    assert SpatialDaylightAutonomy(sky, 500, during="all").measure.verdict(80) == ""


def test_missing_blinds_are_said():
    metric = SpatialDaylightAutonomy(SkyMatrix.uniform(), during="all")
    assert "without blind operation, not conformant with IES LM-83" in TargetedMetric(metric).caution
    assert "not conformant with LM-83" in SpatialDaylightAutonomy.__doc__


def test_refusals(weather):
    sky = SkyMatrix.uniform()
    assert "during='occupied' needs the dates" in message(lambda: DaylightAutonomy(sky))
    assert "during='daylight' needs the dates" in message(lambda: DaylightProvision(sky))
    assert "during must be" in message(lambda: DaylightAutonomy(sky, during="night"))
    assert "no hour" in message(lambda: DaylightAutonomy(sky, during=torch.zeros(1, dtype=torch.bool)))
    for bad in (0, -1, math.nan, "300"):
        assert "threshold must be" in message(lambda: DaylightAutonomy(sky, bad, during="all"))  # noqa: B023
    assert "relaxation must be" in message(lambda: DaylightAutonomy(sky, during="all", relaxation=-0.1))
    assert "fraction must be" in message(lambda: SpatialDaylightAutonomy(sky, fraction=0, during="all"))
    assert "fraction must be" in message(lambda: SpatialDaylightAutonomy(sky, fraction=1.2, during="all"))
    assert "hours must be" in message(lambda: AnnualSunlightExposure(sky, hours=-1, during="all"))
    assert "band must be" in message(lambda: UsefulDaylightIlluminance(sky, "useful", during="all"))
    for limits in ((100, 300), (300, 100, 3000), (100, 100, 3000), (0, 300, 3000)):
        said = message(lambda: UsefulDaylightIlluminance(sky, limits=limits, during="all"))  # noqa: B023
        assert said.startswith("limits must be")
    assert "level must be" in message(lambda: DaylightProvision(sky, "low", during="all"))
    assert "statistic must be" in message(lambda: DaylightFactor(sky, "mode"))
    two = SkyMatrix.from_radiance(torch.ones(146, 2, 3))
    assert "2 hours" in message(lambda: DaylightFactor(two))
    assert "black" in message(lambda: DaylightFactor(SkyMatrix.from_radiance(torch.zeros(146, 1, 3))))
    metric = DaylightAutonomy(sky, during="all")
    assert "(points, 146, 3)" in message(lambda: metric(torch.ones(2, 578, 3)))
    assert "negative or not finite" in message(lambda: metric(torch.full((2, 146, 3), math.inf)))


def test_settings_are_shown():
    sky = SkyMatrix.cie_overcast()
    assert repr(DaylightAutonomy(sky, 500, during="all")) == (
        "DaylightAutonomy(SkyMatrix(146 patches, 1 hours), relaxation=0.1, threshold=500)"
    )
    for make in (RELAXED | CONTINUOUS).values():
        assert "146 patches" in repr(make(sky))
    assert repr(DaylightFactor(sky)) == "DaylightFactor(SkyMatrix(146 patches, 1 hours), statistic='mean')"


def test_every_name_creates_a_metric_from_a_sky(weather, radiance):
    skies: dict[str, SkyMatrix] = {}  # of a kind of light, which takes a second
    for name, named in BY_NAME.items():
        patches = SkyPatches(named.subdivision)
        if named.light not in skies:
            skies[named.light] = named.sky(weather, patches)
        metric = named.create(skies[named.light])
        share = torch.linspace(0.0, 0.3, 4)[:, None, None]
        coefficients = (share * patches.projected_solid_angles.float()[:, None]).expand(-1, -1, 3)
        shown = metric.on_plan(coefficients)
        assert shown.values.shape == (4,), name
        assert (shown.values.diff() >= 0).all() or name == "udi", name
        assert metric.hard(coefficients) > 0, name
        assert named.needs_weather == (metric.sky.weather is not None), name
