"""Names and labels of a scene's objects: equal in all processes, complete, and never a memory address."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from rooms import large_scenes, table
from seeds import shifted

from scenecaptum import (
    SceneAttribution,
    SceneCaptumError,
    SceneRenderer,
    VanillaSceneGradient,
    cli,
    metrics,
)
from scenecaptum.scene import discover, load_scene
from scenecaptum.scene._graph import SceneGraph
from scenecaptum.visualization import columns, shorten

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

# Only a material, the shape group and names in Mitsuba's own style have ids. Mitsuba describes the integrator by
# an address.
NAMELESS = """<scene version="3.0.0">
    <integrator type="depth"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="8"/></sampler>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    <bsdf type="diffuse" id="mat-Wall White.001"/>
    <bsdf type="diffuse" id="_unnamed_7"/>
    <shape type="obj"><string name="filename" value="models/Mesh090.obj"/><ref id="mat-Wall White.001"/></shape>
    <shape type="obj"><string name="filename" value="models/Mesh090.obj"/><ref id="_unnamed_7"/></shape>
    <shape type="obj">
        <string name="filename" value="models/Mesh 070.obj"/>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="3"/></emitter>
    </shape>
    <shape type="rectangle"><ref id="mat-Wall White.001"/></shape>
    <shape type="sphere" id="_unnamed_3">
        <bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>
    </shape>
    <shape type="sphere"><transform name="to_world"><translate x="2"/></transform></shape>
    <shape type="shapegroup" id="tree">
        <shape type="obj"><string name="filename" value="models/Mesh090.obj"/></shape>
        <shape type="cube"/>
    </shape>
    <shape type="instance"><ref id="tree"/></shape>
    <emitter type="constant"/>
</scene>"""

NAMES = {
    "mat-Wall White.001.reflectance.value": "mat-Wall White.001: reflectance",
    "diffuse.reflectance.value": "diffuse: reflectance",
    "Mesh_070.bsdf.brdf_0.reflectance.value": "Mesh_070: surface reflectance",
    "Mesh_070.emitter.radiance.value": "lamp on Mesh_070: radiance",
    "sphere.bsdf.opacity.value": "sphere: opacity",
    "sphere.bsdf.nested_bsdf.reflectance.value": "sphere: reflectance",
    "sphere_2.bsdf.reflectance.value": "sphere_2: reflectance",
    # Mitsuba's keys of these contain no addresses.
    "tree.shape.bsdf.reflectance.value": "tree: shape reflectance",
    "tree.shape_1.bsdf.reflectance.value": "tree: shape 1 reflectance",
    "constant.radiance.value": "constant: radiance",
}

SHAPES = [
    "Mesh090",
    "Mesh090_2",
    "Mesh_070",
    "mat-Wall_White_001_rectangle",
    "sphere",
    "sphere_2",
    "instance",
]


def write_nameless(folder: Path) -> Path:
    (folder / "models").mkdir()
    for name in ("Mesh090", "Mesh 070"):
        (folder / "models" / f"{name}.obj").write_text(OBJ)
    path = folder / "scene.xml"
    path.write_text(NAMELESS)
    return path


@pytest.fixture(scope="module")
def nameless(mi: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nameless(tmp_path_factory.mktemp("nameless"))


def in_a_process(code: str, *arguments: Any) -> Any:
    """Run code in another process, and return the JSON that it prints."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def names_of(path: str) -> list[Any]:
    graph = SceneGraph(load_scene(path))
    about = {name: [p.label, *p.owners] for name, p in discover(graph).items()}
    return [list(about), about, [name for name, *_ in graph.shapes()]]


LIST = f"""
import json, sys
from typing import Any
from scenecaptum.scene import discover, load_scene
from scenecaptum.scene._graph import SceneGraph

{inspect.getsource(names_of)}

print(json.dumps({{path: names_of(path) for path in sys.argv[1:]}}))
"""


# --- Names ----------------------------------------------------------------------------------------


def test_objects_without_an_id_are_named_after_file_material_and_kind(nameless: Path) -> None:
    found = table(nameless)
    assert {n: p.label for n, p in found.items() if not p.problem and "weight" not in n} == NAMES
    assert [name for name, *_ in SceneGraph(load_scene(nameless)).shapes()] == SHAPES
    assert found["sphere.bsdf.opacity.value"].owners == ("sphere",)
    assert found["perspective.x_fov"].kind == "camera"


def test_names_are_still_those_of_mitsuba(mi: Any, nameless: Path) -> None:
    scene = load_scene(nameless)
    assert list(discover(SceneGraph(scene))) == list(mi.traverse(scene).keys())


@pytest.fixture(scope="module")
def rooms() -> list[Path]:
    """Published scenes with hundreds of shapes without ids, where they are available."""
    return [
        path for room in ("kitchen", "classroom") if (path := large_scenes() / room / "scene.xml").is_file()
    ]


@pytest.fixture(scope="module")
def lists(nameless: Path, rooms: list[Path]) -> list[dict[str, Any]]:
    """The names that this process and another find in the same scenes."""
    here = {str(path): names_of(str(path)) for path in (nameless, *rooms)}
    return [json.loads(json.dumps(here)), in_a_process(LIST, nameless, *rooms)]


def test_two_processes_give_the_same_names(nameless: Path, lists: list[dict[str, Any]]) -> None:
    one, other = (found[str(nameless)] for found in lists)
    assert one == other
    assert_no_address(one)


def test_two_processes_give_the_same_names_for_published_rooms(
    rooms: list[Path], lists: list[dict[str, Any]]
) -> None:
    if not rooms:
        pytest.skip("neither kitchen nor classroom is available (set SCENECAPTUM_SCENES)")
    for path in rooms:
        one, other = (found[str(path)] for found in lists)
        assert len(one[2]) > 70
        assert one == other
        assert_no_address(one)


def assert_no_address(found: Any) -> None:
    assert re.findall(r"object_\d\w*|0x[0-9a-f]{6,}|\d{12,}", json.dumps(found)) == []


@pytest.mark.parametrize("optimize", [False, True])
def test_objects_of_the_users_scene_are_named_and_keep_their_ids(
    mi: Any, nameless: Path, optimize: bool
) -> None:
    """Where Mitsuba has not merged shapes, they are those of the file."""
    scene = mi.load_file(str(nameless), optimize=optimize)
    params = mi.traverse(scene)
    before = list(params.keys())
    assert any(name.startswith("object_") for name in before), "Mitsuba gives ids by itself"
    renderer = SceneRenderer(scene, "reflectance")
    names = [name for name, parameter in renderer.parameters_table().items() if not parameter.moves]
    assert names == list(mi.traverse(scene).keys())
    assert not [name for name in names if name.startswith("object_")]
    assert [name for name in before if "object_" not in name and "_unnamed_" not in name] == [
        name for name in names if name in before
    ]
    if not optimize:
        assert names == list(table(nameless))
    # The user's own parameters still write to the same scene, under Mitsuba's names.
    old = next(name for name in before if name.startswith("object_") and name.endswith("reflectance.value"))
    params[old] = mi.Float(0.123) if "Float" in type(params[old]).__name__ else mi.Color3f(0.123)
    params.update()
    new = names[before.index(old)]
    assert renderer.inputs[new].flatten().tolist() == pytest.approx([0.123] * renderer.inputs[new].numel())
    # A name that contains an address is refused with the reason.
    with pytest.raises(SceneCaptumError, match="contain memory addresses"):
        SceneRenderer(scene, old)


def test_merged_meshes_have_unique_names(mi: Any, nameless: Path) -> None:
    names = {shape.id() for shape in load_scene(mi.load_file(str(nameless))).shapes()}
    assert {"Mesh_070", "Mesh090_and_1_more"} <= names


# --- What hangs on names --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def twice(nameless: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, list[Path]]:
    """Two processes attribute a scene with one checkpoint: the second's output, and the folder of both."""
    folder = tmp_path_factory.mktemp("twice")
    outs = [folder / "first", folder / "second"]
    options = ["--inputs", "reflectance", "--checkpoint", str(folder / "kept"), "--no-progress"]
    first, second = (["attribute", str(nameless), *options, "--out", str(out)] for out in outs)
    assert cli.main(first) == 0
    run = subprocess.run(
        [sys.executable, "-m", "scenecaptum.cli", *second], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout, outs


def test_a_second_process_resumes_all_passes(twice: tuple[str, list[Path]]) -> None:
    assert "resumed: 16 of 16 passes" in twice[0]


def test_results_of_two_processes_subtract(twice: tuple[str, list[Path]]) -> None:
    one, other = (SceneAttribution.load(out / "attribution.npz") for out in twice[1])
    difference = one - other
    assert list(difference) == list(one)
    assert all(not value.any() for value in difference.values())


# --- Labels ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def blender(mi: Any, tmp_path_factory: pytest.TempPathFactory) -> SceneRenderer:
    """A scene with ids as Blender's exporter writes them."""
    path = tmp_path_factory.mktemp("blender") / "scene.xml"
    path.write_text(BLENDER)
    return SceneRenderer(path, ["materials", "emitters"])


BLENDER = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective" id="Camera.001">
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    <bsdf type="twosided" id="mat-Wall White.001"><bsdf type="diffuse"/></bsdf>
    <bsdf type="roughplastic" id="mat-Wall White.002"/>
    <shape type="sphere" id="elm__2"><ref id="mat-Wall White.001"/></shape>
    <shape type="sphere" id="Ball.003">
        <transform name="to_world"><translate x="2"/></transform><ref id="mat-Wall White.002"/>
    </shape>
    <shape type="rectangle" id="Area.004">
        <transform name="to_world"><translate z="3"/></transform><emitter type="area" id="emit.9"/>
    </shape>
    <emitter type="constant" id="World.005"/>
</scene>"""

BLENDERS_LABELS = {
    "mat-Wall White.001.brdf_0.reflectance.value": "mat-Wall White.001: reflectance",
    "mat-Wall White.002.alpha": "mat-Wall White.002: roughness",
    "mat-Wall White.002.diffuse_reflectance.value": "mat-Wall White.002: diffuse reflectance",
    "Area.004.emitter.radiance.value": "Area.004: radiance",
    "World.005.radiance.value": "World.005: radiance",
}


def test_an_id_with_dots_is_whole_in_the_label(blender: SceneRenderer) -> None:
    labels = blender.labels
    assert {name: labels[name] for name in BLENDERS_LABELS} == BLENDERS_LABELS
    assert blender.parameters_table()["mat-Wall White.001.brdf_0.reflectance.value"].owners == (
        "mat-Wall White.001",
    )
    shown = blender.surfaces
    assert shown is not None
    assert {"elm__2", "Ball.003"} <= set(shown.objects)


def test_a_scene_from_blender_is_attributed_by_its_names(blender: SceneRenderer) -> None:
    name = "mat-Wall White.001.brdf_0.reflectance.value"
    found = VanillaSceneGradient(blender, metrics.MeanLuminance()).attribute(replicates=2)
    assert found.labels[name] in str(found)
    assert blender({name: torch.tensor(0.0)}, seed=shifted(1)).mean() < blender(seed=shifted(1)).mean()


LONG = [
    "mat-Wall White painted by hand.001: diffuse reflectance",
    "mat-Wall White painted by hand.002: diffuse reflectance",
    "mat-Wall White painted by hand.002: roughness",
    "lamp on Mesh070: radiance",
]


@pytest.mark.parametrize("width", [36, 40, 60])
def test_shortened_labels_keep_object_and_property(width: int) -> None:
    short = shorten(LONG, width)
    assert max(map(columns, short)) <= width
    assert len(set(short)) == len(LONG)
    for label, one in zip(LONG, short, strict=True):
        thing, what = label.split(": ")
        assert one.endswith(f": {what}")
        assert one[:4] == thing[:4]
        assert one.partition(": ")[0][-2:] == thing[-2:]


@pytest.mark.parametrize("width", [16, 20, 24, 28])
def test_in_little_space_both_parts_are_shortened_and_stay_different(width: int) -> None:
    short = shorten(LONG, width)
    assert max(map(columns, short)) <= width
    assert len(set(short)) == len(LONG)
    assert all(": " in one and one.startswith("mat-") for one in short[:3])


def test_labels_that_differ_in_the_middle_are_cut_elsewhere() -> None:
    alike = [f"a wall of the {floor} floor with windows: reflectance" for floor in ("first", "third")]
    short = shorten(alike, 28)
    assert len(set(short)) == 2
    assert max(map(columns, short)) <= 28
