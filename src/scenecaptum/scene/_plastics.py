"""Smooth and rough plastic, with derivatives with respect to every parameter.

Imported only once a variant is active (see ``load_scene``).

Plastic is a diffuse ground under a dielectric surface. How much light the surface lets in (a table over
directions, where it is rough) and how much it keeps inside depend on its index and roughness. Mitsuba's
``plastic`` and ``roughplastic`` compute both outside the derivative graph. The plugins here do the same arithmetic
with the same random numbers, so that pictures are the same, and track all of it but the probabilities: which lobe
is sampled is a choice, and the value carries the whole derivative where the density it is divided by has none.

References
----------
Walter, Marschner, Li and Torrance, "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Table: TypeAlias = "NDArray[np.float64]"

# Directions for which the transmittance of a rough surface is tabulated.
COSINES = np.maximum(1e-6, np.linspace(0, 1, 64))

TINY = 1e-30


class Plastic(mi.BSDF):
    """A diffuse ground under a dielectric surface; subclasses say how that reflects and what it lets through."""

    specular_lobe: str
    reported: tuple[str, ...]  # what Mitsuba's plugin reports to mi.traverse, in its order

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        inside = mi.lookup_ior(props, "int_ior", "polypropylene")
        outside = mi.lookup_ior(props, "ext_ior", "air")
        if inside < 0 or outside < 0:
            raise ValueError("The interior and exterior indices of refraction must be positive!")
        self.eta = mi.Float(inside / outside)
        self.diffuse_reflectance = props.get_texture("diffuse_reflectance", 0.5)
        named = "specular_reflectance" in props
        self.specular_reflectance = props.get_texture("specular_reflectance") if named else None
        self.nonlinear = props.get("nonlinear", False)
        if not isinstance(self.nonlinear, bool):
            raise TypeError('The property "nonlinear" has the wrong type (expected boolean)')
        self.lobes = (getattr(mi.BSDFFlags, self.specular_lobe), mi.BSDFFlags.DiffuseReflection)
        self.m_components = [lobe | mi.BSDFFlags.FrontSide for lobe in self.lobes]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def class_name(self) -> str:
        """Return the name of the Mitsuba class that this one stands for."""
        return type(self).__name__

    def to_string(self) -> str:
        """List what can be set."""
        lines = (f"  {name} = {getattr(self, name)}" for name in self.reported)
        return "\n".join((f"{self.class_name()}[", *lines, "]"))

    def traverse(self, callback: Any) -> None:
        """Report textures and parameters under Mitsuba's names."""
        for name in self.reported:
            value = getattr(self, name)
            if value is not None:
                callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Bring up to date what is derived from the parameters; subclasses first derive what is theirs."""
        diffuse = self.diffuse_reflectance.mean()
        specular = 1 if self.specular_reflectance is None else self.specular_reflectance.mean()
        self.specular_weight = dr.detach(specular / dr.maximum(diffuse + specular, TINY))
        # A number written into the code would give each material a kernel of its own.
        dr.make_opaque(self.eta, self.internal_reflectance, self.specular_weight)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Draw a direction from either lobe; return it with the value divided by its density."""
        active &= mi.Frame3f.cos_theta(si.wi) > 0
        specular = active & (sample1 < self._specular_probability(context, si.wi))
        sampled = dr.zeros(mi.BSDFSample3f)
        sampled.wo = dr.select(
            specular, self._reflect(si.wi, sample2), mi.warp.square_to_cosine_hemisphere(sample2)
        )
        sampled.eta = mi.Float(1)
        sampled.sampled_component = dr.select(specular, mi.UInt32(0), mi.UInt32(1))
        sampled.sampled_type = dr.select(specular, *(mi.UInt32(lobe) for lobe in self.lobes))
        value, sampled.pdf = self.eval_pdf(context, si, sampled.wo, active)
        return sampled, value / dr.maximum(sampled.pdf, TINY)

    def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the value times the cosine of the outgoing direction."""
        return self.eval_pdf(context, si, wo, active)[0]

    def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density with which ``sample`` draws a direction."""
        return self.eval_pdf(context, si, wo, active)[1]

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        """Return the reflectance of the ground."""
        return self.diffuse_reflectance.eval(si, active)

    def _enabled(self, context: Any) -> tuple[bool, bool]:
        """Whether the specular and the diffuse lobe are asked for."""
        specular, diffuse = (context.is_enabled(lobe, index) for index, lobe in enumerate(self.lobes))
        return specular, diffuse

    def _specular_probability(self, context: Any, wi: Any) -> Any:
        specular, diffuse = self._enabled(context)
        if specular != diffuse:
            return mi.Float(specular)
        let_in = dr.detach(self._transmittance(mi.Frame3f.cos_theta(wi)))
        for_specular = (1 - let_in) * self.specular_weight
        for_diffuse = let_in * (1 - self.specular_weight)
        return for_specular / dr.maximum(for_specular + for_diffuse, TINY)

    def _tint(self, si: Any, active: Any) -> Any:
        """Return the factor on what the surface reflects."""
        return 1 if self.specular_reflectance is None else self.specular_reflectance.eval(si, active)

    def _diffuse(self, si: Any, wo: Any, active: Any) -> Any:
        """Return the value of the diffuse lobe: in, back and forth between ground and surface, and out."""
        ground = self.diffuse_reflectance.eval(si, active)
        kept = self.internal_reflectance * ground if self.nonlinear else self.internal_reflectance
        cos_o = mi.Frame3f.cos_theta(wo)
        let_through = self._transmittance(mi.Frame3f.cos_theta(si.wi)) * self._transmittance(cos_o)
        return ground / (1 - kept) * (dr.inv_pi * cos_o * let_through / dr.square(self.eta))


class SmoothPlastic(Plastic):
    """Mitsuba's ``plastic``, whose surface is a mirror."""

    specular_lobe = "DeltaReflection"
    reported = ("eta", "diffuse_reflectance", "specular_reflectance")

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.parameters_changed()

    def parameters_changed(self, keys: Any = ()) -> None:
        """Bring up to date what is derived from the parameters."""
        self.internal_reflectance = mi.fresnel_diffuse_reflectance(1 / self.eta)
        super().parameters_changed(keys)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Draw a diffuse direction or the mirrored one, whose density is the probability of drawing it."""
        sampled, weight = super().sample(context, si, sample1, sample2, active)
        cos_i = mi.Frame3f.cos_theta(si.wi)
        mirrored = active & (cos_i > 0) & (sampled.sampled_component == 0)
        probability = self._specular_probability(context, si.wi)
        reflected = self._tint(si, mirrored) * mi.fresnel(cos_i, self.eta)[0]
        sampled.pdf = dr.select(mirrored, probability, sampled.pdf)
        return sampled, dr.select(mirrored, reflected / dr.maximum(probability, TINY), weight)

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return value and density of the diffuse lobe: those of a mirror are zero but in one direction."""
        _, diffuse = self._enabled(context)
        active &= diffuse & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        probability = 1 - self._specular_probability(context, si.wi)
        density = probability * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        return self._diffuse(si, wo, active) & active, density & active

    def _reflect(self, wi: Any, sample: Any) -> Any:
        return mi.reflect(wi)

    def _transmittance(self, cosine: Any) -> Any:
        return 1 - mi.fresnel(cosine, self.eta)[0]


class RoughPlastic(Plastic):
    """Mitsuba's ``roughplastic``, whose surface is made of microfacets."""

    specular_lobe = "GlossyReflection"
    reported = ("diffuse_reflectance", "alpha", "eta", "specular_reflectance")

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        if self.eta[0] == 1:
            raise ValueError("The interior and exterior indices of refraction must differ!")
        surface = mi.MicrofacetDistribution(props)
        if surface.is_anisotropic():
            raise ValueError("The 'roughplastic' plugin supports no anisotropic microfacet distributions!")
        self.distribution = surface.type()
        self.sample_visible = surface.sample_visible()
        self.alpha = mi.Float(surface.alpha())
        self.parameters_changed()

    def parameters_changed(self, keys: Any = ()) -> None:
        """Bring up to date what is derived from the parameters."""
        self.external_transmittance = self._track(external_transmittance)
        self.internal_reflectance = self._track(internal_reflectance)
        dr.make_opaque(self.alpha, self.external_transmittance)
        super().parameters_changed(keys)

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the value times the cosine of the outgoing direction, and the density of ``sample``."""
        specular, diffuse = self._enabled(context)
        cos_i = mi.Frame3f.cos_theta(si.wi)
        active &= (specular | diffuse) & (cos_i > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        surface = self._surface()
        half = dr.normalize(wo + si.wi)
        facets = surface.eval(half) * surface.smith_g1(si.wi, half) / (4 * cos_i)

        value = mi.Spectrum(0)
        if specular:
            reflected = mi.fresnel(dr.dot(si.wi, half), self.eta)[0]
            value += self._tint(si, active) * (reflected * facets * surface.smith_g1(wo, half))
        if diffuse:
            value += self._diffuse(si, wo, active)

        density = facets if self.sample_visible else surface.pdf(si.wi, half) / (4 * dr.dot(wo, half))
        probability = self._specular_probability(context, si.wi)
        cosine_density = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        density = probability * dr.detach(density) + (1 - probability) * cosine_density
        return value & active, density & active

    def _surface(self) -> Any:
        return mi.MicrofacetDistribution(self.distribution, self.alpha, self.sample_visible)

    def _reflect(self, wi: Any, sample: Any) -> Any:
        normal, _ = self._surface().sample(wi, sample)
        return mi.reflect(wi, normal)

    def _transmittance(self, cosine: Any) -> Any:
        position = cosine * (len(COSINES) - 1)
        index = dr.minimum(mi.UInt32(position), len(COSINES) - 2)
        below, above = (dr.gather(mi.Float, self.external_transmittance, index + i) for i in (0, 1))
        return dr.lerp(below, above, position - index)

    def _track(self, function: Callable[[Any, float, float], Table]) -> Any:
        """Return a function of roughness and index, attached to those of the two that are tracked."""
        alpha, eta = self.alpha[0], self.eta[0]
        value = _array(function(self.distribution, alpha, eta))
        if dr.grad_enabled(self.alpha):
            slope = _slope(lambda moved: function(self.distribution, moved, eta), alpha, 0.05 * alpha)
            value = dr.replace_grad(value, value + slope * self.alpha)
        if dr.grad_enabled(self.eta):
            # Total reflection changes sides where the indices match, so both points lie on the same side of 1.
            step = max(0.1 * min(abs(eta - 1), 0.2), 1e-4)
            middle = max(eta, 1 + step) if eta >= 1 else min(eta, 1 - step)
            slope = _slope(lambda moved: function(self.distribution, alpha, moved), middle, step)
            value = dr.replace_grad(value, value + slope * self.eta)
        return value


def _slope(function: Callable[[float], Table], at: float, step: float) -> Any:
    """Return a difference quotient: total reflection makes the tables too ragged for a derivative at a point."""
    low, high = (float(np.float32(at + shift)) for shift in (-step, step))
    return _array((function(high) - function(low)) / (high - low))


def _array(table: Table) -> Any:
    """Copy a table, since frozen functions go on reading memory that Dr.Jit once borrowed from NumPy."""
    return mi.Float(table.tolist())


@lru_cache(maxsize=1024)
def external_transmittance(distribution: Any, alpha: float, eta: float) -> Table:
    """Return the share of light from each of ``COSINES`` that a rough surface lets in."""

    def let_in(surface: Any, wi: Any, normal: Any) -> Any:
        reflected, cos_t, _, inverse = mi.fresnel(dr.dot(wi, normal), dr.opaque(mi.Float, eta))
        wo = mi.refract(wi, normal, cos_t, inverse)
        return dr.select(wo.z < 0, surface.smith_g1(wo, normal) * (1 - reflected), 0)

    return _integrate(distribution, alpha, eta, let_in)


@lru_cache(maxsize=1024)
def internal_reflectance(distribution: Any, alpha: float, eta: float) -> Table:
    """Return the share of diffuse light from inside that a rough surface reflects: one number."""

    def keep(surface: Any, wi: Any, normal: Any) -> Any:
        wo = mi.reflect(wi, normal)
        reflected, *_ = mi.fresnel(dr.dot(wi, normal), dr.opaque(mi.Float, 1 / eta))
        return dr.select(wo.z > 0, surface.smith_g1(wo, normal) * reflected, 0)

    by_cosine = _integrate(distribution, alpha, 1 / eta, keep)
    return np.array([np.mean(2 * COSINES * by_cosine)])


def _integrate(
    distribution: Any, alpha: float, eta: float, scattered: Callable[[Any, Any, Any], Any]
) -> Table:
    """Average over the facets visible from each of ``COSINES``, by the quadrature that Mitsuba takes."""
    resolution = 32 if eta > 1 else 128
    nodes, weights = mi.quad.gauss_legendre(resolution)
    # What is scattered to the left of the plane of incidence equals what is scattered to the right.
    half = dr.arange(mi.UInt32, resolution // 2)
    cosine, along, across = dr.meshgrid(
        mi.Float(COSINES), 0.5 * nodes + 0.5, dr.gather(mi.Float, 0.5 * nodes + 0.5, half), indexing="ij"
    )
    _, *weight = dr.meshgrid(mi.Float(COSINES), weights, dr.gather(mi.Float, weights, half), indexing="ij")
    beckmann = distribution == mi.MicrofacetType.Beckmann
    surface = mi.MicrofacetDistribution(distribution, dr.opaque(mi.Float, alpha), True)
    wi = mi.Vector3f(dr.sqrt(1 - dr.square(cosine)), 0, cosine)
    normal, _ = surface.sample(wi, mi.Point2f(along, across) if beckmann else mi.Point2f(across, along))
    share = 0.5 * weight[0] * weight[1] * scattered(surface, wi, normal)
    # In double precision, since slopes are small differences of sums.
    table: Table = dr.block_sum(mi.Float64(share), resolution * resolution // 2).numpy()
    return table


mi.register_bsdf("scenecaptum_plastic", SmoothPlastic)
mi.register_bsdf("scenecaptum_roughplastic", RoughPlastic)
