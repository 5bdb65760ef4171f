"""Our plastics against Mitsuba's: equal images, and derivatives that agree with finite differences."""

from __future__ import annotations

import gc
import math
import weakref
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from rooms import room
from seeds import seeds, shifted
from torch.autograd import forward_ad

from scenecaptum import SceneCaptumError, SceneRenderer
from scenecaptum.scene import load_scene

Config = dict[str, Any]

INCIDENT, OUTGOING = 24, 512
KINK = 1.0  # of the index: below it total reflection is outside, above it inside


def speckled() -> Config:
    from scenecaptum.backend import activate

    texels = np.random.default_rng(shifted(3)).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    return {
        "type": "bitmap",
        "bitmap": activate().Bitmap(texels),
        "raw": True,
        "format": "variant",
        "filter_type": "nearest",
    }


MATERIALS: dict[str, Config] = {
    "plastic": {"type": "plastic"},
    "nonlinear": {"type": "plastic", "nonlinear": True, "specular_reflectance": 0.4, "int_ior": "water"},
    "black": {"type": "plastic", "diffuse_reflectance": 0.0, "int_ior": 2.4, "ext_ior": 1.0},
    "inverted": {"type": "plastic", "int_ior": 1.0, "ext_ior": 1.33},
    "rough": {"type": "roughplastic", "nonlinear": True},
    "ggx": {"type": "roughplastic", "distribution": "ggx", "alpha": 0.3, "specular_reflectance": 0.4},
    "all normals": {"type": "roughplastic", "alpha": 0.3, "sample_visible": False, "int_ior": 2.4},
    "nearly smooth": {"type": "roughplastic", "alpha": 0.001, "diffuse_reflectance": 1.0},
    "rough inverted": {"type": "roughplastic", "alpha": 1.0, "int_ior": 1.0, "ext_ior": 1.33},
}


@pytest.fixture(scope="module")
def plastics(mi: Any) -> Any:
    """Our plugins, which are registered by loading a scene that contains plastics."""
    from scenecaptum.scene import _plastics

    return _plastics


def ours(mi: Any, config: Config) -> Any:
    return mi.load_dict({**config, "type": f"scenecaptum_{config['type']}"})


def stage(mi: Any, material: Config) -> Config:
    """A ball of a material, with paths of unlimited length."""
    return room(mi, material, rr_depth=100)


def nested(how: str, material: Config) -> Config:
    return {
        "plain": material,
        "twosided": {"type": "twosided", "nested": material},
        "mask": {"type": "mask", "opacity": 0.7, "nested": material},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.3, "one": material, "two": {"type": "diffuse"}},
        "bumpmap": {"type": "bumpmap", "relief": speckled(), "nested": material},
    }[how]


@pytest.mark.parametrize("component", [None, 0, 1], ids=["both lobes", "specular", "diffuse"])
@pytest.mark.parametrize("config", MATERIALS.values(), ids=MATERIALS)
def test_lobes_are_those_of_mitsuba(mi: Any, plastics: Any, config: Config, component: int | None) -> None:
    import drjit as dr

    rng = np.random.default_rng(shifted(1))
    size = 20_000

    def directions() -> Any:
        vectors = rng.normal(size=(3, size))
        return mi.Vector3f(vectors / np.linalg.norm(vectors, axis=0))

    def compare(found: Any, expected: Any, where: Any) -> None:
        pick = np.array(where)
        one, two = (
            np.broadcast_to(value, (*np.shape(value)[:-1], size))[..., pick] for value in (found, expected)
        )
        # Mitsuba sums its tables in single precision, and densities near 0 are differences of such sums.
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-4 * np.abs(two).max(initial=0))

    theirs, mine = mi.load_dict(config), ours(mi, config)
    context = mi.BSDFContext()
    if component is not None:
        context.component = component
    si = dr.zeros(mi.SurfaceInteraction3f, size)
    si.wi, wo = directions(), directions()
    above = (si.wi.z > 0) & (wo.z > 0)
    for found, expected in zip(
        (mine.eval(context, si, wo), mine.pdf(context, si, wo), *mine.eval_pdf(context, si, wo)),
        (theirs.eval(context, si, wo), theirs.pdf(context, si, wo), *theirs.eval_pdf(context, si, wo)),
        strict=True,
    ):
        compare(found, expected, above)
        assert dr.all(dr.select(above, 0, found) == 0, axis=None)

    numbers = mi.Float(rng.random(size)), mi.Point2f(rng.random((2, size)))
    (found, weight), (expected, their_weight) = (
        bsdf.sample(context, si, *numbers) for bsdf in (mine, theirs)
    )
    compare(weight, their_weight, si.wi.z > 0)
    taken = (si.wi.z > 0) & (dr.max(their_weight) > 0)
    for name in ("wo", "pdf", "eta", "sampled_type", "sampled_component"):
        compare(getattr(found, name), getattr(expected, name), taken)


@pytest.mark.parametrize("name", ["plastic", "ggx"])
def test_images_are_those_of_mitsuba(mi: Any, name: str) -> None:
    textured = {**MATERIALS[name], "diffuse_reflectance": speckled(), "specular_reflectance": speckled()}
    scene = stage(mi, textured)
    # The image of a blend with a perfectly specular lobe is not Mitsuba's: see test_blend.py.
    blends = ("blendbsdf",) if name == "ggx" else ()
    for place, how in enumerate(("plain", "twosided", "mask", "bumpmap", *blends)):
        center = [place - 2, -1.5, -0.7]
        scene[how] = {"type": "sphere", "center": center, "radius": 0.4, "bsdf": nested(how, textured)}
    theirs, mine = (
        np.array(mi.render(loaded, spp=64, seed=shifted(1)))
        for loaded in (mi.load_dict(scene), load_scene(scene))
    )
    np.testing.assert_allclose(mine, theirs, rtol=1e-5)


@pytest.mark.parametrize("config", MATERIALS.values(), ids=MATERIALS)
def test_parameters_have_mitsubas_names(mi: Any, plastics: Any, config: Config) -> None:
    import drjit as dr

    theirs, mine = mi.load_dict(config), ours(mi, config)
    assert list(mi.traverse(mine).keys()) == list(mi.traverse(theirs).keys())
    assert isinstance(mine, plastics.Plastic)
    assert mine.class_name() == theirs.class_name()
    assert mine.component_count() == theirs.component_count()
    assert [mine.flags(i) for i in (0, 1)] == [theirs.flags(i) for i in (0, 1)]
    si = dr.zeros(mi.SurfaceInteraction3f)
    assert dr.all(mine.eval_diffuse_reflectance(si) == theirs.eval_diffuse_reflectance(si), axis=None)
    for name in ("diffuse_reflectance", "specular_reflectance", "no such thing"):
        assert dr.all(mine.has_attribute(name) == theirs.has_attribute(name))
        assert dr.all(mine.eval_attribute(name, si) == theirs.eval_attribute(name, si), axis=None)


@pytest.mark.parametrize("distribution", ["Beckmann", "GGX"])
def test_tables_of_a_nearly_smooth_surface_are_those_of_fresnel(
    mi: Any, plastics: Any, distribution: str
) -> None:
    def fresnel(eta: float) -> Any:
        return np.array(mi.fresnel(mi.Float(plastics.COSINES), eta)[0])

    kind = getattr(mi.MicrofacetType, distribution)
    let_in = plastics.external_transmittance(kind, 1e-4, 1.5)
    np.testing.assert_allclose(let_in[2:], 1 - fresnel(1.5)[2:], atol=1e-3)
    kept = plastics.internal_reflectance(kind, 1e-4, 1.5)
    assert kept == pytest.approx(np.mean(2 * plastics.COSINES * fresnel(1 / 1.5)), abs=1e-3)


def reflected(mi: Any, bsdf: Any) -> Any:
    """Return the reflected part of light from several directions, by a deterministic quadrature."""
    import drjit as dr

    cosine = np.repeat(np.linspace(0.05, 1, INCIDENT), OUTGOING)
    share = np.tile((np.arange(OUTGOING) + 0.5) / OUTGOING, INCIDENT)
    turn = np.tile(2 * math.pi * (np.arange(OUTGOING) * 0.618034 % 1), INCIDENT)
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosine))
    si.wi = mi.Vector3f(np.stack((np.sqrt(1 - cosine**2), 0 * cosine, cosine)))
    flat = np.sqrt(1 - share)
    wo = np.stack((flat * np.cos(turn), flat * np.sin(turn), np.sqrt(share)))
    value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo)).x
    return dr.block_sum(value * mi.Float(math.pi / wo[2]), OUTGOING) / OUTGOING


def assert_slope_is_mitsubas_difference(mi: Any, config: Config, name: str, step: float) -> None:
    import drjit as dr

    mine = mi.traverse(bsdf := ours(mi, config))
    leaf = mi.Float(mine[name])
    dr.enable_grad(leaf)
    mine[name] = leaf
    mine.update()
    value = reflected(mi, bsdf)
    dr.forward(leaf)
    slope = np.array(dr.grad(value), dtype=np.float64)

    theirs = mi.traverse(bsdf := mi.load_dict(config))
    kind = type(theirs[name])

    def at(moved: np.float32) -> Any:
        theirs[name] = kind(float(moved))
        theirs.update()
        return np.array(reflected(mi, bsdf), dtype=np.float64)

    high, low = np.float32(leaf[0] + step), np.float32(leaf[0] - step)
    difference = (at(high) - at(low)) / (float(high) - float(low))
    apart = np.linalg.norm(slope - difference) / np.linalg.norm(difference)
    # Over 5 % of the roughness, the truncation error is half a per cent.
    assert apart < 0.015, f"{name}: {apart:.2%} of the difference quotient apart"


# Each index and each roughness once, with the smoothest surface at both ends of the indices.
QUICK = {(0.05, 1.001), (0.05, 2.4), (0.1, 1.5), (0.3, 1.33), (1.0, 1.1)}


@pytest.mark.parametrize(
    ("alpha", "eta"),
    [
        pytest.param(alpha, eta, marks=() if (alpha, eta) in QUICK else pytest.mark.long)
        for alpha in (0.05, 0.1, 0.3, 1.0)
        for eta in (1.001, 1.1, 1.33, 1.5, 2.4)
    ],
)
def test_derivatives_of_rough_plastic(mi: Any, plastics: Any, alpha: float, eta: float) -> None:
    for distribution in ("beckmann", "ggx"):
        config = {"type": "roughplastic", "alpha": alpha, "distribution": distribution}
        config |= {"int_ior": eta, "ext_ior": 1.0}
        assert_slope_is_mitsubas_difference(mi, config, "alpha", 0.05 * alpha)
        assert_slope_is_mitsubas_difference(mi, config, "eta", 0.1 * min(eta - KINK, 0.2))


@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("reflectance", [0.0, 0.5, 1.0])
def test_derivatives_by_reflectance(mi: Any, plastics: Any, reflectance: float, nonlinear: bool) -> None:
    shared = {"diffuse_reflectance": reflectance, "nonlinear": nonlinear, "ext_ior": 1.0}
    rough = {"type": "roughplastic", "alpha": 0.2, "int_ior": 1.5, **shared}
    assert_slope_is_mitsubas_difference(mi, rough, "alpha", 0.01)
    assert_slope_is_mitsubas_difference(mi, rough, "eta", 0.02)
    if reflectance:  # all that is visible from elsewhere in a mirror
        for eta in (1.001, 1.1, 1.33, 1.5, 2.4):
            smooth = {"type": "plastic", "int_ior": eta, **shared}
            assert_slope_is_mitsubas_difference(mi, smooth, "eta", 0.1 * min(eta - KINK, 0.2))


def gradient(renderer: SceneRenderer, values: dict[str, torch.Tensor], seed: int) -> dict[str, float]:
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    renderer(leaves, seed=seed).mean().backward()
    return {name: leaf.grad.sum().item() for name, leaf in leaves.items()}


@pytest.mark.parametrize(
    ("how", "material", "parameter", "step"),
    [
        ("twosided", {"type": "roughplastic", "distribution": "ggx"}, "brdf_0.alpha", 0.005),
        pytest.param(
            "plain",
            {"type": "roughplastic", "alpha": 1.0, "nonlinear": True},
            "eta",
            0.02,
            marks=pytest.mark.long,
        ),
        pytest.param(
            "mask", {"type": "plastic", "int_ior": 2.4}, "nested_bsdf.eta", 0.02, marks=pytest.mark.long
        ),
    ],
)
def test_derivatives_of_images_agree_with_differences_of_mitsubas(
    mi: Any, how: str, material: Config, parameter: str, step: float
) -> None:
    scene, name, spp, runs = stage(mi, nested(how, material)), f"ball.bsdf.{parameter}", 1024, 6
    renderer = SceneRenderer(scene, "ball.*", spp=spp)
    value = renderer.inputs[name]
    found = torch.tensor([gradient(renderer, {name: value}, seed)[name] for seed in seeds(runs)])

    theirs = mi.traverse(stock := mi.load_dict(scene, optimize=False))
    kind = type(theirs[name])

    def rendered(moved: float, seed: int) -> float:
        theirs[name] = kind(moved)
        theirs.update()
        return float(mi.render(stock, spp=spp, seed=seed).torch().mean())

    differences = torch.tensor(
        [
            (rendered(value.item() + step, seed) - rendered(value.item() - step, seed)) / (2 * step)
            for seed in seeds(100, 100 + runs)
        ]
    )
    (ours, our_error), (difference, error) = (
        (x.mean().item(), x.std().item() / math.sqrt(runs)) for x in (found, differences)
    )
    assert max(our_error, error) < 0.1 * abs(difference), "the case is lost in its noise and shows nothing"
    assert abs(ours - difference) < allowed(2 * runs - 1) * math.hypot(our_error, error), (
        f"{ours=} {difference=} {error=}"
    )


@pytest.mark.long
def test_tables_follow_the_parameters(mi: Any) -> None:
    name = {"alpha": "ball.bsdf.alpha", "eta": "ball.bsdf.eta"}
    rough = {"type": "roughplastic", "distribution": "ggx"}
    renderer = SceneRenderer(stage(mi, rough), "ball.*", spp=16)
    for alpha, eta in ((0.4, 1.5), (0.25, 1.2), (0.4, 1.5)):
        values = {name["alpha"]: torch.tensor(alpha), name["eta"]: torch.tensor(eta)}
        fresh = SceneRenderer(
            stage(mi, {**rough, "alpha": alpha, "int_ior": eta, "ext_ior": 1.0}), "ball.*", spp=16
        )
        torch.testing.assert_close(
            renderer(values, seed=shifted(2)), fresh(seed=shifted(2)), rtol=1e-5, atol=0
        )
        slopes = gradient(renderer, values, seed=shifted(2))
        assert slopes == pytest.approx(gradient(fresh, values, seed=shifted(2)), rel=1e-4)
        with forward_ad.dual_level():
            for moving, value in values.items():
                dual = forward_ad.make_dual(value, torch.ones(()))
                image = renderer({**values, moving: dual}, seed=shifted(2))
                tangent = forward_ad.unpack_dual(image).tangent
                assert tangent.mean().item() == pytest.approx(slopes[moving], rel=1e-4)


def test_scenes_with_plastics_are_freed(mi: Any) -> None:
    for kind in ("plastic", "roughplastic"):
        renderer = SceneRenderer(stage(mi, {"type": kind}), "ball.*", spp=1)
        gradient(renderer, renderer.inputs, seed=shifted())
        material = weakref.ref(renderer._graph.scene.shapes()[0].bsdf())
        assert material() is not None
        del renderer
        gc.collect()
        assert material() is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gloss": 1.0}, 'type "roughplastic": - float "gloss": 1'),
        ({"int_ior": "treacle"}, 'Unable to find an IOR value for "treacle"'),
        ({"int_ior": -1.0}, 'plugin of type "roughplastic": The interior and exterior indices'),
        ({"int_ior": 1.5, "ext_ior": 1.5}, 'type "roughplastic": The interior and exterior indices'),
        ({"distribution": "phong"}, 'an invalid distribution "phong", must be "beckmann" or "ggx"'),
        ({"alpha_u": 0.1, "alpha_v": 0.2}, "no anisotropic microfacet distributions"),
        ({"alpha": "low"}, 'The property "alpha" has the wrong type (expected float, got string)'),
        ({"nonlinear": 1.0}, 'The property "nonlinear" has the wrong type (expected boolean)'),
    ],
)
def test_errors_use_mitsubas_words(mi: Any, changes: Config, message: str) -> None:
    with pytest.raises(SceneCaptumError) as caught:
        load_scene(stage(mi, {"type": "roughplastic", **changes}))
    text = str(caught.value)
    assert message in text
    assert "Traceback" not in text
    assert "scenecaptum_" not in text
