"""Lamps of IES files in scenes: their flux, pattern, derivatives and poses against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from luminaires import write_asymmetric, write_ies
from refusals import message
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, metrics
from scenecaptum.images import LUMINANCE_WEIGHTS
from scenecaptum.scene import ies_lamp, load_scene, read_ies

REFLECTANCE = 0.5
EFFICACY = 179.0
PLACE = (0.3, -0.2, 1.5)
PIXELS = 48


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_asymmetric(tmp_path_factory.mktemp("ies") / "lamp.ies", shifted(3))


def diffuse() -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": REFLECTANCE}}


def film() -> dict[str, Any]:
    return {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}


def floor(mi: Any, lamp: dict[str, Any], **others: Any) -> dict[str, Any]:
    """Return a floor at z = 0, of which 4 m × 4 m are seen from above: columns of the image are x, rows −y."""
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "sensor": {
            "type": "orthographic",
            "to_world": look @ mi.ScalarTransform4f().scale([2, 2, 1]),
            "film": film(),
        },
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(30), "bsdf": diffuse()},
        "downlight": lamp,
        **others,
    }


def expected_illuminance(file: Path, lamp: dict[str, Any], fine: int = 8) -> torch.Tensor:
    """Return the mean illuminance of the floor in each pixel: I(γ, C) cos θ / d² at ``fine²`` points of it."""
    matrix = torch.tensor(np.array(lamp["to_world"].matrix), dtype=torch.float64)
    count = PIXELS * fine
    along = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * 4
    y, x = torch.meshgrid(-along, along, indexing="ij")
    ray = torch.stack([x, y, torch.zeros_like(x)], -1) - matrix[:3, 3]
    distance = ray.norm(dim=-1)
    illuminance = read_ies(file).candela(ray @ matrix[:3, :3]) * matrix[2, 3] / distance**3
    return illuminance.reshape(PIXELS, fine, PIXELS, fine).mean((1, 3))


def sphere(mi: Any, lamp: dict[str, Any]) -> dict[str, Any]:
    """Return an integrating sphere of radius 2."""
    look = mi.ScalarTransform4f().look_at(origin=[0.1, 0.2, 0.3], target=[1, 0, 0], up=[0, 0, 1])
    wall = {"type": "sphere", "radius": 2.0, "flip_normals": True, "bsdf": diffuse()}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": look, "film": film()},
        "wall": wall,
        "downlight": lamp,
    }


@pytest.mark.parametrize("color", [(1, 1, 1), 2700.0], ids=["white", "2700 K"])
def test_an_integrating_sphere_measures_the_flux_of_the_file(mi, file, color):
    """Light that the wall reflects once is the same everywhere in it, wherever the lamp is: ρ Φ / (4 π r²)."""
    scene = sphere(mi, ies_lamp(file, position=(0.5, -0.4, 0.6), aim=(1, 2, -1), color=color))
    twice, once = (SceneRenderer(scene, "*.lumens", spp=512, max_depth=depth) for depth in (3, 2))
    measured = []
    for seed in seeds(8):
        luminance = EFFICACY * metrics.luminance((twice(seed=seed) - once(seed=seed)).double()).mean().item()
        measured.append(luminance * math.pi / REFLECTANCE * 4 * math.pi * 2**2 / REFLECTANCE)
    flux, error = np.mean(measured), np.std(measured, ddof=1) / math.sqrt(8)
    own = read_ies(file).lumens
    assert abs(flux - own) < allowed(8) * error, (flux, error, own)
    assert abs(flux / own - 1) < 0.005


POSES = {
    "down": lambda t: {"position": PLACE},
    "tilted": lambda t: {"position": PLACE, "aim": (0.6, 0.3, -1)},
    "up": lambda t: {"position": PLACE, "aim": (0, 0, 1)},
    "turned": lambda t: {"to_world": t.translate(list(PLACE)).rotate([0, 0, 1], 120).rotate([1, 0, 0], 20)},
}


@pytest.mark.parametrize(
    "pose", ["tilted", "turned", *(pytest.param(p, marks=pytest.mark.long) for p in ("down", "up"))]
)
def test_the_illuminance_of_a_floor_is_that_of_the_candelas(mi, file, pose):
    lamp = ies_lamp(file, **POSES[pose](mi.ScalarTransform4f()))
    renderer = SceneRenderer(floor(mi, lamp), "*.lumens", resolution=(PIXELS, PIXELS), spp=512, max_depth=2)
    images = torch.stack([metrics.luminance(renderer(seed=seed).double()) for seed in seeds(8)])
    measured = EFFICACY * images * math.pi / REFLECTANCE
    error = measured.std(0) / math.sqrt(8)
    expected = expected_illuminance(file, lamp)
    off = (measured.mean(0) / expected - 1).abs().max().item()
    # What 64 points miss of the pixels with a bend of the interpolation, and rounding, are no noise.
    z = ((measured.mean(0) - expected).abs() / (error + 1e-4 * expected)).max().item()
    assert off < 0.01
    assert z < allowed(8, measured[0].numel())


@pytest.fixture(scope="module")
def furnished(mi: Any, file: Path) -> SceneRenderer:
    """Two lamps of different files, another light and a ball, as they are in rooms."""
    symmetric = write_ies(file.parent / "symmetric.ies", [0, 30, 90], [0], [400, 300, 0])
    scene = floor(
        mi,
        ies_lamp(file, position=PLACE),
        spot=ies_lamp(symmetric, position=(1, 1, 2), aim=(-1, -1, -2), lumens=500, color=3000),
        bulb={"type": "point", "position": [0, -1, 2], "intensity": {"type": "rgb", "value": 1.0}},
        ball={"type": "sphere", "center": [0.2, 0.1, 0.4], "radius": 0.3, "bsdf": {"type": "roughplastic"}},
    )
    return SceneRenderer(scene, ["*.lumens", "downlight.pose.*"], spp=16, max_depth=4)


def test_lumens_are_inputs(furnished, file):
    inputs = furnished.inputs
    assert inputs["downlight.lumens"].item() == pytest.approx(read_ies(file).lumens)
    assert inputs["spot.lumens"] == 500
    parameter = furnished.parameters_table()["downlight.lumens"]
    assert (parameter.kind, parameter.label, str(parameter.bounds)) == (
        "emitters",
        "downlight: lumens",
        "[0, ∞)",
    )
    assert parameter.plugin == "IesLamp"


def test_an_image_is_linear_in_the_lumens(furnished):
    own, off = furnished.inputs["downlight.lumens"], torch.tensor(0.0)
    seed = shifted()

    def image(lumens: torch.Tensor) -> torch.Tensor:
        return furnished({"downlight.lumens": lumens}, seed=seed)

    dark, once, twice = image(off), image(own), image(2 * own)
    assert (once - dark).max() > 0
    torch.testing.assert_close(twice - dark, 2 * (once - dark), rtol=1e-4, atol=1e-4)
    # A renderer of another scene does not change this one.
    torch.testing.assert_close(image(own), once, rtol=0, atol=0)


def test_the_derivative_of_lumens_is_that_of_differences(furnished):
    metric, names, drawn = metrics.MeanLuminance(), ["downlight.lumens", "spot.lumens"], []
    for seed in seeds(12):
        leaves = furnished.leaves()
        values = {name: leaves[name] for name in names}
        metric(furnished(values, seed=seed, seed_grad=10_000 + seed)).backward()
        row = []
        for name, value in values.items():
            step = 0.2 * value.detach()
            ends = [metric(furnished({name: value.detach() + h}, seed=20_000 + seed)) for h in (step, -step)]
            row.append(value.grad - (ends[0] - ends[1]) / (2 * step))
        drawn.append(torch.stack(row))
    errors = torch.stack(drawn).double()
    z = errors.mean(0) / (errors.std(0) / math.sqrt(len(errors)))
    assert z.abs().max() < allowed(12, 2), z


@pytest.mark.parametrize("medium", [False, True], ids=["surfaces", "fog"])
def test_a_single_lamp_causes_all_light(mi, file, medium):
    """The same samples in both passes: the derivative times the flux is the image itself, to rounding."""
    scene = floor(mi, ies_lamp(file, position=PLACE))
    if medium:
        fog = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3}
        scene["fog"] = {
            **{"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4},
            **{"bsdf": {"type": "null"}, "interior": fog},
        }
    renderer = SceneRenderer(scene, "*.lumens", spp=16, max_depth=4)
    leaves = renderer.leaves()
    mean = renderer(leaves, seed=shifted()).mean()
    mean.backward()
    lumens = leaves["downlight.lumens"]
    assert (lumens.grad * lumens).item() == pytest.approx(mean.item(), rel=1e-4)


@pytest.mark.parametrize(
    ("pose", "moved"),
    [
        ({"translation": [0.2, 0.1, -0.3]}, lambda t, here: t.translate([0.2, 0.1, -0.3]) @ here),
        ({"rotation": [0, 0, 0.5]}, lambda t, here: here @ t.rotate([0, 0, 1], math.degrees(0.5))),
        ({"rotation": [0.4, 0, 0]}, lambda t, here: here @ t.rotate([1, 0, 0], math.degrees(0.4))),
    ],
    ids=["moved", "turned", "tilted"],
)
def test_a_pose_is_that_of_a_lamp_hung_there(mi, file, pose, moved):
    lamp = ies_lamp(file, position=PLACE)
    renderer = SceneRenderer(floor(mi, lamp), "downlight.pose.*", spp=16, max_depth=2)
    values = {f"downlight.pose.{name}": torch.tensor(value) for name, value in pose.items()}
    there = ies_lamp(file, to_world=moved(mi.ScalarTransform4f(), lamp["to_world"]))
    fresh = SceneRenderer(floor(mi, there), "*.lumens", spp=16, max_depth=2)
    seed = shifted()
    before, after = renderer(seed=seed), renderer(values, seed=seed)
    torch.testing.assert_close(after, fresh(seed=seed), rtol=1e-3, atol=1e-4)
    assert (after - before).abs().max() > 0.01 * before.max()
    torch.testing.assert_close(renderer(seed=seed), before, rtol=0, atol=0)


def test_a_scene_file_names_its_ies_file_relative_to_itself(mi, file):
    path = file.parent / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><emitter type="scenecaptum_ies" id="wall_light">'
        f'<string name="filename" value="{file.name}"/></emitter></scene>'
    )
    renderer = SceneRenderer(path, "emitters")
    assert renderer.inputs["wall_light.lumens"].item() == pytest.approx(read_ies(file).lumens)
    (file.parent / "lamp2.ies").write_text("TILT=NONE\n")
    path.write_text(path.read_text().replace("lamp.ies", "lamp2.ies"))
    said = message(lambda: load_scene(path))
    assert "lamp2.ies cannot be read as an IES file: it ends after 0 of 13 header values." in said
    assert "Traceback" not in said


def test_mitsuba_loads_the_entry(mi, file):
    scene = mi.load_dict(floor(mi, ies_lamp(file, position=PLACE, lumens=10)), optimize=False)
    assert SceneRenderer(scene, "*.lumens").inputs["downlight.lumens"] == 10


def test_a_scaled_lamp_is_refused(mi, file):
    lamp = ies_lamp(file, to_world=mi.ScalarTransform4f().scale(2))
    assert "leave out its scale" in message(lambda: load_scene(floor(mi, lamp)))


def test_a_color_has_a_luminance_of_1_and_that_of_a_black_body(file):
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    for kelvin, chromaticity in {2856: (0.4476, 0.4074), 6500: (0.3135, 0.3237)}.items():
        rgb = ies_lamp(file, color=kelvin)["color"]
        xyz = to_xyz @ rgb
        assert np.dot(rgb, LUMINANCE_WEIGHTS) == pytest.approx(1)
        assert xyz[:2] / xyz.sum() == pytest.approx(chromaticity, abs=5e-4)
    assert ies_lamp(file, color=1200)["color"][2] == 0
    assert np.dot(ies_lamp(file, color=(0.2, 0, 4))["color"], LUMINANCE_WEIGHTS) == pytest.approx(1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"lumens": -1}, "lumens must be a number of at least 0, not -1"),
        ({"lumens": "bright"}, "not 'bright'"),
        ({"lumens": math.nan}, "not nan"),
        ({"position": (0, 1)}, "position must be three finite numbers, not (0, 1)"),
        ({"aim": (0, 0, 0)}, "aim must not be 0"),
        ({"aim": "down"}, "aim must be three finite numbers"),
        ({"color": (1, 1)}, "color must be three numbers"),
        ({"color": (0, 0, 0)}, "not all 0"),
        ({"color": 100}, "1000 to 40000 K, not 100"),
        ({"position": (0, 0, 1), "to_world": "there"}, "to_world replaces position and aim"),
        ({"to_world": "there"}, "to_world must be a Mitsuba transformation, not str"),
    ],
    ids=str,
)
def test_arguments_are_checked(file, arguments, expected):
    assert expected in message(lambda: ies_lamp(file, **arguments))
