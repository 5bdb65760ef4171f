"""Materials that a user registers: their derivatives are right, or marked."""

from __future__ import annotations

import pytest
from seeds import shifted

from scenecaptum import SceneCaptumError, SceneRenderer, activate


@pytest.fixture(scope="module")
def tinted() -> str:
    """Register smooth tinted glass of Mitsuba's tutorial, with its index of refraction as a parameter."""
    mi = activate()
    import drjit as dr

    class TintedGlass(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            self.tint = mi.Color3f(props.get("tint", 0.8))
            self.eta = mi.Float(props.get("eta", 1.33))
            reflection = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            transmission = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [reflection, transmission]
            self.m_flags = reflection | transmission

        def sample(self, ctx, si, sample1, sample2, active=True):
            cos_i = mi.Frame3f.cos_theta(si.wi)
            reflectance, cos_t, eta_it, eta_ti = mi.fresnel(cos_i, self.eta)
            reflects = (sample1 <= reflectance) & active
            found = mi.BSDFSample3f()
            found.wo = dr.select(reflects, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
            found.pdf = dr.select(reflects, reflectance, 1 - reflectance)
            found.eta = dr.select(reflects, 1, eta_it)
            found.sampled_component = dr.select(reflects, mi.UInt32(0), mi.UInt32(1))
            found.sampled_type = dr.select(
                reflects, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
            )
            return found, dr.select(reflects, mi.Color3f(1), self.tint * dr.square(eta_ti)) & active

        def eval(self, ctx, si, wo, active=True):
            return mi.Color3f(0)

        def pdf(self, ctx, si, wo, active=True):
            return mi.Float(0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return mi.Color3f(0), mi.Float(0)

        def traverse(self, callback) -> None:
            callback.put("tint", self.tint, mi.ParamFlags.Differentiable)
            callback.put("eta", self.eta, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys) -> None:
            dr.make_opaque(self.tint, self.eta)

    mi.register_bsdf("tinted_glass", TintedGlass)
    return "tinted_glass"


def test_a_specular_material_of_a_user_is_differentiated_by_differences(tinted: str) -> None:
    scene = {
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": {"type": tinted, "tint": 0.6}},
        "sky": {"type": "envmap", "bitmap": _stripes(), "to_world": activate().ScalarTransform4f()},
        "camera": {
            "type": "perspective",
            "fov": 30,
            "to_world": activate().ScalarTransform4f().look_at([0, -5, 1], [0, 0, 0], [0, 0, 1]),
        },
    }
    renderer = SceneRenderer(scene, inputs="ball.*", resolution=(16, 16), spp=256, max_depth=5)
    reasons = dict(renderer.plan.differences)
    assert set(reasons) == set(renderer.inputs)
    assert all("the choice of a lobe of your specular plugin" in reason for reason in reasons.values())
    leaves, step = renderer.leaves(), 0.02
    renderer(leaves, seed=shifted(1)).mean().backward()
    for name, leaf in leaves.items():
        higher, lower = (
            renderer({name: renderer.inputs[name] + sign * step}, seed=shifted(1)).mean() for sign in (1, -1)
        )
        difference = (higher - lower).item() / (2 * step)
        assert abs(difference) > 0.005
        assert leaf.grad.sum().item() == pytest.approx(difference, rel=0.1), name


def test_a_colour_that_drjit_does_not_track_is_refused_with_the_line_that_makes_it_an_input() -> None:
    mi = activate()

    class Painted(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            self.tint = props["tint"]  # as in Mitsuba's tutorial
            self.coats = mi.UInt32(3)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def sample(self, ctx, si, sample1, sample2, active=True):
            found = mi.BSDFSample3f()
            found.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            found.pdf = mi.warp.square_to_cosine_hemisphere_pdf(found.wo)
            found.eta = mi.Float(1)
            found.sampled_component = mi.UInt32(0)
            found.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            return found, mi.Color3f(self.tint)

        def eval(self, ctx, si, wo, active=True):
            return mi.Color3f(self.tint) * self.pdf(ctx, si, wo)

        def pdf(self, ctx, si, wo, active=True):
            return mi.warp.square_to_cosine_hemisphere_pdf(wo)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo), self.pdf(ctx, si, wo)

        def traverse(self, callback) -> None:
            callback.put("tint", self.tint, mi.ParamFlags.Differentiable)
            callback.put("coats", self.coats, mi.ParamFlags.Differentiable)

    class Tracked(Painted):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.tint = mi.Color3f(props["tint"])

    mi.register_bsdf("painted", Painted)
    mi.register_bsdf("painted_tracked", Tracked)

    def renderer(material: str, name: str, tint: object) -> SceneRenderer:
        scene = {
            "type": "scene",
            "ball": {"type": "sphere", "bsdf": {"type": material, "tint": tint}},
            "sky": {"type": "constant"},
            "camera": {"type": "perspective", "to_world": mi.ScalarTransform4f().translate([0, 0, -5])},
        }
        return SceneRenderer(scene, name, resolution=(8, 8), spp=64, max_depth=3)

    line = r'self\.tint = mi\.Color3f\(props\["tint"\]\)'
    for tint, kind in (([0.2, 0.3, 0.4], "an Array3f64"), (mi.ScalarColor3d(0.2), "a ScalarColor3d")):
        with pytest.raises(
            SceneCaptumError, match=f"it is {kind}, whose numbers Dr.Jit does not track.*{line}"
        ):
            renderer("painted", "ball.bsdf.tint", tint)
    with pytest.raises(SceneCaptumError, match="it is a UInt, not a continuous quantity"):
        renderer("painted", "ball.bsdf.coats", [0.2, 0.3, 0.4])

    tracked, step = renderer("painted_tracked", "ball.bsdf.tint", [0.2, 0.3, 0.4]), 0.1
    leaves = tracked.leaves()
    tracked(leaves, seed=shifted(1)).mean().backward()
    for name, leaf in leaves.items():
        higher, lower = (
            tracked({name: tracked.inputs[name] + sign * step}, seed=shifted(1)).mean() for sign in (1, -1)
        )
        # A convex ball under the sky reflects its light once.
        assert leaf.grad.sum().item() == pytest.approx((higher - lower).item() / (2 * step), rel=1e-3), name


def _stripes():
    """A sky that is brighter on one side, so that refraction matters."""
    import numpy as np

    across = np.linspace(0.1, 1.0, 32, dtype=np.float32)
    return activate().Bitmap(np.tile(across[None, :, None], (16, 1, 3)))
