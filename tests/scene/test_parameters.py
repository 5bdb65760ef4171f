"""Loading a scene, describing its parameters, and selecting some of them."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenecaptum.errors import SceneCaptumError
from scenecaptum.scene import BUNDLED, SceneParameters, discover, load_scene, select
from scenecaptum.scene._graph import SceneGraph
from scenecaptum.scene._selection import KINDS

Config = dict[str, Any]

XML = """<scene version="3.0.0">
    <integrator type="path"/>
    <sensor type="perspective" id="eye">
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    <shape type="sphere" id="ball">
        <bsdf type="diffuse" id="paint">
            <texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/></texture>
        </bsdf>
    </shape>
    <emitter type="constant" id="sky"/>
</scene>"""


def table(scene: Any) -> SceneParameters:
    return discover(SceneGraph(load_scene(scene)))


def rgb(*value: float) -> Config:
    return {"type": "rgb", "value": list(value)}


def camera() -> Config:
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    return {
        "type": "perspective",
        "film": film,
        "sampler": {"type": "independent", "sample_count": 1},
    }


def ball(bsdf: Config, **more: Any) -> Config:
    return {"type": "sphere", "bsdf": bsdf, **more}


def small(**objects: Any) -> Config:
    return {"type": "scene", "eye": camera(), **objects}


def message(call: Callable[[], Any]) -> str:
    with pytest.raises(SceneCaptumError) as caught:
        call()
    return str(caught.value)


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
    return small(
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


@pytest.fixture
def painted(mi: Any, tmp_path: Path) -> Path:
    """A scene file with an 8-bit picture beside it; returns the file."""
    folder = tmp_path / "room"
    folder.mkdir()
    mi.Bitmap(np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3) * 4).write(str(folder / "paint.png"))
    path = folder / "scene.xml"
    path.write_text(XML)
    return path


# --- Loading ---------------------------------------------------------------------------------------


def test_a_missing_scene_names_the_bundled_ones_and_a_similar_name(mi: Any) -> None:
    said = message(lambda: load_scene("cornel-box"))
    assert all(name in said for name in BUNDLED), said
    assert "Did you mean 'cornell-box'?" in said


def test_a_folder_is_refused_with_the_file_inside_it(mi: Any, painted: Path, tmp_path: Path) -> None:
    said = message(lambda: load_scene(painted.parent))
    assert "is a folder" in said
    assert str(painted) in said
    (tmp_path / "empty").mkdir()
    assert "no .xml" in message(lambda: load_scene(tmp_path / "empty"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<scene version='3.0.0'><sensor", ["broken.xml", "cannot be loaded"]),
        ("<scene version='3.0.0'><shape type='sphree'/></scene>", ["broken.xml", "sphree"]),
        ("<scene version='3.0.0'></scene>", ["broken.xml", "no sensor", "<sensor"]),
        (XML, ["broken.xml", "paint.png"]),
    ],
    ids=["syntax", "plugin", "sensor", "missing texture"],
)
def test_a_broken_file_is_named_with_the_reason(mi: Any, tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "broken.xml"
    path.write_text(text)
    said = message(lambda: load_scene(path))
    assert [word for word in words if word not in said] == [], said
    assert "\n" not in said


OPEN = XML.replace('name="width" value="8"', 'name="width" value="$size"').replace(
    '<shape type="sphere" id="ball">',
    '<default name="r" value="2"/><shape type="sphere" id="ball">'
    '<float name="radius" value="$r"/><boolean name="flip_normals" value="$flip"/>',
)


@pytest.fixture
def open_scene(painted: Path) -> Path:
    """A scene file with two placeholders that have no default, and one that has."""
    painted.write_text(OPEN)
    return painted


@pytest.mark.parametrize(
    ("given", "radius"),
    [
        ({"size": 8, "flip": True}, 2.0),
        ({"size": "8", "flip": "false", "r": 0.5}, 0.5),
        ({"size": np.int64(8), "flip": False, "r": np.float32(0.25)}, 0.25),
    ],
)
def test_placeholders_get_their_values(
    mi: Any, open_scene: Path, given: dict[str, Any], radius: float
) -> None:
    scene = load_scene(open_scene, given)
    assert tuple(scene.sensors()[0].film().size()) == (8, 8)
    assert float(scene.shapes()[0].bbox().max.x) == pytest.approx(radius)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (None, "no value for $flip, $size: give parameters={'flip': …, 'size': …}, or -D flip=… -D size=…"),
        ({"flip": True}, "no value for $size: give parameters={'size': …}, or -D size=…"),
        (
            {"flip": True, "size": 8, "sizes": 3},
            "no placeholder $sizes. Did you mean 'size'?",
        ),
        ({"flip": True, "size": 8, "zzz": 3}, "It has $flip, $r, $size."),
        ({"$flip": True, "size": 8}, "the key '$flip'; keys are the $names of the file without $"),
        ({"flip": None, "size": 8}, "gives $flip a NoneType; values are numbers and strings"),
        ([("size", 8)], "must be a mapping such as {'spp': 64}, not list"),
        ({"flip": True, "size": "wide"}, 'could not parse integer value "wide"'),
    ],
)
def test_placeholders_and_values_that_do_not_match_are_named(
    mi: Any, open_scene: Path, given: Any, words: str
) -> None:
    assert words in message(lambda: load_scene(open_scene, given))


def test_placeholders_of_included_files_are_found(mi: Any, open_scene: Path) -> None:
    whole = open_scene.parent / "whole.xml"
    whole.write_text('<scene version="3.0.0"><include filename="$room.xml"/></scene>')
    said = message(lambda: load_scene(whole, {"room": "scene", "flip": True}))
    assert "no value for $size:" in said
    load_scene(whole, {"room": "scene", "flip": True, "size": 8})
    assert "It has $flip, $r, $room, $size." in message(
        lambda: load_scene(whole, {"room": "scene", "flip": True, "size": 8, "w": 1})
    )


def test_values_beside_anything_but_a_file_are_refused(mi: Any) -> None:
    scene = small(ball=ball({"type": "diffuse"}))
    for one in (scene, mi.load_dict(scene), "office"):
        assert "parameters= gives values to the $names of an XML file" in message(
            lambda one=one: load_scene(one, {"spp": 4})
        )
    assert "There is no scene file 'nowhere.xml'" in message(lambda: load_scene("nowhere.xml", {"spp": 4}))


def test_a_scene_dict_without_a_sensor_is_refused(mi: Any) -> None:
    assert "the scene dict has no sensor" in message(
        lambda: load_scene({"type": "scene", "a": {"type": "sphere"}})
    )


def test_a_dict_that_is_not_a_scene_is_refused(mi: Any) -> None:
    assert "not a scene" in message(lambda: load_scene({"type": "sphere"}))


def test_a_property_that_a_plugin_does_not_know_is_named(mi: Any) -> None:
    assert "radiuss" in message(lambda: load_scene(small(ball={"type": "sphere", "radiuss": 2.0})))


def test_a_failed_load_leaves_no_emitter_behind(mi: Any) -> None:
    """While the error is alive, a lamp without its shape would crash any render."""
    import drjit as dr

    def lights() -> set[int]:
        def lives(index: int) -> bool:
            try:
                return dr.reinterpret_array(mi.EmitterPtr, mi.UInt32(index))[0] is not None
            except RuntimeError:
                return False

        return set(filter(lives, range(1, 200)))

    before = lights()
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    loaded = load_scene(small(lamp=lamp))
    assert lights() - before, "the lights of a scene that lives are not found"
    del loaded
    with pytest.raises(SceneCaptumError) as held:
        load_scene(small(lamp=lamp, ball=ball({"type": "diffuse", "gloss": 1.0})))
    assert "gloss" in str(held.value)
    assert lights() <= before


@pytest.mark.parametrize("scene", [None, 3, ["cornell-box"], object()])
def test_a_scene_of_another_type_is_refused_by_its_type(mi: Any, scene: Any) -> None:
    assert type(scene).__name__ in message(lambda: load_scene(scene))


def test_a_loaded_scene_is_used_as_it_is(mi: Any) -> None:
    scene = mi.load_dict(small(ball=ball({"type": "diffuse"})))
    assert load_scene(scene) is scene


def test_textures_are_found_beside_the_file_and_the_search_path_is_left_alone(mi: Any, painted: Path) -> None:
    before, found = mi.file_resolver(), str(mi.file_resolver())
    load_scene(painted)
    load_scene(str(painted))
    (painted.parent / "paint.png").unlink()
    message(lambda: load_scene(painted))  # also where loading fails
    assert str(mi.file_resolver()) == found
    assert mi.file_resolver() is before


def test_loading_does_not_change_the_callers_dict(mi: Any, painted: Path) -> None:
    bitmap = {"type": "bitmap", "filename": str(painted.parent / "paint.png")}
    scene = small(ball=ball({"type": "diffuse", "reflectance": bitmap}))
    found = copy.deepcopy(scene)
    load_scene(scene)
    assert scene == found


def test_eight_bit_pictures_become_differentiable_and_keep_their_values(mi: Any, painted: Path) -> None:
    png = painted.parent / "paint.png"
    bitmap = {"type": "bitmap", "filename": str(png)}
    from_file, from_dict = (
        load_scene(painted),
        load_scene(small(b=ball({"type": "diffuse", "reflectance": bitmap}))),
    )
    encoded = np.array(mi.Bitmap(str(png)), dtype=np.float64) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    for scene, name in ((from_file, "ball.bsdf.reflectance.data"), (from_dict, "b.bsdf.reflectance.data")):
        described = table(scene)[name]
        assert (described.problem, described.shape) == (None, (4, 5, 3))
        texels = np.array(mi.traverse(scene)[name])
        error = np.abs(texels - linear).max()
        assert error < 1e-5, f"texels are {error:.2g} off the sRGB curve; allowed 1e-5"


def test_eight_bit_texels_of_the_users_scene_are_refused_with_the_fix(mi: Any, painted: Path) -> None:
    own = table(mi.load_file(str(painted), optimize=False))
    for call in (lambda: select(own, "ball.bsdf.reflectance.data"), lambda: select(own, "textures")):
        said = message(call)
        assert "8 bits" in said
        assert 'format="variant"' in said


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
    "mist.interior_medium.phase_function.g": ("media", (), "[-1, 1]", "mist"),
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


def test_labels_are_unique_and_short(zoo: SceneParameters) -> None:
    labels = [p.label for p in zoo.values()]
    assert len(set(labels)) == len(labels)
    assert zoo["poster.bsdf.reflectance.data"].label == "poster: reflectance texture"
    assert zoo["lamp.emitter.radiance.value"].label == "lamp: radiance"


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


def test_a_material_of_one_shape_is_named_by_its_id(mi: Any, painted: Path) -> None:
    assert table(painted)["ball.bsdf.reflectance.data"].owners == ("paint",)


# --- Selection -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "inside", "outside"),
    [
        ("reflectance", "shared.reflectance.value", "copper.bsdf.alpha.value"),
        ("roughness", "vinyl.bsdf.alpha", "vinyl.bsdf.eta"),
        ("ior", "glass.bsdf.eta", "copper.bsdf.alpha.value"),
        ("opacity", "mixed.bsdf.weight.value", "shared.reflectance.value"),
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
        ("*.to_world", ["none of which can be differentiated", "eye.to_world", "camera"]),
        ([], ["selects nothing", "reflectance"]),
        ([3], ["int"]),
    ],
)
def test_an_empty_selection_is_explained(zoo: SceneParameters, inputs: Any, words: list[str]) -> None:
    said = message(lambda: select(zoo, inputs))
    assert [word for word in words if word not in said] == [], said


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
