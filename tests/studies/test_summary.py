"""Summaries over rooms: the same as statsmodels and the closed form, right in simulated studies, and honest."""

from __future__ import annotations

import dataclasses
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chance import binomial_margin
from scipy.stats import t
from seeds import shifted
from statsmodels.stats.meta_analysis import combine_effects

from scenecaptum import SceneCaptumError
from scenecaptum.estimation import student_t
from scenecaptum.studies import Study, StudyResult
from scenecaptum.studies._cell_effects import CellEffect, Quantity, _parts_removed
from scenecaptum.studies._random_effects import Observation, _variance_between_cameras, _views, combine
from scenecaptum.studies._summary import Summary, _labels

from . import made

RUNS = 400
ROOMS = ["office", "attic", "kitchen", "stairs"]


def observed(effects: np.ndarray, errors: np.ndarray) -> list[Observation]:
    """One camera and seed in each room."""
    return [
        Observation(f"room {k}", "front", effect, error, 7)
        for k, (effect, error) in enumerate(zip(effects, errors, strict=True))
    ]


@pytest.mark.parametrize("factor", [1.0, 10.0], ids=["rooms differ", "rooms are alike within the noise"])
def test_means_are_those_of_statsmodels(factor: float) -> None:
    effects, errors = np.array([1.0, 2.5, 0.4, 3.0, 1.7]), factor * np.array([0.2, 0.5, 0.3, 0.9, 0.1])
    expected = combine_effects(effects, errors**2, method_re="pm", use_t=True)
    found = combine(observed(effects, errors))
    assert found.mean == pytest.approx(expected.mean_effect_re, rel=1e-4)
    # The larger of its errors, with the factor 1 and with that of Hartung and Knapp.
    error = max(expected.sd_eff_w_re, expected.sd_eff_w_re_hksj)
    effective = 1 / np.square(expected.weights_rel_re).sum()  # number of rooms
    half = t.ppf(0.975, max(1, effective - 1)) * error
    assert (found.low, found.high) == pytest.approx((found.mean - half, found.mean + half), rel=1e-4)
    assert found.between == pytest.approx(math.sqrt(expected.tau2), rel=1e-4)
    assert found.within is None


@pytest.mark.parametrize(
    "effects",
    [[0.0188, 0.020, 0.028], [0.0188, 0.0188, 0.0188], [0.0188, 0.0188 + 1e-15, 0.0188]],
    ids=["rooms that agree by chance", "the same number", "almost the same number"],
)
def test_rooms_that_agree_by_chance_are_as_uncertain_as_their_noise(effects: list[float]) -> None:
    errors = np.array([0.0028, 0.070, 0.065])
    found = combine(observed(np.array(effects), errors))
    weights = 1 / errors**2
    error_of_fixed_effect = 1 / math.sqrt(weights.sum())
    assert found.mean == pytest.approx(weights @ effects / weights.sum(), rel=1e-6)
    assert found.error == pytest.approx(error_of_fixed_effect, rel=1e-6)
    assert found.between == 0
    half = student_t(0.95, 1) * error_of_fixed_effect  # a single room has nearly all the weight
    assert (found.low, found.high) == pytest.approx((found.mean - half, found.mean + half), rel=1e-6)
    assert (found.new_low, found.new_high) == (found.low, found.high)


def test_two_rooms_of_which_one_has_all_the_weight_have_no_interval() -> None:
    found = combine(observed(np.array([-1.14, 0.06]), np.array([0.09, 1.35])))
    assert found.effective_rooms == pytest.approx(1.01, abs=0.01)
    assert found.error is not None
    assert (found.low, found.high, found.new_low, found.new_high) == (None, None, None, None)
    alike = combine(observed(np.array([-1.14, 0.06]), np.array([0.5, 0.5])))
    assert alike.low < 0 < alike.high


@pytest.mark.parametrize("between", [0.1, 0.5])
def test_intervals_hold_the_mean_where_some_rooms_are_noisier_than_others(between: float) -> None:
    # With 0.1 the rooms differ as much as the smallest of their errors, and in most studies less than can be seen.
    runs, errors = 1000, np.array([0.1, 0.2, 0.5, 1.0, 1.0, 2.0])
    generator = np.random.default_rng(shifted())
    held = []
    for of_room, noise in generator.standard_normal((runs, 2, len(errors))):
        found = combine(observed(1 + between * of_room + errors * noise, errors))
        held.append(found.low <= 1 <= found.high)
    assert np.mean(held) > 0.95 - binomial_margin(0.95, runs), (
        f"95 % interval of the mean: {np.mean(held):.3f}"
    )


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_equal_variances_have_a_closed_form(scale: float) -> None:
    effects = scale * np.array([1.0, 2.0, 4.0, 7.0])
    found, spread = combine(observed(effects, np.full(4, 0.5 * scale))), effects.std(ddof=1)
    assert found.mean == pytest.approx(effects.mean())
    assert found.error == pytest.approx(spread / 2, rel=1e-4)
    assert found.high == pytest.approx(effects.mean() + student_t(0.95, 3) * spread / 2, rel=1e-4)
    assert found.between == pytest.approx(math.sqrt(spread**2 - (0.5 * scale) ** 2), rel=1e-4)
    between, half = found.between, found.new_high - found.mean
    assert half == pytest.approx(student_t(0.95, 3) * math.hypot(spread / 2, between), rel=1e-4)


@pytest.mark.parametrize("common", [0.0, 2.0], ids=["cameras of each room", "cameras alike in all rooms"])
def test_intervals_and_variances_are_right_in_simulated_studies(common: float) -> None:
    rooms, cameras, between, within, noise = 6, 3, 1.0, 0.5, 0.3
    generator = np.random.default_rng(shifted(int(common)))
    covered, variances = [], []
    for _ in range(RUNS):
        of_camera = common * generator.standard_normal(cameras)
        mean = 1 + of_camera.mean()
        effects = (
            1
            + of_camera
            + between * generator.standard_normal((rooms, 1))
            + within * generator.standard_normal((rooms, cameras))
            + noise * generator.standard_normal((rooms, cameras))
        )
        found = combine(
            [
                Observation(f"{i}", f"{j}", effects[i, j], noise, 7)
                for i in range(rooms)
                for j in range(cameras)
            ]
        )
        covered.append(found.low <= mean <= found.high)
        variances.append([found.between**2, found.within**2])
    share = np.mean(covered)
    assert abs(share - 0.95) < binomial_margin(0.95, RUNS), f"95 % interval of the mean: {share:.3f}"
    # The variance between the cameras of one room includes what they have in common in all rooms.
    expected = np.array([between**2, within**2 + common**2])
    z = (np.mean(variances, 0) - expected) / (np.std(variances, 0, ddof=1) / math.sqrt(RUNS))
    assert np.abs(z).max() < 4, f"variances off by {z} standard errors"


def test_intervals_of_a_new_room_hold_it() -> None:
    # Where the noise is small; they are narrower than they should be where it hides the differences between rooms.
    generator = np.random.default_rng(shifted())
    effects = 1 + generator.standard_normal((RUNS, 7))
    held = []
    for *rooms, new in effects:
        found = combine(observed(np.array(rooms), np.full(6, 0.01)))
        held.append(found.new_low <= new <= found.new_high)
    assert abs(np.mean(held) - 0.95) < binomial_margin(0.95, RUNS), f"95 % interval: {np.mean(held):.3f}"


def test_what_cameras_have_in_common_is_a_fit_of_rooms_and_cameras() -> None:
    generator = np.random.default_rng(shifted())
    # Not all rooms have all cameras, and one has a camera of its own.
    places = [(i, j) for i in range(5) for j in range(4) if (i, j) not in ((0, 1), (2, 3), (3, 0))] + [(1, 9)]
    effects = generator.standard_normal(len(places))
    views = _views(
        [Observation(f"{i}", f"{j}", e, 0.0) for (i, j), e in zip(places, effects, strict=True)], None
    )
    fit = np.array([[i == k for k in range(5)] + [j == k for k in range(4)] for i, j in places], dtype=float)
    residuals = effects - fit @ np.linalg.lstsq(fit, effects, rcond=None)[0]
    expected = residuals @ residuals / (len(places) - np.linalg.matrix_rank(fit))
    assert _variance_between_cameras(views, remove_common=True) == pytest.approx(expected)


def test_seeds_repeat_the_noise() -> None:
    generator = np.random.default_rng(shifted())
    effects = {
        (room, seed): room + 0.2 * generator.standard_normal() for room in range(3) for seed in range(50)
    }
    found = combine(
        [Observation(f"{room}", "front", effect, 0.2, 7) for (room, _), effect in effects.items()]
    )
    assert found.noise == pytest.approx(0.2)
    # A standard deviation from n degrees of freedom has a relative standard error of 1 / sqrt(2 n).
    assert abs(found.seed_spread / 0.2 - 1) < 4 / math.sqrt(2 * 147)
    assert found.rooms[0].error == pytest.approx(0.2 / math.sqrt(50))
    without = combine(
        [Observation(f"{room}", "front", effect, None) for (room, _), effect in effects.items()]
    )
    assert without.noise == found.seed_spread


def test_the_error_of_a_group_knows_the_covariance_of_its_members(tmp_path: Path) -> None:
    [cell] = made.cells(["office"])
    result = made.study(tmp_path, {cell: {"wall.alpha": 1.0, "floor.alpha": 2.0}}, noise=0.0, shared=0.1)
    [row] = result.summary().rows
    [of_wall, _] = result.summary(None).rows
    # Their noise is the same: errors add up, and not their squares.
    assert row.rooms[0].error == pytest.approx(2 * of_wall.rooms[0].error, rel=1e-5)
    assert row.mean == pytest.approx(3.0, abs=1.0)


def test_groups_are_kinds_patterns_or_single_parameters(tmp_path: Path) -> None:
    cells = made.cells(ROOMS)
    result = made.study(tmp_path, made.random_effects(cells, shifted()))
    by_kind = result.summary()
    assert {row.group for row in by_kind.rows} == {"reflectance", "roughness"}
    assert {row.group for row in result.summary(None).rows} == {*made.random_effects(cells, 0)[cells[0]]}
    walls = result.summary({"walls": "wall*", "all": ["*: reflectance", "*.alpha"]})
    rows = {row.group: row for row in walls.rows}
    assert rows["walls"].mean == pytest.approx(result.summary(None).row("wall.reflectance").mean)
    means = [row.mean for row in by_kind.rows]
    assert [abs(mean) for mean in means] == sorted(map(abs, means), reverse=True)
    effect = {room.room: room.effect for room in rows["all"].rooms}
    parts = [{room.room: room.effect for room in row.rooms} for row in by_kind.rows]
    assert all(effect[room] == pytest.approx(sum(part[room] for part in parts)) for room in ROOMS)


@pytest.mark.parametrize(
    ("group", "message"),
    [
        ({"walls": "*wal.reflectance"}, "matches no name and no label.*Did you mean 'wall.reflectance'"),
        ({"walls": []}, "'walls' is empty"),
        ({"walls": [3]}, "'walls' must have a name, and globs that are strings"),
        ("material", "group must be 'kind', None"),
    ],
)
def test_wrong_groups_are_refused(group: object, message: str, tmp_path: Path) -> None:
    result = made.study(tmp_path, made.random_effects(made.cells(["office"]), 0))
    with pytest.raises(SceneCaptumError, match=message):
        result.summary(group)  # type: ignore[arg-type]


def test_wrong_names_are_refused(tmp_path: Path) -> None:
    cells = made.cells(["office"], metrics=["luminance", "ugr"])
    result = made.study(
        tmp_path, made.random_effects(cells, 0), values_only=[cells[0]._replace(method="value")]
    )
    with pytest.raises(SceneCaptumError, match=r"no finished cell with the metric 'lumiance'\. Did you mean"):
        result.summary(metric="lumiance")
    with pytest.raises(SceneCaptumError, match="no finished cell with an attribution"):
        result.summary(method="value")
    with pytest.raises(SceneCaptumError, match="several metrics, luminance, ugr: choose one"):
        result.summary().row()
    with pytest.raises(SceneCaptumError, match=r"no group 'roughnes'\. Did you mean 'roughness'"):
        result.summary().row("roughnes", metric="ugr")


def test_what_cannot_be_estimated_is_said(tmp_path: Path) -> None:
    one = made.study(tmp_path / "one", made.random_effects(made.cells(["office"]), 0)).summary()
    row = one.row("roughness")
    assert (row.low, row.error, row.between, row.within, row.new_low) == (None,) * 5
    assert row.rooms[0].low < row.mean < row.rooms[0].high
    assert "one room: neither an interval of the mean" in str(one)
    assert "one camera in each room" in str(one)
    failed = made.cells(["attic"])[0]
    two = made.study(
        tmp_path / "two",
        made.random_effects(made.cells(["office", "kitchen"], ["front", "left"]), 0),
        failures={failed: "no camera"},
    ).summary()
    row = two.row("roughness")
    assert row.low < row.mean < row.high
    assert row.new_low is None
    assert row.within > 0
    assert "2 rooms: an interval for a new room takes 3" in str(two)
    assert "1 cell failed or missing, and left out" in two.notes()
    unknown = combine([Observation("office", "front", 1.0, None), Observation("attic", "front", 2.0, None)])
    assert (unknown.noise, unknown.rooms[0].low, unknown.rooms[0].sign) == (None, None, 0)


def test_one_room_with_most_of_the_weight_is_said(tmp_path: Path) -> None:
    summary = made.study(tmp_path, made.random_effects(made.cells(ROOMS), 0)).summary()
    advice = "give the noisy rooms more samples"
    assert advice not in str(summary)

    def weighted(errors: list[float], count: int) -> str:
        found = combine(observed(np.array([-1.1, 0.1, 0.2])[: len(errors)], np.array(errors)))
        rows = [dataclasses.replace(row, **vars(found)) for row in summary.rows[:count]]
        notes = dataclasses.replace(summary, rows=(*rows, *summary.rows[count:])).notes()
        return " ".join(note for note in notes if advice in note)

    assert len(summary.rows) == 2
    assert weighted([0.05, 3.0, 3.0], 2) == f"one room has most of the weight: {advice}"
    assert (
        weighted([0.05, 3.0, 3.0], 1)
        == f"one room has most of the weight ({summary.rows[0].group}): {advice}"
    )
    metrics = [dataclasses.replace(row, metric="ugr") for row in summary.rows]
    summary = dataclasses.replace(summary, rows=(*summary.rows, *metrics))
    assert f" ({summary.rows[0].group} · luminance): " in weighted([0.05, 3.0, 3.0], 1)
    assert not weighted([0.5, 0.5, 0.5], 2)
    assert not weighted([0.05, 3.0], 2)  # that of two rooms has a note of its own


def test_effects_whose_errors_may_be_too_small_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rooms = ["office", "kitchen"]
    result = made.study(tmp_path / "one", made.random_effects(made.cells(rooms, ["0"]), 0))
    cells = made.cells(rooms, ["0", "left"], ["luminance", "ugr"])
    several = made.study(tmp_path / "several", made.random_effects(cells, 0))
    assert not result.summary().doubts
    rare = {"desk.alpha": 0}  # samples behind its variance
    original = StudyResult.attribution

    def with_few_samples(self: StudyResult, cell: Any) -> Any:
        found = original(self, cell)
        info = {**found.info, "effective_samples": rare if cell.scene == "office" else {}}
        return dataclasses.replace(found, info=info)

    monkeypatch.setattr(StudyResult, "attribution", with_few_samples)
    (note,) = [line for line in result.summary(None).notes() if "too small" in line]
    assert note.startswith("the error of 1 effect may be too small (desk: alpha in office): ")
    (note,) = [line for line in several.summary(None).notes() if "too few samples" in line]
    assert note.startswith(
        "the error of 4 effects may be too small (desk: alpha in office · camera 0 · luminance; desk: alpha in "
        "office · camera 0 · ugr; desk: alpha in office · left · luminance and 1 more): "
    )


def test_no_note_has_a_mark_that_no_row_has(tmp_path: Path) -> None:
    cells, failed = made.cells(["office", "attic"]), made.cells(["kitchen"])[0]
    result = made.study(
        tmp_path,
        made.random_effects(cells, 0),
        failures={failed: "no camera"},
        said={cells[0]: {"notes": [], "cautions": ["the picture is noisy"]}},
    )
    summary = dataclasses.replace(result.summary(), doubts=(("desk: alpha in office", "few samples"),))
    tables, notes = str(summary).partition("from 2 cells")[::2]
    assert {"1 of 2 cells has a caution", "1 cell failed or missing, and left out"} <= {*summary.notes()}
    for note in notes.splitlines():
        mark = note.split(" ")[0]
        assert mark not in ("!", "?", "–") or f" {mark} " in tables, note


@pytest.fixture(scope="module")
def removed(tmp_path_factory: pytest.TempPathFactory, mi: Any) -> StudyResult:
    """What a room loses without its parts: one at a time, together, and shared out among them."""
    methods = {
        "alone": {"method": "ablation"},
        "together": {"method": "ablation", "groups": "kind"},
        "shapley": {"method": "shapley", "groups": "kind"},
        "sampled": {"method": "shapley"},
    }
    study = Study(
        ["cornell-box"],
        methods=methods,
        inputs=["floor.*", "ceiling.*", "light.emitter.*"],
        resolution=(8, 8),
        spp=4,
        max_depth=2,
    )
    with ThreadPoolExecutor(1) as thread:
        result = study.run(tmp_path_factory.mktemp("removed"), executor=thread, threads=None)
    assert not result.failures
    return result


@pytest.mark.parametrize("method", ["together", "shapley"])
def test_intervals_of_removals_have_the_degrees_of_freedom_of_their_replicates(
    removed: StudyResult, method: str
) -> None:
    rows = removed.summary(method=method).rows
    assert rows
    for row in rows:
        (room,) = row.rooms
        assert room.high - room.low == pytest.approx(2 * student_t(0.95, 7) * room.error)


def test_a_sum_of_losses_of_parts_removed_alone_is_called_so(removed: StudyResult) -> None:
    def note(summary: Summary) -> str:
        return "".join(one for one in summary.notes() if "each alone" in one)

    assert note(removed.summary(method="alone")) == (
        "the sum of the losses of its parameters, channels or patches, each alone: groups of the method, such as "
        '{"method": "ablation", "groups": "kind"}, remove them together'
    )
    assert "each alone" in str(removed.summary(None, method="alone")), "of the channels of a colour"
    assert not note(removed.summary(method="together"))
    assert not note(removed.summary({"both": ["reflectance", "emitters"]}, method="shapley")), "they add up"
    assert "each alone (emitters · alone, reflectance · alone): " in note(removed.summary())


def test_errors_that_are_sums_of_those_of_shapley_values_are_called_upper_limits(
    removed: StudyResult,
) -> None:
    def note(summary: Summary) -> str:
        return "".join(one for one in summary.notes() if "upper limit" in one)

    assert note(removed.summary(method="sampled")) == (
        "of a sum of Shapley values, the noise is an upper limit (reflectance): the sum of the errors of its "
        "members, whose covariance is not known"
    )
    assert not note(removed.summary(None, method="sampled")), "none is a sum"
    both = {"both": ["reflectance", "emitters"]}
    for method in ("shapley", "alone"):  # of replicates, from which the covariance is known
        assert not note(removed.summary(both if method == "shapley" else "kind", method=method))


@pytest.mark.parametrize(("patch_texels", "parts"), [(24, 1), (12, 2), (5, 5)])
def test_the_patches_of_a_texture_are_parts(patch_texels: int, parts: int) -> None:
    made_up = made.attribution({"wall.alpha": 1.0})
    info = {"quantity": "effect of occlusion", "patch_texels": {"wall.alpha": patch_texels}}
    texture = {"wall.alpha": torch.ones(4, 6, 3)}
    occluded = dataclasses.replace(made_up, attributions=texture, standard_error=None, info=info)
    assert _parts_removed(occluded, "wall.alpha") == parts


def test_no_effect_at_all_is_zero(tmp_path: Path) -> None:
    effects = {cell: {"wall.alpha": 0.0} for cell in made.cells(ROOMS)}
    [row] = made.study(tmp_path, effects, noise=0.0).summary().rows
    assert (row.mean, row.error, row.low, row.high, row.between) == (0.0,) * 5
    assert (row.raises, row.lowers) == (0, 0)


def test_one_room_without_noise_does_not_get_all_the_weight() -> None:
    effects = np.array([0.0, 1.0, 2.0, 3.0])
    assert combine(observed(effects, np.array([0.0, 0.1, 0.1, 0.1]))).mean == pytest.approx(1.5, rel=0.05)


def test_data_frames_have_all_rows(tmp_path: Path) -> None:
    cells = made.cells(ROOMS, metrics=["luminance", "ugr"])
    summary = made.study(tmp_path, made.random_effects(cells, 0)).summary()
    frame = summary.to_dataframe()
    assert len(frame) == len(summary.rows) == 4
    assert frame["rooms"].tolist() == [4] * 4
    assert frame["within"].isna().all()
    assert frame["mean"].tolist() == [row.mean for row in summary.rows]


def test_the_table_can_be_read_by_itself(tmp_path: Path) -> None:
    cells = made.cells(ROOMS, ["front", "left"])
    text = str(made.study(tmp_path, made.random_effects(cells, 0)).summary())
    assert text.startswith(
        "first-order change of mean luminance (cd/m²) over the range of the parameter · luminance · as it is"
    )
    assert "from 8 cells" in text
    assert max(map(len, text.splitlines())) <= 120


def test_without_statsmodels_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = made.study(tmp_path, made.random_effects(made.cells(ROOMS), 0))
    monkeypatch.setitem(sys.modules, "statsmodels.stats.meta_analysis", None)
    with pytest.raises(SceneCaptumError, match=r"need statsmodels: pip install 'scenecaptum\[studies\]'"):
        result.summary()


def test_tables_have_the_labels_of_single_parameters(tmp_path: Path) -> None:
    name, label = "lamp.emitter.radiance.value.alpha", "lamp: emitter.radiance.value.alpha"
    cells = made.cells(["office", "attic"])
    result = made.study(tmp_path, {cell: {name: 3.0, "wall.alpha": 1.0} for cell in cells})
    summary = result.summary(None)
    assert [(row.group, row.label) for row in summary.rows] == [(name, label), ("wall.alpha", "wall: alpha")]
    assert summary.row(label) == summary.row(name)
    assert "wall: alpha" in str(summary)
    assert "wall.alpha" not in str(summary)
    assert [row.label for row in result.summary({"lamps": "lamp*"}).rows] == ["lamps"], "the user's own"


def test_a_label_of_several_groups_and_several_labels_of_one_are_not_used() -> None:
    [cell] = made.cells(["office"])
    pairs = [("a", "same"), ("b", "same"), ("c", "one"), ("c", "other"), ("d", "alone"), ("d", "alone")]
    effects = [CellEffect(cell, *pair, 1.0, 0.1, 7, Quantity("change", None)) for pair in pairs]
    assert _labels(effects) == {"a": "a", "b": "b", "c": "c", "d": "alone"}


def test_a_note_on_many_parameters_names_the_first_few(tmp_path: Path) -> None:
    unlike = {
        cell: {"wall.alpha": 1.0, **{f"{cell.scene}-{n}.alpha": 2.0 for n in range(20)}}
        for cell in made.cells(["office", "attic", "kitchen"])
    }
    notes = made.study(tmp_path, unlike).summary(None).notes()
    (note,) = [one for one in notes if one.startswith("– one room")]
    named = note.removesuffix(" and 57 more)").rpartition("(")[2].split(", ")
    assert note.endswith(" and 57 more)")
    assert len(named) == 3
