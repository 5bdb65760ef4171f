import re

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneCaptumError, SceneRenderer, VanillaSceneGradient
from scenecaptum.errors import near_misses
from scenecaptum.metrics import MeanLuminance
from scenecaptum.scene import KINDS

NAMES = (
    "wall_left.reflectance.value",
    "wall_right.reflectance.value",
    "wall_back.reflectance.value",
    "floor.reflectance.data",
    "frame.reflectance.value",
    "rug.reflectance.value",
    "desk.base_color.value",
    "desk.roughness.value",
    "screen.base_color.value",
    "bulb.emitter.radiance.value",
)


@pytest.mark.parametrize(
    ("wrong", "suggested"),
    [
        ("floor.base_color.value", ["floor.reflectance.data"]),  # of other objects, the names are closer
        ("floor.albedo", ["floor.reflectance.data"]),
        ("Floor.reflectance", ["floor.reflectance.data"]),
        ("wall_back.base_color.value", ["wall_back.reflectance.value"]),
        ("flor.reflectance.value", ["floor.reflectance.data"]),
        ("flor", ["floor.reflectance.data"]),
        ("flor.*", ["floor.reflectance.data"]),
        ("flor*", ["floor.reflectance.data"]),
        ("desk.base_colour.value", ["desk.base_color.value", "desk.roughness.value"]),
        ("wall_*.albedo", [name for name in NAMES if name.startswith("wall_")]),
        ("back_wall.reflectance.value", ["wall_back.reflectance.value"]),
        ("wall.albedo", [name for name in NAMES if name.startswith("wall_")]),
        ("radiance", ["bulb.emitter.radiance.value"]),
        ("emiters", ["emitters"]),
        ("reflectence", ["reflectance"]),
        ("table.base_color.value", ["desk.base_color.value", "screen.base_color.value"]),  # no such object
        ("light.radiance", []),  # "light" is no wall_right
        ("xyzzy", []),
    ],
)
def test_suggestions_are_of_the_object_that_was_named(wrong, suggested):
    said = near_misses(wrong, [*KINDS, *NAMES], instead=" See the list.")
    names = re.findall("'(.*?)'", said)
    if not suggested:
        assert said == " See the list."
    elif len(suggested) == 1 and suggested[0] in KINDS:
        assert names[0] == suggested[0]
    else:
        assert set(names) == set(suggested)
        assert names[0] == suggested[0] or wrong.startswith("wall")


def test_names_of_other_objects_are_followed_by_where_all_names_are():
    for wrong, is_other in (("table.base_color.value", True), ("desk.base_colour.value", False)):
        said = near_misses(wrong, NAMES, instead=" See the list.")
        assert said.startswith(" Did you mean 'desk.base_color.value'")
        assert said.endswith(" See the list.") == is_other


def test_at_most_three_names_are_suggested():
    known = [f"plant.leaf_{k}.reflectance.value" for k in range(9)]
    assert near_misses("plant.albedo", known).count("plant.") == 3
    assert near_misses("plant.albedo", known, limit=1).count("plant.") == 1


def test_a_wrong_name_is_answered_by_its_object_or_by_where_the_names_are_listed():
    renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(4, 4), spp=1)
    result = VanillaSceneGradient(renderer, MeanLuminance()).attribute(spp=1, replicates=1, seed=shifted())
    method = VanillaSceneGradient(renderer, MeanLuminance())
    for call in (
        lambda name: renderer({name: torch.tensor(0.1)}),
        lambda name: result[name],
        lambda name: renderer.parameters_table()[name],
        lambda name: method.attribute(spp=1, groups={"a": name}),
    ):
        with pytest.raises(SceneCaptumError, match=r"Did you mean 'floor\.reflectance\.value'\?"):
            call("floor.base_color.value")
        with pytest.raises(SceneCaptumError, match=r"[`(]inputs|list\(attribution\)|Print parameters_table"):
            call("xyzzy")
