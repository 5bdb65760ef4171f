"""Bad input that once crashed, hung, or was accepted: each case was found by the fuzzer and is refused now."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bitmaps import write_bitmap
from results import make
from seeds import shifted

from extremes import fuzz, specimens
from scenecaptum import SceneAttribution, SceneCaptumError, SceneRenderer, cli
from scenecaptum.files import atomic_write
from scenecaptum.scene import hashable_source, load_scene

SENSOR = '<sensor type="perspective"/>'


def refusal(call: Callable[[], Any]) -> str:
    with pytest.raises(SceneCaptumError) as caught:
        call()
    said = str(caught.value)
    assert "\n" not in said
    return said


def load_xml(folder: Path, text: str) -> Any:
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{text}{SENSOR}</scene>')
    return load_scene(path)


def picture(name: str) -> str:
    return f'<emitter type="envmap"><string name="filename" value="{name}"/></emitter>'


# --- Scenes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<bsdf type="mask">' * 300 + '<bsdf type="diffuse"/>' + "</bsdf>" * 300, ["nested 30", "200"]),
        (
            '<default name="d0" value="aaaa"/>'
            + "".join(f'<default name="d{i}" value="$d{i - 1}$d{i - 1}"/>' for i in range(1, 40)),
            ["d15", "grows"],
        ),
        ('<texture type="bitmap"/>', ["bitmap", "no image", "filename"]),
        ('<emitter type="envmap"/>', ["envmap", "no image", "filename"]),
        (picture("/dev/zero"), ["/dev/zero", "a device"]),
        (picture(".."), ["..", "a folder"]),
    ],
    ids=["deep", "doubling", "no bitmap", "no sky", "device", "folder"],
)
def test_a_scene_file_that_would_end_the_process_is_refused(
    mi: Any, tmp_path: Path, text: str, words: list[str]
) -> None:
    said = refusal(lambda: load_xml(tmp_path, text))
    assert [word for word in words if word not in said] == [], said


def test_comments_and_the_depth_of_usual_scenes_are_no_reason_to_refuse(mi: Any, tmp_path: Path) -> None:
    nested = '<bsdf type="mask">' * 20 + '<bsdf type="diffuse"/>' + "</bsdf>" * 20
    load_xml(tmp_path, "<!--" + "<shape>" * 500 + "-->" + f'<shape type="sphere">{nested}</shape>')


def test_included_files_are_checked_too(mi: Any, tmp_path: Path) -> None:
    (tmp_path / "deep.xml").write_text('<scene version="3.0.0">' + "<a>" * 1000 + "</a>" * 1000 + "</scene>")
    said = refusal(lambda: load_xml(tmp_path, '<include filename="deep.xml"/>'))
    assert "deep.xml" in said


def test_a_dict_that_contains_itself_is_refused(mi: Any) -> None:
    endless: dict[str, Any] = {"type": "twosided"}
    endless["bsdf"] = endless
    assert "contains itself" in refusal(lambda: load_scene({"type": "scene", "a": endless}))


def test_a_dict_that_contains_none_is_refused_with_the_place(mi: Any) -> None:
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": None}}
    assert "ball.bsdf.reflectance" in refusal(lambda: load_scene({"type": "scene", "ball": ball}))


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_an_impossible_file_name_is_refused(mi: Any, name: str) -> None:
    assert "no scene file" in refusal(lambda: load_scene(name))


def test_an_endless_depth_is_refused(mi: Any) -> None:
    assert "max_depth" in refusal(lambda: SceneRenderer("cornell-box", max_depth=10**20))


@pytest.mark.parametrize("out", ["a\0b", "x" * 300])
def test_an_output_folder_of_an_impossible_name_is_one_clear_line(
    capsys: pytest.CaptureFixture[str], out: str
) -> None:
    assert cli.main(["attribute", "cornell-box", "--out", out]) == 2
    said = capsys.readouterr().err
    assert "cannot be written" in said
    assert said.count("\n") == 1


def test_a_folder_of_the_name_of_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "render.png").mkdir()
    expected = pytest.raises(SceneCaptumError, match=r"render.png cannot be written: it is a folder")
    with expected, atomic_write(tmp_path / "render.png") as partial:
        partial.write_bytes(b"")


# --- Pictures, meshes and volumes -----------------------------------------------------------------


def test_a_truncated_radiance_image_is_refused(mi: Any, tmp_path: Path) -> None:
    whole = specimens.hdr(specimens.picture())
    start = whole.index(b"+X 8\n") + 5
    line = (len(whole) - start) // 4
    (tmp_path / "sky.hdr").write_bytes(whole[: start + line] + bytes(range(3, 131)))
    said = refusal(lambda: load_xml(tmp_path, picture("sky.hdr")))
    assert "line 2 of 4" in said
    (tmp_path / "sky.hdr").write_bytes(whole)
    load_xml(tmp_path, picture("sky.hdr"))


def test_a_truncated_exr_is_refused(mi: Any, tmp_path: Path) -> None:
    path = tmp_path / "sky.exr"
    write_bitmap(path, specimens.picture())
    path.write_bytes(path.read_bytes()[:-100])
    assert "sky.exr" in refusal(lambda: load_xml(tmp_path, picture("sky.exr") * 2))


@pytest.mark.parametrize("fault", ["negative", "short", "nan", "dense"])
def test_a_damaged_volume_is_refused(mi: Any, tmp_path: Path, fault: str) -> None:
    data = bytearray(specimens.volume())
    match fault:
        case "negative":
            data[16:24] = struct.pack("<ii", -2, -1)
        case "short":
            del data[-4:]
        case "nan":
            data[-4:] = struct.pack("<f", np.nan)
        case "dense":
            data[-4:] = struct.pack("<f", 1e33)
    (tmp_path / "fog.vol").write_bytes(data)
    said = refusal(lambda: load_xml(tmp_path, f'<shape type="cube">{specimens.FOG}</shape>'))
    assert "fog.vol is damaged" in said
    (tmp_path / "fog.vol").write_bytes(specimens.volume())
    load_xml(tmp_path, f'<shape type="cube">{specimens.FOG}</shape>')


@pytest.mark.parametrize("size", [b"-Y 4 +X 0", b"-Y 0 +X 8", b"-Y 1e9 +X 8", b"-Y 40000 +X 80000", b"-Y 4"])
def test_a_radiance_image_of_an_impossible_size_is_refused(mi: Any, tmp_path: Path, size: bytes) -> None:
    (tmp_path / "sky.hdr").write_bytes(specimens.hdr(specimens.picture()).replace(b"-Y 4 +X 8", size))
    assert "sky.hdr is damaged" in refusal(lambda: load_xml(tmp_path, picture("sky.hdr")))


@pytest.mark.parametrize(("where", "by"), [(-1, 0x7F), (-4, 0), (-5, 1), (2, 9), (20, 0), (30, 0)])
def test_a_serialized_mesh_that_points_beyond_its_end_is_refused(
    mi: Any, tmp_path: Path, where: int, by: int
) -> None:
    data = bytearray(specimens.serialized())
    data[where] = by
    (tmp_path / "tent.serialized").write_bytes(data)
    shape = '<shape type="serialized"><string name="filename" value="tent.serialized"/></shape>'
    assert "tent.serialized is damaged" in refusal(lambda: load_xml(tmp_path, shape))
    (tmp_path / "tent.serialized").write_bytes(specimens.serialized())
    load_xml(tmp_path, shape)


@pytest.mark.parametrize("binary", [True, False])
def test_a_ply_mesh_with_an_invalid_vertex_index_is_refused(mi: Any, tmp_path: Path, binary: bool) -> None:
    whole = specimens.ply(binary)
    last = struct.pack("<i", 2**31 - 1) if binary else b"2147483647\n"
    (tmp_path / "tent.ply").write_bytes(whole[: -4 if binary else -2] + last)
    shape = '<shape type="ply"><string name="filename" value="tent.ply"/></shape>'
    assert "vertex 2147483647 of 4" in refusal(lambda: load_xml(tmp_path, shape))
    (tmp_path / "tent.ply").write_bytes(whole)
    load_xml(tmp_path, shape)


@pytest.mark.parametrize("line", [b"element vertex 4\n", b"float x", b"uchar int", b"face 2"])
def test_a_ply_mesh_with_an_incomplete_header_is_refused(mi: Any, tmp_path: Path, line: bytes) -> None:
    (tmp_path / "tent.ply").write_bytes(specimens.ply().replace(line, b""))
    shape = '<shape type="ply"><string name="filename" value="tent.ply"/></shape>'
    assert "tent.ply" in refusal(lambda: load_xml(tmp_path, shape))


def test_a_mesh_without_faces_is_refused(mi: Any, tmp_path: Path) -> None:
    (tmp_path / "flag.obj").write_text(specimens.OBJ.partition("f ")[0] + "f 1/1/1\n")
    shape = '<shape type="obj" id="flag"><string name="filename" value="flag.obj"/></shape>'
    assert "'flag' has no faces" in refusal(lambda: load_xml(tmp_path, shape))
    (tmp_path / "flag.obj").write_text(specimens.OBJ)
    load_xml(tmp_path, shape)


# --- Saved results --------------------------------------------------------------------------------


def members(path: Path) -> dict[str, Any]:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("tampering", ["number", "label", "exchange", "left out", "added", "no checksum"])
def test_a_result_that_was_changed_after_saving_is_refused(tmp_path: Path, tampering: str) -> None:
    path = tmp_path / "result.npz"
    make().save(path)
    found = members(path)
    match tampering:
        case "number":
            found["attributions/0"] = found["attributions/0"] * 1.001
        case "label":
            found["header"] = np.array(str(found["header"]).replace("desk: roughness", "desk: gloss"))
        case "exchange":
            found["attributions/0"], found["attributions/1"] = (
                found["attributions/1"],
                found["attributions/0"],
            )
        case "left out":
            del found["image"]
        case "added":
            found["extra"] = np.zeros(3)
        case "no checksum":
            del found["checksum"]
    np.savez(path, **found)
    assert "result.npz" in refusal(lambda: SceneAttribution.load(path))


@pytest.mark.parametrize("number", [1, 2, 3])
def test_results_of_earlier_versions_are_refused_with_the_reason(tmp_path: Path, number: int) -> None:
    path = tmp_path / "result.npz"
    make().save(path)
    found = members(path)
    header = json.loads(str(found["header"]))
    found["header"] = np.array(json.dumps({**header, "format": f"scenecaptum attribution {number}"}))
    np.savez(path, **found)
    message = refusal(lambda: SceneAttribution.load(path))
    assert f"has the format 'scenecaptum attribution {number}'" in message
    assert "attribute again" in message


@pytest.mark.parametrize(
    "header", ["[" * 100_000, "null", "{}", '{"format": 3}', '{"format": "scenecaptum attribution 4"}']
)
def test_a_header_of_another_structure_is_refused(tmp_path: Path, header: str) -> None:
    path = tmp_path / "result.npz"
    np.savez(path, header=header)
    assert "result.npz" in refusal(lambda: SceneAttribution.load(path))


# --- All of it ------------------------------------------------------------------------------------


def check(outcomes: list[fuzz.Outcome]) -> None:
    print(fuzz.table(outcomes))
    bad = [one for one in outcomes if one.word in fuzz.BAD]
    print("\n".join(f"{one.kind} {one.index}: {one.word}: {one.detail}" for one in bad))
    assert not bad, bad[0]


def test_a_sample_of_corrupted_input_is_refused_or_succeeds() -> None:
    check(fuzz.fuzz(50, seed=shifted(1), kinds=["saved", "xml"], is_tracing=False))


@pytest.mark.long
def test_two_thousand_corrupted_inputs_are_refused_or_succeed() -> None:
    outcomes = fuzz.fuzz(2120, seed=shifted())
    assert len(outcomes) >= 2000
    check(outcomes)


def test_unprintable_objects_are_named_by_their_type() -> None:
    class Broken:
        """Arrays of Dr.Jit raise like this if their shape does not fit."""

        def __repr__(self) -> str:
            raise RuntimeError("internal error")

    assert hashable_source({"type": "scene", "shade": Broken()}) == {"type": "scene", "shade": "Broken"}
