"""Describing the parameters of a scene, and selecting some of them."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import message
from rooms import ball, small_scene, table

from scenecaptum.designs import design_of
from scenecaptum.scene import SceneParameters, discover_in, load_scene, near_names, select
from scenecaptum.scene._bounds import Bounds
from scenecaptum.scene._selection import KINDS

Config = dict[str, Any]


def rgb(*value: float) -> Config:
    return {"type": "rgb", "value": list(value)}


@pytest.fixture(scope="module")
def zoo_dict(mi: Any) -> Config:
    """One of each: every kind of material, light and medium, materials shared, nested and seen from behind."""
    ref, inner = {"type": "ref", "id": "shared"}, {"type": "ref", "id": "inner"}
    texels = mi.Bitmap(np.full((4, 5, 3), 0.5, np.float32))
    fog = {
        "type": "homogeneous",
        "albedo": rgb(0.5, 0.6, 0.7),
        "sigma_t": 1.0,
        "phase": {"type": "hg", "g": 0.1},
    }
    return small_scene(
        shared={"type": "diffuse", "reflectance": rgb(0.2, 0.3, 0.4)},
        inner={"type": "diffuse", "reflectance": rgb(0.4, 0.3, 0.2)},
        two_faced={"type": "twosided", "bsdf": inner},
        first=ball(ref),
        second=ball(ref),
        wrapped=ball({"type": "twosided", "bsdf": ref}),
        faced=ball({"type": "ref", "id": "two_faced"}),
        inner_only=ball({"type": "twosided", "bsdf": inner}),
        cut_out=ball({"type": "mask", "opacity": 0.5, "bsdf": ref}),
        mixed=ball({"type": "blendbsdf", "weight": 0.3, "a": ref, "b": {"type": "diffuse"}}),
        gold=ball({"type": "conductor", "material": "Au"}),
        copper=ball({"type": "roughconductor", "material": "Cu", "alpha": 0.2}),
        glass=ball({"type": "dielectric"}),
        frosted=ball({"type": "roughdielectric", "alpha": 0.3}),
        enamel=ball({"type": "plastic", "diffuse_reflectance": rgb(0.1, 0.2, 0.3)}),
        vinyl=ball({"type": "roughplastic", "alpha": 0.2}),
        lacquer=ball({"type": "principled", "base_color": rgb(0.1, 0.2, 0.3), "roughness": 0.3}),
        poster=ball({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texels, "raw": True}}),
        lamp=ball({"type": "diffuse"}, emitter={"type": "area", "radiance": rgb(1, 2, 3)}),
        spot={"type": "point", "position": [0, 0, 3], "intensity": rgb(1, 1, 1)},
        sky={"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))},
        mist=ball({"type": "null"}, interior=fog),
        crate={"type": "cube", "bsdf": ref},
    )


@pytest.fixture(scope="module")
def zoo(zoo_dict: Config) -> SceneParameters:
    return table(zoo_dict)


# --- Discovery -------------------------------------------------------------------------------------

UNIT, POSITIVE, NON_NEGATIVE = "[0, 1]", "(0, ∞)", "[0, ∞)"
ALL_SHARERS = "shared wrapped cut_out mixed"

EXPECTED = {
    "shared.reflectance.value": ("reflectance", (3,), UNIT, ALL_SHARERS),
    # No shape uses it directly: it belongs to the two materials that contain it.
    "inner.reflectance.value": ("reflectance", (3,), UNIT, "two_faced inner_only"),
    "cut_out.bsdf.opacity.value": ("opacity", (), UNIT, "cut_out"),
    "mixed.bsdf.weight.value": ("opacity", (), UNIT, "mixed"),
    "mixed.bsdf.bsdf_1.reflectance.value": ("reflectance", (), UNIT, "mixed"),
    # A mirror without a named metal has an index of exactly 0.
    "gold.bsdf.eta.value": ("ior", (3,), NON_NEGATIVE, "gold"),
    "gold.bsdf.k.value": ("ior", (3,), NON_NEGATIVE, "gold"),
    "gold.bsdf.specular_reflectance.value": ("reflectance", (), UNIT, "gold"),
    "copper.bsdf.alpha.value": ("roughness", (), "(0, 1]", "copper"),
    "enamel.bsdf.diffuse_reflectance.value": ("reflectance", (3,), UNIT, "enamel"),
    "vinyl.bsdf.alpha": ("roughness", (), "(0, 1]", "vinyl"),
    "vinyl.bsdf.eta": ("ior", (), POSITIVE, "vinyl"),
    "lacquer.bsdf.base_color.value": ("reflectance", (3,), UNIT, "lacquer"),
    "lacquer.bsdf.roughness.value": ("roughness", (), "(0, 1]", "lacquer"),
    "lacquer.bsdf.metallic.value": ("surface", (), UNIT, "lacquer"),
    "poster.bsdf.reflectance.data": ("reflectance", (4, 5, 3), UNIT, "poster"),
    "lamp.emitter.radiance.value": ("emitters", (3,), NON_NEGATIVE, "lamp"),
    "spot.intensity.value": ("emitters", (3,), NON_NEGATIVE, "spot"),
    "sky.scale": ("emitters", (), NON_NEGATIVE, "sky"),
    "mist.interior_medium.albedo.value.value": ("media", (3,), UNIT, "mist"),
    "mist.interior_medium.sigma_t.value.value": ("media", (), NON_NEGATIVE, "mist"),
    "mist.interior_medium.phase_function.g": ("media", (), "[−1, 1]", "mist"),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_parameter_is_described(zoo: SceneParameters, name: str) -> None:
    p = zoo[name]
    kind, shape, bounds, owners = EXPECTED[name]
    assert (p.problem, p.kind, p.shape, str(p.bounds)) == (None, kind, shape, bounds)
    assert sorted(p.owners) == sorted(owners.split())


def test_the_sky_is_a_light_and_not_a_texture(zoo: SceneParameters) -> None:
    sky = zoo["sky.data"]
    assert (sky.kind, len(sky.shape), sky.is_texture, sky.problem) == ("emitters", 3, False, None)
    assert zoo["poster.bsdf.reflectance.data"].is_texture


def test_a_transformation_has_the_shape_of_its_matrix(zoo: SceneParameters) -> None:
    assert zoo["first.to_world"].shape == zoo["eye.to_world"].shape == (4, 4)
    to_uv = zoo["poster.bsdf.reflectance.to_uv"]
    assert (to_uv.shape, to_uv.is_texture) == ((3, 3), False)
    assert to_uv.bounds == to_uv.range == Bounds()
    assert any(
        line.startswith("first.to_world ") and line.split()[2] == "4×4" for line in str(zoo).splitlines()
    )


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("crate.vertex_positions", "changes visibility"),
        ("first.to_world", "changes visibility"),
        ("crate.faces", "geometry"),
        ("eye.to_world", "camera"),
        ("eye.x_fov", "camera"),
        ("lamp.emitter.sampling_weight", "how samples are drawn"),
        ("lacquer.bsdf.main_specular_sampling_rate", "how samples are drawn"),
        ("poster.bsdf.reflectance.to_uv", "transformation"),
        ("spot.position", "positions a light"),
    ],
)
def test_parameters_without_derivative_have_a_reason(zoo: SceneParameters, name: str, reason: str) -> None:
    assert reason in (zoo[name].problem or "differentiable")
    assert zoo[name].status.startswith("not differentiable: ")
    # Selected by its exact name, it is refused with the same reason.
    assert reason in message(lambda: select(zoo, name))


@pytest.mark.parametrize("name", ["glass.bsdf.eta", "mist.interior_medium.scale"])
def test_parameters_that_mitsuba_does_not_track_use_finite_differences(
    zoo: SceneParameters, name: str
) -> None:
    assert (zoo[name].status, zoo[name].tracked) == ("differentiable", False)


@pytest.mark.parametrize(
    "name", ["shared.reflectance.value", "copper.bsdf.alpha.value", "vinyl.bsdf.diffuse_reflectance.value"]
)
def test_a_correct_derivative_carries_no_caution(zoo: SceneParameters, name: str) -> None:
    assert zoo[name].status == "differentiable"


def test_names_are_those_of_mitsuba_unmerged(mi: Any, zoo_dict: Config, zoo: SceneParameters) -> None:
    assert list(zoo) == list(mi.traverse(mi.load_dict(zoo_dict, optimize=False)).keys())


def test_the_scale_of_a_bump_map_is_not_labelled_as_that_of_its_object(mi: Any) -> None:
    relief = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((4, 4, 1), 0.5, np.float32))}
    bumpy = {"type": "bumpmap", "relief": relief, "scale": 2.0, "nested": {"type": "diffuse"}}
    found = table(small_scene(tile=ball({"type": "twosided", "bumpy": bumpy})))
    labels = {one.label for one in found.values() if not one.problem}
    assert {"tile: bump scale", "tile: bump texture", "tile: reflectance"} <= labels
    assert "tile: scale" not in labels


def test_textures_that_bend_normals_have_a_caution(mi: Any) -> None:
    """Where a bent normal turns away from the ray, shading jumps."""
    texels = np.full((4, 4, 3), 0.5, np.float32)
    image = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}
    uniform = {"type": "rgb", "value": [0.5, 0.6, 0.9]}
    for normals in (image, uniform):
        surface = {"type": "normalmap", "normalmap": normals, "bsdf": {"type": "diffuse"}}
        found = [one for one in table(small_scene(tile=ball(surface))).values() if one.role == "normalmap"]
        cautions = [one.caution or "" for one in found if not one.problem]
        assert ["turns away from the viewer" in caution for caution in cautions] == [True]


def test_bounds_of_a_sky_are_those_of_mitsuba(mi: Any) -> None:
    found = table(small_scene(sky={"type": "sunsky"}))
    assert str(found["sky.turbidity"].bounds) == "[1, 10]"
    assert str(found["sky.albedo.value"].bounds) == "[0, 1]"


def test_effects_of_a_cone_are_from_zero_to_its_angle(mi: Any) -> None:
    found = table(small_scene(spot={"type": "spot", "cutoff_angle": 20.0, "beam_width": 15.0}))
    for name in ("spot.cutoff_angle", "spot.beam_width"):
        assert str(found[name].bounds) == "[0, 180]"
        assert str(found[name].range) == "[0, ∞)"


@pytest.mark.parametrize("has_texture", [False, True])
def test_the_texture_of_a_spot_is_an_input_only_if_there_is_one(mi: Any, has_texture: bool) -> None:
    slide = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.5, np.float32))}
    found = table(small_scene(spot={"type": "spot"} | ({"texture": slide} if has_texture else {})))
    problems = {one.name: one.problem or "" for one in found.values() if one.role == "texture"}
    if has_texture:
        assert problems["spot.texture.data"] == ""
    else:
        assert "has no texture" in problems["spot.texture.value"]


@pytest.mark.parametrize("order", [("paint", "wall", "floor"), ("wall", "paint", "floor")])
def test_a_shared_material_has_its_own_label_wherever_it_is_defined(mi: Any, order: tuple[str, ...]) -> None:
    """A material that is referred to before it is defined gets a name within the first shape."""
    using = {"type": "rectangle", "material": {"type": "ref", "id": "paint"}}
    parts = {"paint": {"type": "diffuse"}, "wall": using, "floor": using}
    found = table(small_scene(**{name: parts[name] for name in order}))
    assert "paint: reflectance" in {one.label for one in found.values()}


def listed_textures(mi: Any) -> Config:
    """Textures that the scene lists, and that materials refer to."""
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.4, np.float32)), "raw": True}
    refs = {name: {"type": "ref", "id": name} for name in ("wood", "rough", "tiles", "paint", "metal")}
    return {
        "type": "scene",
        "wood": bitmap,
        "rough": bitmap,
        "tiles": {"type": "checkerboard"},
        "spare": bitmap,
        "paint": {"type": "diffuse", "reflectance": refs["wood"]},
        "metal": {"type": "roughconductor", "alpha": refs["rough"]},
        "lower": {"type": "rectangle", "bsdf": refs["paint"]},
        "ball": {"type": "sphere", "bsdf": refs["metal"]},
        "cube": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": refs["tiles"]}},
        "sky": {"type": "constant"},
        "camera": {"type": "perspective"},
    }


def test_textures_that_the_scene_lists_belong_to_the_materials_that_read_them(mi: Any) -> None:
    found = table(listed_textures(mi))
    textures = ("wood", "rough", "tiles", "spare")
    assert {
        name: (p.label, p.kind, p.shape, str(p.bounds), p.owners, p.is_used)
        for name, p in found.items()
        if name.partition(".")[0] in textures and not p.problem
    } == {
        "wood.data": ("wood: reflectance texture", "reflectance", (4, 4, 3), "[0, 1]", ("paint",), True),
        "rough.data": ("rough: roughness texture", "roughness", (4, 4, 1), "(0, 1]", ("metal",), True),
        "tiles.color0.value": ("tiles: reflectance color0", "reflectance", (), "[0, 1]", ("cube",), True),
        "tiles.color1.value": ("tiles: reflectance color1", "reflectance", (), "[0, 1]", ("cube",), True),
        "spare.data": ("spare: map", "scene", (4, 4, 3), "(−∞, ∞)", (), False),
    }
    assert select(found, "reflectance") == ("wood.data", "tiles.color0.value", "tiles.color1.value")


def test_textures_of_a_users_scene_are_named_after_their_plugin(mi: Any) -> None:
    found = table(mi.load_dict(listed_textures(mi), optimize=False))
    assert {name: found[name].kind for name in found if name.endswith(".data")} == {
        "bitmap.data": "reflectance",
        "bitmap_2.data": "roughness",
        "bitmap_3.data": "scene",
    }


def test_labels_are_unique_and_short(zoo: SceneParameters) -> None:
    labels = [p.label for p in zoo.values()]
    assert len(set(labels)) == len(labels)
    assert zoo["poster.bsdf.reflectance.data"].label == "poster: reflectance texture"
    assert zoo["lamp.emitter.radiance.value"].label == "lamp: radiance"
    assert zoo["lamp.bsdf.reflectance.value"].label == "lamp: surface reflectance"


def test_the_scenes_own_values_are_within_their_bounds(
    mi: Any, zoo_dict: Config, zoo: SceneParameters
) -> None:
    values = mi.traverse(load_scene(zoo_dict))
    outside = {}
    for name, p in zoo.items():
        if p.problem is None:
            value = np.array(values[name])
            if value.min() < p.bounds.low or value.max() > p.bounds.high:
                outside[name] = (value.min(), value.max(), str(p.bounds))
    assert not outside


def test_the_table_prints_one_line_per_parameter(
    zoo: SceneParameters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)  # a terminal of this width would cut it
    header, *lines = str(zoo).splitlines()
    assert header.split() == ["name", "kind", "shape", "bounds", "owner", "status"]
    assert [line.split()[0] for line in lines] == list(zoo)
    assert all(p.status in line for p, line in zip(zoo.values(), lines, strict=True))


def test_an_unknown_parameter_raises_with_a_similar_name(zoo: SceneParameters) -> None:
    said = message(lambda: zoo["shared.reflectanse.value"])
    assert "Did you mean 'shared.reflectance.value'" in said


def test_the_table_is_a_mapping_for_unknown_names_too(zoo: SceneParameters) -> None:
    assert "shared" not in zoo
    assert zoo.get("shared") is None
    assert zoo.get("shared", "other") == "other"


# --- Selection -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "inside", "outside"),
    [
        ("reflectance", "shared.reflectance.value", "copper.bsdf.alpha.value"),
        ("roughness", "vinyl.bsdf.alpha", "vinyl.bsdf.eta"),
        ("ior", "glass.bsdf.eta", "copper.bsdf.alpha.value"),
        ("opacity", "mixed.bsdf.weight.value", "shared.reflectance.value"),
        ("surface", "lacquer.bsdf.sheen.value", "lacquer.bsdf.roughness.value"),
        ("textures", "poster.bsdf.reflectance.data", "sky.data"),
        ("emitters", "sky.data", "lamp.emitter.sampling_weight"),
        ("media", "mist.interior_medium.scale", "lamp.emitter.radiance.value"),
        ("materials", "lacquer.bsdf.sheen.value", "lamp.emitter.radiance.value"),
        ("all", "lamp.emitter.radiance.value", "crate.vertex_positions"),
    ],
)
def test_a_kind_selects_its_differentiable_parameters(
    zoo: SceneParameters, kind: str, inside: str, outside: str
) -> None:
    chosen = select(zoo, kind)
    assert inside in chosen
    assert outside not in chosen
    assert [name for name in chosen if zoo[name].problem] == []
    assert kind in KINDS


def test_every_kind_of_a_differentiable_parameter_can_be_selected(zoo: SceneParameters) -> None:
    kinds = {p.kind for p in zoo.values() if not p.problem}
    assert len(kinds) > 5
    for kind in kinds:
        assert {*select(zoo, kind)} == {p.name for p in zoo.values() if p.kind == kind and not p.problem}


def test_kinds_partition_the_differentiable_parameters(zoo: SceneParameters) -> None:
    parts = [select(zoo, kind) for kind in ("materials", "emitters", "media")]
    assert sorted(name for part in parts for name in part) == sorted(select(zoo, "all"))
    assert set(select(zoo, "all")) == {name for name, p in zoo.items() if not p.problem}


def test_a_glob_an_exact_name_and_a_list(zoo: SceneParameters) -> None:
    assert select(zoo, "shared.reflectance.value") == ("shared.reflectance.value",)
    assert select(zoo, "gold.*.k.*") == ("gold.bsdf.k.value",)
    assert set(select(zoo, "vinyl.*")) == {
        "vinyl.bsdf.alpha",
        "vinyl.bsdf.eta",
        "vinyl.bsdf.diffuse_reflectance.value",
    }
    assert set(select(zoo, ["media", "sky.*", "sky.scale"])) == {
        *select(zoo, "media"),
        "sky.scale",
        "sky.data",
    }


def test_selections_come_in_the_scenes_order_once_each(zoo: SceneParameters) -> None:
    chosen = select(zoo, ["sky.scale", "reflectance", "shared.reflectance.value", "*.reflectance.value"])
    order = [name for name in zoo if name in chosen]
    assert list(chosen) == order


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        ("reflectanse", ["matches no parameter", "'reflectance'", "parameters_table()"]),
        ("shared.reflectance.valu", ["matches no parameter", "'shared.reflectance.value'"]),
        (["reflectance", "nothing.*"], ["'nothing.*'", "matches no parameter"]),
        ("emitter", ["matches no parameter", "Did you mean 'emitters'?"]),
        ("shared", ["matches no parameter", "Did you mean 'shared.*'?"]),
        ("*.to_world", ["none of which can be differentiated", "eye.to_world", "camera"]),
        ([], ["selects nothing", "reflectance"]),
        ([3], ["int"]),
    ],
)
def test_an_empty_selection_is_explained(zoo: SceneParameters, inputs: Any, words: list[str]) -> None:
    said = message(lambda: select(zoo, inputs))
    assert [word for word in words if word not in said] == [], said


def test_a_kind_that_the_scene_lacks_is_answered_with_those_that_it_has() -> None:
    scene = {"type": "scene", "eye": {"type": "perspective"}, "lamp": {"type": "point"}}
    said = message(lambda: select(discover_in(scene), "media"))
    assert said.endswith("the scene has no parameter of this kind. It has emitters, poses, camera, all.")


@pytest.mark.parametrize(
    ("glob", "instead"),
    [
        ("*.translation", "*.pose.translation"),
        ("chair.*tion", "chair.pose.*tion"),
        ("chair*", "chair*.pose.*"),
        ("camera.*", "camera"),
        ("*translation", "chair.pose.translation"),
    ],
)
def test_a_glob_of_poses_is_told_how_to_select_them(glob: str, instead: str) -> None:
    """What is suggested selects the same poses, and those of no other object."""
    poses = [p for p in discover_in("office").values() if p.moves and p.owners[0] in ("chair", "camera")]
    said = message(lambda: select(SceneParameters(poses), glob))
    assert "matches only poses" in said
    assert f"write {instead!r}" in said
    selected = select(SceneParameters(poses), instead)
    assert set(selected) <= {p.name for p in poses if fnmatchcase(p.name, glob)}


def test_a_shape_is_told_the_object_that_it_is_a_part_of() -> None:
    parameters = discover_in("office")
    said = message(lambda: select(parameters, "chair_seat.pose.translation"))
    assert (
        "'chair_seat' is part of the object 'chair': select 'chair.pose.translation', or list it in" in said
    )
    assert "Did you mean" not in said
    assert "is part of" not in message(lambda: select(parameters, "chairs.pose.translation"))
    assert "is part of" not in message(lambda: select(parameters, "chair_seat.reflectance"))


@pytest.mark.parametrize("inputs", ["paint", "paint*", "paint.*", "paint.base_color"])
def test_the_id_of_a_material_in_no_name_is_told_what_its_parameters_are_called(mi: Any, inputs: str) -> None:
    paint = {
        "type": "principled",
        "id": "paint",
        "base_color": {"type": "rgb", "value": 0.5},
        "roughness": 0.4,
    }
    cube = {"type": "cube", "bsdf": paint}
    camera = {"type": "perspective"}
    parameters = discover_in({"type": "scene", "camera": camera, "cube": cube, "sky": {"type": "constant"}})
    assert "The parameters of 'paint' are 'cube.bsdf.*'." in message(lambda: select(parameters, inputs))
    assert len(select(parameters, "cube.bsdf.*")) > 1


def test_a_hint_for_an_id_with_brackets_is_a_glob_that_matches_it(mi: Any) -> None:
    paint = {"type": "diffuse", "id": "paint"}
    scene = {"type": "scene", "camera": {"type": "perspective"}, "cube[2]": {"type": "cube", "bsdf": paint}}
    parameters = discover_in(scene)
    said = message(lambda: select(parameters, "paint"))
    (glob,) = re.findall(r"The parameters of 'paint' are '(.*)'\.", said)
    assert len(select(parameters, glob)) == 1


def test_the_radiance_of_a_shape_whose_material_is_shared_is_told_its_own_name() -> None:
    said = message(lambda: select(discover_in("office"), "sky.radiance.value"))
    assert "Did you mean 'sky.emitter.radiance.value'" in said
    assert "The material of" not in said


@pytest.mark.parametrize(
    ("inputs", "meant"),
    [
        ("ball.bsdf.alpha", "metal.alpha.value"),
        ("ball.alpha*", "metal.alpha.value"),
        ("ball.pose.sale", "ball.pose"),
    ],
)
def test_a_shape_is_told_the_name_of_its_shared_material(mi: Any, inputs: str, meant: str) -> None:
    metal = {"type": "roughconductor", "alpha": 0.3}
    camera, ref = {"type": "perspective"}, {"type": "ref", "id": "metal"}
    shapes = {"ball": {"type": "sphere", "own": ref}, "cube": {"type": "cube", "own": ref}}
    parameters = discover_in({"type": "scene", "camera": camera, "metal": metal, **shapes})
    said = message(lambda: select(parameters, inputs))
    assert f"Did you mean '{meant}" in said
    hint = "The material of 'ball' is 'metal.*'."
    assert (hint in said) == meant.startswith("metal")
    # The same of the name in a design.
    renderer = SimpleNamespace(inputs=dict.fromkeys(parameters), parameters=parameters)
    said = message(lambda: design_of(renderer, {inputs: 0.2}))
    assert (hint in said) == meant.startswith("metal")
    assert f"Did you mean '{meant}" in said


@pytest.mark.parametrize("inputs", ["sensor.*", "sensor.film.*", "sensor.fov", "camera.x_fov"])
def test_a_selection_of_the_sensor_is_told_how_the_camera_is_called(inputs: str) -> None:
    said = message(lambda: select(discover_in("cornell-box"), inputs))
    names = "camera.pose.translation, camera.pose.rotation, camera.fov"
    assert f"Select the camera as {names}, or all of these as 'camera'." in said


def test_a_misspelt_object_in_a_glob_is_told_its_name() -> None:
    said = message(lambda: select(discover_in("cornell-box"), "flor.*"))
    assert "Did you mean 'floor.*'" in said


@pytest.mark.parametrize(
    ("glob", "meant"),
    [
        ("*box.specular_reflectance*", "tall_box.reflectance.value"),
        ("*.reflectanse.*", "reflectance"),
        ("flor.reflectance*", "floor.reflectance*"),
        ("ligt.*", "light.*"),
        ("*.bsdf_9.*", ""),
    ],
)
def test_a_glob_without_a_match_is_told_only_what_matches(glob: str, meant: str) -> None:
    parameters = discover_in("cornell-box")
    _, _, hint = message(lambda: select(parameters, glob)).partition("Did you mean ")
    suggested = re.findall("'([^']*)'", hint.partition("?")[0])
    assert all(select(parameters, one) for one in suggested)
    assert meant in suggested if meant else not suggested


@pytest.mark.parametrize("wrong", ["lamp[1]", "lamp[1].*"])
def test_a_glob_that_is_suggested_for_an_id_with_brackets_matches_it(wrong: str) -> None:
    name = "lamp[1].emitter.radiance.value"
    (glob,) = re.findall("'([^']*)'", near_names(wrong, [name, "floor.reflectance.value"]))
    assert fnmatchcase(name, glob)


def test_a_kind_without_parameters_is_named(mi: Any) -> None:
    said = message(lambda: select(table("cornell-box"), "media"))
    assert "'media'" in said
    assert "Did you mean" not in said


def test_a_published_scene_loads_with_differentiable_textures(mi: Any, shared_scenes: Path) -> None:
    room = shared_scenes / "living-room" / "scene.xml"
    if not room.is_file():
        pytest.skip(f"{room} does not exist")
    described = table(room)
    assert len(select(described, "textures")) >= 1
    assert [p.problem for p in described.values() if p.name.endswith(".data") and p.problem] == []
    assert all(p.caution is None for p in described.values() if p.name.endswith("reflectance.data"))
