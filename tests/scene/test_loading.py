"""Loading scenes: files, placeholders, dicts and loaded scenes, and what is refused."""

from __future__ import annotations

import copy
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bitmaps import write_bitmap
from refusals import message
from rooms import ball, small_scene, table

from scenecaptum import SceneRenderer
from scenecaptum.errors import SceneCaptumError
from scenecaptum.scene import BUNDLED, load_scene, select

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


@pytest.fixture
def painted(mi: Any, tmp_path: Path) -> Path:
    """A scene file with an 8-bit picture beside it; returns the file."""
    folder = tmp_path / "room"
    folder.mkdir()
    mi.Bitmap(np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3) * 4).write(str(folder / "paint.png"))
    path = folder / "scene.xml"
    path.write_text(XML)
    return path


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
    ("name", "content"), [("room.glb", b"glTF\x02\0"), ("room.png", b"\x89PNG"), ("a.xml", b"")]
)
def test_a_file_of_another_kind_is_refused(mi: Any, tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    said = message(lambda: load_scene(tmp_path / name))
    assert "is not a scene in Mitsuba's XML" in said


def test_a_dict_without_a_sensor_gets_one_of_a_dict(mi: Any) -> None:
    said = message(lambda: load_scene({"type": "scene", "ball": {"type": "sphere"}}))
    assert '{"type": "perspective"}' in said


def test_a_mesh_is_refused_with_its_place_in_a_scene(mi: Any, tmp_path: Path) -> None:
    (tmp_path / "chair.ply").write_text("ply\n")
    said = message(lambda: load_scene(tmp_path / "chair.ply"))
    assert "is a mesh, not a scene" in said
    assert '{"type": "ply", "filename": "chair.ply"}' in said


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
    scene = small_scene(ball=ball({"type": "diffuse"}))
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
    assert "radiuss" in message(lambda: load_scene(small_scene(ball={"type": "sphere", "radiuss": 2.0})))


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
    loaded = load_scene(small_scene(lamp=lamp))
    assert lights() - before, "the lights of a scene that lives are not found"
    del loaded
    with pytest.raises(SceneCaptumError) as held:
        load_scene(small_scene(lamp=lamp, ball=ball({"type": "diffuse", "gloss": 1.0})))
    assert "gloss" in str(held.value)
    assert lights() <= before


@pytest.mark.parametrize("scene", [None, 3, ["cornell-box"], object()])
def test_a_scene_of_another_type_is_refused_by_its_type(mi: Any, scene: Any) -> None:
    assert type(scene).__name__ in message(lambda: load_scene(scene))


def test_a_loaded_scene_is_used_as_it_is(mi: Any) -> None:
    scene = mi.load_dict(small_scene(ball=ball({"type": "diffuse"})))
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
    scene = small_scene(ball=ball({"type": "diffuse", "reflectance": bitmap}))
    found = copy.deepcopy(scene)
    load_scene(scene)
    assert scene == found


def test_loading_leaves_tensors_in_the_callers_dict(mi: Any) -> None:
    bitmap = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((4, 4, 3), 0.4, np.float32))}
    scene = small_scene(ball=ball({"type": "diffuse", "reflectance": bitmap}))
    for _ in range(2):
        assert table(load_scene(scene))["ball.bsdf.reflectance.data"].shape == (4, 4, 3)
    assert bitmap["data"].shape == (4, 4, 3)


def test_eight_bit_pictures_become_differentiable_and_keep_their_values(mi: Any, painted: Path) -> None:
    png = painted.parent / "paint.png"
    bitmap = {"type": "bitmap", "filename": str(png)}
    from_file, from_dict = (
        load_scene(painted),
        load_scene(small_scene(b=ball({"type": "diffuse", "reflectance": bitmap}))),
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


def test_a_selection_that_skips_eight_bit_texels_has_a_caution(mi: Any, painted: Path) -> None:
    own = mi.load_file(str(painted), optimize=False)
    renderer = SceneRenderer(own, "all", resolution=(4, 4), spp=1)
    name = "ball.bsdf.reflectance.data"
    assert name not in renderer.inputs
    assert "8 bits" in renderer.info["left_out"][name]
    assert name in dict(renderer.plan.cautions)


def test_a_blackbody_is_refused_because_mitsuba_has_none_in_rgb(mi: Any) -> None:
    scene = small_scene(b=ball({"type": "diffuse"}))
    scene["glow"] = {"type": "point", "intensity": {"type": "blackbody", "temperature": 3000.0}}
    assert "spectral variants" in message(lambda: SceneRenderer(scene, resolution=(4, 4), spp=1))


def test_a_material_of_one_shape_is_named_by_its_id(mi: Any, painted: Path) -> None:
    assert table(painted)["ball.bsdf.reflectance.data"].owners == ("paint",)


def test_an_exr_file_is_loaded_with_a_single_thread(mi: Any, tmp_path: Path) -> None:
    write_bitmap(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32))
    code = """
        import sys
        from scenecaptum import activate
        activate()
        import drjit as dr
        from scenecaptum.scene import load_scene
        dr.set_thread_count(1)
        sky = {"type": "envmap", "filename": sys.argv[1]}
        load_scene({"type": "scene", "sky": sky, "camera": {"type": "perspective"}})
        assert dr.thread_count() == 1
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "sky.exr")]
    subprocess.run(command, check=True, timeout=60)
