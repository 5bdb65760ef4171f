"""Studies: cells as files, the same numbers in any process, and nothing lost."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from disks import file_size_limit
from refusals import message
from seeds import seeds, shifted
from study_metrics import brightness, broken

from scenecaptum import SceneCaptumError, SceneRenderer, VanillaSceneGradient, View, cli
from scenecaptum.studies import Cell, Study, StudyResult
from scenecaptum.studies._recipe import digest_of_scene

from .conftest import TINY, VALUE, value_study

Run = Callable[..., StudyResult]


class Counting(ThreadPoolExecutor):
    """Counts the cells that it is given."""

    count = 0

    def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
        self.count += 1
        return super().submit(*args, **kwargs)


def test_a_grid_has_a_cell_for_every_combination() -> None:
    study = Study(
        {"box": "cornell-box", "room": "office"},
        cameras=[View(), [0, 0], {"turn": 30}, View(fov=20.0), "fisheye"],
        metrics=["luminance", {"metric": "ugr", "threshold_factor": 5}, brightness],
        designs={"as it is": {}, "dark": {"*.reflectance.value*": 0.5}},
        methods=["gradient", {"method": "value", "replicates": 2}],
        seeds=[3, 4],
    )
    assert len(study) == 2 * 5 * 3 * 2 * 2 * 2 == len(set(study.cells))
    assert study.cells[0] == Cell("box", "as it is", "luminance", "as it is", "gradient", 3)
    assert {cell.camera for cell in study.cells} == {"as it is", "[0, 0]", "turn=30", "fov=20.0", "fisheye"}
    assert {cell.metric for cell in study.cells} == {"luminance", "ugr threshold_factor=5", "brightness"}
    assert {cell.method for cell in study.cells} == {"gradient", "value replicates=2"}


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "no scene file": (
        lambda: Study(["cornel-box"]),
        "no scene file 'cornel-box'.*Did you mean 'cornell-box'",
    ),
    "a string": (lambda: Study("cornell-box"), "scenes must be a list"),
    "nothing": (lambda: Study([]), "scenes is empty"),
    "one name twice": (lambda: Study(["office", "office"]), "same name"),
    "a number as a scene": (lambda: Study({"a": 3}), "a path, the name of a bundled scene or a Mitsuba dict"),
    "a metric": (lambda: Study(["office"], metrics=["lumin"]), "no metric 'lumin'.*Did you mean 'luminance'"),
    "no function": (lambda: Study(["office"], metrics={"a": 3}), "'a' must be a name or a function"),
    "an option": (
        lambda: Study(["office"], metrics=[{"metric": "luminance", "threshold_factor": 3}]),
        "'threshold_factor' has no effect",
    ),
    "an element of a number": (
        lambda: Study(["office"], metrics=[{"metric": "luminance", "target": 0}]),
        "'target' has no effect",
    ),
    "options alone": (
        lambda: Study(["office"], metrics=[{"threshold_factor": 3}]),
        "needs the entry 'metric'",
    ),
    "a local function": (
        lambda: value_study(metrics={"f": lambda image: image.mean()}).run("."),
        "top level",
    ),
    "a method": (lambda: Study(["office"], methods=["gradients"]), "Did you mean 'gradient'"),
    "a camera": (lambda: Study(["office"], cameras=[{"turned": 3}]), "the arguments of View"),
    "a seed": (lambda: Study(["office"], seeds=[-1]), "seeds must be a whole number"),
    "an unknown name": (
        lambda: Study(["office"], cells=[("offices", "0", "luminance", "as it is", "gradient", 0)]),
        "the scene 'offices', which the study does not have. Did you mean 'office'",
    ),
    "a short cell": (lambda: Study(["office"], cells=[("office", 0)]), "A cell has a name for each"),
    "no cells": (lambda: Study(["office"], cells=[]), "at least one cell"),
    "two executors": (
        lambda: Study(["office"]).run("x", executor=ThreadPoolExecutor(), workers=2),
        "give executor= or workers=",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_one_clear_error(name: str, mi: Any) -> None:
    call, expected = REFUSED[name]
    with pytest.raises(SceneCaptumError, match=expected) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_cells_in_processes_are_those_of_a_plain_call(in_processes: StudyResult, mi: Any) -> None:
    for camera, sensor in (("front", 0), ("left", View(turn=-15))):
        renderer = SceneRenderer("cornell-box", "reflectance", sensor=sensor, **TINY)
        expected = VanillaSceneGradient(renderer, brightness).attribute(seed=shifted())
        found = in_processes.attribution(
            Cell("cornell-box", camera, "own", "as it is", "gradient", shifted())
        )
        assert found.metric_value == pytest.approx(expected.metric_value, rel=1e-5)
        for name, gradient in expected.items():
            assert torch.allclose(found[name], gradient, rtol=1e-4, atol=1e-5 * gradient.abs().max().item())


def test_cells_that_fail_are_rows_with_their_errors(in_processes: StudyResult) -> None:
    errors = {cell.metric: error for cell, error in in_processes.failures.items()}
    assert "ValueError: this metric has no value (study_metrics.py:" in errors["broken"]
    assert "died 3 times" in errors["aborts"]
    assert len(in_processes) == 3
    assert not in_processes.missing
    frame = in_processes.values()
    assert dict(frame.status.value_counts()) == {"finished": 3, "failed": 2}
    assert frame[frame.status == "finished"].error.eq("").all()
    assert "2 failed" in str(in_processes)


def test_tables_are_tidy(in_processes: StudyResult, tmp_path: Path) -> None:
    import pandas

    effects = in_processes.effects()
    cell = next(iter(in_processes.cells))
    ranking = in_processes.attribution(cell).ranking()
    mine = effects[(effects[list(Cell._fields)] == list(cell)).all(axis=1)]
    assert list(mine.name) == [row.name for row in ranking]
    assert list(mine.effect) == [row.effect for row in ranking]
    for ending, read in ((".csv", pandas.read_csv), (".parquet", pandas.read_parquet)):
        in_processes.write_table(tmp_path / f"effects{ending}")
        assert read(tmp_path / f"effects{ending}").effect.tolist() == effects.effect.tolist()
    assert "not as effects.txt" in message(lambda: in_processes.write_table("effects.txt"))


def test_a_study_goes_on_where_it_stopped(run: Run, tmp_path: Path) -> None:
    study = value_study(seeds=seeds(4))
    first = run(study, tmp_path)
    before = {cell: first.numbers(cell) for cell in first.cells}
    lost = list(first.cells)[2]
    (tmp_path / "cells" / f"{first.cells[lost]}.zip").unlink()
    (tmp_path / "cells" / ".half-written.zip").write_bytes(b"half")
    assert StudyResult.load(tmp_path).missing == [lost]
    with Counting(1) as executor:
        again = run(value_study(seeds=seeds(4)), tmp_path, executor=executor)
    assert executor.count == 1
    assert {cell: again.numbers(cell)["value"] for cell in again.cells} == pytest.approx(
        {cell: numbers["value"] for cell, numbers in before.items()}, rel=1e-5
    )


def test_failed_cells_are_computed_again_if_asked(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def metric(image):\n    raise OSError('the disk of the metric is away')\n")
    study = value_study(metrics={"mine": f"{file}:metric"})
    assert "the disk of the metric is away" in str(run(study, tmp_path / "out").failures)
    file.write_text("def metric(image):\n    return image.mean()\n")
    assert len(run(study, tmp_path / "out").failures) == 1
    result = run(study, tmp_path / "out", retry_failed=True)
    assert not result.failures
    assert len(result) == 1
    assert not list((tmp_path / "out" / "failed").iterdir())  # the error is gone


def test_another_study_does_not_get_into_the_folder(run: Run, tmp_path: Path) -> None:
    run(value_study(), tmp_path)
    assert "has another study" in message(lambda: run(value_study(spp=2), tmp_path))
    manifest = json.loads((tmp_path / "study.json").read_text())
    manifest["versions"]["drjit"] = "0.1"
    (tmp_path / "study.json").write_text(json.dumps(manifest))
    assert "drjit" in message(lambda: run(value_study(), tmp_path))
    assert "not the folder of a study" in message(lambda: StudyResult.load(tmp_path / "cells"))


def test_a_changed_scene_file_is_another_study(run: Run, tmp_path: Path) -> None:
    scene = tmp_path / "room.xml"
    text = (
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>'
        '<integer name="height" value="8"/></film></sensor><emitter type="constant" id="sky"/>'
        '<shape type="sphere" id="ball"><bsdf type="diffuse"/></shape></scene>'
    )
    scene.write_text(text)
    run(value_study(scene), tmp_path / "out")
    scene.write_text(text.replace("ball", "sphere"))
    assert "has another study" in message(lambda: run(value_study(scene), tmp_path / "out"))


def test_a_scene_that_is_not_on_the_worker_is_a_row(run: Run, tmp_path: Path) -> None:
    scene = tmp_path / "room.xml"
    scene.write_text('<scene version="3.0.0"/>')
    study = value_study(scene, "cornell-box")
    scene.unlink()
    result = run(study, tmp_path / "out")
    assert len(result) == 1
    (error,) = result.failures.values()
    assert "room.xml is not on this machine: put it into a folder that all machines share" in error


def test_a_folder_that_the_worker_does_not_see_is_a_row(run: Run, tmp_path: Path) -> None:
    class Away(ThreadPoolExecutor):
        """A worker of another machine, on which the folder is empty."""

        def submit(self, function: Any, recipe: Any, folder: str, *args: Any) -> Future[Any]:
            return super().submit(function, recipe, str(tmp_path / "elsewhere"), *args)

    with Away(1) as executor:
        result = run(value_study(), tmp_path / "out", executor=executor)
    assert "is not seen by this worker: use a folder that all machines share" in str(result.failures)


def test_an_executor_that_ends_leaves_what_is_finished(run: Run, tmp_path: Path) -> None:
    class Ending(ThreadPoolExecutor):
        def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
            future = super().submit(*args, **kwargs)
            self.shutdown(wait=True)
            return future

    text = message(lambda: run(value_study(seeds=seeds(3)), tmp_path, executor=Ending(1)))
    assert "Ending has ended" in text
    assert "run the study again" in text
    assert len(run(value_study(seeds=seeds(3)), tmp_path)) == 3


def test_a_full_disk_stops_the_study_with_one_error(run: Run, thread: Executor, tmp_path: Path) -> None:
    study = value_study(seeds=seeds(3))
    run(study, tmp_path)
    for path in (tmp_path / "cells").iterdir():
        path.unlink()
    with file_size_limit(0):
        text = message(lambda: run(study, tmp_path))
        thread.submit(int).result()  # the cell that was under way when the study stopped
    assert "The study stopped" in text
    assert "cannot be written" in text
    assert "\n" not in text
    assert not list((tmp_path / "cells").iterdir())
    assert len(run(study, tmp_path)) == 3


def test_a_study_that_stops_cancels_the_cells_that_have_not_begun(run: Run, tmp_path: Path) -> None:
    futures = []

    class Recording(ThreadPoolExecutor):
        def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
            futures.append(super().submit(*args, **kwargs))
            return futures[-1]

    study = value_study(seeds=seeds(40))
    run(study, tmp_path)
    for path in (tmp_path / "cells").iterdir():
        path.unlink()
    with Recording(1) as executor, file_size_limit(0):
        message(lambda: run(study, tmp_path, executor=executor))
        assert futures[-1].cancelled()


def test_cells_that_fail_alike_are_one_line(run: Run, tmp_path: Path) -> None:
    result = run(value_study(metrics=[broken], seeds=seeds(7)), tmp_path)
    (line,) = [line for line in str(result).splitlines() if line.startswith("failed: ")]
    assert "and 6 more cells: " in line


def test_folders_that_cannot_be_written(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file" / "out", Path("/proc/study")):
        assert "cannot be written" in message(lambda folder=folder: run(value_study(), folder))


def test_scene_dicts_reach_the_worker_with_transforms_and_textures(run: Run, mi: Any, tmp_path: Path) -> None:
    transform = mi.ScalarTransform4f
    texels = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(shifted())).numpy()

    def wall(side: float, **texture: Any) -> dict[str, Any]:
        bitmap = {"type": "bitmap", "raw": True, **texture}
        placed = transform().translate([side, 0, 0]).scale(0.5).rotate([1, 0, 0], 90)
        return {"type": "rectangle", "to_world": placed, "bsdf": {"type": "diffuse", "reflectance": bitmap}}

    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": transform().look_at(origin=[0, -4, 1], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8},
        },
        "ball": {
            "type": "sphere",
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": mi.ScalarColor3f(0.5, 0.2, 0.1)},
            },
        },
        "left": wall(-1, data=mi.TensorXf(texels)),
        "right": wall(1, bitmap=mi.Bitmap(texels)),
        "sky": {"type": "constant"},
    }
    many = {"method": "value", "replicates": 16, "spp": 64}
    result = run(value_study(metrics=[brightness], scenes={"ball": scene}, methods=[many]), tmp_path)
    (cell,) = result.cells
    image = SceneRenderer(scene, resolution=(8, 8), spp=4096, max_depth=2)(seed=shifted(1))
    found = result.numbers(cell)
    assert abs(found["value"] - image.mean().item()) < 4 * found["standard_error"]
    text = message(lambda: Study({"ball": {**scene, "paint": mi.load_dict({"type": "diffuse"})}}))
    assert "'paint' of the scene dict is a BSDF, which cannot be sent" in text


def test_scenes_whose_textures_differ_in_few_texels_have_keys_of_their_own(mi: Any) -> None:
    texels = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(shifted())).numpy()
    changed = texels.copy()
    changed[30, 30] = 0.0
    for kind in (mi.TensorXf, mi.Bitmap):
        scenes = [{"type": "scene", "paint": {"type": "bitmap", "data": kind(t)}} for t in (texels, changed)]
        assert len({digest_of_scene(scene) for scene in (*scenes, *scenes)}) == 2


def test_designs_change_what_their_globs_match(run: Run, tmp_path: Path) -> None:
    designs = {"as it is": {}, "black": {"*.reflectance.value": 0.0}, "none": {"*carpet*": 0.5}}
    result = run(value_study(designs=designs, inputs="reflectance", max_depth=3), tmp_path)
    values = {cell.design: result.numbers(cell)["value"] for cell in result.cells}
    assert values["black"] < values["as it is"]
    assert "'*carpet*' (its last * is an operator), which is not an input" in str(result.failures)


def test_a_metric_names_its_element_by_class_by_index_or_by_indices(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "def channels(image):\n    return image.mean((0, 1))\n\n"
        "channels.target_index = ['red', 'green', 'blue'].index\n\n"
        "def columns(image):\n    return image.mean(0)\n"
    )
    (tmp_path / "rooms.toml").write_text(
        'scenes = ["cornell-box"]\nresolution = [8, 8]\nspp = 4\nmax_depth = 2\ninputs = "reflectance"\n'
        'methods = ["value", "gradient"]\n[metrics]\n'
        'name = { metric = "mine.py:channels", target = "blue" }\n'
        'index = { metric = "mine.py:channels", target = 2 }\n'
        'red = { metric = "mine.py:channels", target = 0 }\n'
        'indices = { metric = "mine.py:columns", target = [3, 2] }\n'
        'none = "mine.py:channels"\n'
    )
    result = run(Study.from_file(tmp_path / "rooms.toml"), tmp_path / "out")
    for method in ("value", "gradient"):
        values = {
            cell.metric: result.numbers(cell)["value"]
            for cell in result.cells
            if cell.method == method and cell not in result.failures
        }
        assert values.keys() == {"name", "index", "red", "indices"}
        assert values["name"] == values["index"]
        assert len(set(values.values())) == 3
    assert all("Select an element with target=" in error for error in result.failures.values())


@pytest.mark.parametrize(
    ("metric", "expected"),
    [
        ('{ metric = "shape-logit", target = "cubee" }', "no class called 'cubee'.*Did you mean 'cube'"),
        ('{ metric = "mine.py:logits", target = "lihgt" }', "'lihgt'"),
        ('{ metric = "mine.py:logits", target = "dark" }', ""),
        ('{ metric = "mine.py:logit" }', "cannot be imported.*'logit'"),
        ('{ metric = "mine.py:plain", target = "light" }', "have elements with names"),
    ],
)
def test_a_misspelled_element_is_refused_before_the_first_cell(
    metric: str, expected: str, tmp_path: Path, thread: Executor, mi: Any
) -> None:
    (tmp_path / "mine.py").write_text(
        "def plain(image):\n    return image.mean((0, 1))\n\n"
        "def logits(image):\n    return image.mean((0, 1))\n\n"
        "logits.target_index = ['dark', 'light'].index\n"
    )
    (tmp_path / "rooms.toml").write_text(
        'scenes = ["cornell-box"]\nresolution = [8, 8]\nspp = 4\nmax_depth = 2\n'
        f'methods = ["value"]\n[metrics]\nlight = "luminance"\nanswer = {metric}\n'
    )
    study, folder = Study.from_file(tmp_path / "rooms.toml"), tmp_path / "out"
    if not expected:
        assert len(study.run(folder, executor=thread, threads=None)) == 2
        return
    with pytest.raises(SceneCaptumError, match=f"The metric 'answer' of the study: .*{expected}"):
        study.run(folder, executor=thread, threads=None)
    assert not folder.exists(), "a corrected study would be another one"


def test_names_are_as_written_and_numbers_say_what_they_are_of(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def channels(image):\n    return image.mean((0, 1))\n")
    (tmp_path / "place.epw").write_text("")
    (tmp_path / "rooms.toml").write_text(
        'scenes = ["office"]\ncameras = ["grid"]\nmetrics = [{ metric = "mine.py:channels", target = 2 }, '
        '{ metric = "da", weather = "place.epw" }]\n'
    )
    cells = Study.from_file(tmp_path / "rooms.toml").cells
    assert [cell.metric for cell in cells] == ["mine.py:channels target=2", "da weather=place.epw"]
    assert str(cells[0]) == "office · grid · mine.py:channels target=2 · as it is · gradient · seed 0"


def test_metrics_of_daylight_have_their_coefficients(run: Run, tmp_path: Path) -> None:
    study = Study(
        ["classroom"],
        cameras=["grid"],
        metrics=["daylight-factor"],
        inputs="reflectance",
        spp=1,
        max_depth=3,
        methods={"value": VALUE, "gradient": {"method": "gradient", "replicates": 2}},
    )
    result = run(study, tmp_path)
    assert not result.failures
    numbers, _ = (result.numbers(cell) for cell in result.cells)
    grid = result.attribution([*result.cells][1]).info["sensor grid"]
    assert f"grid: {grid}, if the scene's unit is the metre" in numbers["notes"], (
        "as the command daylight says"
    )
    assert numbers["unit"] == "%"
    assert numbers["value"] > 0


def test_a_share_of_points_is_relaxed_and_has_the_depth_of_daylight(run: Run, tmp_path: Path) -> None:
    options = {"metrics": ["sda"], "inputs": "reflectance", "spp": 1, "methods": {"value": VALUE}}
    with pytest.raises(SceneCaptumError, match=r"'sda' is one of points.*cameras = \[\"grid\"\]"):
        Study(["classroom"], **options)
    study = Study(["classroom"], cameras=["grid"], **options)
    result = run(study, tmp_path)
    (numbers,) = (result.numbers(cell) for cell in result.cells)
    assert numbers["measure"].startswith("relaxed spatial daylight autonomy")
    assert not numbers["verdict"]
    said = "; ".join(numbers["notes"])
    assert "this value is relaxed" in said
    assert "blinds are not modeled" in said
    assert "weather: made-up, of no real place" in said
    assert re.search(r"grid: \d+ points on .*, 0\.8 m above it, .* m apart, if the scene's unit", said)
    assert "light is followed through 10 segments" in said
    assert numbers["max_depth"] == 10
    assert "grid: " in str(result)
    assert "made-up, of no real place" in str(result)
    (recipe,) = (study._recipe(cell) for cell in study.cells)
    assert recipe.renderer_options["max_depth"] == 10


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], mi: Any) -> None:
    (tmp_path / "mine.py").write_text("def metric(image):\n    return image.mean()\n")
    file = tmp_path / "rooms.toml"
    file.write_text(
        'scenes = ["cornell-box"]\nmetrics = ["mine.py:metric"]\nresolution = [8, 8]\nspp = 4\n'
        'methods = ["value"]\n[cameras]\nfront = 0\nleft = { turn = -20 }\n'
    )
    out = tmp_path / "out"
    assert cli.main(["study", str(file), "--out", str(out), "--workers", "1"]) == 0
    printed, progress = capsys.readouterr()
    assert progress.startswith("study: 2 cells\nstudy: 1 of 2 cells, ")
    assert cli.main(["study", str(file), "--out", str(out), "--workers", "1", "--no-progress"]) == 0
    assert capsys.readouterr().err == ""
    assert "2 cells finished" in printed
    assert "values.csv  the metric of each cell" in printed
    assert len((out / "values.csv").read_text().splitlines()) == 3
    for text, expected in (
        ('scene = ["office"]', "'scene', which a study does not. Did you mean 'scenes'"),
        ("seeds = [1]", "needs scenes"),
        ("scenes = [", "is not valid TOML"),
    ):
        file.write_text(text)
        assert cli.main(["study", str(file)]) == 2
        assert expected in capsys.readouterr().err
    assert cli.main(["study", str(tmp_path / "none.toml")]) == 2


@pytest.mark.long
def test_all_executors_give_the_same_bits() -> None:
    import studies

    assert studies.main(["equal"]) == 0


@pytest.mark.long
def test_nothing_is_lost_when_processes_are_killed() -> None:
    import studies

    assert studies.main(["kill", "--seed", str(shifted())]) == 0


def test_a_design_of_what_is_not_selected_says_which_inputs_select_it(
    run: Callable[..., StudyResult], tmp_path: Path
) -> None:
    result = run(value_study(designs={"dim": {"light*radiance.value*": 0.5}}, inputs="reflectance"), tmp_path)
    (error,) = result.failures.values()
    assert "'light.emitter.radiance.value', but that is not selected" in error
    assert error.endswith('inputs="emitters" selects it.')  # without the name of this machine
