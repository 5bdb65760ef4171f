"""Moved objects, lights and cameras: the same pictures as scenes that were loaded that way, and closed forms."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from refusals import message
from seeds import seeds, shifted

from scenecaptum import (
    FeatureAblationScene,
    IntegratedGradientsScene,
    SceneRenderer,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
)

Config = dict[str, Any]
LAMP = "lamp.pose.translation"

TRANSLATION, ROTATION, SCALE = (0.2, -0.1, 0.15), (0.1, 0.3, -0.2), 0.2


def camera(**options: Any) -> Config:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    place = mi.ScalarTransform4f().look_at(origin=(0, -6, 1), target=(0, 0, 0), up=(0, 0, 1))
    defaults = {"to_world": place, "fov": 40.0, "film": film, "sampler": {"type": "independent"}}
    return {"type": "perspective", **defaults, **options}


def scene(**parts: Any) -> Config:
    floor = {"type": "rectangle", "to_world": _translate((0, 0, -1.5)).scale(4)}
    lights = {"sky": {"type": "constant", "radiance": 0.4}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": camera(),
        "ground": floor,
        **lights,
        **parts,
    }


def _turned() -> tuple[list[float], float]:
    """Return the axis and the angle in degrees of the rotation above."""
    angle = math.hypot(*ROTATION)
    return [x / angle for x in ROTATION], math.degrees(angle)


def _rotate(axis: tuple[float, float, float], degrees: float) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().rotate(axis, degrees)


def _look_at(*places: tuple[float, float, float]) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().look_at(*places)


def _translate(by: tuple[float, float, float]) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().translate(list(by))


def moved(pivot: tuple[float, float, float], *, rotate: bool = True, scale: bool = True) -> Any:
    """Return the transform of the pose above, about a pivot, by Mitsuba's own functions."""
    transform = _translate(TRANSLATION) @ _translate(pivot)
    if rotate:
        transform = transform.rotate(*_turned())
    if scale:
        transform = transform.scale(1 + SCALE)
    return transform @ _translate((-pivot[0], -pivot[1], -pivot[2]))


def pose(name: str, *components: str) -> dict[str, torch.Tensor]:
    values = {
        "translation": torch.tensor(TRANSLATION),
        "rotation": torch.tensor(ROTATION),
        "scale": torch.tensor(SCALE),
    }
    return {f"{name}.pose.{component}": values[component] for component in components or values}


def bent_mesh(folder: Path) -> str:
    """Write a mesh with normals that are not those of its faces."""
    import mitsuba as mi

    mesh = mi.load_dict({"type": "rectangle"})
    mesh = mi.Mesh("bent", 4, 2, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [-1, 0, -1, 1, 0, -1, 1, 0.3, 1, -1, 0, 1]
    params["faces"] = [0, 1, 2, 0, 2, 3]
    normals = np.array([[-0.5, -1, 0], [0.5, -1, 0], [0.3, -1, 0.4], [-0.3, -1, 0.4]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    params["vertex_normals"] = normals.ravel().tolist()
    params.update()
    path = folder / "bent.ply"
    mesh.write_ply(str(path))
    return str(path)


SHAPES = {
    "sphere": {"type": "sphere", "center": [0.3, 0, 0], "radius": 0.7},
    "cube": {"type": "cube"},
    "cylinder": {"type": "cylinder", "p0": [0, 0, -0.5], "p1": [0.2, 0.1, 0.8], "radius": 0.4},
    "rectangle": {"type": "rectangle", "flip_normals": False},
    "disk": {"type": "disk"},
    "lamp": {"type": "sphere", "radius": 0.5, "emitter": {"type": "area", "radiance": 3.0}},
}


def same_pictures(left: Config, right: Config, values: dict[str, torch.Tensor]) -> None:
    """Check that a pose renders what a scene renders that was loaded in that pose."""
    renderer = SceneRenderer(left, list(values), spp=4)
    before = renderer(seed=shifted(1))
    found = renderer(values, seed=shifted(1))
    expected = SceneRenderer(right, "reflectance", spp=4)(seed=shifted(1))
    # Rounding moves a few samples across an edge.
    off = ((found - expected).abs() > 1e-3).any(-1).float().mean()
    assert off < 0.02, f"{100 * off:.1f} % of the pixels differ"
    assert (found - before).abs().max() > 0.01
    # Mitsuba computes the length of a cylinder again, with rounding.
    torch.testing.assert_close(renderer(seed=shifted(1)), before, atol=1e-4, rtol=1e-4)


def test_a_part_moves_with_its_whole(mi: Any) -> None:
    """A part turns within the whole, about its own centre; the whole takes it along."""
    arm = {"type": "rectangle", "to_world": _translate((1.3, 0, 0)).rotate([1, 0, 0], 90).scale(0.4)}
    turn = _translate((1.3, 0, 0)).rotate([0, 1, 0], 40).translate([-1.3, 0, 0])
    whole = moved((0.35, 0.0, 0.0))  # the centre of the bounds of both, x from -1 to 1.7
    values = pose("robot") | {"arm.pose.rotation": torch.tensor([0.0, math.radians(40), 0.0])}
    robot = {"robot": ["body", "arm"], "arm": "arm"}
    renderer = SceneRenderer(scene(body={"type": "cube"}, arm=arm), list(values), objects=robot, spp=4)
    other = scene(
        body={"type": "cube", "to_world": whole}, arm=arm | {"to_world": whole @ turn @ arm["to_world"]}
    )
    found = renderer(values, seed=shifted(1))
    expected = SceneRenderer(other, "reflectance", spp=4)(seed=shifted(1))
    off = ((found - expected).abs() > 1e-3).any(-1).float().mean()
    assert off < 0.02, f"{100 * off:.1f} % of the pixels differ"
    assert (found - renderer(seed=shifted(1))).abs().max() > 0.01
    assert renderer.collisions({"arm.pose.translation": torch.tensor([-1.0, 0.0, 0.0])}) == []


def centre(shape: Config) -> tuple[float, float, float]:
    import mitsuba as mi

    box = mi.load_dict(shape).bbox()
    middle = [(low + high) / 2 for low, high in zip(box.min, box.max, strict=True)]
    return middle[0], middle[1], middle[2]


@pytest.mark.parametrize("kind", SHAPES)
def test_a_moved_shape_is_that_of_a_scene_loaded_so(mi: Any, kind: str) -> None:
    shape = SHAPES[kind]
    loaded = mi.load_dict(shape)
    if kind == "cube":
        own = mi.ScalarTransform4f()
    else:
        matrix = np.array(mi.traverse(loaded)["to_world"].matrix).reshape(4, 4, -1)[..., 0]
        own = mi.ScalarTransform4f(matrix.tolist())
    rest = {k: v for k, v in shape.items() if k not in ("center", "radius", "p0", "p1")}
    other = {**rest, "to_world": moved(centre(shape)) @ own}
    same_pictures(scene(thing=shape), scene(thing=other), pose("thing"))


@pytest.mark.parametrize("face_normals", [False, True])
def test_a_mesh_keeps_its_normals(mi: Any, tmp_path: Path, face_normals: bool) -> None:
    mesh = {"type": "ply", "filename": bent_mesh(tmp_path), "face_normals": face_normals}
    other = {**mesh, "to_world": moved(centre(mesh))}
    same_pictures(scene(thing=mesh), scene(thing=other), pose("thing"))


def test_an_instance_moves(mi: Any) -> None:
    group = {"type": "shapegroup", "ball": {"type": "sphere"}, "box": {"type": "cube"}}
    parts = {"group": group, "copy": {"type": "instance", "shapes": {"type": "ref", "id": "group"}}}
    pivot = (0.0, 0.0, 0.0)
    other = {**parts, "copy": {**parts["copy"], "to_world": moved(pivot)}}
    same_pictures(scene(**parts), scene(**other), pose("copy"))


def test_lights_move(mi: Any) -> None:
    ball = {"type": "sphere"}
    above = _translate((0.5, -1, 2.5)).rotate([1, 0, 0], 180)
    for light, components, other in (
        (
            {"type": "point", "position": [1, -2, 2], "intensity": 20.0},
            ("translation",),
            {"type": "point", "position": [1 + 0.2, -2 - 0.1, 2 + 0.15], "intensity": 20.0},
        ),
        (
            {"type": "spot", "to_world": above, "intensity": 20.0},
            ("translation", "rotation"),
            {"type": "spot", "to_world": moved((0.5, -1, 2.5), scale=False) @ above, "intensity": 20.0},
        ),
        (
            {"type": "directional", "to_world": above, "irradiance": 2.0},
            ("rotation",),
            {
                "type": "directional",
                "to_world": moved((0.5, -1, 2.5), scale=False) @ above,
                "irradiance": 2.0,
            },
        ),
    ):
        same_pictures(scene(ball=ball, beam=light), scene(ball=ball, beam=other), pose("beam", *components))


def test_an_environment_turns(mi: Any) -> None:
    texels = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    turned = {**sky, "bitmap": mi.Bitmap(texels), "to_world": mi.ScalarTransform4f().rotate(*_turned())}
    ball = {"type": "sphere"}
    same_pictures(scene(ball=ball, sky=sky), scene(ball=ball, sky=turned), pose("sky", "rotation"))


def test_an_environment_that_turns_is_painted_on_the_background(mi: Any) -> None:
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}
    names = ["sky.pose.rotation", "beam.pose.rotation", "ball.pose.rotation"]
    beam = {"type": "directional", "irradiance": 2.0}
    renderer = SceneRenderer(scene(ball={"type": "sphere"}, sky=sky, beam=beam), names, spp=1)
    surfaces = renderer.surfaces
    assert surfaces is not None
    assert np.array_equal(surfaces.shown(names[:1]), surfaces.mask("background"))
    assert not surfaces.shown(names[1:2]).any()  # the camera does not see a beam
    assert np.array_equal(surfaces.shown(names[2:]), surfaces.mask("ball"))


def test_the_camera_moves(mi: Any) -> None:
    own = camera()["to_world"]
    other = camera(to_world=moved((0, -6, 1), scale=False) @ own, fov=44.0)
    values = {**pose("camera", "translation", "rotation"), "camera.fov": torch.tensor(44.0)}
    parts = {"ball": {"type": "sphere"}, "box": SHAPES["cylinder"]}
    same_pictures(scene(**parts), scene(**parts, sensor=other), values)


def painted(**parts: Any) -> Config:
    """Return a scene with a textured floor and a textured ball."""
    import mitsuba as mi

    def texture(seed: int) -> Config:
        texels = np.random.default_rng(seed).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
        return {"type": "diffuse", "reflectance": bitmap}

    floor = {"type": "rectangle", "to_world": _translate((0, 0, -1.5)).scale(4), "bsdf": texture(1)}
    ball = {"type": "sphere", **parts.pop("ball", {}), "bsdf": texture(2)}
    return scene(ground=floor, ball=ball, **parts)


@pytest.mark.parametrize(
    ("moved_one", "method"),
    [
        pytest.param("ball", VanillaSceneGradient, id="ball-gradient"),
        pytest.param("ball", FeatureAblationScene, id="ball-ablation"),
        pytest.param("camera", IntegratedGradientsScene, id="camera-integrated gradients"),
        pytest.param(
            "ball", IntegratedGradientsScene, id="ball-integrated gradients", marks=pytest.mark.long
        ),
        pytest.param("camera", VanillaSceneGradient, id="camera-gradient", marks=pytest.mark.long),
        pytest.param("camera", FeatureAblationScene, id="camera-ablation", marks=pytest.mark.long),
    ],
)
def test_a_result_has_the_surfaces_and_the_camera_of_its_poses(mi: Any, moved_one: str, method: Any) -> None:
    """Those of a scene loaded in the pose, whatever was rendered before, also beside textures."""
    parts = (
        {"ball": {"to_world": _translate(TRANSLATION)}}
        if moved_one == "ball"
        else {"sensor": camera(to_world=moved((0, -6, 1), scale=False) @ camera()["to_world"])}
    )
    values = pose(moved_one, *(("translation",) if moved_one == "ball" else ("translation", "rotation")))
    renderer = SceneRenderer(painted(), ["reflectance", *values], spp=4)
    loaded = SceneRenderer(painted(**parts), "reflectance", spp=4)
    own = renderer.surfaces
    options = {"n_steps": 2} if method is IntegratedGradientsScene else {}
    if method is not VanillaSceneGradient:
        options["baselines"] = 0.0
    result = method(renderer, metrics.MeanLuminance()).attribute(
        {**renderer.inputs, **values}, seed=shifted(), spp=4, **options
    )
    expected = loaded.surfaces_with_texels()
    assert expected.texels.keys() == result.surfaces.texels.keys() != set()
    for name in ("ball", "ground"):
        off = np.abs(result.surfaces.mask(name) - expected.mask(name)) > 1 / 16
        assert off.mean() < 0.02, f"{name} is at another place in {100 * off.mean():.1f} % of the pixels"
    for name, texels in expected.texels.items():
        rising = np.arange(16.0, dtype=np.float32)[:, None]
        shown, truth = (
            np.bincount(one.pixel, one.fraction * own_texels.density(rising, len(one.pixel))[:, 0], 256)
            for one, own_texels in ((result.surfaces, result.surfaces.texels[name]), (expected, texels))
        )
        assert (np.abs(shown - truth) > 0.1 * truth.max()).mean() < 0.02
    assert np.abs(own.mask("ball") - expected.mask("ball")).max() > 0.5
    assert result.info["sensor"] == loaded.info["sensor"]
    assert (result.info["sensor"] == renderer.info["sensor"]) == (moved_one == "ball")


def test_the_renderer_describes_its_camera_as_loaded_after_renders_of_other_poses(mi: Any) -> None:
    renderer = SceneRenderer(scene(), "camera", spp=1)
    before = renderer.info["sensor"], renderer.up, pytest.approx(renderer.camera.fov, rel=1e-6)
    values = {"camera.fov": torch.tensor(80.0), "camera.pose.rotation": torch.tensor([-1.4, 0.0, 0.0])}
    renderer(values, seed=shifted())
    assert (renderer.info["sensor"], renderer.up, renderer.camera.fov) == before
    assert renderer.info_of(values)["sensor"].startswith("perspective, 80° wide")


def check(
    parts: Config, values: dict[str, torch.Tensor], expected: dict[str, list[float]], radiance: float = 1.0
) -> None:
    """Check derivatives of the mean of the picture against closed forms, within 3 errors and 2 %."""
    renderer = SceneRenderer(scene(**parts), list(values), spp=2048)
    mean = metrics.MeanLuminance(efficacy=1.0)
    found = VanillaSceneGradient(renderer, mean).attribute(seed=shifted(), replicates=16)
    for name, numbers in expected.items():
        truth, errors = torch.tensor(numbers), found.standard_error[name].reshape(-1)
        off = (found[name].reshape(-1) - truth).abs()
        scale = truth.abs().max()
        assert (off <= allowed(16, 12) * errors + 0.02 * truth.abs()).all(), (found[name], truth, errors)
        assert (errors <= 0.1 * scale).all(), f"{name} is too noisy to tell: {errors} of {scale}"


def looking_down(distance: float = 1e-3) -> Config:
    """Return a camera that sees a point of the ground from close by, below everything else."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at(origin=(0, 0, -1.5 + distance), target=(0, 0, -1.5), up=(0, 1, 0))
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return camera(to_world=place, fov=1.0, near_clip=1e-5, film=film)


GROUND = {"type": "diffuse", "reflectance": 0.5}


def lit_point(**parts: Any) -> Config:
    """Return a scene in which direct light falls on a point of the ground at z = −1.5."""
    floor = {"type": "rectangle", "to_world": _translate((0, 0, -1.5)).scale(4), "bsdf": GROUND}
    dark = {"type": "constant", "radiance": 0.0}
    return {"sensor": looking_down(), "ground": floor, "sky": dark, **parts}


def disk_irradiance(position: torch.Tensor, radius: float) -> torch.Tensor:
    """Return the irradiance at the origin under a parallel disk of radiance 1 (Gross et al., 1981)."""
    across, height = position[:2].square().sum(), position[2].square()
    total = across + height + radius**2
    return (
        math.pi / 2 * (1 - (across + height - radius**2) / (total.square() - 4 * radius**2 * across).sqrt())
    )


def slope(function: Any, at: list[float], extent: float = 0.1) -> list[float]:
    """Return the mean slopes over the range of a pose, by element."""
    point = torch.tensor(at, dtype=torch.float64)
    steps = extent / 2 * torch.eye(len(at), dtype=torch.float64)
    return [float(function(point + step) - function(point - step)) / extent for step in steps]


def test_a_disk_lamp_moves_along_and_across_its_axis(mi: Any) -> None:
    at, radius = [0.6, 0.0, 1.2], 0.5
    turned = _translate((at[0], at[1], at[2] - 1.5)).rotate([1, 0, 0], 180).scale(radius)
    lamp = {"type": "disk", "to_world": turned, "emitter": {"type": "area", "radiance": 2.0}}

    def radiance(position: torch.Tensor) -> torch.Tensor:
        return 2.0 * 0.5 / math.pi * disk_irradiance(position, radius)

    name = "lamp.pose.translation"
    check(lit_point(lamp=lamp), {name: torch.zeros(3)}, {name: slope(radiance, at)})


def test_a_small_lamp_over_a_floor_is_raised(mi: Any) -> None:
    at = [0.5, 0.3, 1.4]
    lamp = {"type": "point", "position": [at[0], at[1], at[2] - 1.5], "intensity": 3.0}

    def radiance(position: torch.Tensor) -> torch.Tensor:
        return 3.0 * 0.5 / math.pi * position[2] / position.norm() ** 3

    name = "lamp.pose.translation"
    check(lit_point(lamp=lamp), {name: torch.zeros(3)}, {name: slope(radiance, at)})


def test_a_spot_light_turns(mi: Any) -> None:
    height, tilt, cutoff, beam = 1.5, math.radians(14), 30.0, 5.0
    place = _translate((0, 0, height - 1.5)).rotate([0, 1, 0], math.degrees(tilt)).rotate([1, 0, 0], 180)
    spot = {"type": "spot", "to_world": place, "intensity": 4.0, "cutoff_angle": cutoff, "beam_width": beam}

    def radiance(turn: torch.Tensor) -> torch.Tensor:
        # The axis is turned about x and y; the point is straight below.
        x, y, _ = turn.tolist()
        cross = torch.tensor([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
        axis = torch.matrix_exp(cross) @ torch.tensor(
            [-math.sin(tilt), 0.0, -math.cos(tilt)], dtype=torch.float64
        )
        angle = torch.acos(-axis[2])
        falloff = (math.radians(cutoff) - angle) / math.radians(cutoff - beam)
        return 4.0 * 0.5 / math.pi * falloff / height**2

    name = "beam.pose.rotation"
    extent = math.radians(5)
    check(lit_point(beam=spot), {name: torch.zeros(3)}, {name: slope(radiance, [0.0, 0.0, 0.0], extent)})


def test_a_black_sphere_before_the_sky_moves_and_grows(mi: Any) -> None:
    distance, radius, fov, radiance = 5.0, 0.8, 40.0, 2.0
    place = mi.ScalarTransform4f().look_at(origin=(0, -distance, 0), target=(0, 0, 0), up=(0, 0, 1))
    ball = {"type": "sphere", "radius": radius, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    low = {"type": "rectangle", "to_world": _translate((0, 0, -100))}
    parts = {"ball": ball, "ground": low, "sensor": camera(to_world=place, fov=fov)}
    parts["sky"] = {"type": "constant", "radiance": radiance}

    def mean(pose: torch.Tensor) -> torch.Tensor:
        away, size = distance + pose[0], radius * (1 + pose[1])
        share = math.pi * size**2 / (away**2 - size**2) / (4 * math.tan(math.radians(fov) / 2) ** 2)
        return radiance * (1 - share)

    (away, _), (_, grown) = slope(mean, [0.0, 0.0]), slope(mean, [0.0, 0.0], 0.05)
    names = {"ball.pose.translation": [0.0, away, 0.0], "ball.pose.scale": [grown]}
    check(parts, {"ball.pose.translation": torch.zeros(3), "ball.pose.scale": torch.zeros(())}, names)


def wall_light(points: torch.Tensor) -> torch.Tensor:
    """Return the radiance of the wall at ``(…, 2)`` points of it."""
    return 1 + 0.5 * torch.sin(2.0 * points[..., 0] + 0.5) * torch.cos(1.5 * points[..., 1])


def seen_wall(
    rotation: torch.Tensor, fov: float, rfilter: Any, size: int = 8, fine: int = 24
) -> torch.Tensor:
    """Return the picture ``(size, size)`` of the wall at y = 3, from the origin, by numerical integration."""
    centres = (torch.arange(size * fine, dtype=torch.float64) + 0.5) / fine
    along = (2 * centres / size - 1) * math.tan(math.radians(fov) / 2)
    down, across = torch.meshgrid(along, along, indexing="ij")
    directions = torch.stack([across, torch.ones_like(across), -down], -1)
    x, y, z = rotation.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    directions = directions @ torch.matrix_exp(cross).T
    light = wall_light(3 * directions[..., [0, 2]] / directions[..., 1:2])
    offsets = centres - (torch.arange(size, dtype=torch.float64) + 0.5)[:, None]
    weights = rfilter(offsets)
    weights = weights / weights.sum(1, keepdim=True)
    return weights @ light @ weights.T


@pytest.mark.parametrize("kind", ["box", pytest.param("tent", marks=pytest.mark.long), "gaussian"])
def test_the_camera_turns_and_zooms_before_a_wall(mi: Any, kind: str) -> None:
    size, fov, half = 8, 35.0, 4.0
    texels = (torch.arange(512) + 0.5) / 512 * 2 * half - half
    down, across = torch.meshgrid(-texels, texels, indexing="ij")
    light = (
        wall_light(torch.stack([across, down], -1))[..., None].expand(-1, -1, 3).numpy().astype(np.float32)
    )
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(light), "raw": True}
    wall = {
        "type": "rectangle",
        "to_world": _translate((0, 3, 0)).rotate([1, 0, 0], 90).scale(half),
        "emitter": {"type": "area", "radiance": bitmap},
    }
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": {"type": kind},
        "pixel_format": "rgb",
    }
    place = mi.ScalarTransform4f().look_at(origin=(0, 0, 0), target=(0, 1, 0), up=(0, 0, 1))
    parts = {"wall": wall, "sensor": camera(to_world=place, fov=fov, film=film)}
    names = ["camera.pose.rotation", "camera.fov"]
    renderer = SceneRenderer({"type": "scene", **parts}, names, spp=256, max_depth=1)

    plugin = mi.load_dict({"type": kind})

    def rfilter(offsets: torch.Tensor) -> torch.Tensor:
        if kind == "box":
            return (offsets.abs() < 0.5).double()
        return (
            plugin.eval(mi.Float(offsets.flatten().float().numpy())).torch().reshape(offsets.shape).double()
        )

    weight = torch.rand(size, size, generator=torch.Generator().manual_seed(shifted(3)), dtype=torch.float64)

    def seen(turn: torch.Tensor, zoom: float = 0.0) -> float:
        return float((weight * seen_wall(turn, fov + zoom, rfilter)).mean())

    picture = seen_wall(torch.zeros(3), fov, rfilter)
    with torch.no_grad():
        assert (renderer(seed=shifted(), spp=4096)[..., 0] - picture).abs().max() < 0.02, "another wall"
    steps = 1e-4 * torch.eye(3, dtype=torch.float64)
    turns = [(seen(step) - seen(-step)) / 2e-4 for step in steps]
    zoomed = (seen(torch.zeros(3), 0.01) - seen(torch.zeros(3), -0.01)) / 0.02

    def metric(image: torch.Tensor) -> torch.Tensor:
        return (image[..., 0] * weight.to(image)).mean()

    found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted(), replicates=16)
    values = torch.cat([found[name].reshape(-1) for name in names])
    errors = torch.cat([found.standard_error[name].reshape(-1) for name in names])
    truth = torch.tensor([*turns, zoomed])
    assert ((values - truth).abs() <= allowed(16, 12) * errors + 0.02 * truth.abs()).all(), (
        values,
        truth,
        errors,
    )
    assert errors[:3].max() < 0.1 * truth[:3].norm()
    assert not found.info["jumps"]


def test_a_turn_whose_gradient_holds_for_a_part_of_a_pixel_only_is_marked(mi: Any) -> None:
    """The wall is wide over the range of a turn, a pixel at the edge of the lamp is not: renders say the same."""
    renderer = SceneRenderer(
        "cornell-box", ["camera.pose.rotation", "camera.fov"], resolution=(32, 32), spp=64
    )
    turn = "camera.pose.rotation"
    metrics = {"wall": lambda image: image[10:20, 3:9].mean(), "edge": lambda image: image[4, 18].mean()}
    for name, metric in metrics.items():
        found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted())
        gradient = found[turn].norm().item()
        step = math.radians(2.5) * found[turn] / gradient
        with torch.no_grad():
            ends = [metric(renderer({turn: end}, seed=shifted(1), spp=1024)).item() for end in (step, -step)]
        over_range = (ends[0] - ends[1]) / (2 * math.radians(2.5))
        if name == "wall":
            assert found.info["local"] == []
            assert over_range == pytest.approx(gradient, rel=0.15)
        else:
            assert turn in found.info["local"]
            assert abs(over_range) < 0.1 * gradient
            assert "does not hold over the range" in " ".join(str(found).split())


def test_a_turned_camera_turns_on(mi: Any) -> None:
    """The derivative at another rotation is that of the axis–angle vector, not of a further rotation."""
    turned = {"camera.pose.rotation": torch.tensor([0.1, 0.8, 0.05])}
    renderer = SceneRenderer(
        scene(ball=SHAPES["lamp"]), ["camera.pose.rotation"], resolution=(24, 24), spp=256, max_depth=2
    )
    weight = torch.linspace(0, 1, 24)[:, None, None] * torch.linspace(1, 2, 24)[None, :, None]

    def metric(image: torch.Tensor) -> torch.Tensor:
        return (image * weight).mean()

    (name,) = turned
    found = VanillaSceneGradient(renderer, metric).attribute(turned, seed=shifted(), replicates=16)
    differences = []
    for seed in seeds(10, 26):
        with torch.no_grad():
            pairs = [
                [metric(renderer({name: turned[name] + sign * step}, seed=seed, spp=64)) for sign in (1, -1)]
                for step in 0.02 * torch.eye(3)
            ]
        differences.append(torch.tensor([float(up - down) / 0.04 for up, down in pairs]))
    expected = torch.stack(differences)
    error = (expected.var(0) / len(expected) + found.standard_error[name].square()).sqrt()
    z = (found[name] - expected.mean(0)) / error
    assert z.abs().max() < allowed(16, 3), (found[name], expected.mean(0), error)


def test_poses_that_are_refused(mi: Any) -> None:
    def refusal(inputs: Any, **options: Any) -> str:
        return message(lambda: SceneRenderer("cornell-box", inputs, **options))

    parts = scene(ball={"type": "sphere"})
    assert "the same from all directions" in message(lambda: SceneRenderer(parts, "sky.pose.rotation"))
    assert "no shape matches" in refusal("poses", objects={"boxes": "*_bix*"})
    twice = {"a": ["tall_box*", "floor*"], "b": "*_box_shape"}
    assert "belongs to the objects 'a' and 'b'" in refusal("poses", objects=twice)
    same = {"a": "*_box_shape", "b": "*_box_shape"}
    assert "belongs to the objects 'a' and 'b'" in refusal("poses", objects=same)
    renderer = SceneRenderer("cornell-box", "poses", resolution=(8, 8), spp=1)
    name = "tall_box_shape.pose.scale"
    assert "outside the physical range" in message(lambda: renderer({name: torch.tensor(-1.0)}))
    assert "not finite" in message(
        lambda: renderer({"tall_box_shape.pose.rotation": torch.tensor([0.0, math.nan, 0.0])})
    )
    assert "single sensor" in message(
        lambda: SceneRenderer("cornell-box", "camera.fov", sensor=[0, "fisheye"])
    )
    # A setting of Mitsuba's sensor, which never has a derivative, would not say what to change.
    of_kind = message(lambda: SceneRenderer("cornell-box", "camera", sensor=[0, "fisheye"]))
    assert "camera.pose.translation, for example: it needs a renderer with a single sensor" in of_kind


def test_what_a_light_without_geometry_lacks_is_named(mi: Any) -> None:
    """What changes nothing says why, a transform which pose to select; globs select what there is."""
    lights = {
        "point": {"type": "point", "intensity": 1.0},
        "spot": {"type": "spot", "intensity": 1.0},
        "sun": {"type": "directional", "irradiance": 1.0},
        "env": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))},
    }
    parts = {"type": "scene", "sensor": {"type": "perspective"}, **lights}
    size, far = "it has no size", "its light comes from infinitely far away"
    why = {
        "point": {"rotation": "its light is the same in all directions", "scale": size},
        "spot": {"scale": size},
        "sun": {"translation": far, "scale": far},
        "env": {"translation": far, "scale": far},
    }
    for light, reasons in why.items():
        for component, reason in reasons.items():
            name = f"{light}.pose.{component}"
            assert message(lambda n=name: SceneRenderer(parts, n)) == f"{name!r} cannot be moved: {reason}."
        place = "position" if light == "point" else "to_world"
        said = message(lambda n=f"{light}.{place}": SceneRenderer(parts, n))
        assert f"it positions a light; select {light}.pose.* instead." in said
        left = {f"{light}.pose.{one}" for one in ("translation", "rotation", "scale") if one not in reasons}
        assert set(SceneRenderer(parts, f"{light}.pose.*").inputs) == left
    # An object of shapes that has the name of the light.
    whole = {"scene": {**parts, "cone": {"type": "sphere"}}, "objects": {"spot": "cone"}}
    said = message(lambda: SceneRenderer(inputs="spot.to_world", **whole))
    assert "it positions a light; select spot_light.pose.* instead." in said
    assert "spot_light.pose.rotation" in SceneRenderer(inputs="spot_light.pose.*", **whole).inputs
    sky = {**parts, "env": {"type": "sunsky"}}
    for name in ("env.pose.scale", "env.to_world"):
        said = message(lambda n=name: SceneRenderer(sky, n))
        assert "Mitsuba's SunskyEmitter is placed in the scene file or dict alone: change that" in said


def test_a_lamp_in_the_ceiling_is_marked(mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "light.pose.*", resolution=(24, 24), spp=256)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    assert "ceiling_shape" in found.info["jumps"]["light.pose.translation"]
    assert "light.pose.translation" not in [row.name for row in found.ranking()]
    assert "light.pose.scale" in [row.name for row in found.ranking()]
    assert "is not ranked" in str(found)


def test_a_mean_gradient_over_noisy_scenes_has_no_derivative_at_a_jump_either(mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "light.pose.translation", resolution=(16, 16), spp=64)
    found = SmoothGradScene(renderer, metrics.MeanLuminance()).attribute(seed=shifted(), spp=256)
    assert list(found.info["jumps"]) == ["light.pose.translation"]
    assert not found.ranking()


def test_what_is_at_the_end_of_twice_the_range_is_near(mi: Any) -> None:
    for gap, near in ((0.1, ["floor"]), (0.11, [])):
        ball = {"type": "sphere", "radius": 0.2, "center": [0, 0, gap + 0.2]}
        scene = {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)},
            "ball": ball,
            "sky": {"type": "constant"},
            "sensor": {"type": "perspective"},
        }
        renderer = SceneRenderer(scene, "ball.pose.translation", resolution=(4, 4), spp=1)
        assert renderer.touching("ball.pose.translation") == near, gap


def test_the_length_of_a_vector_is_that_of_its_effect(mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "short_box_shape.pose.translation", resolution=(24, 24), spp=64)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    (name,) = found
    assert found.effects()[name] <= 0.1 * float(found[name].norm())
    # A vector that is only noise has no length, on average over seeds.
    lengths = [
        VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=seed, spp=16)
        for seed in seeds(1, 4)
    ]
    assert all(one.effects_error()[name] > 0 for one in lengths)


def test_objects_that_cannot_reach_the_top_get_no_more_renders(mi: Any) -> None:
    """The same order and values, within errors, as with renders for all; fewer renders."""
    inputs = [
        "back_wall_shape.pose.translation",
        "*_box_shape.pose.translation",
        "left_wall_shape.pose.scale",
    ]
    renderer = SceneRenderer("cornell-box", inputs, resolution=(24, 24), spp=64)
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    found = method.attribute(seed=shifted(), top=1, tolerance=0.05)
    plan = found.info["planner"]
    assert plan["settled"], "nothing was settled"
    assert found.ranking()[0].name not in plan["settled"]
    whole = method.attribute(seed=shifted(1), spp=512)
    for name in found:
        error = (found.standard_error[name].square() + whole.standard_error[name].square()).sqrt()
        assert ((found[name] - whole[name]).abs() < allowed(8, 12) * error).all(), name


@pytest.mark.long
def test_ablation_confirms_poses(mi: Any) -> None:
    from scenecaptum import validation

    inputs = ["short_box_shape.pose.translation", "tall_box_shape.pose.rotation", "floor.reflectance.value"]
    renderer = SceneRenderer("cornell-box", inputs, resolution=(24, 24), spp=512)
    test = validation.ablation_test(renderer, metrics.MeanLuminance(), seed=shifted())
    assert all(row.agrees is not False for row in test.rows), test


def test_explanations_speak_of_units_and_degrees(mi: Any) -> None:
    inputs = ["short_box_shape.pose.translation", "tall_box_shape.pose.rotation"]
    renderer = SceneRenderer("cornell-box", inputs, resolution=(24, 24), spp=1024)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    text = " ".join(str(found.explain()).split())
    assert "over ±0.05 units towards (" in text
    assert "over ±2.5° about (" in text


def test_the_map_shows_what_moves(mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "tall_box_shape.pose.*", resolution=(24, 24), spp=64)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    shown = torch.from_numpy(renderer.surfaces.mask("tall_box_shape")) > 0.9
    heatmap = found.heatmap()
    assert heatmap[shown].min() > 0
    assert heatmap[torch.from_numpy(renderer.surfaces.mask("left_wall_shape")) > 0.9].max() == 0


def test_a_direction_that_jumps_is_left_out_where_others_matter_more(mi: Any) -> None:
    """The table says so, and the effect is that of the other directions."""
    name = "ball.pose.translation"
    renderer = SceneRenderer(
        "cornell-box", name, resolution=(8, 8), spp=4, objects={"ball": "short_box_shape"}
    )
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    info = {
        **found.info,
        "jumps": {},
        "kept_directions": {name: [1.0, 1.0, 0.0]},
        "left_out_directions": {name: "it jumps"},
    }
    marked = dataclasses.replace(found, info=info)
    assert marked.factors()[name][2] == 0
    assert "this direction is left out" in str(marked)
    assert marked.effects()[name] <= 0.1 * float(found[name][:2].norm()) + 1e-6
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    grouped = method.attribute(seed=shifted(), groups={"moved": [name]})
    assert grouped["moved"].shape == ()
    assert [row.name for row in grouped.ranking()] == ["moved"]


def below_a_ceiling(beside: float, inputs: Sequence[str] = (LAMP,)) -> Any:
    """Return a renderer of the floor ``beside`` a lamp, which is 5 cm below a ceiling that it crosses."""
    down = _rotate((1, 0, 0), 180)
    return SceneRenderer(
        {
            "type": "scene",
            "sensor": camera(to_world=_look_at((beside, 0, -1), (beside, 0, -2), (0, 1, 0))),
            "ceiling": {"type": "rectangle", "to_world": down.scale(3)},
            "floor": {"type": "rectangle", "to_world": _translate((0, 0, -2)).scale(3)},
            "lamp": {
                "type": "rectangle",
                "to_world": _translate((0, 0, -0.05)) @ down.scale(0.2),
                "emitter": {"type": "area", "radiance": 20.0},
            },
        },
        inputs,
        spp=64,
        max_depth=2,
    )


def test_a_direction_that_jumps_has_no_part_in_the_effect_and_its_error(mi: Any) -> None:
    """Along the ceiling the lamp has a derivative, which renders confirm; its fall through it has none."""
    from scenecaptum import validation

    renderer, metric = below_a_ceiling(beside=1.5), metrics.MeanLuminance()
    found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted())
    assert found.info["kept_directions"] == {LAMP: [1.0, 1.0, 0.0]}
    assert not found.info["left_out"], "that is of parameters of the scene"
    effect, errors = found.effects()[LAMP], found.effects_error()
    assert effect == pytest.approx(0.1 * float(found[LAMP][0]), rel=0.01)
    assert errors is not None
    assert errors[LAMP] < 0.02 * effect < 0.1 * 0.1 * float(found.standard_error[LAMP][2])
    assert found.weights()[LAMP][2] == 0
    assert not found.untrusted_errors()
    assert "ceiling is near; this direction is left out" in " ".join(str(found).split())
    assert "–" in next(line for line in str(found).splitlines() if line.startswith("1 ")), (
        "a number without meaning"
    )
    twice = found + found
    assert twice.effects_error()[LAMP] < 0.02 * twice.effects()[LAMP]
    (row,) = validation.ablation_test(renderer, metric, found, seed=shifted()).rows
    assert row.above_noise
    assert row.agrees
    planned = VanillaSceneGradient(renderer, metric).attribute(seed=shifted(), tolerance=0.05)
    assert planned.info["planner"]["reached"]


def test_where_nothing_has_a_derivative_every_form_says_why(mi: Any, tmp_path: Path) -> None:
    from results import all_text

    from scenecaptum import explanation, optimize, report, validation

    renderer, metric = below_a_ceiling(beside=0.0), metrics.MeanLuminance()
    found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted())
    reason = found.info["jumps"][LAMP]
    said = f"lamp: translation is not ranked: {reason}; no derivative"
    assert found.ranking() == []
    figures = (found.plot_bars(), found.plot_heatmap(), found.plot_overlay(signed=True))
    for text in (str(found), str(found.explain()), *map(all_text, figures)):
        assert said in " ".join(text.split())
        assert "depends on none" not in text
        assert "all effects are 0" not in text
    report.write_report([found], tmp_path / "page.html")
    assert said in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert found.to_dataframe().empty
    assert said in message(lambda: optimize.minimize(renderer, metric, below=0.0, spp=16, seed=shifted()))
    assert said in message(lambda: validation.interactions(renderer, metric, found))
    report.write_json(found, tmp_path / "numbers.json")
    report.write_csv(found, tmp_path / "numbers.csv")
    assert said in str(explanation.explain(renderer, metric, changes=1, spp=16, seed=shifted()).sections())
    verdict = validation.ablation_test(renderer, metric, found, seed=shifted()).verdict
    assert verdict == f"Nothing to test: lamp: translation has no derivative: {reason}"


def test_a_search_ends_where_nothing_has_a_derivative(mi: Any) -> None:
    method = VanillaSceneGradient(below_a_ceiling(beside=0.0), metrics.MeanLuminance())
    found = method.attribute(seed=shifted(), tolerance=1e-4)
    planner = found.info["planner"]
    assert len(planner["rounds"]) == 1
    assert planner["reached"] is False
    assert planner["stopped"] == "the lack of a derivative"
    assert "half-widths" not in str(found)


def test_a_group_is_the_sum_of_what_has_a_derivative(mi: Any) -> None:
    renderer = below_a_ceiling(beside=0.0, inputs=[LAMP, "lamp.emitter.radiance.value"])
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    whole, together, apart = (
        method.attribute(seed=shifted(), groups=groups)
        for groups in (None, {"both": "lamp.*"}, {"moved": [LAMP], "light": "lamp.emitter.*"})
    )
    (light,) = whole.ranking()
    assert light.name != LAMP
    assert together.effects()["both"] == pytest.approx(light.effect, rel=1e-4)
    assert "lamp: translation is left out of its group" in " ".join(str(together).split())
    assert [row.name for row in apart.ranking()] == ["light"]
    assert "moved is not ranked" in str(apart)


def test_what_no_light_reaches_has_no_effect_when_it_moves(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two renders of its difference are equal but for rounding, which is neither an effect nor a jump."""
    from scenecaptum.rendering._engine import Engine

    def rounded(engine: Engine, *arguments: Any) -> torch.Tensor:
        # As several threads sum a pixel, each time in another order.
        image = primal(engine, *arguments)
        return image * (1 + torch.finfo(image.dtype).eps * torch.randn(image.shape))

    primal = Engine.primal
    monkeypatch.setattr(Engine, "primal", rounded)
    hidden = {"type": "cube", "to_world": _translate((0, 0, -5)).scale(0.2)}
    renderer = SceneRenderer(scene(hidden=hidden), "hidden.pose.*", resolution=(16, 16), spp=16)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=seeds(1)[0])
    assert all(not value.any() and not found.standard_error[name].any() for name, value in found.items())
    assert "jumps" not in str(found)
