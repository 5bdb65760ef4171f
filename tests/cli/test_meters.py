"""Commands on a scene whose sensor is an irradiance meter, which has neither a picture nor a plan."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scenecaptum import cli

SCENE = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <emitter type="constant"/>
    <shape type="rectangle" id="desk">
        <sensor type="irradiancemeter">
            <film type="hdrfilm">
                <integer name="width" value="1"/><integer name="height" value="1"/><rfilter type="box"/>
            </film>
        </sensor>
    </shape>
</scene>"""


@pytest.fixture
def scene(tmp_path: Path) -> str:
    path = tmp_path / "desk.xml"
    path.write_text(SCENE)
    return str(path)


def test_the_illuminance_of_a_desk_is_attributed(scene: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = [
        "--metric",
        "mean-illuminance",
        "--spp",
        "64",
        "--max-depth",
        "3",
        "--no-progress",
        "--out",
        str(out),
    ]
    assert cli.main(["attribute", scene, *options]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "attribution.csv",
        "attribution.json",
        "attribution.npz",
        "bars.png",
    ]
    # Under a uniform sky of radiance 1 the irradiance is π.
    metric = json.loads((out / "attribution.json").read_text())["metric"]
    assert metric["value"] == pytest.approx(179 * 3.14159, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["attribute", "--metric", "luminance", "--report"], "an irradiancemeter has neither"),
        (["explain", "--metric", "luminance", "--report"], "an irradiancemeter has neither"),
        (["attribute", "--metric", "luminance", "--format", "heatmap"], "this sensor shows none"),
        (["attribute", "--metric", "ugr"], "irradiancemeter has no camera"),
    ],
)
def test_what_needs_a_picture_is_refused_in_one_line(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    command, *options = arguments
    assert cli.main([command, scene, *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
