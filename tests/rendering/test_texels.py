"""Texel maps, surfaces behind mirrors and panes, and derivative images, against renders and Mitsuba's rays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from seeds import shifted

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.projection import SurfaceMap, heatmap
from scenecaptum.scene.bundled import office

FLOOR = "floor.reflectance.data"
Config = dict[str, Any]


@pytest.fixture(scope="module")
def room(mi: Any) -> SceneRenderer:
    return SceneRenderer("office", inputs=[FLOOR], resolution=(48, 27), spp=16, max_depth=3)


def camera(mi: Any, **film: int) -> Config:
    return {
        "type": "perspective",
        "fov": 50,
        "to_world": mi.ScalarTransform4f().look_at(origin=[0.3, -0.2, 4], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}, **film},
        "sampler": {"type": "independent", "sample_count": 4},
    }


def rays(scene: Any, mi: Any, shape: tuple[int, int]) -> tuple[Any, np.ndarray]:
    """The 16 Hammersley points of every pixel as rays, and the pixel of each."""
    height, width = shape
    pixel, point = np.divmod(np.arange(height * width * 16), 16)
    down = np.array([int(f"{n:04b}"[::-1], 2) for n in range(16)])[point]
    x = (pixel % width + (point + 0.5) / 16) / width
    y = (pixel // width + (down + 0.5) / 16) / height
    place = mi.Point2f(x.astype(np.float32), y.astype(np.float32))
    return scene.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))[0], pixel


# --- Texels ----------------------------------------------------------------------------------------


def shown_by_map(surfaces: SurfaceMap, name: str, texels: np.ndarray, share: np.ndarray) -> np.ndarray:
    """What each pixel shows of a texture according to the map, ``(H, W, 3)``."""
    values = surfaces.texels[name].density(texels * share[..., None], len(surfaces.pixel))
    picture = np.zeros((surfaces.shape[0] * surfaces.shape[1], 3))
    np.add.at(picture, surfaces.pixel, values * surfaces.fraction[:, None])
    return picture


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
def test_the_map_mixes_texels_as_mitsuba_does(mi: Any, filter_type: str, wrap: str) -> None:
    texels = np.random.default_rng(shifted(3)).uniform(0.1, 0.9, (5, 4, 3)).astype(np.float32)
    radiance = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "filter_type": filter_type,
        "wrap_mode": wrap,
        "to_uv": mi.ScalarTransform3f().translate([0.3, -0.2]).rotate(20).scale([1.7, 1.2]),
    }
    card = {"type": "rectangle", "emitter": {"type": "area", "radiance": radiance}}
    scene = mi.load_dict({"type": "scene", "camera": camera(mi), "card": card}, optimize=False)
    renderer = SceneRenderer(scene, "emitters")
    (name,) = (name for name, value in renderer.inputs.items() if value.ndim == 3)
    surfaces = renderer.surfaces_with_texels()

    ray, pixel = rays(scene, mi, surfaces.shape)
    si = scene.ray_intersect(ray)
    seen = np.array(si.emitter(scene).eval(si)).T
    expected = np.stack([np.bincount(pixel, channel) for channel in seen.T], -1) / 16
    found = shown_by_map(surfaces, name, texels, np.full((5, 4), 1 / 20))
    error = np.abs(found - expected).max()
    assert expected.max() > 0.5
    assert error < 1e-5, f"what the texels show differs by {error}; allowed 1e-5"
    # Texels are changed to measure the texture's filter; the scene belongs to the caller.
    assert np.array_equal(np.array(mi.traverse(scene)[name]), texels)


def test_the_map_mixes_an_environment_as_mitsuba_does(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from scenecaptum.rendering import _texels

    # At a pole a pixel shows all meridians, of which the map keeps only the nearest texels.
    monkeypatch.setattr(_texels, "MAX_BILINEAR_TEXELS", 1000)
    sky = np.random.default_rng(shifted(4)).uniform(0.5, 1.5, (6, 10, 3)).astype(np.float32)
    turned = mi.ScalarTransform4f().rotate([2 / 7, 3 / 7, 6 / 7], 70)
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {**camera(mi), "fov": 150},
            "ball": {"type": "sphere", "radius": 0.4, "emitter": {"type": "area", "radiance": 7.0}},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": turned},
        },
        optimize=False,
    )
    renderer = SceneRenderer(scene, ["sky.data"])
    texels = renderer.inputs["sky.data"].numpy()
    surfaces = renderer.surfaces_with_texels()
    ray, pixel = rays(scene, mi, surfaces.shape)
    si = scene.ray_intersect(ray)
    seen = np.where(np.array(si.is_valid()), 0, np.array(si.emitter(scene).eval(si))).T
    expected = np.stack([np.bincount(pixel, channel) for channel in seen.T], -1) / 16

    # The solid angle of each texel, summed over directions.
    height, width = 6, 12
    theta = (np.arange(20000) + 0.5) / 20000 * np.pi
    near = np.maximum(0, 1 - np.abs(theta * 5 / np.pi - np.arange(height)[:, None]))
    row = (near * np.sin(theta)).sum(1) * np.pi / 20000 / 2 / 10
    found = shown_by_map(surfaces, "sky.data", texels, np.repeat(row[:, None], width, 1).astype(np.float32))
    error = np.abs(found - expected).max()
    assert error < 1e-4, f"what the texels show differs by {error}; allowed 1e-4"
    # The copied columns at either side of the parameter count for nothing.
    assert not np.isin(surfaces.texels["sky.data"].texel % width, [0, width - 1]).any()


def test_a_fine_texture_has_few_entries_with_all_of_its_weight(mi: Any) -> None:
    texels = np.random.default_rng(shifted(5)).random((900, 1000, 3), np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    card = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": bitmap}}
    renderer = SceneRenderer({"type": "scene", "camera": camera(mi), "card": card}, "textures")
    surfaces = renderer.surfaces_with_texels()
    (shown,) = surfaces.texels.values()
    assert len(shown.entry) <= 16 * len(surfaces.pixel)
    weights = np.bincount(shown.entry, shown.weight, len(surfaces.pixel)) / texels[..., 0].size
    on_card = surfaces.object_index == surfaces.objects.index("card")
    np.testing.assert_allclose(weights, on_card, atol=1e-5)


def test_a_texture_in_an_instance_is_found_on_its_shape(mi: Any) -> None:
    texels = np.random.default_rng(shifted(6)).random((4, 4, 3), np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    scene = {
        "type": "scene",
        "camera": camera(mi),
        "group": {
            "type": "shapegroup",
            "card": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": bitmap}},
            "ball": {"type": "sphere", "center": [1.6, 0, 0], "radius": 0.5},
        },
        "placed": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": mi.ScalarTransform4f().scale(0.7),
        },
    }
    surfaces = SceneRenderer(scene, "textures").surfaces_with_texels()
    (shown,) = surfaces.texels.values()
    weights = np.bincount(shown.entry, shown.weight, len(surfaces.pixel)) / 16
    whole = surfaces.fraction[surfaces.object_index == 0] == 1
    weights = weights[surfaces.object_index == 0][whole]
    assert (weights > 0.999).sum() > 50
    assert (weights == 0).sum() > 5
    assert ((weights > 0) & (weights < 0.999)).sum() < 5


# --- Attributes of meshes --------------------------------------------------------------------------

CORNERS = np.array([[-1, -1, 0], [1.2, -1, 0.3], [1, 0.8, 0], [-0.7, 1, -0.2], [0.1, 0.2, 0.5]], np.float32)
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
AREAS = np.linalg.norm(
    np.cross(CORNERS[FACES[:, 1]] - CORNERS[FACES[:, 0]], CORNERS[FACES[:, 2]] - CORNERS[FACES[:, 0]]),
    axis=-1,
)


def painted_mesh(mi: Any, attribute: str, colours: np.ndarray, **material: Any) -> Any:
    """A tent of four faces whose ``material`` uses colours per corner or face."""
    properties = mi.Properties()
    for name, plugin in material.items():
        properties[name] = mi.load_dict(plugin)
    mesh = mi.Mesh("tent", len(CORNERS), len(FACES), props=properties)
    geometry = mi.traverse(mesh)
    geometry["vertex_positions"] = CORNERS.ravel()
    geometry["faces"] = FACES.ravel().astype(np.uint32)
    geometry.update()
    mesh.add_attribute(attribute, colours.shape[1], colours.ravel())
    return mesh


def colours_of(attribute: str, seed: int = 8) -> np.ndarray:
    count = len(CORNERS) if attribute.startswith("vertex") else len(FACES)
    return np.random.default_rng(shifted(seed)).uniform(0.2, 0.8, (count, 3)).astype(np.float32)


def share_of(attribute: str) -> np.ndarray:
    part = AREAS / AREAS.sum()
    if attribute.startswith("face"):
        return part
    return np.bincount(FACES.ravel(), np.repeat(part / 3, 3))


def painted_with(attribute: str) -> Config:
    return {"type": "mesh_attribute", "name": attribute}


@pytest.mark.parametrize("attribute", ["vertex_color", "face_color"])
def test_the_map_mixes_the_colours_of_a_mesh_as_mitsuba_does(mi: Any, attribute: str) -> None:
    colours = colours_of(attribute)
    shining = painted_mesh(
        mi, attribute, colours, emitter={"type": "area", "radiance": painted_with(attribute)}
    )
    scene = mi.load_dict({"type": "scene", "camera": camera(mi), "tent": shining}, optimize=False)
    renderer = SceneRenderer(scene, "emitters")
    name = f"tent.{attribute}"
    assert renderer.inputs[name].shape == colours.shape
    surfaces = renderer.surfaces_with_texels()
    ray, pixel = rays(scene, mi, surfaces.shape)
    si = scene.ray_intersect(ray)
    seen = np.array(si.emitter(scene).eval(si)).T
    expected = np.stack([np.bincount(pixel, channel) for channel in seen.T], -1) / 16
    found = np.zeros_like(expected)
    values = surfaces.texels[name].density(colours * share_of(attribute)[:, None], len(surfaces.pixel))
    np.add.at(found, surfaces.pixel, values * surfaces.fraction[:, None])
    error = np.abs(found - expected).max()
    assert expected.max() > 0.5
    assert error < 1e-5, f"what the mesh shows differs by {error}; allowed 1e-5"


def tent_scene(mi: Any, attribute: str, colours: np.ndarray) -> Config:
    matte = {"type": "diffuse", "reflectance": painted_with(attribute)}
    return {
        "type": "scene",
        "camera": camera(mi),
        "tent": painted_mesh(mi, attribute, colours, bsdf=matte),
        "lamp": {"type": "point", "position": [1, 2, 4], "intensity": 9.0},
        "sky": {"type": "constant", "radiance": 0.3},
    }


@pytest.mark.parametrize("attribute", ["vertex_color", "face_color"])
def test_the_gradient_of_each_corner_and_face_agrees_with_differences(mi: Any, attribute: str) -> None:
    name = f"tent.{attribute}"
    renderer = SceneRenderer(tent_scene(mi, attribute, colours_of(attribute)), name, max_depth=4)
    x = renderer.leaves()
    renderer(x, seed=shifted(2), spp=16).square().mean().backward()
    expected = torch.zeros(x[name].shape)
    for place in np.ndindex(*expected.shape):
        step = torch.zeros_like(expected)
        step[place] = 0.02
        up, down = (
            renderer({name: renderer.inputs[name] + sign * step}, seed=shifted(2), spp=16)
            .double()
            .square()
            .mean()
            for sign in (1, -1)
        )
        expected[place] = (up - down) / 0.04
    torch.testing.assert_close(x[name].grad, expected, rtol=1e-3, atol=1e-3 * expected.abs().max().item())


def test_a_mesh_of_one_colour_ranks_like_that_colour(mi: Any) -> None:
    colour = [0.5, 0.4, 0.3]
    scene = tent_scene(mi, "vertex_color", np.tile(np.float32(colour), (5, 1)))
    painted = SceneRenderer(scene, "reflectance", spp=16)
    plain = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
    scene["tent"] = painted_mesh(mi, "vertex_color", colours_of("vertex_color"), bsdf=plain)
    uniform = SceneRenderer(scene, "reflectance", spp=16)
    (many,), (one,) = (
        VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted(4)).ranking(1)
        for renderer in (painted, uniform)
    )
    assert len(many.total) == 3
    np.testing.assert_allclose(many.total, one.total, rtol=1e-4)
    np.testing.assert_allclose(many.total_error, one.total_error, rtol=1e-2)


@pytest.mark.parametrize("attribute", ["vertex_color", "face_color"])
def test_a_uniform_gradient_of_a_mesh_is_painted_uniformly(mi: Any, attribute: str) -> None:
    scene = tent_scene(mi, attribute, colours_of(attribute))
    scene["mirror"] = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([1.7, 0, 0.5]).rotate([0, 1, 0], -60),
        "bsdf": {"type": "conductor", "material": "none"},
    }
    renderer = SceneRenderer(scene, "reflectance", spp=1)
    name = f"tent.{attribute}"
    even = torch.from_numpy(share_of(attribute)[:, None] * np.float32([1.0, 0.5, 0.2])).float()
    for surfaces in (renderer.surfaces_with_texels(), renderer.see_through()):
        result = SceneAttribution({name: even}, standard_error=None, metric_value=1.0, surfaces=surfaces)
        texel_by_texel = heatmap(result, texels=True, norm="linear")
        torch.testing.assert_close(texel_by_texel, heatmap(result, norm="linear"), rtol=0, atol=1e-5)
        assert (texel_by_texel > 0.5).sum() > 30
    mirrored = renderer.see_through().shown([name]) - renderer.surfaces.shown([name])
    assert (mirrored > 0.9).sum() > 5, "the mirror shows the tent"


# --- Gradients of texels ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def floor_gradient(room: SceneRenderer) -> torch.Tensor:
    """The gradient of the mean of the image with seed 7."""
    x = room.leaves()
    room(x, seed=shifted(7)).mean().backward()
    gradient: torch.Tensor = x[FLOOR].grad
    return gradient


def test_texel_gradients_agree_with_differences_block_by_block(
    room: SceneRenderer, floor_gradient: torch.Tensor
) -> None:
    value, step, side = room.inputs[FLOOR], 0.02, 16
    measured, expected = [], []
    for row in range(0, 64, side):
        for column in range(0, 64, side):
            shift = torch.zeros_like(value)
            shift[row : row + side, column : column + side] = step
            up, down = (
                room({FLOOR: value + sign * shift}, seed=shifted(7)).double().mean() for sign in (1, -1)
            )
            expected.append(((up - down) / (2 * step)).item())
            measured.append(floor_gradient[row : row + side, column : column + side].double().sum().item())
    error = np.abs(np.array(measured) - expected)
    allowed = 1e-4 * np.max(np.abs(expected))
    # The rug hides two blocks; the others are tested.
    assert (np.abs(expected) > 20 * allowed).sum() == 14, expected
    assert error.max() < allowed, f"blocks differ by {error.max():.3g}; allowed {allowed:.3g}"


def test_texel_gradients_sum_to_that_of_a_plain_colour(mi: Any) -> None:
    colour = [0.4, 0.3, 0.2]
    floors = {
        FLOOR: {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.full((64, 64, 3), colour, np.float32)),
            "raw": True,
            "format": "variant",
        },
        "floor.reflectance.value": {"type": "rgb", "value": colour},
    }
    gradients = {}
    for name, reflectance in floors.items():
        scene = {**office(), "floor": {"type": "diffuse", "reflectance": reflectance}}
        renderer = SceneRenderer(scene, name, resolution=(32, 18), spp=16, max_depth=3)
        x = renderer.leaves()
        (renderer(x, seed=shifted(3)) ** 2).mean().backward()
        gradients[name] = x[name].grad
    torch.testing.assert_close(
        gradients[FLOOR].sum((0, 1)), gradients["floor.reflectance.value"], rtol=1e-4, atol=0
    )


def painted_floor(room: SceneRenderer, gradient: torch.Tensor) -> torch.Tensor:
    result = SceneAttribution(
        {FLOOR: gradient}, standard_error=None, metric_value=1.0, surfaces=room.surfaces_with_texels()
    )
    return heatmap(result, texels=True, norm="linear")


def test_a_block_of_texels_is_painted_where_it_changes_the_image(room: SceneRenderer) -> None:
    block = torch.zeros_like(room.inputs[FLOOR])
    block[36:60, :16] = 1.0
    change = room.derivative_image(FLOOR, block, seed=shifted(5), spp=64).abs().sum(-1)
    painted = painted_floor(room, block)
    inside, outside = painted > 0.95 * painted.max(), painted == 0
    assert inside.sum() > 20
    low, high = change[inside].min(), change[outside].max()
    assert low > high, f"least change inside the block {low:.3g}, most outside {high:.3g}"


def test_a_uniform_gradient_of_texels_is_painted_like_a_plain_colour(room: SceneRenderer) -> None:
    even = torch.full((64, 64, 3), 0.25)
    result = SceneAttribution(
        {FLOOR: even}, standard_error=None, metric_value=1.0, surfaces=room.surfaces_with_texels()
    )
    painted, plain = (heatmap(result, texels=texels, norm="linear") for texels in (True, False))
    torch.testing.assert_close(painted, plain, rtol=0, atol=1e-5)


def test_an_attribution_to_a_texture_is_saved_with_its_texels(room: SceneRenderer, tmp_path: Any) -> None:
    result = VanillaSceneGradient(room, metrics.MeanLuminance()).attribute(replicates=1, spp=4)
    painted = result.heatmap(texels=True)
    assert painted.unique().numel() > 100
    result.save(tmp_path / "floor.npz")
    assert torch.equal(SceneAttribution.load(tmp_path / "floor.npz").heatmap(texels=True), painted)


def test_texels_are_traced_for_textures_only(cornell: SceneRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    from scenecaptum.rendering import _texels

    monkeypatch.setattr(_texels.Lookup, "shown", lambda *_: pytest.fail("no input is a texture"))
    result = VanillaSceneGradient(cornell, metrics.MeanLuminance()).attribute(replicates=1, spp=1)
    assert result.surfaces is cornell.surfaces


# --- Objects under pixels ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bare_office(mi: Any) -> Any:
    config = office()
    config["sensor"]["film"].update(width=96, height=54)
    return mi.load_dict(config, optimize=False)


def names_met(mi: Any, scene: Any, hit: Any) -> np.ndarray:
    import drjit as dr

    dr.eval(hit)  # once, not for every shape
    names = np.full(len(np.array(hit.t)), "background", dtype=object)
    for shape in scene.shapes():
        names[np.array(hit.shape == mi.ShapePtr(shape))] = shape.id()
    return names


def centre_rays(mi: Any, scene: Any) -> Any:
    row, column = np.mgrid[0:54, 0:96].reshape(2, -1).astype(np.float32)
    place = mi.Point2f((column + 0.5) / 96, (row + 0.5) / 54)
    return scene.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))[0]


def only_object(surfaces: SurfaceMap) -> np.ndarray:
    """The name of the object that covers the whole pixel, None at edges."""
    names = np.full(surfaces.shape[0] * surfaces.shape[1], None, dtype=object)
    whole = surfaces.fraction > 1 - 1e-6
    names[surfaces.pixel[whole]] = np.array(surfaces.objects, dtype=object)[surfaces.object_index[whole]]
    return names


@pytest.fixture(scope="module")
def wide_office(mi: Any) -> SceneRenderer:
    return SceneRenderer("office", "reflectance", resolution=(96, 54), spp=1)


def test_the_object_of_each_pixel_of_the_office_is_what_a_ray_hits(
    mi: Any, bare_office: Any, wide_office: SceneRenderer
) -> None:
    met = names_met(mi, bare_office, bare_office.ray_intersect(centre_rays(mi, bare_office)))
    surfaces = wide_office.surfaces
    found = only_object(surfaces)
    clear = found != None  # noqa: E711 -- elementwise
    assert clear.mean() > 0.5
    assert (found[clear] == met[clear]).all()
    # At an edge the object at the centre covers a part of the pixel, except for slivers between the rays.
    pairs = set(zip(surfaces.pixel.tolist(), np.array(surfaces.objects)[surfaces.object_index], strict=True))
    lost = sum((pixel, met[pixel]) not in pairs for pixel in np.flatnonzero(~clear).tolist())
    assert lost <= 0.02 * (~clear).sum(), f"{lost} of {(~clear).sum()} pixels miss the object at their centre"


def test_fractions_sum_to_one_on_every_pixel(wide_office: SceneRenderer) -> None:
    for surfaces in (wide_office.surfaces, wide_office.see_through()):
        total = np.bincount(surfaces.pixel, surfaces.fraction, 96 * 54)
        assert np.abs(total - 1).max() < 1e-6
        assert (surfaces.fraction < 1).any()


def test_surfaces_do_not_depend_on_earlier_renders(mi: Any) -> None:
    # A sensor's film gets its size when it renders.
    first, second = (SceneRenderer("office", "reflectance", resolution=(20, 20), spp=1) for _ in range(2))
    second()
    assert np.array_equal(first.surfaces.pixel, second.surfaces.pixel)
    assert np.array_equal(first.surfaces.fraction, second.surfaces.fraction)


# --- Mirrors and glass -------------------------------------------------------------------------------


def test_a_mirror_shows_what_a_reflected_ray_hits(
    mi: Any, bare_office: Any, wide_office: SceneRenderer
) -> None:
    si = bare_office.ray_intersect(centre_rays(mi, bare_office))
    seen = names_met(mi, bare_office, si)
    reflected = bare_office.ray_intersect(si.spawn_ray(si.to_world(mi.reflect(si.wi))))
    expected = np.where(seen == "mirror_glass", names_met(mi, bare_office, reflected), seen)
    found = only_object(wide_office.see_through())
    compared = (seen == "mirror_glass") & (found != None)  # noqa: E711 -- elementwise
    assert compared.sum() > 15
    assert len(set(expected[compared])) > 1
    assert (found[compared] == expected[compared]).all()
    elsewhere = (seen != "mirror_glass") & (found != None)  # noqa: E711 -- elementwise
    assert (found[elsewhere] == seen[elsewhere]).all()


def behind(mi: Any, bsdf: Config, ball: Config | None = None, **pane: Config) -> SurfaceMap:
    """The surfaces seen through a pane before a wall, with a screen behind the camera."""
    transform = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "camera": {
            "type": "orthographic",
            "to_world": transform().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 12, "height": 12},
        },
        "pane": {"type": "rectangle", "to_world": transform().scale(3), "bsdf": bsdf, **pane},
        "wall": {"type": "rectangle", "to_world": transform().translate([0, 0, -1]).scale(9)},
        "screen": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(9),
        },
    }
    if ball is not None:
        scene["ball"] = ball
    return SceneRenderer(scene, "all").see_through()


def shares(surfaces: SurfaceMap) -> dict[str, np.ndarray]:
    found = {}
    for index, name in enumerate(surfaces.objects):
        one = surfaces.object_index == index
        if one.any():
            found[name] = np.bincount(surfaces.pixel[one], surfaces.fraction[one], 144)
    return found


@pytest.mark.parametrize(
    ("bsdf", "reflected"),
    [
        ({"type": "thindielectric", "int_ior": 1.5}, 2 * 0.04 / 1.04),
        ({"type": "dielectric", "int_ior": 3.0}, 0.25),
        ({"type": "conductor", "material": "none"}, 1.0),
        ({"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}, 0.0),
        ({"type": "twosided", "bsdf": {"type": "conductor"}}, 1.0),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_a_pane_splits_a_pixel_as_it_splits_light(mi: Any, bsdf: Config, reflected: float) -> None:
    found = shares(behind(mi, bsdf))
    assert found.keys() <= {"wall", "screen"}
    mirrored = found.get("screen", np.zeros(144))
    # Each pixel has one ray in each sixteenth: chance decides about one sixteenth only.
    allowed = 4 * max(mirrored.std(), 1e-6) / 12
    assert abs(mirrored.mean() - reflected) <= allowed, (
        f"{mirrored.mean()} is reflected, expected {reflected}"
    )
    np.testing.assert_allclose(mirrored + found.get("wall", 0), 1)


@pytest.mark.parametrize("kind", ["diffuse", "roughdielectric", "plastic"])
def test_a_scattering_surface_ends_the_path(mi: Any, kind: str) -> None:
    assert shares(behind(mi, {"type": kind})).keys() == {"pane"}


def test_a_light_ends_the_path_even_if_it_is_a_mirror(mi: Any) -> None:
    shining = {"emitter": {"type": "area", "radiance": 1.0}}
    assert shares(behind(mi, {"type": "conductor"}, **shining)).keys() == {"pane"}


def test_the_path_enters_and_leaves_glass(mi: Any) -> None:
    ball = {"type": "sphere", "radius": 1.0, "center": [0, 0, 1], "bsdf": {"type": "dielectric"}}
    found = shares(behind(mi, {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}, ball=ball))
    assert found.keys() == {"wall", "screen", "background"}
    # At the centre, either side of the ball reflects 4 %.
    centre = found["wall"].reshape(12, 12)[5:7, 5:7].mean()
    assert 0.85 < centre < 0.97, f"the wall has {centre} of the pixels behind the middle of the ball"


def test_a_heatmap_can_follow_mirrors(wide_office: SceneRenderer) -> None:
    sky = "window_pane.reflectance.value"
    through = wide_office.see_through()
    result = SceneAttribution(
        {sky: torch.ones(3)}, standard_error=None, metric_value=1.0, surfaces=wide_office.surfaces
    )
    in_mirror = torch.from_numpy(wide_office.surfaces.shown(["mirror.specular_reflectance.value"])) == 1
    assert not result.heatmap()[in_mirror].any()
    assert result.heatmap(surfaces=through)[in_mirror].max() == 1


# --- Derivative images -----------------------------------------------------------------------------


def test_a_derivative_image_is_the_difference_of_two_renders(room: SceneRenderer) -> None:
    step, value = 0.02, room.inputs[FLOOR]
    direction = torch.rand(value.shape, generator=torch.Generator().manual_seed(shifted()))
    derivative = room.derivative_image(FLOOR, direction, seed=shifted(2), spp=8)
    up, down = (
        room({FLOOR: value + sign * step * direction}, seed=shifted(2), spp=8).double() for sign in (1, -1)
    )
    expected = (up - down) / (2 * step)
    assert derivative.shape == (27, 48, 3)
    error = (derivative - expected).norm() / expected.norm()
    assert error < 1e-3, f"they differ by {error:.3g} of their norm; allowed 1e-3"


def test_a_derivative_image_moves_all_channels_by_default(cornell: SceneRenderer) -> None:
    name = "left_wall.reflectance.value"
    whole = cornell.derivative_image(name, seed=shifted(1))
    parts = [cornell.derivative_image(name, one, seed=shifted(1)) for one in torch.eye(3)]
    torch.testing.assert_close(whole, sum(parts), rtol=1e-4, atol=1e-5)
    # The channels of an image are those of a colour.
    assert parts[0][..., 0].any()
    assert not parts[0][..., 1:].any()


def test_a_derivative_image_of_an_invalid_parameter_is_refused(cornell: SceneRenderer) -> None:
    from scenecaptum import SceneCaptumError

    with pytest.raises(SceneCaptumError, match="Did you mean"):
        cornell.derivative_image("left_wal.reflectance.value")
    with pytest.raises(SceneCaptumError, match=r"direction has shape \(2,\)"):
        cornell.derivative_image("left_wall.reflectance.value", torch.ones(2))
