"""Tables and numbers, on results made by hand: nothing is rendered."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from results import CASES, NASTY, all_text, make

from scenecaptum import SceneAttribution
from scenecaptum.protocols import ResultKind
from scenecaptum.visualization import (
    align_decimals,
    minus,
    plain_number,
    plot_bars,
    row_cautions,
    shorten,
    table_html,
    table_text,
    untrusted_groups,
    with_error,
)
from scenecaptum.visualization._notes import goal_notes
from scenecaptum.visualization._text import axis_label


@pytest.fixture(autouse=True)
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")


def row_of(name: str, text: str) -> str:
    (line,) = [line for line in text.splitlines() if re.match(rf" *\d+  {re.escape(name)}", line)]
    return line


# -- numbers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (0.09784, 0.00079, ("0.0978", "0.0008")),
        (0.09784, 0.00012, ("0.09784", "0.00012")),
        (0.5, 0.00097, ("0.5000", "0.0010")),
        (-3.14159, 0.2, ("−3.14", "0.20")),
        (1.25e-7, 2e-8, ("1.25e−7", "0.20e−7")),
        (3e-8, 4e-6, ("0", "4e−6")),
        (2e-5, 4e-6, ("0.000020", "0.000004")),
        (1234567.0, 4000.0, ("1.235e6", "0.004e6")),
        (12345.6, 720.0, ("12300", "700")),
        (-1e-12, 3e-9, ("0", "3.0e−9")),
        (1e3, 2e7, ("0", "2.0e7")),
        (0.0494687, 1e-13, ("0.049469", "0.000001")),
        (-0.9995092, 7e-7, ("−0.999509", "0.000001")),
        (-0.9995092, 1.3e-6, ("−0.999509", "0.000002")),
        (8.6382191, 2e-9, ("8.638219", "0.000001")),
        (123456.78, 0.02, ("123456.8", "0.1")),
        (1234567.8, 0.02, ("1.234568e6", "0.000001e6")),
        (0.0512345, 2.1e-6, ("5.12345e−2", "0.00021e−2")),
        (1.234567e-4, 1e-12, ("1.234567e−4", "0.000001e−4")),
        (0.001, 0.12, ("0.00", "0.12")),
        (0.0, 0.0, ("0", "0")),
        (0.0, 0.002, ("0", "0.0020")),
        (0.2, 0.0, ("0.2000", "0")),
        (1 / 3, None, ("0.3333", "")),
        (0.99999, None, ("1.000", "")),
        (float("nan"), 0.12, ("nan", "0.12")),
        (2.0, float("inf"), ("2.000", "inf")),
        (float("inf"), None, ("inf", "")),
    ],
)
def test_digits_follow_the_error(value: float, error: float | None, written: tuple[str, str]) -> None:
    assert with_error(value, error) == written


def test_decimal_points_stand_in_one_column() -> None:
    aligned = align_decimals(["-12.5", "0.0978", "3e-7", "0"])
    assert len({len(number) for number in aligned}) == 1
    assert aligned[0].index(".") == aligned[1].index(".") == aligned[2].index("e")


def test_shortened_names_stay_different() -> None:
    names = ["luminaire_left: radiance", "luminaire_right: radiance", "sky"]
    short = shorten(names, 15)
    assert len(set(short)) == 3
    assert max(map(len, short)) <= 15
    assert all(one.startswith("lum") and one.endswith("nce") for one in short[:2])
    assert "…" in short[0]
    assert short[2] == "sky"
    assert shorten(["a\nb\x1b[2J"], 20) == ["a�b�[2J"]


def test_names_are_cut_at_words_and_stay_different() -> None:
    assert shorten(["smoothed margin of cube over the best other class"], 36) == [
        "smoothed margin … best other class"
    ]
    assert shorten(["of averyveryveryveryveryverylongword only"], 20) == ["of averyve…word only"]
    alike = shorten([f"smoothed logit of {name} minus that of cube" for name in ("cylinder", "spheres")], 36)
    assert len(set(alike)) == 2
    assert max(map(len, alike)) <= 36


def test_names_that_differ_only_in_the_middle_stay_different() -> None:
    names = [f"{'from here ' * 8}{shape}{' to there' * 8}" for shape in ("cube", "ball")]
    short = shorten(names, 36)
    assert [next(shape for shape in ("cube", "ball") if shape in one) for one in short] == ["cube", "ball"]
    assert max(map(len, short)) <= 36
    assert all(one.startswith("from here") for one in short)


def test_a_difference_of_two_classes_keeps_both_in_notes_and_on_axes() -> None:
    name = "smoothed logit of cube minus that of cylinder"
    result = make(measure={"name": name})
    assert f"change of {name} per unit" in " ".join(table_text(result).split())
    assert name in axis_label(result)


@pytest.mark.parametrize(
    ("quantity", "said"),
    [
        (ResultKind.GRADIENT_VARIANCE, "variance of the change of mean luminance (cd/m²)² per unit"),
        (ResultKind.MEAN_SQUARED_GRADIENT, "mean squared change of mean luminance (cd/m²)² per unit"),
        (ResultKind.MEAN_GRADIENT, "mean change of mean luminance (cd/m²) per unit"),
    ],
)
def test_squares_have_the_unit_squared(quantity: ResultKind, said: str) -> None:
    result = make(quantity=quantity.value, measure={"name": "mean luminance", "unit": "cd/m²"})
    assert said in axis_label(result, "unit")


# -- tables ----------------------------------------------------------------------------------------------


def test_table_shows_what_was_measured_and_how() -> None:
    heading = table_text(make()).splitlines()[0]
    assert heading == "Glare = 2.3369 ± 0.0005 · VanillaSceneGradient · 64 spp in 8 replicates"


@pytest.mark.parametrize(
    ("quantity", "note"),
    [
        ("effect over the range", "effect: first-order change of Glare over the range of the parameter"),
        ("effect of ablation", "effect: loss of Glare by ablation"),
        ("contribution", "effect: contribution to Glare"),
    ],
)
def test_table_says_whether_effects_are_extrapolated(quantity: str, note: str) -> None:
    assert note in table_text(make(quantity=quantity)).splitlines()


@pytest.mark.parametrize("quantity", [ResultKind.EFFECT, ResultKind.ABLATION, ResultKind.CONTRIBUTION])
def test_numbers_that_repeat_the_effect_have_no_column(quantity: ResultKind) -> None:
    every = make(quantity=quantity.value)
    assert table_text(every).splitlines()[2].endswith(f"{quantity.value}: R, G, B")
    scalars = dataclasses.replace(every, attributions={name: every[name] for name in ("rough", "noisy")})
    assert table_text(scalars).splitlines()[2:4] == [
        "#  parameter        effect",
        "1  desk: roughness  −0.0978 ± 0.0008",
    ]
    assert table_html(scalars).count("<th ") == table_html(every).count("<th ") - 1 == 3
    gradients = dataclasses.replace(scalars, info={**scalars.info, "quantity": ResultKind.GRADIENT.value})
    assert "gradient per unit" in table_text(gradients).splitlines()[2]


@pytest.mark.parametrize("quantity", [ResultKind.GRADIENT_VARIANCE, ResultKind.MEAN_SQUARED_GRADIENT])
def test_table_explains_squares_below_0(quantity: ResultKind) -> None:
    note = "below 0: not above the noise of rendering, which is subtracted"
    result = make(quantity=quantity.value)
    assert table_text(result).count(note) == 1
    assert note in table_html(result)
    positive = dataclasses.replace(result, attributions={n: v.abs() for n, v in result.items()})
    assert note not in table_text(positive)
    assert note not in table_text(make())
    # One whose digits are those of 0 is no number below 0.
    rounded = {**positive.attributions, "tiny": torch.tensor(-1e-11), "noisy": torch.tensor(-1e-5)}
    text = table_text(dataclasses.replace(positive, attributions=rounded))
    assert "−" not in re.sub(r"e−\d+", "", text), "the exponents of small numbers aside"
    assert note not in text
    below = {**rounded, "noisy": torch.tensor(-0.02)}
    assert note in table_text(dataclasses.replace(positive, attributions=below))


def test_table_says_that_effects_of_a_small_roughness_may_be_far_off() -> None:
    def text(value: float, extent: float, top: int | None = None, effect: float = -2.0) -> str:
        name = "metal.alpha.value"
        return table_text(
            dataclasses.replace(
                make(barred=False),
                attributions={name: torch.tensor(effect), "floor": torch.tensor(1.0)},
                parameter_values={name: torch.tensor(value), "floor": torch.tensor(0.01)},
                extents={name: torch.tensor([extent]), "floor": torch.ones(1)},
            ),
            top=top,
        )

    note = "~  metal.alpha.value: a small roughness often acts most near 0"
    assert note in text(0.02, 1.0)
    assert note in text(0.2, 1.0)
    assert (
        "far off; render the change, or measure an ablation with another roughness as baseline (not shown)"
        in " ".join(text(0.02, 1.0, 1, -0.9).split())
    )
    assert "not shown" not in text(0.02, 1.0, 1)
    assert "far off" not in text(0.3, 1.0)
    assert "far off" not in text(0.02, 0.05), "the range is that of the user"


def test_every_small_roughness_has_a_mark_and_the_note_names_the_leading_ones() -> None:
    """Effects of 0, and those within their noise, overstate nothing."""
    effects = {
        "sky.radiance": 100.0,
        "big.alpha": 20.0,
        "small.alpha": -3.0,
        "smaller.alpha": 2.0,
        "zero.alpha": 0.0,
        "noisy.alpha": 1.0,
    }
    errors = dict.fromkeys(effects, 0.01) | {"zero.alpha": 0.0, "noisy.alpha": 0.7}

    def result(names: Sequence[str]) -> SceneAttribution:
        return dataclasses.replace(
            make(),
            attributions={name: torch.tensor(effects[name]) for name in names},
            covariance={name: torch.tensor([[errors[name] ** 2]]) for name in names},
            standard_error={name: torch.tensor(errors[name]) for name in names},
            parameter_values={name: torch.tensor(0.02) for name in names},
            extents={name: torch.ones(1) for name in names},
            labels={},
        )

    text = table_text(result(list(effects)))
    marked = {name for name in effects if f"{name} ~" in " ".join(row_of(name, text).split())}
    assert marked == {"big.alpha", "small.alpha", "smaller.alpha"}
    assert "~ big.alpha and 2 more: a small roughness often acts most near 0" in " ".join(text.split())
    without = table_text(result([name for name in effects if name != "big.alpha"]))
    assert "~ small.alpha and 1 more: a small roughness often acts" in " ".join(without.split())


def test_the_caution_of_a_row_in_a_file_names_that_row() -> None:
    names = ("floor.alpha", "wall.alpha")
    found = row_cautions(
        dataclasses.replace(
            make(barred=False),
            attributions={name: torch.tensor(1.0) for name in names},
            parameter_values={name: torch.tensor(0.02) for name in names},
            extents={name: torch.ones(1) for name in names},
            labels={},
        )
    )
    for name in names:
        assert found[name].startswith(f"~ {name}: a small roughness often acts"), found


def lowest(name: str, value: float, gradient: float = 0.0) -> SceneAttribution:
    """A result with a roughness and a reflectance, which has a larger effect unless that is 0."""
    return dataclasses.replace(
        make(barred=False),
        attributions={name: torch.tensor(gradient), "floor": torch.tensor(1.0)},
        parameter_values={name: torch.tensor(value), "floor": torch.tensor(0.5)},
        extents={name: torch.ones(1), "floor": torch.ones(1)},
        labels={},
    )


@pytest.mark.parametrize(
    ("name", "value", "gradient", "has_note"),
    [
        ("metal.alpha.value", 0.0, 0.0, True),
        ("metal.alpha_u.value", 5e-5, 0.0, True),
        ("metal.alpha.value", 0.001, 0.0, False),
        ("metal.alpha.value", 0.0, 0.01, False),
        ("desk.roughness.value", 0.03, 0.0, True),
        ("desk.roughness.value", 0.04, 0.0, False),
        ("wall.reflectance.value", 0.0, 0.0, False),
    ],
)
def test_table_says_that_a_derivative_at_the_lowest_roughness_says_nothing(
    name: str, value: float, gradient: float, has_note: bool
) -> None:
    text = " ".join(table_text(lowest(name, value, gradient)).split())
    assert (f"~ {name}: Mitsuba renders a roughness this low as its lowest" in text) == has_note
    # One that is not 0 there may be far off.
    assert (f"{name} ~ " in text) == (has_note or gradient != 0)


def test_table_says_that_a_low_roughness_lost_in_noise_is_better_attributed_alone() -> None:
    def text(error: float, noisy: Sequence[str] = ("metal.alpha.value", "not here"), **info: Any) -> str:
        name = "metal.alpha.value"
        return table_text(
            dataclasses.replace(
                make(**info),
                attributions={name: torch.tensor(-2.0), "floor": torch.tensor(1.0)},
                covariance={name: torch.tensor([[error**2]]), "floor": torch.tensor([[1.0]])},
                parameter_values={},
                extents={name: torch.ones(1), "floor": torch.ones(1)},
                info={**make(**info).info, "noisy_roughness": noisy},
            )
        )

    note = (
        "~ the error of this roughness is large among many inputs: metal.alpha.value; it is often smaller if you "
        "select it alone"
    )
    assert note in " ".join(text(1.0).split())
    several = (
        "these roughnesses are large among many inputs: metal.alpha.value; floor; they are often smaller if"
    )
    assert several in " ".join(text(1.0, noisy=["metal.alpha.value", "floor"]).split())
    assert "alone" not in text(0.1), "its error is small enough"
    assert "alone" not in text(1.0, quantity="effect of ablation"), "no gradient is taken"


def test_table_says_that_the_scale_of_a_map_is_the_effect_of_its_light() -> None:
    sky = {"sky.data": torch.ones(2, 3, 3), "sky.scale": torch.tensor(1.0)}
    result = dataclasses.replace(
        make(barred=False),
        attributions=sky,
        parameter_values={"sky.data": torch.ones(3), "sky.scale": torch.tensor(1.0)},
        extents={"sky.data": torch.ones(3), "sky.scale": torch.ones(1)},
    )
    note = "~  sky.data: for the same amount added to every texel; sky.scale: for all of its light"
    assert note in table_text(result).splitlines()
    assert "every texel" not in table_text(result, scale="unit")
    lines = " ".join(table_text(result, scale="value").split())
    assert "~ sky.data: relative to the mean, which is added to every texel alike; for each texel" in lines
    assert row_cautions(result, "value").keys() == {"sky.data"}


@pytest.mark.parametrize(("of_scale", "is_shared"), [(0.5, True), (0.0, False)])
def test_table_says_that_a_map_and_its_scale_share_what_their_light_contributes(
    of_scale: float, is_shared: bool
) -> None:
    sky = {"sky.data": torch.ones(2, 3, 3), "sky.scale": torch.tensor(of_scale)}
    values = {"sky.data": torch.ones(3), "sky.scale": torch.tensor(1.0)}
    result = dataclasses.replace(
        make(barred=False, quantity="contribution"), attributions=sky, parameter_values=values, extents={}
    )
    note = "sky.data; sky.scale: one light, whose contribution is the sum of both"
    assert (note in table_text(result).splitlines()) is is_shared


def test_table_says_that_a_bump_map_has_no_effect_whatever_its_texels_do() -> None:
    bump = {"wall.bsdf.nested_texture.data": torch.zeros(2, 3, 1), "wall.bsdf.scale": torch.tensor(1.0)}
    result = dataclasses.replace(
        make(barred=False),
        attributions=bump,
        parameter_values={name: torch.ones(1) for name in bump},
        extents={name: torch.ones(1) for name in bump},
    )
    note = "~ wall.bsdf.nested_texture.data: the same height added to every texel bends no normal, so"
    assert note in " ".join(table_text(result).split())
    assert "every texel" not in table_text(result, scale="unit")


def test_table_ranks_with_sign_error_and_channels() -> None:
    text = table_text(make())
    names = re.findall(r"^ *\d+  (\S+)", text, flags=re.MULTILINE)
    assert names == ["lamp", "two_minds", "floor", "desk:", "wall", "noisy", "tiny", NASTY]
    assert re.search(r"0\.0978 +± 0\.0008 +−0\.0978$", row_of("desk: roughness", text))
    assert re.search(r"± 0\.0030 .*\+0\.100 +−0\.200 +\+0\.010$", row_of("two_minds", text))
    assert re.search(r"1\.25e−7 ± 0\.20e−7 +\+1\.25e−7$", row_of("tiny", text))
    points = {row_of(name, text).index(".") for name in ("lamp", "two_minds", "wall", "tiny")}
    assert len(points) == 1


def test_texture_shows_totals_with_a_note() -> None:
    text = table_text(make())
    assert re.search(r"Σ .*−0\.080 +−0\.120 +−0\.160$", row_of("floor", text))
    assert "Σ totals over the texels" in text
    occluded = table_text(make(quantity=ResultKind.OCCLUSION.value))
    assert "Σ totals over the patches" in occluded
    assert "R, G, B" not in occluded, "all channels have the same"
    plain = dataclasses.replace(make(), attributions={"rough": torch.tensor(1.0)})
    assert "texel" not in table_text(plain)


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        (17.9, 0.2, "within 19, the limit for offices"),
        (18.3, 0.94, "within 19, the limit for offices; too close to 19 to be sure"),
        (23.5, 2.5, "above 19; too uncertain to be sure: 18.5 to 28.5 within two errors"),
        (18.99, None, "within 19, the limit for offices"),
    ],
)
def test_a_class_within_the_noise_is_called_so(value: float, error: float | None, said: str) -> None:
    limits = {"name": "unified glare rating", "limits": [19.0, 22.0, 25.0]}
    info = {"measure": limits, "verdict": said.partition(";")[0]}
    rated = dataclasses.replace(make(**info), metric_value=value, metric_standard_error=error)
    assert f" · {said} · " in " ".join(table_text(rated).replace("\n", " · ").split())
    assert said in table_html(rated)
    unrated = dataclasses.replace(rated, info={**rated.info, "verdict": ""})
    assert "to be sure" not in table_text(unrated)


def test_missing_error_bars_are_explained() -> None:
    text = table_text(make(barred=False))
    assert "no error bars: 1 replicate" in text
    assert "±" not in text
    assert "no error bars" not in table_text(make())


def planned(**changes: Any) -> SceneAttribution:
    planner = {
        "tolerance": 0.05,
        "share": 0.05,
        "top": None,
        "time_limit": None,
        "reached": True,
        "stopped": "goal",
        "relative_half_width": 0.0463,
        "order": None,
    }
    return make(planner={**planner, **changes})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "95 % half-widths ≤ 4.63 % (target: 5 %), for effects ≥ 5 % of the total"),
        (
            {"reached": False, "stopped": "the time limit"},
            "95 % half-widths ≤ 4.63 % (target: 5 %, stopped by the time limit), for effects ≥ 5 % of the total",
        ),
        (
            {"tolerance": None, "time_limit": 10.0, "reached": None},
            "95 % half-widths ≤ 4.63 % in 10 s, for effects ≥ 5 % of the total",
        ),
        (
            {"relative_half_width": 1.017, "reached": False, "stopped": "the time limit"},
            "95 % half-widths ≤ 102 % (target: 5 %, stopped by the time limit), for effects ≥ 5 % of the total",
        ),
        (
            {"relative_half_width": 0.10001},
            "95 % half-widths ≤ 10.1 % (target: 5 %), for effects ≥ 5 % of the total",
        ),
        (
            {"relative_half_width": None, "tolerance": None, "time_limit": 4.0, "reached": None},
            "95 % half-widths not known in 4 s: more samples are needed",
        ),
        (
            {"relative_half_width": None, "reached": False, "stopped": "the lack of a derivative"},
            "95 % half-widths not known (target: 5 %, stopped by the lack of a derivative)",
        ),
        ({"top": 3, "order": [["a"], ["b"], ["c"]]}, "order of the top 3 resolved"),
        ({"top": 3, "order": [["a", "b"], ["c"]]}, "order of the top 3 resolved except 1 tie"),
        (
            {"top": 3, "order": [["a", "b"], ["c"]], "reached": False, "stopped": "the time limit"},
            "order of the top 3 not resolved, stopped by the time limit",
        ),
    ],
)
def test_a_goal_is_reported_in_one_line(changes: dict[str, Any], words: str) -> None:
    assert goal_notes(planned(**changes)) == [words]
    assert words in " ".join(str(planned(**changes)).split())
    assert words in planned(**changes)._repr_html_()


def test_interruption_is_reported() -> None:
    text = table_text(make(interrupted=True, replicates=3))
    assert "interrupted after 3 replicates" in text
    assert "in 3 replicates" not in text


def test_parameters_left_out_for_their_values_are_named_in_every_form() -> None:
    said = "knob.eta.value is left out: it is -0.0485"
    left_out = make(left_out={"knob.eta.value": "it is -0.0485"})
    assert f"! {said}" in " ".join(table_text(left_out).split())
    assert said in " ".join(table_html(left_out).split())
    assert f"! {said}" in " ".join(all_text(plot_bars(left_out)).split())
    many = make(left_out={f"knob{n}": "it is nan" for n in range(9)})
    assert "4 more are left out" in " ".join(table_text(many).split())


def test_cautions_are_grouped() -> None:
    text = table_text(make(cautions={"rough": "size is off", "wall": "size is off", "lamp": "sign is off"}))
    assert text.count("size is off") == 1
    assert "!2 size is off (2 parameters)" in text
    assert "!1 sign is off (1 parameter)" in text
    assert " !2 " in row_of("desk: roughness", text)
    assert " !2 " in row_of("wall", text)
    assert " !1 " in row_of("lamp", text)
    assert "!" not in row_of("noisy", text)
    assert "! off" in " ".join(table_text(make(cautions={"rough": "off"})).split())


@pytest.mark.parametrize(
    ("names", "counted", "named"),
    [
        (["lamp"], "1 parameter", "lamp"),
        (["lamp", "two_minds"], "2 parameters", "lamp; two_minds"),
        (
            ["wall", "tiny", "lamp"],
            "3 parameters, 2 of them not shown",
            "lamp; wall; tiny, 2 of them not shown",
        ),
        (["wall", "tiny"], "2 parameters, none of them shown", "wall; tiny, none of them shown"),
        (["tiny"], "1 parameter, not shown", "tiny, not shown"),
        (
            ["rough", "wall", "tiny", "lamp"],
            "4 parameters, 3 of them not shown",
            "lamp; desk: roughness; wall and 1 more, 3 of them not shown",
        ),
    ],
)
def test_notes_say_which_of_their_parameters_have_no_row(
    names: list[str], counted: str, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda _: dict.fromkeys(names, "few"))
    text = table_text(make(cautions=dict.fromkeys(names, "size is off")), top=2)
    assert f"?  few ({named})" in text
    assert f"!  size is off ({counted})" in text
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda one: dict.fromkeys(one, "few"))
    text = table_text(make(), top=2)
    assert "all parameters: few" in text
    assert "?" not in text, "no row has the mark"


def test_notes_name_rows_in_the_order_of_the_ranking(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a report does, which has all rows."""
    made = make()
    order = [row.name for row in made.ranking()]
    doubts = dict.fromkeys([*reversed(order[:-1])], "few")
    monkeypatch.setattr(SceneAttribution, "untrusted_errors", lambda _: doubts)
    assert untrusted_groups(made) == {"few": order[:-1]}
    labels = [made.labels.get(name, name) for name in order[:3]]
    for top in (2, None):
        assert f"?  few ({'; '.join(labels)} and {len(order) - 4} more" in table_text(made, top=top)


@pytest.mark.parametrize("columns", [30, 50, 80, 120])
def test_no_line_is_wider_than_the_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    long = {name: f"{name}_{'very_' * 30}long" for name, *_ in CASES}
    cautions = {"rough": "the plugin's tables are outside the derivative graph: its size is off"}
    text = table_text(dataclasses.replace(make(cautions=cautions), labels=long))
    assert max(map(len, text.splitlines())) <= columns
    assert "…" in text
    if columns >= 80:
        assert "−0.200" in text


def test_long_rankings_end_with_the_number_of_hidden_rows() -> None:
    text = table_text(make(), top=2)
    assert "… and 6 more of at most 0.215" in text
    assert "desk" not in text
    assert "more of at most" not in table_text(make(), top=None)
    lengths = {name: torch.ones(one.shape[-1:] or (1,)) for name, one in make().items()}
    ranged = dataclasses.replace(make(lights_off=["lamp"]), extents=lengths)
    text = table_text(ranged, top=2)
    assert "… and 5 more of at most 0.090 and 1 ranked last" in text
    assert "lamp: off, and Glare is not linear in the light" in " ".join(text.split())
    assert "… and 1 ranked last; .ranking()" in table_text(ranged, top=len(ranged) - 1)


def test_many_channels_are_summarised() -> None:
    spectrum = {"spectrum": torch.tensor([0.1, -0.3, 0.2, 0.0]).repeat(4)}
    text = table_text(SceneAttribution(spectrum, None, 1.0))
    assert "16 numbers, −0.300 to +0.200" in text


def test_contributions_are_not_called_gradients() -> None:
    text = table_text(dataclasses.replace(make(), convergence_delta=0.00123))
    assert "contribution" in text
    assert "gradient" not in text.replace("VanillaSceneGradient", "")
    assert "convergence delta 0.0012" in text


def test_html_is_escaped_and_complete() -> None:
    text = table_html(make(metric="<b>", cautions={"rough": "a < b"}))
    assert "<script" not in text
    assert "&lt;script&gt;" in text
    assert "<b>&lt;b&gt; = 2.3369 ± 0.0005</b>" in text
    assert "a &lt; b" in text
    assert text.count("<tr>") == 1 + len(CASES)
    assert "0.0978 " in text


@pytest.mark.parametrize(("size", "is_said"), [(0.1, True), (100.0, False)])
def test_a_pose_in_the_noise_says_why_its_effect_is_0(size, is_said):
    moved = SceneAttribution(
        {"camera.translation": torch.full((3,), size)},
        {"camera.translation": torch.ones(3)},
        1.0,
        covariance={"camera.translation": torch.eye(3)},
        info={"metric": "Glare", "vectors": ["camera.translation"], "replicates": 8},
    )
    assert ("; 0: not above the noise" in " ".join(str(moved).split())) == is_said


def test_a_difference_and_a_sum_name_the_methods_and_samples_of_both_sides() -> None:
    first, second = make(), make(method="SmoothGradScene", spp=512)
    few = make(method="SmoothGradScene", spp=512, replicates=4)

    def header(attribution: SceneAttribution) -> str:
        return " ".join(table_text(attribution).partition("parameter")[0].split())

    both = "VanillaSceneGradient and SmoothGradScene · 64 and 512 spp in 8 replicates"
    assert both in header(first - second)
    assert both in header(first + second)
    assert both in header((first - second) - first)
    assert "64 spp in 8 replicates and 512 spp in 4 replicates" in header(first - few)
    assert "VanillaSceneGradient · 64 spp in 8 replicates" in header(first - make(seed=1))
    text = " ".join(all_text(plot_bars(first - second)).split())
    assert both in text


def test_a_number_that_rounds_to_zero_has_no_sign() -> None:
    assert [plain_number(value, "%") for value in (-0.04, -0.06, -0.0, -10.0)] == ["0.0", "−0.1", "0", "−10"]
    assert [minus(text) for text in ("-0.00", "-0", "-0.01", "-1e-05")] == ["0.00", "0", "−0.01", "−1e−05"]
