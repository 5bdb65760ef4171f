"""What results with baselines say that they are compared with."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from results import all_text, make
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    GradientShapScene,
    IntegratedGradientsScene,
    OcclusionScene,
    SceneAttribution,
    SceneRenderer,
    ShapleyValueScene,
)
from scenecaptum.attr._baseline_words import describe_baselines
from scenecaptum.attr._baselines import resolve_baselines
from scenecaptum.report import write_report
from scenecaptum.scene import BUNDLED
from scenecaptum.visualization import plot_bars, table_html, table_text

FLOOR, LIGHT = "floor.reflectance.value", "light.emitter.radiance.value"
SURFACES = ("left_wall", "right_wall", "floor", "ceiling", "back_wall", "short_box", "tall_box")
DEFAULTS = "all other inputs at their default baselines (lights and reflectances 0)"


class Room(ToyRenderer):
    """A mean brightness of three inputs, without a table of parameters."""

    labels = {"x": "floor: reflectance"}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__(0.0)
        self.inputs = {"x": torch.tensor([0.5, 0.3, 0.8]), "y": torch.tensor(1.5), "map": torch.rand(4, 4, 3)}
        self.bounds = dict.fromkeys(self.inputs, (0.0, math.inf))

    def __call__(self, inputs, *, seed: int, spp: int) -> torch.Tensor:
        values = {**self.inputs, **inputs}
        return self.matrix @ (values["x"] * values["y"] + values["map"].mean((0, 1)))


@pytest.fixture(scope="module")
def cornell():
    return SceneRenderer("cornell-box", inputs=["reflectance", "emitters"], resolution=(4, 4), spp=1)


def words(renderer, baselines) -> dict:
    resolved = resolve_baselines(renderer, renderer.inputs, baselines)
    return describe_baselines(renderer, renderer.inputs, baselines, resolved)


def test_a_mapping_says_what_the_other_inputs_are_compared_with(cornell):
    inputs = cornell.inputs
    info = words(cornell, {FLOOR: 0.2})
    assert info["compared_with"] == f"floor: reflectance 0.2; {DEFAULTS}"
    assert info["baselines"][FLOOR] == "0.2"
    assert info["baselines"][LIGHT] == "0"
    # The cure that the documentation gives.
    info = words(cornell, {**inputs, FLOOR: 0.2})
    assert info["compared_with"] == "floor: reflectance 0.2; all other inputs unchanged"
    assert set(info["baselines"]) == set(inputs)
    assert [name for name, written in info["baselines"].items() if written != "unchanged"] == [FLOOR]


@pytest.mark.parametrize(
    ("baselines", "sentence"),
    [
        ("dark", "all lights off, everything else unchanged"),
        ("black", "all reflectances 0, everything else unchanged"),
        ("grey", "each reflectance at its own mean, everything else unchanged"),
        (0.25, "all inputs at 0.25"),
        (torch.tensor([0.1, 0.2, 0.3]), "all inputs at (0.1, 0.2, 0.3)"),
        ({"emitters": 0, "*_wall.*": 0.5}, f"emitters 0; *_wall.* 0.5; {DEFAULTS}"),
        ({"emitters": 0, "reflectance": 0.5}, "emitters 0; reflectance 0.5"),
        (
            {f"{name}.*": 0.5 for name in SURFACES[:6]},
            "".join(f"{name}.* 0.5; " for name in SURFACES[:6]) + DEFAULTS,
        ),
        (
            {f"{name}.*": 0.5 for name in SURFACES},
            "".join(f"{name}.* 0.5; " for name in SURFACES[:6])
            + f'and 1 more changed (see info["baselines"]); {DEFAULTS}',
        ),
    ],
    ids=str,
)
def test_sentences(cornell, baselines, sentence):
    assert words(cornell, baselines)["compared_with"] == sentence


def test_another_scene_and_named_values_that_are_unchanged(cornell):
    assert words(cornell, cornell)["compared_with"] == "the values of another scene"
    kept = {FLOOR: cornell.inputs[FLOOR]}
    assert words(cornell, kept)["compared_with"] == f"floor: reflectance unchanged; {DEFAULTS}"


def test_maps_have_their_mean_and_renderers_without_a_table_zeros():
    room = Room()
    info = words(room, {"map": torch.tensor([[[0.0]], [[0.5]], [[0.5]], [[1.0]]])})
    assert info["compared_with"] == "map with a mean of 0.5; all other inputs at their default baselines (0)"
    assert info["baselines"] == {"x": "0", "y": "0", "map": "with a mean of 0.5"}


@pytest.mark.parametrize(
    "method",
    [FeatureAblationScene, ShapleyValueScene, IntegratedGradientsScene, GradientShapScene, OcclusionScene],
)
def test_every_method_keeps_its_baselines_and_shows_a_given_one(method, tmp_path: Path):
    attribute = method(Room(), torch.mean).attribute
    default = attribute(spp=16, replicates=2)
    assert default.info["baselines"]
    assert "compared with" not in table_text(default)

    given = attribute(baselines={"map": 0.25}, spp=16, replicates=2)
    given.save(tmp_path / "one.npz")
    loaded = SceneAttribution.load(tmp_path / "one.npz")
    assert loaded.info["baselines"] == given.info["baselines"]
    assert loaded.info["baselines"]["map"] == "0.25"
    sentence = "compared with: map 0.25"
    assert sentence in table_text(loaded)
    assert sentence in table_html(loaded)
    assert sentence in all_text(plot_bars(loaded))


@pytest.mark.parametrize("method", [FeatureAblationScene, ShapleyValueScene, IntegratedGradientsScene])
def test_inputs_that_the_default_baselines_leave_unchanged_are_named(mi, method):
    scene = {**BUNDLED["cornell-box"](), "metal": {"type": "roughconductor", "alpha": 0.3}}
    scene["short_box_shape"] = {**scene["short_box_shape"], "bsdf": {"type": "ref", "id": "metal"}}
    inputs = ["short_box_shape.bsdf.alpha.value", "floor.reflectance.value"]
    renderer = SceneRenderer(scene, inputs, resolution=(4, 4), spp=16, max_depth=3)
    attribution = method(renderer, torch.mean).attribute(seed=shifted())
    assert attribution.info["baselines"]["short_box_shape.bsdf.alpha.value"] == "unchanged"
    defaults = "compared with: lights and reflectances 0, all other inputs unchanged"
    note = f"{defaults}; compared with itself, so that its 0 says nothing: {attribution.labels[inputs[0]]}"
    for text in (table_text(attribution), all_text(plot_bars(attribution))):
        assert note in " ".join(text.split())


def test_inputs_that_a_mapping_leaves_unchanged_are_named_apart_from_the_defaults(mi):
    scene = {**BUNDLED["cornell-box"](), "metal": {"type": "roughconductor", "alpha": 0.3}}
    scene["short_box_shape"] = {**scene["short_box_shape"], "bsdf": {"type": "ref", "id": "metal"}}
    metal = [f"short_box_shape.bsdf.{name}.value" for name in ("alpha", "eta", "k")]
    renderer = SceneRenderer(scene, [*metal, FLOOR, LIGHT], resolution=(4, 4), spp=16, max_depth=3)
    attribution = FeatureAblationScene(renderer, torch.mean).attribute(baselines={metal[0]: 0.5})
    labels = renderer.labels
    unchanged = f"compared with themselves, so that their 0 says nothing: {labels[metal[1]]}; "
    note = f"{labels[metal[0]]} 0.5; {DEFAULTS}; {unchanged}"
    for text in (table_text(attribution), all_text(plot_bars(attribution))):
        assert note + labels[metal[2]] in " ".join(text.split())


@pytest.mark.parametrize("method", [FeatureAblationScene, ShapleyValueScene])
@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ({"all of it": ["x", "y", "map"]}, "compared with itself in its group: x"),
        ({"first": ["x"], "rest": ["y", "map"]}, "compared with itself, so that its 0 says nothing: first"),
    ],
)
def test_inputs_of_groups_that_are_unchanged_are_named(method, groups: dict[str, list[str]], words: str):
    """A group whose inputs all keep their values has effect 0; one with others does not."""
    room = Room()
    kept = {"x": room.inputs["x"], "y": 0.5, "map": 0.25}
    attribution = method(room, torch.mean).attribute(baselines=kept, groups=groups, spp=16)
    note = f"y 0.5; map 0.25; all other inputs unchanged; {words}"
    text = " ".join(table_text(attribution).split())
    assert note in text
    assert text.count("compared with itself") == 1
    zeros = [name for name, value in attribution.items() if not value.any()]
    assert zeros == [name for name, inputs in groups.items() if inputs == ["x"]]


def test_default_baselines_are_the_same_of_a_scene_with_an_input_at_0():
    black = Room()
    black.inputs["y"] = torch.tensor(0.0)
    first, second = (FeatureAblationScene(room, torch.mean).attribute(spp=16) for room in (Room(), black))
    assert second.info["compared_with"] == "0, all other inputs unchanged"
    assert "different baselines" not in table_text(second - first)


def test_several_baselines_are_named():
    shap = GradientShapScene(Room(), torch.mean)
    several = shap.attribute(baselines=[0.0, 0.1, 0.2], n_samples=4, spp=16)
    assert several.info["baselines"] == "3 baselines"
    named = "(1) all inputs at 0; (2) all inputs at 0.1; (3) all inputs at 0.2"
    assert f"compared with: 3 baselines with equal probability: {named}" in " ".join(
        table_text(several).split()
    )
    one = shap.attribute(baselines=[0.1], n_samples=4, spp=16)
    assert "compared with: all inputs at 0.1" in table_text(one)


def test_a_difference_of_results_with_different_baselines_says_so():
    ablation = FeatureAblationScene(Room(), torch.mean)
    first, second, default = (ablation.attribute(baselines=one, spp=16) for one in (0.1, 0.2, None))
    assert "compared with: all inputs at 0.1" in table_text(first - first)
    for other in (second, default):
        assert "compared with: different baselines" in table_text(first - other)
        assert "compared with: different baselines" in table_text(other + first)


def test_the_page_of_a_report_has_the_note(tmp_path: Path):
    note = "floor 0.2; all other inputs unchanged"
    write_report(make(compared_with=note), tmp_path / "report.html")
    assert f"compared with: {note}" in (tmp_path / "report.html").read_text()
