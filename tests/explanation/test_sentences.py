"""The sentences of an explanation, from numbers made by hand."""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace
from typing import Any

import pytest
import results
import torch
from seeds import shifted

from scenecaptum.attr import Change, Definition, Explanation, Row, Source
from scenecaptum.protocols import ResultKind

UGR = {
    "name": "unified glare rating",
    "symbol": "UGR",
    "unit": "",
    "better": "lower",
    "limits": [16.0, 19.0, 22.0],
    "source": "EN 12464-1",
}


def rated(value: float, error: float, **info: Any) -> Any:
    attribution = results.make(measure=UGR, verdict="within 19, the limit for offices", **info)
    return dataclasses.replace(attribution, metric_value=value, metric_standard_error=error)


def change(measured: float | None, error: float | None = 0.02, predicted: float = -0.7) -> Change:
    before, after = torch.tensor([0.62, 0.62, 0.62]), torch.tensor([0.72, 0.72, 0.72])
    return Change("wall", "wall_left: reflectance", before, after, predicted, 0.01, measured, error)


def lines(explanation: Explanation) -> dict[str, list[str]]:
    return dict(explanation.sections()[1:])


def test_the_verdict_names_its_source_and_a_limit_that_is_too_close():
    (clear, _), *_ = Explanation(rated(17.5, 0.1)).sections()
    assert clear.endswith("within 19, the limit for offices (EN 12464-1)")
    (close, _), *_ = Explanation(rated(18.9, 0.1)).sections()
    assert "too close to 19 to be sure" in close


def test_only_the_quoted_value_is_too_close_to_a_limit():
    """The relaxed value is near 19, and the value by the definition many errors from it."""
    far = Explanation(rated(19.05, 0.1), definition=Definition(20.0, "within 22", error=0.04))
    assert far.rating() == "within 22 (EN 12464-1)"
    near = Explanation(rated(20.0, 0.04), definition=Definition(19.05, "within 22", error=0.1))
    assert near.rating().endswith("too close to 19 to be sure")


def test_contributions_say_what_they_are_compared_with_and_whether_they_add_up():
    def notes(convergence: str) -> list[str]:
        info = {"convergence": convergence, "explained": 4.0, "compared_with": "wall 0.9"}
        found = dataclasses.replace(results.make(**info), convergence_delta=-0.1, convergence_delta_error=0.5)
        return next(iter(lines(Explanation(found)).values()))[-2:]

    delta = "inconclusive whether the effects add up: delta −0.1 ± 0.5 of 4.0, mostly noise: use more samples"
    assert notes("inconclusive") == [delta, "compared with: wall 0.9"]
    assert "add" not in notes("adds up")[0]
    assert notes("adds up")[1] == "compared with: wall 0.9"


def test_a_value_that_may_be_in_several_classes_has_its_range():
    wide = Explanation(rated(17.2, 0.04), definition=Definition(20.1, "within 22", error=2.5))
    assert wide.rating().endswith("too uncertain to be sure: 15.1 to 25.1 within two errors")


def test_the_error_of_a_rating_without_a_glare_source_is_explained():
    def notes(value: float, error: float, verdict: str = "no glare source found") -> list[str]:
        attribution = rated(value, error)
        return Explanation(
            dataclasses.replace(attribution, info={**attribution.info, "verdict": verdict})
        ).notes()

    note = "the error of 0.13 is noise: in single replicates a pixel is bright enough to count"
    assert notes(0.0, 0.13) == [note]
    assert notes(0.0, 0.0) == []
    assert notes(12.0, 0.13, "within 16") == []


def test_the_rating_of_a_picture_names_its_resolution():
    rating = rated(17.5, 0.1)
    assert Explanation(rating).headline() == "unified glare rating = 17.50 ± 0.10 at 6×4 pixels"
    of_points = dataclasses.replace(rating, surfaces=None)
    assert Explanation(of_points).headline() == "unified glare rating = 17.50 ± 0.10"
    assert "pixels" not in Explanation(results.make()).headline()  # no rating


def test_a_change_has_values_effects_and_errors():
    (line,) = lines(Explanation(rated(24.8, 0.05), changes=(change(-0.68),)))["What would change it"]
    assert line == (
        "wall_left reflectance 0.62 → 0.72: UGR 24.80 → 24.12 "
        "(−0.680 ± 0.020 rendered, −0.700 ± 0.010 predicted)"
    )


def test_a_change_that_is_not_linear_is_marked():
    assert change(-0.68).is_linear
    assert not change(-1.4).is_linear
    (line,) = lines(Explanation(rated(24.8, 0.05), changes=(change(-1.4),)))["What would change it"]
    assert line.endswith("predicted, not linear)")


@pytest.mark.parametrize("replicates", [4, 8])
def test_a_linear_change_is_hardly_ever_called_not_linear(replicates: int):
    """Beyond two of their standard errors are 1 in 12 means of 8 replicates, and 1 in 7 of 4."""
    draws = torch.randn(2000, replicates, generator=torch.Generator().manual_seed(shifted(0)))
    means, errors = 1.4 + draws.mean(1), draws.std(1) / replicates**0.5
    changes = [
        dataclasses.replace(change(mean, error, predicted=1.4), degrees_of_freedom=replicates - 1)
        for mean, error in zip(means.tolist(), errors.tolist(), strict=True)
    ]
    assert sum(not one.is_linear for one in changes) < 30  # 6 are expected, and 300 without Student's t


def test_a_change_that_is_off_because_of_its_derivative_says_so():
    biased = rated(24.8, 0.05, cautions={"wall": "its derivative is biased"})
    (line,) = lines(Explanation(biased, changes=(change(-1.4),)))["What would change it"]
    assert line.endswith("predicted, derivative known to be biased)")
    (line,) = lines(Explanation(biased, changes=(change(-0.68),)))["What would change it"]
    assert line.endswith("predicted)")


def test_a_clear_change_of_the_other_sign_says_so_even_if_the_prediction_is_too_noisy_to_contradict_it():
    wrong = dataclasses.replace(
        change(0.05, 0.006, predicted=-0.26), predicted_error=0.1, degrees_of_freedom=7
    )
    assert wrong.is_linear
    assert wrong.is_clear
    (line,) = lines(Explanation(rated(17.0, 0.05), changes=(wrong,)))["What would change it"]
    assert line.endswith("predicted, with the other sign)")


def test_a_change_within_its_noise_is_not_said_but_named_as_unknown():
    said = lines(Explanation(rated(24.8, 0.05), changes=(change(-0.03),)))
    assert "What would change it" not in said
    assert any("within its noise" in line for line in said["Too noisy to say"])
    unclear = dataclasses.replace(change(-8.0, 4.0), exact=17.6, exact_error=1.4)
    both = Explanation(
        rated(20.06, 0.06), changes=(unclear,), definition=Definition(20.0, "within 22", error=0.4)
    )
    assert lines(both)["Too noisy to say"][0].endswith(
        "UGR 20 → 18, by −2.4 ± 1.4 (relaxed: −8 ± 4 rendered, −0.700 ± 0.010 predicted): within its noise"
    )


def test_effects_and_shares_within_their_noise_are_not_said():
    sources = (Source("window", "top", 0.8, 0.01, 3000.0), Source("lamp", "left", 0.03, 0.02, 5000.0))
    said = lines(Explanation(rated(24.8, 0.05), sources=sources, count=20))
    assert said["Where the glare comes from"] == [
        "window, top: 80.0 ± 1.0 % of it, at 3000 cd/m²",
        "the rest: 20.0 %",
    ]
    (effects,) = (value for heading, value in said.items() if heading.startswith("What it depends on"))
    assert not any(line.startswith(("noisy", results.NASTY)) for line in effects)
    assert any(line.startswith("desk roughness: −0.0978 ± 0.0008") for line in effects)


def shares_of(*shares: tuple[str, float, float]) -> list[str]:
    sources = tuple(Source(name, "left", share, error, 237.0) for name, share, error in shares)
    return lines(Explanation(rated(24.8, 0.05), sources=sources)).get("Where the glare comes from", [])


def test_no_share_that_is_larger_than_one_that_is_named_is_part_of_the_rest():
    found = shares_of(
        ("sky", 0.36, 0.2), ("white", 0.35, 0.21), ("ceramic", 0.1, 0.04), ("floor", 0.08, 0.05)
    )
    assert found == [
        "sky, left: 36 ± 20 % of it, at 237 cd/m² (uncertain)",
        "white, left: 35 ± 21 % of it, at 237 cd/m² (uncertain)",
        "ceramic, left: 10 ± 4 % of it, at 237 cd/m²",
        "the rest: 19.0 %",
    ]


@pytest.mark.parametrize(
    ("measured", "missing", "said"),
    [
        (-7.6, 6.4, "; corrected for the edges of lamps, by about −1.2"),
        (-1.5, -2.0, "; corrected for the edges of lamps, by about −3.5"),
        (-0.01, -24.0, ": within its noise; corrected for the edges of lamps, by about −24"),
        (-7.6, 0.5, ""),  # a small part of the change
        (-0.2, 0.03, ""),  # within its noise
    ],
)
def test_a_change_of_a_rating_is_also_stated_with_what_lamps_lack(measured: float, missing: float, said: str):
    one = dataclasses.replace(change(measured, 0.05), missing=missing)
    sections = lines(Explanation(rated(19.3, 0.5), changes=(one,))).values()
    text = " ".join(line for section in sections for line in section)
    assert ("for the edges of lamps" in text) == bool(said)
    assert said in text


def test_the_largest_shares_are_named_where_none_is_clear():
    shares = [("sky", 0.4, 0.3), ("a", 0.2, 0.15), ("b", 0.15, 0.1), ("c", 0.1, 0.06)]
    *named, rest = shares_of(*shares)
    assert [line.split(",")[0] for line in named] == ["sky", "a", "b"]
    assert all(line.endswith("(uncertain)") for line in named)
    assert rest == "the rest: 25.0 %"


def test_what_the_picture_lacks_is_said_below_the_shares():
    sources = (Source("panel", "top", 0.99, 0.01, 2300.0),)
    lacking = ("the reflection of spot_l", "the reflection of spot_r")
    found = lines(Explanation(rated(7.0, 3.5), sources=sources, not_in_sources=lacking))
    *_, last = found["Where the glare comes from"]
    assert last.startswith(
        "the picture lacks light of the reflection of spot_l, the reflection of spot_r: few"
    )


def test_the_shares_of_other_metrics_say_of_what_they_are():
    said = lines(Explanation(rated(24.8, 0.05), sources=(Source("wall", "centre", 0.28, 0.01),)))
    heading = "What it sees in the picture: shares of the sum of |gradient × value| over the pixels"
    assert said[heading] == ["wall, centre: 28.0 ± 1.0 %", "the rest: 72.0 %"]


def test_the_sources_of_a_relaxed_rating_are_said_to_be_its_own():
    sources = (Source("ground", "bottom", 0.8, 0.01, 1800.0),)
    stated = Explanation(rated(24.8, 0.05), sources=sources, definition=Definition(24.6, ""))
    assert "Where the glare comes from: shares of the relaxed rating" in lines(stated)


def of_range(**inputs: tuple[torch.Tensor, torch.Tensor]) -> Any:
    """Return an attribution with a gradient and a value for each input, over ranges of length 1."""
    gradients = {name.replace("_", "."): gradient for name, (gradient, _) in inputs.items()}
    channels = {name: 1 if one.ndim == 0 else one.shape[-1] for name, one in gradients.items()}
    return dataclasses.replace(
        results.make(),
        attributions=gradients,
        parameter_values={name.replace("_", "."): value for name, (_, value) in inputs.items()},
        extents={name: torch.ones(count) for name, count in channels.items()},
        covariance={name: 1e-6 * torch.eye(count) for name, count in channels.items()},
        standard_error={name: torch.full_like(one, 1e-3) for name, one in gradients.items()},
        labels={},
    )


def effects_of(explanation: Explanation) -> list[str]:
    (effects,) = (
        value for heading, value in lines(explanation).items() if heading.startswith("What it depends")
    )
    return effects


def test_effects_over_a_range_that_may_be_far_off_are_marked_as_in_the_table():
    metal = (torch.tensor(-2.0), torch.tensor(0.02))
    found = of_range(metal_alpha=metal, floor=(torch.tensor(1.0), torch.tensor(0.5)))
    first, second, note = effects_of(Explanation(found))
    assert first == "metal.alpha: −2.0000 ± 0.0010 ~"
    assert second == "floor: +1.0000 ± 0.0010"
    assert note.startswith("~ metal.alpha: a small roughness often acts most near 0")
    assert "metal.alpha ~" in str(found)
    rough = (torch.tensor(-2.0), torch.tensor(0.4))
    assert "~" not in " ".join(effects_of(Explanation(of_range(metal_alpha=rough))))


def test_a_move_that_is_mostly_vertical_says_so():
    def said(up: int | None, *direction: float) -> str:
        found = of_range(desk_pose_translation=(torch.tensor(direction), torch.zeros(3)))
        info = {**found.info, "vectors": ["desk.pose.translation"], "up": up}
        (line,) = effects_of(Explanation(dataclasses.replace(found, info=info)))
        return line

    assert said(2, 0.0, -0.1, -1.0).endswith(" towards (0.0, −0.1, −1.0), down")
    assert said(1, 0.0, 1.0, 0.2).endswith(" towards (0.0, 1.0, 0.2), up")
    assert said(2, 0.9, 0.0, -0.4).endswith(" towards (0.9, 0.0, −0.4)")
    assert said(None, 0.0, 0.0, -1.0).endswith(" towards (0.0, 0.0, −1.0)")


def test_a_move_into_the_floor_says_that_the_change_is_along_it():
    def said(*direction: float, name: str = "desk.pose.translation") -> list[str]:
        found = of_range(desk_pose_translation=(torch.tensor(direction), torch.zeros(3)))
        info = {**found.info, "vectors": ["desk.pose.translation"], "up": 2}
        found = dataclasses.replace(found, info=info)
        move = Change(name, "desk: translation", torch.zeros(3), torch.tensor([0.5, 0.0, 0.0]), 0.1, 0.01)
        return effects_of(Explanation(found, changes=(move,)))[1:]

    assert said(0.1, 0.0, -1.0) == ["desk.pose.translation: the change below is along the floor, not down"]
    assert said(1.0, 0.0, -0.1) == []
    assert said(0.1, 0.0, -1.0, name="lamp.pose.translation") == []


def test_a_note_is_on_effects_that_are_stated():
    found = of_range(
        floor=(torch.tensor(3.0), torch.tensor(0.5)), metal_alpha=(torch.tensor(-2.0), torch.tensor(0.02))
    )
    assert effects_of(Explanation(found, count=1)) == ["floor: +3.0000 ± 0.0010"]


def test_a_map_of_light_has_a_note_and_its_change_is_a_factor():
    texels = torch.arange(1.0, 19.0).reshape(2, 3, 3)
    found = of_range(sky_data=(torch.ones(2, 3, 3), texels), sky_scale=(torch.tensor(5.0), torch.tensor(1.0)))
    data, scale, note = effects_of(Explanation(found))
    assert (data.startswith("sky.data: "), data.endswith(" ~"), scale.endswith("~")) == (True, True, False)
    assert note == "~ sky.data: for the same amount added to every texel; sky.scale: for all of its light"
    brighter = Change("sky.data", "sky: map", texels, 1.25 * texels, 76.0, 1.0, 75.7, 1.0)
    (line,) = lines(Explanation(found, changes=(brighter,)))["What would change it"]
    assert line.startswith("sky map × 1.25: ")
    shifted_texels = dataclasses.replace(brighter, after=texels + 0.1)
    (line,) = lines(Explanation(found, changes=(shifted_texels,)))["What would change it"]
    assert " → " in line.partition(": ")[0]


def test_samples_are_advised_up_to_a_hundred_times_as_many():
    def advice(error: float) -> str:
        attribution = rated(24.8, 0.05)
        covariance = {**attribution.covariance, "noisy": torch.full((1, 1), error**2)}
        errors = {**attribution.standard_error, "noisy": torch.tensor(error)}
        noisy = dataclasses.replace(attribution, covariance=covariance, standard_error=errors)
        (line,) = lines(Explanation(noisy))["Too noisy to say"]
        return line

    assert "times the samples would tell" in advice(0.1)
    assert advice(20.0).endswith(
        "within two errors; this cannot be resolved with a reasonable number of samples"
    )


def test_of_many_effects_none_is_stated_because_one_is_beyond_two_errors_by_chance():
    def stated(z: float, count: int) -> bool:
        inputs = {f"a_{index}": (torch.tensor(1e-3 * z), torch.tensor(0.5)) for index in range(count)}
        said = lines(Explanation(of_range(**inputs)))
        assert any(heading.startswith("What it depends") for heading in said) != ("Too noisy to say" in said)
        return "Too noisy to say" not in said

    # Student's t of 7 degrees of freedom: 2.36 at 5 %, and 4.59 at 5 % / 20.
    assert stated(2.4, 1)
    assert not stated(2.3, 1)
    assert stated(4.6, 20)
    assert not stated(4.4, 20)


def test_of_one_parameter_it_says_whether_it_matters_and_why_its_derivative_is_wrong():
    noisy = of_range(wall=(torch.tensor(2e-3), torch.tensor(0.5)))
    wrong = dataclasses.replace(noisy, info={**noisy.info, "cautions": {"wall": "biased here"}})
    said = dict(Explanation(wrong).sections())["Too noisy to say"]
    assert said[0].startswith("whether wall matters: its effect of")
    assert said[1:] == ["! biased here"]
    assert dict(Explanation(noisy).sections())["Too noisy to say"] == said[:1]


def test_where_no_effect_can_be_ranked_the_changes_that_are_clear_as_rendered_are_named():
    noisy = of_range(**{f"wall_{index}": (torch.tensor(3e-3), torch.tensor(0.5)) for index in range(30)})
    unranked = "which of 30 parameters matter most: no effect is clear enough to rank"

    def said(*changes: Change) -> list[str]:
        return lines(Explanation(noisy, changes=changes))["Too noisy to say"]

    assert said() == [f"{unranked}; use more samples"]
    assert said(change(None)) == said()
    within_noise, *others = said(change(-0.03))
    assert ("within its noise" in within_noise, others) == (True, said())
    assert said(change(-0.68)) == [
        f"{unranked}, but rendered changes are clear: wall_left reflectance (−0.680 ± 0.020); use more samples"
    ]


def test_where_no_effect_can_be_ranked_a_light_that_is_off_and_left_out_is_named():
    noisy = of_range(**{name: (torch.tensor(3e-3), torch.tensor(0.5)) for name in ("wall", "floor", "lamp")})
    off = dataclasses.replace(noisy, info={**noisy.info, "lights_off": ["lamp"]})
    first, light = lines(Explanation(off))["Too noisy to say"]
    assert first.startswith("which of 2 parameters matter most")
    assert light.startswith("lamp: off, and ")
    assert "so ranked last" in light
    (alone,) = lines(Explanation(noisy))["Too noisy to say"]
    assert alone.startswith("which of 3 parameters matter most")


def test_an_effect_that_may_be_chance_is_named_if_it_is_larger_than_one_that_is_stated():
    inputs = {f"a_{index}": (torch.tensor(0.01), torch.tensor(0.5)) for index in range(20)}
    found = of_range(**inputs, other=(torch.tensor(0.04), torch.tensor(0.5)))
    errors = {"other": torch.full((1, 1), 0.02**2)}
    found = dataclasses.replace(found, covariance={**found.covariance, **errors})
    (line,) = lines(Explanation(found))["Too noisy to say"]
    assert line == "other (+0.040 ± 0.020) may have an effect of 0.01 or more within two errors; " + (
        "86 times the samples would tell"  # twice Student's t at 5 % / 21, 4.64, squared
    )
    assert effects_of(Explanation(found))[0] == (
        "which effect is largest is uncertain: other (+0.040 ± 0.020) may exceed those below"
    )


def with_errors(effects: dict[str, tuple[float, float]]) -> Any:
    """Return an attribution of effects with standard errors."""
    found = of_range(
        **{name: (torch.tensor(value), torch.tensor(0.5)) for name, (value, _) in effects.items()}
    )
    covariance = {name: torch.full((1, 1), error**2) for name, (_, error) in effects.items()}
    return dataclasses.replace(found, covariance={**found.covariance, **covariance})


def test_a_squared_gradient_has_no_sign_and_the_square_of_the_unit():
    found = with_errors({"lamp": (37.3, 1.7), "wall": (20.0, 1.0), "floor": (0.02, 40.0)})
    labels = {"lamp": "lamp: radiance", "wall": "wall: reflectance", "floor": "floor: reflectance"}
    found = dataclasses.replace(found, labels=labels, extents={**found.extents, "lamp": torch.tensor([4.0])})

    def said(**info: Any) -> Explanation:
        of_unit = {**found.info, "measure": {"name": "luminance", "unit": "cd/m²"}, **info}
        return Explanation(dataclasses.replace(found, info=of_unit))

    squared = said(quantity=ResultKind.MEAN_SQUARED_GRADIENT.value)
    lamp, wall, larger, note = effects_of(squared)
    assert larger == "also uncertain: floor reflectance (0 ± 40) may exceed those above"
    assert (lamp, wall) == ("lamp radiance: 37.3 ± 1.7 (cd/m²)²", "wall reflectance: 20.0 ± 1.0 (cd/m²)²")
    assert note == "per unit: compare parameters of one kind only"
    (hiding,) = lines(squared)["Too noisy to say"]
    assert hiding.startswith("floor reflectance (0 ± 40) may have an effect of 20 (cd/m²)² or more")
    assert "+" not in squared.text()
    plain = effects_of(said())
    assert "lamp radiance: +149 ± 7 cd/m²" in plain
    assert note not in plain


def test_a_large_effect_with_a_clear_sign_is_stated_beside_a_small_one_that_is_exact():
    """Also where noise alone would reach as many errors at one of so many parameters."""
    small = {f"noise{index}": (1e-5, 1e-3) for index in range(60)}
    found = with_errors({"sun": (0.056, 0.030), "floor": (-0.034, 0.007), "metal": (-0.002, 0.0003), **small})
    first, floor, metal = effects_of(Explanation(found))
    assert first == "which effect is largest is uncertain: sun (+0.056 ± 0.030) may exceed those below"
    assert floor == "floor: −0.034 ± 0.007 (sign clear, size uncertain)"
    assert metal == "metal: −0.00200 ± 0.00030"


def test_a_clear_sign_is_named_between_larger_and_smaller_effects():
    """Not clear of the noise of so many parameters, but far above the least of those that are."""
    small = {f"noise{index}": (1e-5, 1e-3) for index in range(60)}
    found = with_errors(
        {"floor": (120.0, 9.0), "cube": (39.0, 12.0), "pane": (-11.0, 4.0), "flat": (1.9, 0.1), **small}
    )
    floor, flat, between = effects_of(Explanation(found))
    assert (floor, flat) == ("floor: +120 ± 9", "flat: +1.90 ± 0.10")
    assert between == "larger than the last of these, but uncertain: cube (+39 ± 12), pane (−11 ± 4)"
    assert len(effects_of(Explanation(found, count=1))) == 1


def test_only_an_effect_that_is_larger_by_its_value_is_called_the_largest_one():
    inputs = {"pane": (110.0, 20.0), "ceiling": (60.0, 29.0), "ground": (54.0, 20.0), "cloth": (-28.0, 9.0)}
    found = with_errors(inputs | {"wall": (5.0, 8.0)})
    assert effects_of(Explanation(found)) == [
        "pane: +110 ± 20",
        "also uncertain: ceiling (+60 ± 29) may exceed those above",
    ]
    hiding, ranks = lines(Explanation(found))["Too noisy to say"]
    assert hiding.startswith("ceiling (+60 ± 29) may have an effect of 110 or more within two errors; ")
    assert ranks == "how the others rank; clear in sign: ground (+54 ± 20), cloth (−28 ± 9)"
    # The reader asked for one, and got it.
    assert lines(Explanation(found, count=1))["Too noisy to say"] == [hiding]
    # The one that is named is the largest one, not the one with the largest error.
    larger = with_errors(inputs | {"lamp": (130.0, 70.0), "wall": (5.0, 150.0)})
    assert effects_of(Explanation(larger))[0] == (
        "which effect is largest is uncertain: lamp (+130 ± 70) and 2 others may exceed those below"
    )


def test_an_effect_whose_error_is_unreliable_is_not_called_clear_in_sign():
    inputs = {"pane": (110.0, 20.0), "ground": (54.0, 20.0), "cloth": (-28.0, 9.0), "wall": (5.0, 8.0)}
    found = with_errors(inputs)
    counts = {**dict.fromkeys(inputs, 1000), "ground": 3}
    few = dataclasses.replace(found, info={**found.info, "effective_samples": counts})
    *_, both = lines(Explanation(found))["Too noisy to say"]
    *_, trusted = lines(Explanation(few))["Too noisy to say"]
    assert both == "how the others rank; clear in sign: ground (+54 ± 20), cloth (−28 ± 9)"
    assert trusted == "how the others rank; clear in sign: cloth (−28 ± 9)"


@pytest.mark.parametrize("light", ["pane", "cloth"])
def test_a_light_that_is_named_has_the_note_of_its_effect_once(light):
    """Whether its effect is stated, or only its sign."""
    inputs = {"pane": (110.0, 20.0), "ground": (54.0, 20.0), "cloth": (-28.0, 9.0), "wall": (5.0, 8.0)}
    found = with_errors(inputs)
    lit = dataclasses.replace(found, info={**found.info, "lights_on": [light]})
    note = "effects of lights are to first order"
    assert str(Explanation(found)).count(note) == 0
    assert str(Explanation(lit)).count(note) == 1


def test_the_effect_of_a_pose_is_above_the_noise_and_has_no_sign():
    """It is the largest in any direction."""
    inputs = {"pane": (110.0, 20.0), "table.pose.rotation": (54.0, 20.0), "cloth": (-28.0, 9.0)}
    *_, ranks = lines(Explanation(with_errors(inputs)))["Too noisy to say"]
    assert ranks == "how the others rank; above the noise: table.pose.rotation (+54 ± 20), cloth (−28 ± 9)"


def test_an_effect_that_a_render_confirms_is_no_noise():
    found = with_errors({"wall": (-3.0, 1.4), "lamp": (0.1, 0.01)})

    def said(measured: float) -> tuple[list[str], bool]:
        explanation = Explanation(found, changes=(change(measured),))
        return effects_of(explanation), "wall" in " ".join(lines(explanation).get("Too noisy to say", []))

    (wall, lamp), is_noise = said(-0.68)
    assert wall == "wall: −3.0 ± 1.4 (sign clear, size uncertain)"
    assert (lamp, is_noise) == ("lamp: +0.100 ± 0.010", False)
    effects, is_noise = said(0.68)  # the sign of the effect is wrong
    assert (effects, is_noise) == (["lamp: +0.100 ± 0.010"], False)
    effects, is_noise = said(-0.03)
    assert (effects[1:], is_noise) == (["lamp: +0.100 ± 0.010"], True)
    assert effects[0].startswith("which effect is largest is uncertain: wall (−3.0 ± 1.4)")


def test_an_effect_whose_error_is_untrusted_has_the_mark_of_the_table():
    found = with_errors({"metal": (2.0, 0.1), "floor": (1.0, 0.1)})
    few = dataclasses.replace(found, info={**found.info, "effective_samples": {"metal": 3, "floor": 1000}})
    metal, floor, note = effects_of(Explanation(few))
    assert (metal, floor) == ("metal: +2.00 ± 0.10 ?", "floor: +1.00 ± 0.10")
    reason = "too few samples contribute to the variance for a reliable error: the light is rare"
    assert note == f"? {reason}; effects other than these may miss such light, too"
    both = dataclasses.replace(found, info={**found.info, "effective_samples": {"metal": 3, "floor": 3}})
    # No row has the mark where all would have it.
    assert effects_of(Explanation(both))[-1] == f"all parameters: {reason}"
    assert "?" not in Explanation(both).text()
    assert effects_of(Explanation(few, count=1)) == [metal, note]


@pytest.mark.parametrize(("count", "effect"), [(3, 2.0), (0, 0.0)])
def test_a_doubt_reads_well_after_one_name_and_after_all(count: int, effect: float):
    found = with_errors({"metal": (effect, 0.1), "floor": (effect, 0.1)})
    reasons = []
    for doubted in (["metal"], ["metal", "floor"]):
        counts = {"metal": 1000, "floor": 1000} | dict.fromkeys(doubted, count)
        one = dataclasses.replace(found, info={**found.info, "effective_samples": counts})
        [reason] = set(one.untrusted_errors().values())
        assert reason in " ".join(str(one).split())
        reasons.append(reason)
    assert reasons[0] == f"{reasons[1]}; effects other than these may miss such light, too"
    assert not {"it", "its", "they", "their", "them"} & {*re.findall(r"\w+", reasons[0])}, reasons[0]


def test_an_effect_whose_derivative_is_known_to_be_wrong_has_the_mark_of_the_table():
    found = with_errors({"metal": (2.0, 0.1), "floor": (1.0, 0.1), "wall": (0.5, 0.1)})
    counts = {"metal": 3, "floor": 1000, "wall": 1000}

    def said(count: int, **cautions: str) -> list[str]:
        info = {**found.info, "cautions": cautions, "effective_samples": counts}
        return effects_of(Explanation(dataclasses.replace(found, info=info), count=count))

    metal, floor, wall, caution, doubt = said(3, metal="it is biased", wall="it is biased")
    assert metal == "metal: +2.00 ± 0.10 !?"
    assert (floor, wall) == ("floor: +1.00 ± 0.10", "wall: +0.50 ± 0.10 !")
    assert (caution, doubt[:2]) == ("! it is biased", "? ")
    assert said(2, wall="it is biased")[:2] == ["metal: +2.00 ± 0.10 ?", floor]
    assert not any("!" in line for line in said(2, wall="it is biased")), "the wall is not stated"
    several = said(3, floor="its size is off", wall="it is biased")
    assert [line[-2:] for line in several[:3]] == [" ?", "!1", "!2"]
    assert several[3:5] == ["!1 its size is off", "!2 it is biased"]


def test_the_largest_of_several_unclear_effects_are_named_with_the_samples_that_would_tell():
    """Also where another one has an error that no number of samples brings down."""
    errors = {"pane": 0.6, "door": 0.4, "cloth": 0.01, "sky": 90.0, "desk": 0.2, "book": 0.08}
    effects = {"pane": 1.2, "door": -0.8, "cloth": 0.1, "sky": 0.05, "desk": 0.4, "book": 0.15}
    found = of_range(**{name: (torch.tensor(value), torch.tensor(0.5)) for name, value in effects.items()})
    covariance = {name: torch.full((1, 1), error**2) for name, error in errors.items()}
    found = dataclasses.replace(found, covariance={**found.covariance, **covariance})
    (line,) = lines(Explanation(found))["Too noisy to say"]
    assert line == (
        "5 parameters may have an effect of 0.1 or more within two errors; the largest: pane (+1.2 ± 0.6), "
        "door (−0.8 ± 0.4), desk (+0.40 ± 0.20); 4 times the samples would tell of pane"
    )


def test_every_effect_that_two_errors_take_above_the_smallest_one_is_counted():
    """By its value or by its error alone, none of sky, pot and rug would be."""
    unclear = {"chair": (-1.1, 0.4), "sky": (0.6, 0.24), "pot": (0.56, 0.18), "rug": (0.4, 0.3)}
    found = with_errors({"screen": (4.6, 0.6), "picture": (0.71, 0.02), **unclear, "book": (0.2, 0.2)})
    (hiding,) = lines(Explanation(found))["Too noisy to say"]
    named = "chair (−1.1 ± 0.4), sky (+0.60 ± 0.24), pot (+0.56 ± 0.18)"
    assert hiding.startswith(
        f"4 parameters may have an effect of 0.71 or more within two errors; the largest: {named}; "
    )


def test_a_rough_gradient_is_smoothed_where_more_samples_would_not_help():
    network = {"gradient_note": "rough", "advice": "smooth it"}
    many = of_range(**{f"wall_{index}": (torch.tensor(3e-3), torch.tensor(0.5)) for index in range(30)})
    two = with_errors({"pane": (110.0, 20.0), "ceiling": (60.0, 29.0)})

    def remedy(found: Any, **info: Any) -> str:
        of_metric = dataclasses.replace(found, info={**found.info, **info})
        (line,) = lines(Explanation(of_metric))["Too noisy to say"]
        return line.rpartition("; ")[2]

    assert (remedy(many), remedy(many, **network)) == ("use more samples", "smooth it")
    assert "times the samples would tell" in remedy(two)
    assert remedy(two, **network) == "smooth it"
    # An ablation has no gradient.
    assert remedy(many, **network, quantity=ResultKind.ABLATION.value) == "use more samples"
    # What is advised of a function, which may contain a network or not, does not replace the number.
    assert "times the samples would tell" in remedy(two, advice="use more samples")


def test_markdown_has_the_same_sentences():
    explanation = Explanation(rated(24.8, 0.05), changes=(change(-0.68),))
    markdown = explanation.markdown()
    for heading, sentences in explanation.sections()[1:]:
        assert f"### {heading}" in markdown
        assert all(f"- {sentence}" in markdown for sentence in sentences)


def test_the_rating_of_a_changed_scene_is_not_negative():
    (line,) = lines(Explanation(rated(1.0, 0.05), changes=(change(-3.4),)))["What would change it"]
    assert "→ 0" in line
    assert "→ −" not in line


def test_lines_of_text_do_not_break_inside_a_number():
    text = Explanation(rated(24.8, 0.05), changes=(change(-0.68),)).text(width=60)
    assert all(len(line) <= 60 for line in text.splitlines())
    assert not any(line.rstrip().endswith("±") or line.lstrip().startswith("±") for line in text.splitlines())


def test_the_note_on_a_goal_stands_below_its_line():
    moved = SimpleNamespace(
        name="sky", label="sky: radiance", before=torch.zeros(3), after=torch.ones(3), extent="switched on"
    )
    goal = SimpleNamespace(
        moved=(moved,), outcome="UGR 25 → 18, below 19", note="rate it again", reached=True, was_below=False
    )
    said = lines(Explanation(rated(24.8, 0.05), goal=goal))["What reaches the goal"]
    assert said == [
        "sky radiance 0 → 1, switched on",
        "UGR 25 → 18, below 19, in other renders",
        "rate it again",
    ]


def test_of_a_search_that_found_nothing_the_start_is_stated():
    outcome = "UGR 25, not below 19; the search found no lower value"
    goal = SimpleNamespace(moved=(), outcome=outcome, note="", reached=False, was_below=False)
    said = lines(Explanation(rated(24.8, 0.05), goal=goal))["What was tried to reach the goal"]
    assert said == [outcome]


def test_without_error_bars_it_says_so():
    attribution = results.make(barred=False)
    assert any("no error bars" in line for line in lines(Explanation(attribution))["Too noisy to say"])


def test_effects_that_are_all_exactly_zero_are_not_too_noisy():
    """Such as those on a share of points that is 0 or 100 %."""
    attribution = results.make(barred=False)
    zero = {name: torch.zeros_like(value) for name, value in attribution.attributions.items()}
    said = lines(Explanation(dataclasses.replace(attribution, attributions=zero, replicates={})))
    assert "Too noisy to say" not in said


SDA = {
    "name": "spatial daylight autonomy",
    "symbol": "sDA",
    "unit": "%",
    "better": "higher",
    "limits": [55.0],
    "definition": "share of the points with at least 300 lx",
}


def of_daylight(value: float, error: float, **parts: Any) -> Explanation:
    attribution = results.make(measure=SDA, verdict="at least 55 %", picture={"caution": "no blinds"})
    attribution = dataclasses.replace(
        attribution, metric_value=value, metric_standard_error=error, surfaces=None
    )
    return Explanation(attribution, **parts)


def test_the_exact_value_is_to_be_quoted_and_cautions_stand_first():
    exact = Definition(47.0, "below 55 %, the limit", points=50)
    (headline, notes), *_ = of_daylight(56.8, 0.5, definition=exact, premises=("weather: Oslo",)).sections()
    # 55 lies between the two.
    assert headline == ("spatial daylight autonomy = 47 %: below 55 %, the limit; too close to 55 to be sure")
    assert notes == [
        "caution: no blinds",
        "sDA: share of the points with at least 300 lx",
        "quote 47 %, the value by the definition (in steps of 2 %, one point); the relaxed value "
        "56.8 ± 0.5 % only serves the derivatives",
        "weather: Oslo",
    ]
    share_of_hours = of_daylight(56.8, 0.5, definition=Definition(47.0, ""))
    assert not any("steps of" in note for note in share_of_hours.notes())
    assert not any(note.startswith("quote") for note in of_daylight(56.8, 0.5).notes())


def test_no_value_is_to_be_quoted_of_a_picture_that_is_too_noisy():
    noisy = dataclasses.replace(
        rated(9.4, 2.1),
        info=rated(9.4, 2.1).info
        | {"picture": {"caution": "the picture is too noisy for the relaxed value"}},
    )
    note = Explanation(noisy, definition=Definition(7.7, "", error=0.5)).notes()[-1]
    assert note == (
        "7.7 ± 0.5 is the value by the definition; the relaxed value 9.4 ± 2.1 only serves the derivatives"
    )


def test_a_value_by_the_definition_has_an_error_and_its_class_may_be_in_doubt():
    near = of_daylight(59.6, 0.6, definition=Definition(58.7, "at least 55 %", 63, error=2.0))
    assert near.headline() == "spatial daylight autonomy = 58.7 ± 2.0 %"
    assert near.rating().endswith("too close to 55 to be sure")
    clear = of_daylight(59.6, 0.6, definition=Definition(58.7, "at least 55 %", 63, error=1.6))
    assert clear.rating() == "at least 55 %"
    assert any(note.startswith("quote 58.7 ± 1.6 %, the value by the definition") for note in clear.notes())
    assert of_daylight(59.6, 0.6, definition=Definition(60.0, "", 63)).value() == "60"


def test_a_share_that_is_the_same_in_all_replicates_is_not_exact_and_few_points_have_an_advice():
    few = of_daylight(75.0, 0.1, definition=Definition(75.0, "preferred", 4, error=0.0))
    assert few.headline() == "spatial daylight autonomy = 75 % ± less than one point (25 %)"
    assert few.value() == "75"
    assert few.notes()[-1] == (
        "quote 75 %, the value by the definition (in steps of 25 %, one point); the relaxed value "
        "75.00 ± 0.10 % only serves the derivatives; choose a finer spacing"
    )
    hours = of_daylight(75.0, 0.1, definition=Definition(75.0, "", error=0.0))
    assert hours.headline() == "spatial daylight autonomy = 75 ± 0 %"
    ratio = of_daylight(57.0, 0.1, definition=Definition(57.1, "", error=0.0, step=3.17))
    assert ratio.headline() == "spatial daylight autonomy = 57.1 % ± less than one point (3.2 %)"
    enough = of_daylight(75.0, 0.0, definition=Definition(75.0, "preferred", 20, error=0.0))
    assert "in steps of 5 %, one point)" in enough.notes()[-1]


def test_a_saturated_share_with_no_clear_effect_says_so():
    def said(value: float, z: float, better: str = "higher", **parts: float) -> dict[str, list[str]]:
        noisy = of_range(lamp=(torch.tensor(1e-3 * z), torch.tensor(0.5)))
        noisy = dataclasses.replace(noisy, info={**noisy.info, "measure": {**SDA, "better": better}})
        return lines(Explanation(noisy, definition=Definition(value, "", points=20, error=0.0, **parts)))

    (found,) = said(100.0, 2.0).values()
    assert found == ["every point passes: nothing limits it"]
    assert list(said(0.0, 2.0).values()) == [["no point passes"]]
    assert list(said(0.0, 2.0, "lower").values()) == [["no point counts"]]
    assert list(said(95.0, 2.0)) == ["Too noisy to say"]
    assert list(said(100 / 0.95, 2.0, greatest=100 / 0.95).values()) == [found]
    assert list(said(100.0, 2.0, greatest=100 / 0.95)) == ["Too noisy to say"]
    (clear,) = said(100.0, 9.0).values()
    assert clear == ["lamp: +0.0090 ± 0.0010 percentage points"]


@pytest.mark.parametrize(
    ("exact", "missing", "is_far"),
    [(16.3, 0.0, True), (11.6, 0.0, False), (11.6, 6.8, True), (11.6, 0.2, False)],
)
def test_a_relaxed_change_far_from_the_exact_one_is_no_guide(exact: float, missing: float, is_far: bool):
    """Also where it is far from the exact one without the edges of lamps."""
    dimmed = dataclasses.replace(
        change(-9.5, 0.4, predicted=-2.5), exact=exact, exact_error=0.3, missing=missing
    )
    parts = {"definition": Definition(19.6, "within 22", error=0.2), "changes": (dimmed,)}
    legend, *_ = lines(Explanation(rated(19.8, 0.1), **parts))["What would change it"]
    assert ("neither says much" in legend) == is_far
    assert ("compare changes by it" in legend) != is_far


@pytest.mark.parametrize(("relative", "is_other"), [(-0.8, True), (-4.4, False), (None, False)])
def test_a_change_by_the_threshold_is_also_stated_with_another(relative: float | None, is_other: bool):
    """The definition and the relaxed rating fall alike."""
    dimmed = dataclasses.replace(
        change(-3.1, 0.04, predicted=-1.9), exact=13.4, exact_error=0.12, relative=relative
    )
    parts = {"definition": Definition(18.0, "within 19", error=0.2), "changes": (dimmed,)}
    legend, line = lines(Explanation(rated(18.3, 0.1), **parts))["What would change it"]
    assert ("neither says much" in legend) == is_other
    assert line.endswith("; with a threshold of 5 times the mean luminance, by about −0.8") == is_other


def test_a_change_has_exact_values_before_and_after_with_its_relaxed_effects():
    raised = dataclasses.replace(change(2.0, 0.1, predicted=2.1), exact=47.0 + 100 / 63)
    said = lines(of_daylight(46.0, 0.5, definition=Definition(47.0, "", points=63), changes=(raised,)))
    legend, line = said["What would change it"]
    assert legend == (
        "sDA by the definition, before → after, jumps by whole points; the relaxed change, in parentheses, does "
        "not: compare changes by it"
    )
    assert any(
        heading.startswith("What it depends on: ") and " of relaxed spatial" in heading for heading in said
    )
    assert line.endswith("sDA 47 → 48.6 % (relaxed: +2.00 ± 0.10 rendered, +2.100 ± 0.010 predicted)")
    known = dataclasses.replace(raised, exact_error=0.7)
    said = lines(of_daylight(46.0, 0.5, definition=Definition(47.0, "", points=63), changes=(known,)))
    _, line = said["What would change it"]
    assert "sDA 47 → 48.6 %, by +1.6 ± 0.7 percentage points (relaxed: +2.00" in line
    hours = lines(of_daylight(46.0, 0.5, definition=Definition(47.0, ""), changes=(raised,)))
    assert "jumps at the threshold; the relaxed change" in hours["What would change it"][0]


def test_the_fewest_rows_with_most_of_the_effect_decide():
    rows = (
        Row(1, "y = 5 m", "top", 7, 0.0437, 0.0, 0.0),
        Row(2, "y = 4 m", "top", 7, 100 / 7, 3.0, 0.3),
        Row(3, "y = 3 m", "top", 7, 80.0, 2.5, 0.1),
        Row(4, "y = 2 m", "top", 7, 100.0, 0.1, 0.2),
    )
    first, legend, *others = lines(of_daylight(57.0, 0.5, rows=rows))["Which points decide"]
    assert first == "row 2 (y = 4 m) and row 3 (y = 3 m) decide: 100 % of the effect of 10 % more light"
    assert legend == (
        "below, sDA there, and how 10 % more light there changes sDA of all points; rows are counted from the top "
        "of the plan, where y points up"
    )
    assert others[0] == "row 1 (y = 5 m), 7 points: 0.0 %; 0 percentage points for all points"
    assert others[1] == "row 2 (y = 4 m), 7 points: 14.3 %; +3.00 ± 0.30 percentage points for all points"
    assert len(others) == 4
    three = tuple(dataclasses.replace(row, effect=1.0, effect_error=0.1) for row in rows[:3])
    assert lines(of_daylight(57.0, 0.5, rows=three))["Which points decide"][0] == (
        "most of them: 3 of 3 rows have 100 % of the effect of 10 % more light"
    )
    below = (dataclasses.replace(rows[1], name="z = 4 m", towards="−z"),)
    _, legend, _ = lines(of_daylight(57.0, 0.5, rows=below))["Which points decide"]
    assert legend.endswith("from the top of the plan, where −z points up")
    dark = tuple(dataclasses.replace(row, effect=0.0) for row in rows)
    (nothing,) = lines(of_daylight(0.0, 0.0, rows=dark))["Which points decide"]
    assert nothing.startswith("none: ")


def test_rows_beside_each_other_are_columns_of_the_plan():
    column = Row(1, "x = 5 m", "left", 7, None, 1.0, 0.1, towards="x")
    first, legend, other = lines(of_daylight(57.0, 0.5, rows=(column,)))["Which points decide"]
    assert first.startswith("column 1 (x = 5 m) decides")
    assert legend == (
        "below, how 10 % more light there changes sDA of all points; columns are counted from the left of the "
        "plan, where x points to the right"
    )
    assert other == "column 1 (x = 5 m), 7 points: +1.00 ± 0.10 percentage points for all points"
