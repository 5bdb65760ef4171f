"""The effects of two results side by side: what is shown, over which range, and what a render contradicts."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import results
import torch

from scenecaptum import SceneRenderer, VanillaSceneGradient, cli, metrics
from scenecaptum.attr import SceneAttribution
from scenecaptum.cli import _compared, _compared_effects
from scenecaptum.visualization import range_notes

SKY = "sky.emitter.radiance.value"
SMALL = "--resolution 32x18 --spp 16 --max-depth 3 --no-progress"


def with_ranges(before: SceneAttribution, **factors: float) -> SceneAttribution:
    """Return a result with ranges of one unit, times the factors."""
    lengths = {name: torch.ones_like(totals) for name, totals in before.weights("unit").items()}
    return dataclasses.replace(
        before, extents={name: factors.get(name, 1.0) * length for name, length in lengths.items()}
    )


def scaled(before: SceneAttribution, **factors: float) -> SceneAttribution:
    return dataclasses.replace(
        before, attributions={name: factors.get(name, 1.0) * value for name, value in before.items()}
    )


def with_values(one: SceneAttribution, **values: list[float]) -> SceneAttribution:
    return dataclasses.replace(
        one, parameter_values={name: torch.tensor(value) for name, value in values.items()}
    )


def text_of(before: SceneAttribution, after: SceneAttribution) -> list[str]:
    sides = [_compared.Side(), _compared.Side()]
    return _compared.lines(_compared.Compared(before, after, ["A", "B"], 0.0, None, sides))


def rows_of(text: list[str]) -> list[str]:
    start = next(index for index, line in enumerate(text) if line.startswith("effect of"))
    return [line for line in text[start + 1 :] if not line.startswith("  ")]


def test_the_table_has_what_was_set_then_clear_changes_and_then_leading_effects() -> None:
    before = with_ranges(results.make())
    after = scaled(before, two_minds=1.5, rough=1.5)
    before, after = with_values(before, noisy=0.1), with_values(after, noisy=0.2)
    text = text_of(before, after)
    labels = [line.split("  ")[0] for line in rows_of(text)]
    assert labels[:3] == ["noisy", "desk: roughness", "two_minds"], "the one that was set comes first"
    assert set(labels[3:]) == {"lamp", "floor", "wall"}, "leading effects that do not change"
    noisy = [line for line in rows_of(text) if line.endswith(" ◆")]
    assert [line.split("  ")[0] for line in noisy] == ["noisy", "lamp", "floor", "wall"]
    assert "  ◆ change within the noise" in text
    assert text[-1] == "  not shown: 2 effects, 1 with no change, 1 with a change within the noise"
    above = text[next(index for index, line in enumerate(text) if line.startswith("effect of")) - 1]
    assert above == "effect: first-order change of Glare over the range of the parameter"


def test_a_derivative_that_is_known_to_be_wrong_is_marked() -> None:
    both = {"lamp": "it is biased"}
    before = with_ranges(results.make(cautions=both))
    text = text_of(before, scaled(with_ranges(results.make(cautions=both)), rough=1.5))
    assert [line.split("  ")[0] for line in rows_of(text) if "!" in line] == ["lamp !"]
    assert "  ! it is biased" in text
    # Of one design alone, such as a mirror that the other does not have.
    after = with_ranges(results.make(cautions={**both, "wall": "it is biased", "rough": "its size is off"}))
    text = text_of(before, scaled(after, rough=1.5))
    labels = [line.split("  ")[0] for line in rows_of(text) if "!" in line]
    assert labels == ["desk: roughness !2", "lamp !1", "wall !1"]
    assert "  !1 it is biased" in text
    assert "  !2 B: its size is off" in text
    assert not any("!" in line for line in text_of(with_ranges(results.make()), with_ranges(results.make())))


def test_clear_changes_that_are_not_shown_are_counted() -> None:
    before = results.make()
    factors = {"lamp": 2.0, "rough": 1.5, "tiny": 3.0}  # the effect of tiny is a millionth of the lamp's
    text = text_of(before, scaled(before, **factors))
    assert not any(line.startswith("tiny") for line in text)
    (counted,) = re.findall(r"not shown: .*", " ".join(" ".join(text).split()))
    reasons = "1 with no change, 1 with a change within the noise, 1 with a change of at most 2.6e−7"
    assert counted == f"not shown: 3 effects, {reasons}"


def test_equal_effects_have_no_digits_of_rounding_and_no_mark_of_noise() -> None:
    lamp = "light.emitter.radiance.value"
    renderer = SceneRenderer("cornell-box", [lamp], resolution=(8, 8), spp=16, max_depth=3)
    one = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute()
    rounding = {
        field: {lamp: (1 + 1e-7) * getattr(one, field)[lamp]} for field in ("attributions", "replicates")
    }
    text = text_of(one, dataclasses.replace(one, **rounding))
    (row,) = rows_of(text)
    assert re.fullmatch(r"light: radiance +(\S{3,5}) +\1 +0", row)
    assert not any("noise" in line for line in text)


@pytest.mark.parametrize("factor", [0.1, 2.0])
def test_an_effect_is_over_the_range_in_its_own_design(factor: float) -> None:
    """As in the report: a lamp that is dimmed to a tenth, with the same gradient, contributes a tenth."""
    before = with_ranges(results.make())
    other = with_ranges(before, lamp=factor)
    (lamp,) = [one for one in _compared_effects.compared_effects(before, other) if one.name == "lamp"]
    assert (lamp.before, lamp.after) == (before.effects()["lamp"], other.effects()["lamp"])
    assert lamp.after == pytest.approx(factor * lamp.before)
    assert lamp.change == pytest.approx(lamp.after - lamp.before)
    assert (before.effects_error() or {})["lamp"] * (1 + factor**2) ** 0.5 == pytest.approx(lamp.error)
    text = " ".join(" ".join(text_of(before, other)).split())
    assert "The effect of lamp is over different ranges, each that of its own result" in text
    assert "different ranges" not in " ".join(text_of(before, before))


@pytest.mark.parametrize("is_linear", [False, True])
def test_a_light_that_is_off_in_both_designs_has_no_effect_and_is_counted_only(is_linear: bool) -> None:
    """As in a comparison with a design in which it is on: a design has one number, whatever stands beside it."""
    before = with_ranges(results.make(lights_off=["lamp"], linear_in_light=is_linear))
    after = dataclasses.replace(before, attributions={name: 1.5 * one for name, one in before.items()})
    (lamp,) = [one for one in _compared_effects.compared_effects(before, after) if one.name == "lamp"]
    assert (lamp.before, lamp.after, lamp.change) == (0, 0, 0)
    text = text_of(before, after)
    assert not any(row.startswith("lamp") for row in rows_of(text))
    joined = " ".join(" ".join(text).split())
    assert "1 of lights that are off" in joined
    assert "lamp is off in both, so in the comparison its effect, from off to its value, is 0. " in joined
    assert "Each result's own table has its effect if it is switched on." in joined
    assert "ranked last" not in joined
    assert "switching on" not in joined


def test_effects_of_lights_have_the_note_of_a_metric_that_is_not_linear_in_the_light() -> None:
    first = with_ranges(results.make(lights_on=["lamp"]))
    changed, linear = (
        dataclasses.replace(first, info={**first.info, **info})
        for info in ({"lights_on": []}, {"linear_in_light": True})
    )
    note = "effects of lights are to first order: Glare is not linear in the light"
    assert sum(line.startswith(f"  {note}") for line in text_of(first, first)) == 1
    assert any(line.startswith(f"  A: {note}") for line in text_of(first, changed)), "of one of both alone"
    assert not any(note in line for line in text_of(linear, linear))


def test_a_light_that_is_switched_off_has_no_effect_there() -> None:
    on = with_ranges(results.make())
    off = dataclasses.replace(on, info={**on.info, "lights_off": ["lamp"]})
    on, off = with_values(on, lamp=[1.0] * 3), with_values(off, lamp=[0.0] * 3)
    (lamp,) = [one for one in _compared_effects.compared_effects(on, off) if one.name == "lamp"]
    assert (lamp.before, lamp.after) == (on.effects()["lamp"], 0)
    assert lamp.change == pytest.approx(-lamp.before)
    text = text_of(on, off)
    assert rows_of(text)[0].startswith("lamp")
    joined = " ".join(" ".join(text).split())
    assert "The effect of lamp is over different ranges, each that of its own result" in joined
    assert "for a light from off to its value, so 0 where it is off." in joined
    assert "off in both" not in joined
    assert "switching on" not in joined
    assert "lights that are off" not in joined


def test_the_error_of_a_change_over_different_ranges_is_that_of_common_random_numbers() -> None:
    """Half a lamp has half the effect in each replicate, so the error of the change is half of the effect's."""
    lamp = "light.emitter.radiance.value"
    renderer = SceneRenderer("cornell-box", [lamp], resolution=(8, 8), spp=16, max_depth=3)
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    before, after = (method.attribute({lamp: factor * renderer.inputs[lamp]}) for factor in (1.0, 0.5))
    (found,) = _compared_effects.compared_effects(before, after)
    assert found.change == pytest.approx(-before.effects()[lamp] / 2, rel=1e-3)
    assert found.error == pytest.approx((before.effects_error() or {})[lamp] / 2, rel=0.02)


@pytest.mark.parametrize(
    ("rendered", "contradicts"),
    [
        ((0.06, 0.001), False),
        ((0.12, 0.001), False),
        ((0.2, 0.001), True),
        ((0.2, 0.05), False),
        ((0.02, 0.001), True),
        ((-0.05, 0.001), True),
        ((0.0, 0.001), True),
        ((0.02, 0.05), False),  # the noise of the render
        ((-0.05, 0.05), False),
        ((-0.9, 0.05), True),
    ],
)
def test_a_rendered_change_contradicts_an_effect_by_its_sign_or_by_a_factor_of_two(
    rendered: tuple[float, float], contradicts: bool
) -> None:
    before = with_ranges(results.make())
    # The derivatives of "wall" are 0.05, 0.02 and −0.001: to first order, this step changes the metric by 0.069.
    before, after = (with_values(before, wall=[value] * 3) for value in (0.0, 1.0))
    for one in _compared_effects.with_contradictions(before, after, rendered):
        notes = {text: names for text, names in range_notes(one).items() if "rendered" in text}
        assert list(notes.values()) == ([["wall"]] if contradicts else [])
        assert all("wall: the derivatives at this design predict a change of +0.06" in text for text in notes)


def test_a_change_of_nothing_or_of_a_texture_contradicts_no_effect() -> None:
    before = with_ranges(results.make())
    floors = [with_values(before, floor=[value] * 3) for value in (0.0, 1.0)]
    for pair in ((before, before), floors):
        found = _compared_effects.with_contradictions(pair[0], pair[1], (5.0, 0.1))
        assert not any("contradicted" in one.info for one in found)


def test_parameters_of_one_result_are_named_and_the_others_compared() -> None:
    before = results.make()
    names = [name for name in before if name != "lamp"]
    less = dataclasses.replace(before, attributions={name: before[name] for name in names})
    after = scaled(less, rough=1.5)
    for pair, title in (((before, after), "A"), ((after, before), "B")):
        text = text_of(*pair)
        assert f"  lamp is in {title} only" in text
        assert rows_of(text)[0].startswith("desk: roughness")
    other = dataclasses.replace(
        before,
        attributions={**before.attributions, "noisy": torch.zeros(3)},
        covariance={**(before.covariance or {}), "noisy": torch.eye(3)},
    )
    assert "  noisy is of another size in B, and not compared" in text_of(before, other)


def test_groups_and_parameters_are_compared_by_the_metric_alone() -> None:
    before = results.make()
    after = dataclasses.replace(
        before,
        attributions={"group": torch.tensor(1.0)},
        info={**before.info, "quantity": "effect over the range"},
    )
    text = text_of(before, after)
    assert not any(line.startswith("effect of") for line in text)
    assert any("group is in B only" in line for line in text)


def test_contributions_with_different_baselines_say_so() -> None:
    """A change of the baseline alone is none of the lamp."""
    before = results.make()
    black, grey = (
        dataclasses.replace(before, info={**before.info, "quantity": "contribution", "compared_with": words})
        for words in ("all lights off", "grey")
    )
    assert "  compared with different baselines; A: all lights off; B: grey" in text_of(black, grey)
    assert not any("compared with" in line for line in text_of(black, black))


def compared(more: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[str, dict[str, Any]]:
    """Return what the command prints, and the data of its page."""
    assert cli.main(shlex.split(f"compare {more} --no-progress --out {folder}")) == 0
    page = (folder / "comparison.html").read_text()
    data = json.loads(page.partition('id="data">')[2].partition("</script>")[0])
    return capsys.readouterr().out, data


@pytest.mark.long
def test_a_dimmed_sky_has_one_effect_in_terminal_and_page_and_the_render_contradicts_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = f"office --metric ugr --inputs emitters {SMALL} --set {SKY}*=0.2"
    printed, page = compared(more, tmp_path, capsys)
    (row,) = re.findall(r"^sky: radiance ~ +(\S+) +(\S+) +(\S+) ± \S+$", printed, re.MULTILINE)
    after = [next(one for one in result["rows"] if one["name"] == SKY) for result in page["results"]]
    for written, one in zip(row, after, strict=False):
        assert float(written.replace("−", "-")) == pytest.approx(one["effect"], abs=0.06)
    assert [bool(one["rangeNotes"]) for one in after] == [False, True]
    assert "first-order change of relaxed unified glare rating over" in " ".join(printed.split())
    said = " ".join(printed.split())
    assert "the design: sky: radiance: the derivatives at this design predict a change of" in said


@pytest.mark.parametrize(("factors", "is_opposite"), [((0.6, 0.3), True), ((1.0, 0.2), False)])
def test_values_that_move_in_opposite_directions_have_a_caution(
    factors: tuple[float, float], is_opposite: bool
) -> None:
    before = results.make()
    sides = [_compared.Side()] * 2
    changes = (2.1, 0.4) if is_opposite else (-11.9, 0.1)
    found = _compared.Compared(before, before, ["A", "B"], -4.5, 0.1, sides, by_definition=changes)
    assert bool(found.opposite()) == is_opposite
    assert (found.opposite() in found.notes()) == is_opposite
    unclear = dataclasses.replace(found, by_definition=(2.1, 1.4))
    assert unclear.opposite() == ""


@pytest.mark.parametrize(
    ("amounts", "said"),
    [
        ((2.8, 2.4), "(A: by about 2.8; B: by about 2.4): without that, the change is about −0.8"),
        ((0.0, 9.8), "(A: by about 0; B: by about 9.8): without that, the change is about +9.4"),
        ((2.8, 2.8), ""),
        ((2.8, 2.84), ""),  # within the noise of the change
    ],
)
def test_a_change_whose_ratings_lack_different_amounts_is_stated_with_them(
    amounts: tuple[float, float], said: str
) -> None:
    before = results.make()
    sides = [_compared.Side(missing=one) for one in amounts]
    found = _compared.Compared(before, before, ["A", "B"], -0.4, 0.05, sides)
    assert found.lacking() == (said and f"caution: the edges of lamps lower the ratings {said}")
    assert (found.lacking() in found.notes()) == bool(said)
    exact = dataclasses.replace(found, by_definition=(-4.0, 0.5))
    assert ("is about +5.8" in exact.lacking()) == (amounts[1] > 9), "small beside this change"


@pytest.mark.parametrize(("amounts", "is_lacking"), [((2.8, 2.4), True), ((2.8, 2.8), False), ((2.8,), True)])
def test_saved_ratings_that_lack_different_amounts_have_a_caution_on_the_change(
    amounts: tuple[float, ...], is_lacking: bool
) -> None:
    before = results.make()
    notes = [(f"pixels at the edges of lamp …: the rating is too low, by about {one}",) for one in amounts]
    sides = [_compared.Side(premises=one, is_saved=True) for one in (*notes, ())[:2]]
    found = _compared.Compared(before, before, ["A", "B"], -0.4, 0.05, sides)
    assert any("the change lacks the difference" in note for note in found.notes()) == is_lacking


@pytest.mark.parametrize(("exact", "is_far"), [(-3.3, True), (0.0, True), (-8.1, False)])
def test_a_relaxed_change_far_from_the_exact_one_is_no_guide(exact: float, is_far: bool) -> None:
    """The brightest pixel is in the transition of the threshold, and fades with all of the rating."""
    rated = results.make()
    rated = dataclasses.replace(rated, info={**rated.info, "metric": "UnifiedGlareRating"})
    sides = [_compared.Side()] * 2
    found = _compared.Compared(rated, rated, ["A", "B"], -9.5, 0.4, sides, by_definition=(exact, 0.1))
    assert ("depend on it more than on the scene" in found.relaxed()) == is_far
    assert found.relaxed().endswith(": compare with --threshold-factor 5" if is_far else "by −9.5 ± 0.4.")
    of_daylight = dataclasses.replace(found, before=results.make())
    assert "threshold" not in of_daylight.relaxed()


def test_a_comparison_of_daylight_prints_classes_and_cautions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = "classroom --spp 4 --spacing 2 --metric sda --inputs pane.*"
    printed, page = compared(f"{more} --set pane.specular_transmittance.value=0.3", tmp_path, capsys)
    printed = " ".join(printed.split())
    verdicts = [result["verdict"] for result in page["results"]]
    assert all(verdicts)
    for title, words in zip(("as it is", "the design"), verdicts, strict=True):
        assert re.search(rf"{title}: [^:]+: {re.escape(words)}", printed)
    assert printed.count("caution: blinds are not modeled") == 1
    assert all(result["rankedUnit"] == "percentage points" for result in page["results"])


def test_effects_that_are_left_out_for_one_reason_are_counted_once() -> None:
    noisy = _compared_effects.ComparedEffect("a", "a", 1.0, 1.1, 0.1, 1.0)
    assert _compared_effects._left_out([noisy] * 2) == ["not shown: 2 effects with a change within the noise"]
    assert _compared_effects._left_out([]) == []
