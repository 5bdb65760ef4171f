"""Daylight coefficients: the irradiance of a sensor grid by the patch of the sky that it comes from."""

from __future__ import annotations

import gc
import importlib.util
import math
import weakref
from typing import Any

import pytest
import torch
from seeds import seeds, shifted
from side_lit import at, grey, room, side_lit_room

from scenecaptum import SceneCaptumError, SceneRenderer, SensorGrid, VanillaSceneGradient
from scenecaptum.daylight import (
    DaylightFactor,
    SkyMatrix,
    SkyPatches,
    SpatialDaylightAutonomy,
    illuminance,
    synthetic_weather,
)

HAS_RADIANCE = importlib.util.find_spec("pyradiance") is not None
PATCHES = SkyPatches.tregenza()
GRID = SensorGrid(height=0.8, spacing=1.0)


def spread(renderer: SceneRenderer, count: int = 16) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean picture over several seeds, and its standard error."""
    runs = torch.stack([renderer(seed=seed).double() for seed in seeds(count)])
    return runs.mean(0), runs.std(0) / math.sqrt(count)


def test_an_unobstructed_point_sees_every_patch_by_its_projected_solid_angle(mi: Any) -> None:
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(5), "bsdf": grey(0.5)}
    scene = room(sky={"type": "constant", "radiance": {"type": "rgb", "value": 7.0}}, ground=ground)
    renderer = SceneRenderer(scene, "reflectance", sensor=at((0, 0, 0.1)), sky_patches=PATCHES, spp=64)
    found, error = spread(renderer)
    assert found.shape == (1, 146, 3)
    z = (found[0, :, 0] - PATCHES.projected_solid_angles) / error[0, :, 0].clamp_min(1e-9)
    assert z.square().mean() < 3
    assert z.abs().max() < 6  # Student's t with 15 degrees of freedom, of 146 patches


def test_patches_add_up_to_the_irradiance_under_a_uniform_sky(mi: Any) -> None:
    scene = side_lit_room()
    coefficients = SceneRenderer(scene, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=16)
    irradiance = SceneRenderer(scene, "reflectance", sensor=GRID, spp=2048)
    found, _ = spread(coefficients)
    total = torch.stack([coefficients(seed=seed).double().sum(1) for seed in seeds(16)])
    expected, own = (part.flatten(0, 1) for part in spread(irradiance))
    assert found.sum(1).allclose(total.mean(0))
    z = (total.mean(0) - expected) / (total.std(0) / 4).hypot(own)
    assert z.abs().max() < 5, z


def test_other_lamps_do_not_count(mi: Any) -> None:
    scene = side_lit_room()
    lamp = {"type": "point", "position": [0, 0, 1.5], "intensity": {"type": "rgb", "value": 100.0}}
    alone = SceneRenderer(scene, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=32)
    with_lamp = SceneRenderer(
        {**scene, "lamp": lamp}, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=32
    )
    means, errors = zip(*(spread(renderer, 8) for renderer in (alone, with_lamp)), strict=True)
    z = (means[0].sum() - means[1].sum()) / errors[0].square().sum().add(errors[1].square().sum()).sqrt()
    assert abs(z) < 5


def test_the_rows_of_the_picture_are_the_points_inside(mi: Any) -> None:
    post = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([1, 0.5, 0.5]).scale([0.2, 0.2, 0.5]),
    }
    scene = {**side_lit_room(), "post": {**post, "bsdf": grey(0.5)}}
    with pytest.warns(UserWarning, match="1 of 6 points of the sensor grid lie inside objects"):
        renderer = SceneRenderer(scene, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=16)
    assert renderer.grid.inside.tolist() == [[True, True, False], [True, True, True]]
    light = renderer(seed=shifted(2)).sum((1, 2))
    assert light.shape == (5,)
    placed = renderer.grid.spread(light)
    assert placed[0, 2] == 0
    assert (placed[1] > placed[0]).all(), "the second row is the one at the window"


def test_the_radiances_of_sky_and_lamps_are_no_inputs(mi: Any) -> None:
    renderer = SceneRenderer(side_lit_room(), "all", sensor=GRID, sky_patches=PATCHES)
    assert "floor.bsdf.reflectance.value" in renderer.inputs
    assert "sky.radiance.value" not in renderer.inputs
    with pytest.raises(SceneCaptumError, match=r"'sky.radiance.value' cannot be .*, which the weather sets"):
        SceneRenderer(side_lit_room(), "sky.radiance.value", sensor=GRID, sky_patches=PATCHES)


def test_a_scene_with_y_up_has_the_same_sky(mi: Any) -> None:
    """A wall to the south hides the patches there, whichever axis points up."""
    tables = []
    for up, turn in (([0, 0, 1], None), ([0, 1, 0], -90)):
        base = mi.ScalarTransform4f() if turn is None else mi.ScalarTransform4f().rotate([1, 0, 0], turn)
        ground = {"type": "rectangle", "to_world": base.scale(5), "bsdf": grey(0.0)}
        wall = base.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(5)
        scene = room(sky={"type": "constant"}, ground=ground)
        scene["wall"] = {"type": "rectangle", "to_world": wall, "bsdf": grey(0.0)}
        towards = base @ mi.ScalarPoint3f(0, 1, 1)
        scene["sensor"] = {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=base @ mi.ScalarPoint3f(0, -0.5, 1), target=towards, up=up
            ),
        }
        point = tuple(float(x) for x in base @ mi.ScalarPoint3f(0, 0, 0.1))
        grid = at(point, facing=tuple(float(x) for x in up))
        renderer = SceneRenderer(scene, "reflectance", sensor=grid, sky_patches=PATCHES, spp=64)
        tables.append(renderer(seed=shifted(0))[0, :, 0])
    assert ((tables[0] > 0) == (tables[1] > 0)).float().mean() > 0.97
    assert (tables[0] - tables[1]).abs().sum() < 0.05 * tables[0].sum()
    south = PATCHES.directions[:, 1] < -0.5
    north = PATCHES.directions[:, 1] > 0.5
    assert tables[0][south].sum() < 0.1 * tables[0][north].sum()


# --- Derivatives ----------------------------------------------------------------------------------

INPUTS = [
    "floor.bsdf.reflectance.value",
    "pane.bsdf.specular_transmittance.value",
    "blind.bsdf.opacity.value",
    "blind.pose.scale",
]


@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_of_annual_metrics_are_those_of_differences(mi: Any, name: str) -> None:
    """Of the whole chain, with common random numbers: reflectance, glass, the opacity and the place of a blind."""
    scene = side_lit_room(pane=name == INPUTS[1], blind="blind" in name)
    renderer = SceneRenderer(scene, [name], sensor=GRID, sky_patches=PATCHES, spp=64)
    sky = (
        SkyMatrix.from_weather(synthetic_weather(), PATCHES)
        if HAS_RADIANCE
        else SkyMatrix.cie_overcast(PATCHES)
    )
    metric = SpatialDaylightAutonomy(sky, relaxation=0.5) if HAS_RADIANCE else DaylightFactor(sky)
    found = VanillaSceneGradient(renderer, metric).attribute(seed=shifted(7))
    value, h = renderer.inputs[name], 0.05
    step = torch.zeros_like(value)
    step.view(-1)[0] = h
    slopes = torch.stack(
        [
            (metric(renderer({name: value + step}, seed=s)) - metric(renderer({name: value - step}, seed=s)))
            / (2 * h)
            for s in seeds(1000, 1008)
        ]
    ).double()
    own, own_error = (part[name].flatten()[0].item() for part in (found, found.standard_error))
    # Common random numbers leave little noise in the difference; the metric bends by about 2 % over the step.
    error = math.hypot(own_error, slopes.std().item() / math.sqrt(8), 0.02 * own)
    assert abs(own - slopes.mean().item()) < 4 * error, (
        f"{own} ± {own_error}, {slopes.mean()} ± {slopes.std()}"
    )
    assert abs(own) > 4 * own_error, "the derivative is too small to tell"


def test_plain_autograd_differentiates_the_number_that_was_rendered(mi: Any) -> None:
    renderer = SceneRenderer(side_lit_room(), "floor.*", sensor=GRID, sky_patches=PATCHES, spp=4)
    metric = DaylightFactor(SkyMatrix.cie_overcast(PATCHES))
    leaves = renderer.leaves()
    metric(renderer(leaves, seed=shifted(5))).backward()
    ((name, leaf),) = leaves.items()
    with torch.no_grad():
        up, down = (metric(renderer({name: leaf + h}, seed=shifted(5))).item() for h in (0.01, -0.01))
    assert leaf.grad.sum().item() == pytest.approx((up - down) / 0.02, rel=0.01)


def test_samples_may_change_between_calls(mi: Any) -> None:
    renderer = SceneRenderer(side_lit_room(), "floor.*", sensor=GRID, sky_patches=PATCHES, spp=8)
    first = renderer(seed=shifted(1)).sum()
    more = renderer(seed=shifted(1), spp=64).sum()
    assert renderer(seed=shifted(1)).sum() == pytest.approx(first.item(), rel=1e-5)
    assert more.item() == pytest.approx(first.item(), rel=0.3)


def test_a_scene_is_freed_with_its_renderer(mi: Any) -> None:
    renderer = SceneRenderer(side_lit_room(), "floor.*", sensor=GRID, sky_patches=PATCHES, spp=1)
    leaves = renderer.leaves()
    renderer(leaves, seed=shifted()).sum().backward()
    graph = weakref.ref(renderer._graph)
    del renderer, leaves
    gc.collect()
    assert graph() is None


# --- Direct light ---------------------------------------------------------------------------------


def test_direct_light_is_that_of_a_black_room(mi: Any) -> None:
    """Through a pane and the gaps of a blind, path by path."""
    tables = []
    for reflectance, direct in ((None, True), (0.0, False)):
        scene = side_lit_room(pane=True, blind=True)
        renderer = SceneRenderer(
            scene, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=16, direct_sky=direct
        )
        values = renderer.inputs if reflectance is None else black(renderer)
        tables.append(renderer(values, seed=shifted(3)))
    assert tables[0].sum() > 0
    torch.testing.assert_close(tables[0], tables[1], rtol=1e-4, atol=1e-6)


def black(renderer: SceneRenderer) -> dict[str, torch.Tensor]:
    surfaces = {name: value for name, value in renderer.inputs.items() if name.endswith("reflectance.value")}
    return renderer.inputs | {name: torch.zeros_like(value) for name, value in surfaces.items()}


def test_direct_light_depends_on_panes_and_blinds_alone(mi: Any) -> None:
    scene = side_lit_room(pane=True, blind=True)
    renderer = SceneRenderer(
        scene, ["reflectance", "opacity"], sensor=GRID, sky_patches=PATCHES, spp=16, direct_sky=True
    )
    leaves = renderer.leaves()
    total = renderer(leaves, seed=shifted(4)).sum()
    total.backward()
    slopes = {name: 0.0 if leaf.grad is None else leaf.grad.sum().item() for name, leaf in leaves.items()}
    pane = slopes.pop("pane.bsdf.specular_transmittance.value")
    # All light passes the pane once, and is proportional to its transmittance.
    assert pane == pytest.approx(total.item() / 0.8, rel=1e-3)
    opacity = slopes.pop("blind.bsdf.opacity.value")
    assert opacity < 0
    assert slopes
    assert set(slopes.values()) == {0.0}


REACH = 2 * 6 * math.sqrt(2)  # degrees: gendaymtx spreads the sun over neighbours, patches of 6°


@pytest.mark.skipif(not HAS_RADIANCE, reason="a year of weather needs pyradiance")
def test_direct_sun_falls_where_the_true_sun_does(mi: Any) -> None:
    """But for the hours in which the sun is so near to the edge of the opening that its patches reach over it."""
    patches, year = SkyPatches.reinhart(2), synthetic_weather()
    year = year.select(year.occupied() & (year.direct_normal > 0))
    sky = SkyMatrix.from_weather(year, patches, sun="only")
    scene = side_lit_room()
    renderer = SceneRenderer(scene, "reflectance", sensor=GRID, sky_patches=patches, spp=16, direct_sky=True)
    found = illuminance(renderer(seed=shifted(5)), sky)
    points = renderer.grid.positions.reshape(-1, 1, 3)
    seen = torch.stack([sees_through_opening(points, sun) for sun in around(year.sun_directions(), REACH)])
    outdoors = sky.horizontal_illuminance()
    dark, sunny = ~seen.any(0), seen.all(0) & (outdoors > 3000)
    assert dark.sum() > 1000
    assert sunny.sum() > 1000
    assert found[dark].max() == 0
    assert (found[sunny] > 1000).all()


def sees_through_opening(points: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Whether a ray from each point leaves the room through the opening in its south, ``(points, directions)``."""
    x, y, z = ((-1.5 - points[..., 1]) / directions[:, 1])[..., None].mul(directions).add(points).unbind(-1)
    del y
    to_sky = (directions[:, 1] < 0) & (directions[:, 2] > 0)
    return to_sky & (x.abs() < 2) & (z > 0.8) & (z < 2)


def around(directions: torch.Tensor, degrees: float) -> list[torch.Tensor]:
    """Return directions, and those at an angle to them to all sides."""
    across = torch.linalg.cross(
        directions, torch.tensor([0.0, 0.0, 1.0], dtype=directions.dtype).expand_as(directions)
    )
    across = across / across.norm(dim=-1, keepdim=True)
    upward, size = torch.linalg.cross(across, directions), math.tan(math.radians(degrees))
    turned = [
        directions + size * (math.cos(angle) * across + math.sin(angle) * upward)
        for angle in torch.arange(0, 2 * math.pi, math.pi / 4).tolist()
    ]
    return [directions, *(one / one.norm(dim=-1, keepdim=True) for one in turned)]


# --- Bad input ------------------------------------------------------------------------------------


def test_what_coefficients_need_is_one_clear_line(mi: Any) -> None:
    scene = side_lit_room()
    with pytest.raises(SceneCaptumError, match="needs the points of a sensor grid"):
        SceneRenderer(scene, "reflectance", sky_patches=PATCHES)
    with pytest.raises(SceneCaptumError, match="direct_sky=True needs sky_patches="):
        SceneRenderer(scene, "reflectance", sensor=GRID, direct_sky=True)
    without = {name: part for name, part in scene.items() if name != "sky"}
    with pytest.raises(SceneCaptumError, match="need a sky, and the scene has none: add a constant emitter"):
        SceneRenderer(without, "reflectance", sensor=GRID, sky_patches=PATCHES)
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    message = r"scene has none \(its `Skylight` is an area light, not a constant emitter\): add"
    with pytest.raises(SceneCaptumError, match=message):
        SceneRenderer({**without, "Skylight": lamp}, "reflectance", sensor=GRID, sky_patches=PATCHES)
    sun = {"type": "sunsky", "turbidity": 3.0, "sun_direction": [0, 0, 1]}
    with pytest.raises(
        SceneCaptumError,
        match=r"need a sky .*, which is not what `sky` \(sunsky\) is: replace it by <emitter .*; the weather",
    ):
        SceneRenderer({**without, "sky": sun}, "reflectance", sensor=GRID, sky_patches=PATCHES)
    renderer = SceneRenderer(scene, "reflectance", sensor=GRID, sky_patches=PATCHES, spp=1)
    with pytest.raises(SceneCaptumError, match="no forward mode"):
        renderer.derivative_image("floor.bsdf.reflectance.value")
