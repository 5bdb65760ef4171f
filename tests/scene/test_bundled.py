"""The bundled scenes: readable names, physical values, and images that are finite and lit."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from scenecaptum import SceneRenderer, SensorGrid
from scenecaptum.backend import activate
from scenecaptum.scene.bundled import BUNDLED, classroom, cornell_box, office

CORNELL_MATERIALS = {"left_wall", "right_wall", "floor", "ceiling", "back_wall", "short_box", "tall_box"}
OFFICE_MATERIALS = {
    *(
        "wall_left",
        "wall_right",
        "wall_back",
        "ceiling",
        "floor",
        "rug",
        "desk",
        "cabinet",
        "chair",
        "screen",
    ),
    *("mirror", "lamp_shade", "lamp_stand", "window_frame", "picture", "mug", "plant", "curtain"),
}
OFFICE_EMITTERS = {"sky", "luminaire_left", "luminaire_right", "luminaire_back", "bulb"}
OFFICE_LIGHTS = {f"{emitter}.emitter.radiance.value" for emitter in OFFICE_EMITTERS}
CLASSROOM_MATERIALS = {
    *("ceiling", "floor", "wall_windows", "wall_front", "wall_back", "wall_corridor"),
    *("ground", "pane", "window_frame", "cloth", "desk", "chair", "board", "door"),
}


def test_a_scene_needs_no_variant_to_be_set_before() -> None:
    script = "from scenecaptum.scene import bundled; bundled.office(); bundled.classroom()"
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.fixture(scope="module")
def mi() -> Any:
    return activate()


@pytest.fixture(params=sorted(BUNDLED))
def name(request: pytest.FixtureRequest, mi: Any) -> str:
    return str(request.param)


def parameters(mi: Any, name: str) -> dict[str, Any]:
    return dict(mi.traverse(mi.load_dict(BUNDLED[name](), optimize=False)).items())


def test_the_bundled_scenes_are_these() -> None:
    assert dict(BUNDLED) == {"classroom": classroom, "cornell-box": cornell_box, "office": office}


@pytest.mark.parametrize(
    ("name", "materials", "lights"),
    [
        ("cornell-box", CORNELL_MATERIALS, {"light.emitter.radiance.value"}),
        ("office", OFFICE_MATERIALS, OFFICE_LIGHTS),
        ("classroom", CLASSROOM_MATERIALS, {"sky.radiance.value"}),
    ],
)
def test_parameters_carry_readable_names(mi: Any, name: str, materials: set[str], lights: set[str]) -> None:
    keys = parameters(mi, name)
    assert materials <= {key.split(".")[0] for key in keys}
    assert lights == {key for key in keys if "radiance" in key}


def test_every_reflectance_is_physical(mi: Any, name: str) -> None:
    unit = ("reflectance.value", "reflectance.data", "base_color.value", "roughness.value", "alpha.value")
    values = {key: np.array(v) for key, v in parameters(mi, name).items() if key.endswith(unit)}
    assert len(values) >= 8
    outside = {key: (v.min(), v.max()) for key, v in values.items() if v.min() <= 0 or v.max() > 1}
    assert not outside


def test_the_picture_is_finite_and_lit(mi: Any, name: str) -> None:
    scene = BUNDLED[name]()
    scene["sensor"]["film"].update(width=64, height=36)
    image = np.array(mi.render(mi.load_dict(scene, optimize=False), spp=8))
    assert image.shape == (36, 64, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.02
    assert image.max() > 10  # a source is in view


def test_each_call_builds_a_new_dict(mi: Any, name: str) -> None:
    first, second = BUNDLED[name](), BUNDLED[name]()
    assert first == second
    first["sensor"]["film"]["width"] = 1
    first["floor"]["reflectance"]["type"] = "changed"
    assert second == BUNDLED[name]() != first


def test_office_is_rich_enough_to_rank(mi: Any) -> None:
    scene = office()
    bsdfs = {"diffuse", "principled", "conductor", "roughconductor", "twosided"}
    assert sum(isinstance(part, dict) and part.get("type") in bsdfs for part in scene.values()) >= 14
    assert len(mi.load_dict(scene, optimize=False).emitters()) >= 3


@pytest.mark.parametrize("key", ["floor.reflectance.data", "picture.reflectance.data"])
def test_office_textures_can_be_differentiated(mi: Any, key: str) -> None:
    params = mi.traverse(mi.load_dict(office(), optimize=False))
    assert isinstance(params[key], mi.TensorXf)
    assert params.flags(key) & mi.ParamFlags.NonDifferentiable.value == 0


def test_the_classroom_has_a_grid_of_desks_and_a_blind_that_moves(mi: Any) -> None:
    renderer = SceneRenderer(
        "classroom",
        ["blind.pose.translation", "cloth.opacity.value", "pane.specular_transmittance.value"],
        sensor=SensorGrid(height=0.8, spacing=1.0),
        spp=16,
    )
    assert renderer.grid.inside.all()
    assert renderer.grid.positions[..., 1].amin() == pytest.approx(1.0)
    with torch.no_grad():
        lit = renderer(seed=0).mean((1, 2))
    assert lit[-1] > 3 * lit[0]  # the last row is the one at the windows
