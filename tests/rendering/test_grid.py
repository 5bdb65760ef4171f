"""Sensor grids: irradiance at points of a room, against closed forms, differences and stock renders."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from seeds import seeds, shifted
from side_lit import at, grey, rgb, room, side_lit_room, walls

from scenecaptum import SceneCaptumError, SceneRenderer, SensorGrid, VanillaSceneGradient, metrics
from scenecaptum.explanation import grid_premises
from scenecaptum.grid import en_12464_spacing

Config = dict[str, Any]


def box(mi: Any, floor: float = 0.5) -> Config:
    """Return a closed room with a lamp under its ceiling."""
    place = mi.ScalarTransform4f
    lamp = {
        "type": "rectangle",
        "to_world": place().translate([0.5, 0, 1.9]).rotate([1, 0, 0], 180).scale(0.3),
    }
    lamp["emitter"] = {"type": "area", "radiance": rgb(20.0)}
    return room(**walls(floor=floor), lamp=lamp)


def measured(
    scene: Config, grid: SensorGrid, *, spp: int = 256, **options: Any
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean irradiance of each point over several seeds, with its standard error."""
    renderer = SceneRenderer(scene, "emitters", sensor=grid, spp=spp, **options)
    runs = torch.stack([renderer(seed=seed)[..., 1].double() for seed in seeds(16)])
    return runs.mean(0).flatten(), (runs.std(0) / 4).flatten()


def held(found: torch.Tensor, error: torch.Tensor, expected: torch.Tensor, relative: float = 0.02) -> None:
    assert ((found - expected).abs() <= 4 * error + 1e-6).all(), f"{found} ± {error}, expected {expected}"
    assert (error < relative * expected).all(), "the errors are too large to tell"


def test_a_uniform_sky_gives_pi_times_its_radiance(mi: Any) -> None:
    sky = {"type": "constant", "radiance": rgb(2.0)}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(5), "bsdf": grey(0.9)}
    found, error = measured(room(sky=sky, ground=ground), at((0, 0, 0.1), (1, 2, 3)))
    held(found, error, torch.full((2,), 2 * math.pi).double())


def test_a_furnace_has_the_same_irradiance_everywhere(mi: Any) -> None:
    """A closed room of emission e and reflectance ρ has the radiance e / (1 - ρ)."""
    # Mitsuba's sphere is 0.3 % too bright inside.
    wall = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().scale(2),
        "flip_normals": True,
        "bsdf": grey(0.5),
    }
    wall["emitter"] = {"type": "area", "radiance": rgb(1.0)}
    found, error = measured(room(wall=wall), at((0, 0, 0), (0.5, 0.2, -1.0)), max_depth=-1)
    held(found, error, torch.full((2,), 2 * math.pi).double())


def test_a_point_light_follows_the_inverse_square_and_the_cosine(mi: Any) -> None:
    """Rays of a sensor never hit a point: its light comes by emitter sampling at the grid."""
    lamp = {"type": "point", "position": [0, 0, 3], "intensity": rgb(5.0)}
    floor = {"type": "rectangle", "bsdf": grey(0.0)}
    points = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.0, 1.0, 0.5]]).double()
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": grey(0.0)}
    scene = room(lamp=lamp, floor=floor, box=box)
    renderer = SceneRenderer(scene, "emitters", sensor=at(*points.tolist()), spp=4)
    away = torch.tensor([0.0, 0.0, 3.0]) - points
    distance = away.norm(dim=1)
    expected = 5 * away[:, 2] / distance**3
    torch.testing.assert_close(renderer(seed=shifted(0))[0, :, 0].double(), expected, rtol=1e-4, atol=1e-6)


def test_a_small_lamp_has_its_form_factor(mi: Any) -> None:
    """A disc of radius r at the height h over a point: ``E = π L r² / (r² + h²)``."""
    lamp = {"type": "disk", "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 180)}
    lamp["emitter"] = {"type": "area", "radiance": rgb(10.0)}
    ground = {"type": "rectangle", "bsdf": grey(0.0)}
    found, error = measured(room(lamp=lamp, ground=ground), at((0, 0, 0), (0, 0, 1)))
    held(found, error, torch.tensor([math.pi * 10 / 5, math.pi * 10 / 2]).double())


@pytest.mark.long
def test_a_grid_on_a_white_floor_sees_what_the_floor_reflects(mi: Any) -> None:
    """Irradiance is π times the radiance of a white diffuse surface: of a stock render of the room from above."""
    scene = box(mi, floor=1.0)
    renders = stock_irradiance(mi, scene, (0.3, -0.2), spp=4096)
    found, error = measured(scene, at((0.3, -0.2, 1e-3)), max_depth=5)
    assert abs(found - renders.mean()) < 4 * error.hypot(renders.std() / 4)


def stock_irradiance(mi: Any, scene: Config, place: tuple[float, float], *, spp: int) -> torch.Tensor:
    """Return what Mitsuba's own path tracer finds for a place on a white floor, for each of 16 seeds."""
    x, y = place
    camera = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at(origin=[x, y, 0.5], target=[x, y, 0], up=[0, 1, 0]),
        "fov": 0.01,
        "film": {
            "type": "hdrfilm",
            "width": 1,
            "height": 1,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
    }
    # One bounce more than ours: from the floor to the camera.
    stock = mi.load_dict({**scene, "sensor": camera, "integrator": {"type": "path", "max_depth": 6}})
    renders = [mi.render(stock, seed=seed, spp=spp).torch()[0, 0, 1] for seed in seeds(16)]
    return math.pi * torch.stack(renders).double()


# --- Where points are -----------------------------------------------------------------------------


def test_points_are_spread_over_the_floor(mi: Any) -> None:
    grid = SceneRenderer(box(mi), "emitters", sensor=SensorGrid(height=0.75, spacing=0.5, margin=0.5)).grid
    assert (grid.width, grid.height) == (6, 4)
    assert grid.inside.all()
    assert grid.positions[0, 0].tolist() == pytest.approx([-1.25, 0.75, 0.75])
    assert grid.positions[-1, -1].tolist() == pytest.approx([1.25, -0.75, 0.75])
    assert grid.normals.unique(dim=0).tolist() == [[0, 0, 1]] or (grid.normals[..., 2] == 1).all()


def test_a_floor_in_pieces_is_named_by_its_material(mi: Any) -> None:
    place, parquet = mi.ScalarTransform4f, {"type": "ref", "id": "parquet"}
    scene = {**room(parquet=grey(0.5)), **walls(), "lamp": box(mi)["lamp"]}
    del scene["floor"]
    pieces = {
        "west": place().translate([-1, 0, 0]).scale([1, 1.5, 1]),
        "east": place().translate([1.2, 0, 0]).scale([0.8, 1.5, 1]),
        "shelf": place().translate([1.5, 0, 1]).scale([0.4, 0.4, 1]),
    }
    for name, to_world in pieces.items():
        scene[name] = {"type": "rectangle", "to_world": to_world, "bsdf": parquet}
    found = SceneRenderer(scene, "emitters", sensor=SensorGrid(floor="parquet", spacing=0.5, margin=0.1)).grid
    assert (found.floor, found.sides) == ("parquet", pytest.approx((4.0, 3.0)))
    across = found.plan[..., 0]
    assert across[found.inside].min() < -1.5
    assert across[found.inside].max() > 1.5
    in_gap = (across > 0) & (across < 0.4)
    assert in_gap.any()
    assert not found.inside[in_gap].any()
    west = SceneRenderer(scene, "emitters", sensor=SensorGrid(floor="west", spacing=0.5, margin=0.1)).grid
    assert (west.floor, west.plan[..., 0].max() < 0) == ("west", True)


def test_both_sides_of_a_ceiling_do_not_make_it_so_large_that_it_is_the_floor(mi: Any) -> None:
    """The ceiling of a room is a slab, a little larger than its floor: 2 × 15.8 m² against 12 m²."""
    scene = {
        **box(mi),
        "white": grey(0.8),
        "ceiling": {"type": "cube", "bsdf": {"type": "ref", "id": "white"}},
    }
    scene["ceiling"]["to_world"] = mi.ScalarTransform4f().translate([0, 0, 2.07]).scale([2.2, 1.8, 0.07])
    scene["floor"]["bsdf"] = {"type": "ref", "id": "white"}
    grid = SceneRenderer(scene, "emitters", sensor=SensorGrid(spacing=1.0)).grid
    assert (grid.floor, grid.material, grid.sides) == ("floor", "white", pytest.approx((4.0, 3.0)))
    assert grid.positions[..., 2].max() == pytest.approx(0.8)
    assert SceneRenderer(box(mi), "emitters", sensor="grid").grid.material == ""  # that of the shape itself


def test_the_default_spacing_is_that_of_the_standard(mi: Any) -> None:
    """EN 12464-1: 0.2 · 5^log10(d), of the longer side, or of the shorter one of a long room."""
    assert en_12464_spacing(1.0, 1.0) == pytest.approx(0.2)
    assert en_12464_spacing(10.0, 8.0) == pytest.approx(1.0)
    assert en_12464_spacing(100.0, 10.0) == pytest.approx(1.0)
    assert en_12464_spacing(1e6, 1e6) == 10.0
    grid = SceneRenderer(box(mi), "emitters", sensor="grid").grid
    assert (grid.width, grid.height) == (
        math.ceil(3 / en_12464_spacing(3, 2)),
        math.ceil(2 / en_12464_spacing(3, 2)),
    )


def test_an_l_shaped_floor_leaves_its_corner_out(mi: Any) -> None:
    scene = box(mi)
    del scene["floor"]
    place = mi.ScalarTransform4f
    mesh = mi.Mesh("l", 6, 4)
    params = mi.traverse(mesh)
    corners = [(-2, -1.5), (2, -1.5), (2, 0), (0, 0), (0, 1.5), (-2, 1.5)]
    params["vertex_positions"] = [x for corner in corners for x in (*corner, 0.0)]
    params["faces"] = [0, 1, 3, 1, 2, 3, 0, 3, 5, 3, 4, 5]
    params.update()
    scene["floor"] = mesh
    scene["camera"] = {"type": "perspective", "to_world": place()}
    inside = SceneRenderer(scene, "emitters", sensor=SensorGrid(spacing=0.5, margin=0.0)).grid.inside
    assert inside.shape == (6, 8)
    assert not inside[:3, 4:].any()
    assert inside[:3, :4].all()
    assert inside[3:].all()


def test_points_inside_furniture_are_left_out(mi: Any) -> None:
    scene = box(mi)
    block = mi.ScalarTransform4f().translate([-1, 0, 0.4]).scale([0.5, 0.5, 0.4])
    scene["block"] = {"type": "cube", "to_world": block}
    with pytest.warns(UserWarning, match="lie inside objects"):
        renderer = SceneRenderer(scene, "emitters", sensor=SensorGrid(height=0.5, spacing=0.5))
    assert (~renderer.grid.inside).sum() == 4
    picture = renderer(seed=1)
    assert (picture[~renderer.grid.inside] == 0).all()
    assert (picture[renderer.grid.inside] > 0).all()


@pytest.mark.parametrize(("height", "is_noted"), [(0.5, False), (0.8, True)])
def test_points_right_below_a_table_top_count_with_a_warning(mi: Any, height: float, is_noted: bool) -> None:
    scene = box(mi)
    top = mi.ScalarTransform4f().translate([-1, 0, 0.85]).scale([0.5, 0.5, 0.01])
    scene["top"] = {"type": "cube", "to_world": top}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        renderer = SceneRenderer(scene, "emitters", sensor=SensorGrid(height=height, spacing=0.5))
    assert renderer.grid.inside.all()
    assert renderer.grid.covered == (4 if is_noted else 0)
    cautions = [line for line in grid_premises(renderer) if "right below a surface" in line]
    assert bool(cautions) is is_noted
    shown = [str(one.message) for one in caught]
    assert (
        any(re.match(r"4 of \d+ points .* 0.04 m below it.* such as 0.90 m", message) for message in shown)
        is is_noted
    )


@pytest.mark.parametrize(("sides", "under_the_sky"), [((2, 2), 0), ((2, 1), 8)])
def test_points_without_a_roof_above_are_counted(
    mi: Any, sides: tuple[float, float], under_the_sky: int
) -> None:
    """Of 4 × 4 points, below glass over all of the floor or over its middle."""
    place = mi.ScalarTransform4f().translate([0, 0, 3]) @ mi.ScalarTransform4f().scale([*sides, 1])
    roof = {"type": "rectangle", "to_world": place, "bsdf": {"type": "thindielectric"}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)}
    upright = mi.ScalarTransform4f().look_at(origin=[0, -9, 1], target=[0, 0, 1], up=[0, 0, 1])
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "to_world": upright},
        "sky": {"type": "constant"},
        "floor": floor,
        "roof": roof,
    }
    points = SceneRenderer(scene, sensor=SensorGrid(floor="floor", spacing=1.0, margin=0.0)).grid
    assert points.inside.sum() == 16
    assert points.open_above == under_the_sky


def test_points_lie_on_a_surface(mi: Any) -> None:
    scene = box(mi)
    block = mi.ScalarTransform4f().translate([-1, 0, 0.4]).scale([0.5, 0.5, 0.4])
    scene["block"] = {"type": "cube", "to_world": block}
    top = SceneRenderer(
        scene, "emitters", sensor=SensorGrid(surface="block", facing=(0, 0, 1), count=20), spp=16
    )
    assert top.grid.positions.shape == (1, 20, 3)
    assert (top.grid.positions[..., 2] - 0.8).abs().max() < 1e-3
    assert (top().mean(-1) > 0).all()


def test_points_of_a_file(mi: Any, tmp_path: Path) -> None:
    path = tmp_path / "points.pts"
    path.write_text("# x y z nx ny nz\n0 0 0.8 0 0 2\n1 0.5 0.8 0 1 0\n")
    grid = SceneRenderer(box(mi), "emitters", sensor=SensorGrid.from_file(path)).grid
    assert grid.positions.tolist() == [[[0, 0, 0.8], [1, 0.5, 0.8]]]
    assert grid.normals.tolist() == [[[0, 0, 1], [0, 1, 0]]]


# --- Cylindrical illuminance ----------------------------------------------------------------------


def test_cylindrical_illuminance_of_a_uniform_sky(mi: Any) -> None:
    """The half space of radiance L above a black ground: π L / 2, as ``∫ L sin θ dω / π``."""
    sky = {"type": "constant", "radiance": rgb(2.0)}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1e4), "bsdf": grey(0.0)}
    around = SensorGrid.cylindrical(torch.tensor([[0.0, 0.0, 0.1]]))
    renderer = SceneRenderer(room(sky=sky, ground=ground), "emitters", sensor=around, spp=256)
    metric = metrics.MeanIlluminance(renderer.grid, efficacy=1.0)
    runs = torch.stack([metric(renderer(seed=seed)).double() for seed in seeds(16)])
    held(runs.mean()[None], (runs.std() / 4)[None], torch.tensor([math.pi]).double())


@pytest.mark.parametrize(("directions", "as_good_as"), [(8, 8), (7, 14), (3, 6)])
def test_cylindrical_illuminance_of_a_point_light(mi: Any, directions: int, as_good_as: int) -> None:
    """``I sin θ / (π d²)``, and no further off than stated for light from one direction."""
    points = torch.tensor([[0.3, 0.0, 1.0], [1.0, 0.2, 0.5], [-0.4, 1.1, 2.0]])
    lamp = {"type": "point", "position": [0, 0, 3], "intensity": rgb(5.0)}
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": grey(0.0)}
    around = SensorGrid.cylindrical(points, directions)
    picture = SceneRenderer(room(lamp=lamp, box=box), "emitters", sensor=around, spp=1)(seed=shifted(0))
    away = torch.tensor([0.0, 0.0, 3.0]) - points
    expected = 5 * away[:, :2].norm(dim=1) / away.norm(dim=1) ** 3 / math.pi
    assert picture.shape == (3, directions, 3)
    error = picture[..., 0].mean(1) / expected - 1
    # Sums of the cosines of even directions: the light aligned with one of them, or halfway between two.
    half = math.pi / as_good_as
    assert (error >= half / math.tan(half) - 1 - 1e-5).all(), error
    assert (error <= half / math.sin(half) - 1 + 1e-5).all(), error


def test_directions_of_a_cylinder_are_even_and_horizontal() -> None:
    for up in ((0.0, 0.0, 1.0), (0.0, 2.0, 0.0), (1.0, 1.0, 0.5)):
        normals = SensorGrid.cylindrical(torch.zeros(2, 3), 5, up=up).normals
        assert normals is not None
        cosines = torch.tensor([math.cos(0.4 * math.pi * step) for step in range(5)]).double()
        torch.testing.assert_close(normals[1] @ normals[1, 0], cosines)
        torch.testing.assert_close(normals @ torch.tensor(up).double(), torch.zeros(2, 5).double())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points": torch.zeros(3)}, "takes points"),
        ({"points": torch.zeros(1, 3), "directions": 2}, "directions must be"),
        ({"points": torch.zeros(1, 3), "up": (0.0, 0.0, 0.0)}, "must be a direction"),
    ],
)
def test_a_bad_cylinder_is_one_clear_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneCaptumError, match=message):
        SensorGrid.cylindrical(**options)


BAD_GRIDS = {
    "outside": (lambda: at((5, 0, 0.8)), "1 of 1 points of the grid lie outside the scene's bounds"),
    "hidden": (lambda: at((-1, 0, 0.4), (1, 0, 0.8)), "1 of 2 points of the grid lie inside an object"),
    "too high": (lambda: SensorGrid(height=7.0), "No point of the sensor grid is in the room"),
    "no floor": (lambda: SensorGrid(floor="flor"), "Did you mean 'floor'"),
    "a wall as floor": (lambda: SensorGrid(floor="left"), "'left' has no level part"),
    "another floor": (lambda: SensorGrid(floor="nowhere"), "no shape and no material of this name"),
    "no surface": (lambda: SensorGrid(surface="desk"), "no shape of this name"),
    "facing away": (lambda: SensorGrid(surface="floor", facing=(0, 0, -1)), "no part of it faces"),
    "no area": (lambda: SensorGrid(rectangle=((0, 0), (0, 1))), "has no area"),
}


@pytest.mark.parametrize("case", BAD_GRIDS)
def test_a_bad_grid_is_one_clear_line(mi: Any, case: str) -> None:
    make, message = BAD_GRIDS[case]
    scene = box(mi)
    block = mi.ScalarTransform4f().translate([-1, 0, 0.4]).scale([0.5, 0.5, 0.4])
    scene["block"] = {"type": "cube", "to_world": block}
    with pytest.raises(SceneCaptumError, match=message) as raised:
        SceneRenderer(scene, "emitters", sensor=make())
    assert "\n" not in str(raised.value)


BAD_SPECS = {
    "height": ({"height": -1.0}, "height of a sensor grid must be at least 0"),
    "spacing": ({"spacing": 0.0}, "spacing of a sensor grid must be above 0"),
    "endless": ({"rectangle": ((0.0, 0.0), (1.0, math.inf))}, "rectangle of a sensor grid must be finite"),
    "four numbers": ({"rectangle": (0.0, 0.0, 1.0, 2.0)}, r"must be finite corners, \(\(x0, y0\)"),
    "not a number": ({"margin": math.nan}, "margin of a sensor grid"),
    "two": ({"floor": "floor", "surface": "desk"}, "got floor= and surface="),
    "normals": ({"points": torch.zeros(1, 3)}, "belong together"),
    "zero": ({"points": torch.zeros(1, 3), "normals": torch.zeros(1, 3)}, "is \\(0, 0, 0\\)"),
    "shapes": ({"points": torch.zeros(1, 3), "normals": torch.ones(2, 3)}, "must both be"),
}


def test_points_above_the_ceiling_are_not_in_the_room_under_a_sky_either(mi: Any) -> None:
    with pytest.raises(SceneCaptumError, match="No point of the sensor grid is in the room"):
        SceneRenderer(side_lit_room(), "emitters", sensor=SensorGrid(height=2.1))


@pytest.mark.parametrize("case", BAD_SPECS)
def test_a_bad_setting_is_one_clear_line(case: str) -> None:
    options, message = BAD_SPECS[case]
    with pytest.raises(SceneCaptumError, match=message):
        SensorGrid(**options)


def test_a_bad_file_of_points_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "points.pts"
    for text, message in (("", "has no points"), ("0 0 0 1\n", "Line 1"), ("0 0 0 0 0 up\n", "Line 1")):
        path.write_text(text)
        with pytest.raises(SceneCaptumError, match=message):
            SensorGrid.from_file(path)
    with pytest.raises(SceneCaptumError, match="cannot be read"):
        SensorGrid.from_file(tmp_path / "none.pts")


def test_what_needs_a_view_says_so(mi: Any) -> None:
    renderer = SceneRenderer(box(mi), "reflectance", sensor=SensorGrid(spacing=1.0), spp=4)
    with pytest.raises(SceneCaptumError, match="have no camera"):
        _ = renderer.camera
    with pytest.raises(SceneCaptumError, match="leave resolution= out"):
        SceneRenderer(box(mi), "reflectance", sensor="grid", resolution=(8, 8))
    with pytest.raises(SceneCaptumError, match="leave resolution= out"):
        renderer.replace(resolution=(8, 8))
    with pytest.raises(SceneCaptumError, match="cannot be rendered by prb"):
        renderer.replace(integrator="prb")
    with pytest.raises(SceneCaptumError, match="only sensor"):
        SceneRenderer(box(mi), "reflectance", sensor=["grid", 0])
    with pytest.raises(SceneCaptumError, match="no mask"):
        renderer.mask("floor")
    with pytest.raises(SceneCaptumError, match="requires a picture"):
        VanillaSceneGradient(renderer, torch.mean).attribute(denoise=True)
    with pytest.raises(SceneCaptumError, match="Only a renderer with"):
        _ = SceneRenderer(box(mi), "reflectance").grid


# --- Derivatives ----------------------------------------------------------------------------------


def weighted(image: torch.Tensor) -> torch.Tensor:
    rows, columns = image.shape[:2]
    return (
        (image[..., 1] * torch.linspace(1, 2, rows * columns).reshape(rows, columns).to(image)).mean().log()
    )


def test_derivatives_are_those_of_differences(mi: Any) -> None:
    """Reflectances, lamps and poses at once, by a non-linear metric, against plain renders with other seeds."""
    scene = box(mi)
    names = ["floor.bsdf.reflectance.value", "left.bsdf.reflectance.value", "lamp.emitter.radiance.value"]
    poses = ["lamp.pose.translation"]
    renderer = SceneRenderer(scene, [*names, *poses], sensor=SensorGrid(spacing=1.0), spp=512)
    found = VanillaSceneGradient(renderer, weighted).attribute(seed=shifted(3))
    for name, h in [*((name, 0.05) for name in names[:2]), (names[2], 2.0), (poses[0], 0.05)]:
        value = renderer.inputs[name]
        step = torch.zeros_like(value)
        step[-1 if name in poses else 1] = h
        slopes = torch.stack(
            [
                (
                    weighted(renderer({name: value + step}, seed=s))
                    - weighted(renderer({name: value - step}, seed=s))
                )
                / (2 * h)
                for s in seeds(1000, 1008)
            ]
        ).double()
        own = found[name][-1 if name in poses else 1].item()
        own_error = found.standard_error[name][-1 if name in poses else 1].item()
        # The step of the reflectances bends the logarithm by less than 1 %.
        error = math.hypot(own_error, slopes.std().item() / math.sqrt(8), 0.01 * own)
        assert abs(own - slopes.mean().item()) < 4 * error, f"{name}: {own} ± {own_error}, {slopes.mean()}"


def window_room(mi: Any, **changed: float) -> Config:
    """Return a side-lit room with a white floor, a pane, a blind before it and a lamp, some of them changed."""
    scene = side_lit_room(pane=True, blind=True)
    scene["floor"]["bsdf"] = grey(1.0)
    scene["back"]["bsdf"] = grey(changed.get("back", 0.5))
    scene["pane"]["bsdf"]["specular_transmittance"] = rgb(changed.get("pane", 0.8))
    scene["blind"]["bsdf"]["opacity"] = changed.get("opacity", 0.6)
    lift = mi.ScalarTransform4f().translate([0, 0, changed.get("lift", 0.0)])
    scene["blind"]["to_world"] = lift @ scene["blind"]["to_world"]
    scene["lamp"] = box(mi)["lamp"]
    scene["lamp"]["emitter"]["radiance"] = rgb(changed.get("lamp", 5.0))
    return scene


DIFFERENCES = {
    "back.bsdf.reflectance.value": ("back", 0.5, 0.1),
    "pane.bsdf.specular_transmittance.value": ("pane", 0.8, 0.05),
    "blind.bsdf.opacity.value": ("opacity", 0.6, 0.1),
    "blind.pose.translation": ("lift", 0.0, 0.05),
    "lamp.emitter.radiance.value": ("lamp", 5.0, 2.0),
}


@pytest.mark.long
def test_derivatives_are_those_of_stock_renders(mi: Any) -> None:
    """A wall, a pane, a blind and its height, and a lamp, against Mitsuba's own renders of changed rooms."""
    place, spp = (0.3, -1.0), 16384
    renderer = SceneRenderer(
        window_room(mi), [*DIFFERENCES], sensor=at((*place, 1e-3)), spp=16 * spp, max_depth=5
    )
    found = VanillaSceneGradient(renderer, lambda image: image[..., 1].mean()).attribute(seed=shifted(7))
    for name, (changed, value, h) in DIFFERENCES.items():
        up, down = (
            stock_irradiance(mi, window_room(mi, **{changed: value + sign * h}), place, spp=spp)
            for sign in (1, -1)
        )
        slopes = (up - down) / (2 * h)
        expected, error = slopes.mean().item(), slopes.std().item() / 4
        index = {"lift": 2}.get(changed, 1) if found[name].ndim else ()
        own, own_error = found[name][index].item(), found.standard_error[name][index].item()
        both = math.hypot(own_error, error)
        message = f"{name}: {own:.4g} ± {own_error:.2g}, stock {expected:.4g} ± {error:.2g}"
        assert abs(own - expected) < 4 * both, message
        assert abs(expected) > 4 * both, f"{message}: the errors are too large to tell"


def test_plain_autograd_differentiates_the_number_that_was_rendered(mi: Any) -> None:
    renderer = SceneRenderer(box(mi), ["floor.*", "lamp.emitter.*"], sensor=SensorGrid(spacing=1.5), spp=4)
    values = {name: value.requires_grad_() for name, value in renderer.inputs.items()}
    weighted(renderer(values, seed=shifted(5))).backward()
    for name, value in values.items():
        step = 0.01 * torch.eye(3)[1]
        with torch.no_grad():
            up, down = (
                weighted(renderer({name: value + sign * step}, seed=shifted(5))).item() for sign in (1, -1)
            )
        assert value.grad is not None
        assert value.grad[1].item() == pytest.approx((up - down) / 0.02, rel=0.02, abs=2e-5)


def test_lamps_add_up_to_the_irradiance(mi: Any) -> None:
    renderer = SceneRenderer(box(mi), "emitters", sensor=SensorGrid(spacing=1.0), spp=64)
    found = VanillaSceneGradient(renderer, torch.mean).attribute(seed=shifted(2), denoise=False)
    (row,) = found.ranking()
    assert row.effect == pytest.approx(
        found.metric_value, abs=4 * (row.effect_error + found.metric_standard_error)
    )
