"""Smooth and rough plastic that are differentiable with respect to every parameter.

Imported only once a variant is active (see ``load_scene``).

Plastic is a diffuse base under a dielectric coating. The coating's external transmittance (a table over incident
cosines if it is rough) and internal reflectance depend on its index of refraction and roughness. Mitsuba's
``plastic`` and ``roughplastic`` compute both outside the derivative graph. These plugins do the same arithmetic
with the same random numbers, so images are identical, and track everything except the sampling densities: lobe
selection is discrete, and with a detached density the value carries the whole derivative.

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

# Incident cosines at which the transmittance of a rough coating is tabulated.
COSINES = np.maximum(1e-6, np.linspace(0, 1, 64))

EPSILON = 1e-30


class Plastic(mi.BSDF):
    """A diffuse base under a dielectric coating; subclasses define the coating's reflection and transmission."""

    specular_lobe: str
    parameter_names: tuple[str, ...]  # in the order in which Mitsuba's plugin reports them to mi.traverse

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
        # Plain numbers: a frozen function traverses the attributes before each launch, and enumerations whole.
        self.lobes = (int(getattr(mi.BSDFFlags, self.specular_lobe)), int(mi.BSDFFlags.DiffuseReflection))
        self.m_components = [lobe | int(mi.BSDFFlags.FrontSide) for lobe in self.lobes]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def class_name(self) -> str:
        """Return the name of the Mitsuba class that this one replaces."""
        return type(self).__name__

    def to_string(self) -> str:
        """List the parameters."""
        lines = (f"  {name} = {getattr(self, name)}" for name in self.parameter_names)
        return "\n".join((f"{self.class_name()}[", *lines, "]"))

    def traverse(self, callback: Any) -> None:
        """Report textures and parameters under Mitsuba's names."""
        for name in self.parameter_names:
            value = getattr(self, name)
            if value is not None:
                callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Update derived values; subclasses update theirs first."""
        diffuse = self.diffuse_reflectance.mean()
        specular = 1 if self.specular_reflectance is None else self.specular_reflectance.mean()
        self.specular_weight = dr.detach(specular / dr.maximum(diffuse + specular, EPSILON))
        # Literals would be compiled into the code, with a separate kernel for each material.
        dr.make_opaque(self.eta, self.internal_reflectance, self.specular_weight)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Sample a direction; return it with the BSDF value times cosine, divided by the density."""
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
        return sampled, value / dr.maximum(sampled.pdf, EPSILON)

    def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the BSDF value times the cosine of the outgoing direction."""
        return self.eval_pdf(context, si, wo, active)[0]

    def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of ``sample``."""
        return self.eval_pdf(context, si, wo, active)[1]

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        """Return the diffuse reflectance of the base."""
        return self.diffuse_reflectance.eval(si, active)

    def _enabled(self, context: Any) -> tuple[bool, bool]:
        """Whether the specular and the diffuse lobe are enabled."""
        specular, diffuse = (context.is_enabled(lobe, index) for index, lobe in enumerate(self.lobes))
        return specular, diffuse

    def _specular_probability(self, context: Any, wi: Any) -> Any:
        specular, diffuse = self._enabled(context)
        if specular != diffuse:
            return mi.Float(specular)
        transmittance = dr.detach(self._transmittance(mi.Frame3f.cos_theta(wi)))
        specular_part = (1 - transmittance) * self.specular_weight
        diffuse_part = transmittance * (1 - self.specular_weight)
        return specular_part / dr.maximum(specular_part + diffuse_part, EPSILON)

    def _eval_specular_reflectance(self, si: Any, active: Any) -> Any:
        return 1 if self.specular_reflectance is None else self.specular_reflectance.eval(si, active)

    def _eval_diffuse(self, si: Any, wo: Any, active: Any) -> Any:
        """Return the diffuse lobe times cosine, including interreflection between base and coating."""
        base = self.diffuse_reflectance.eval(si, active)
        interreflected = self.internal_reflectance * base if self.nonlinear else self.internal_reflectance
        cos_o = mi.Frame3f.cos_theta(wo)
        transmittance = self._transmittance(mi.Frame3f.cos_theta(si.wi)) * self._transmittance(cos_o)
        return base / (1 - interreflected) * (dr.inv_pi * cos_o * transmittance / dr.square(self.eta))


class SmoothPlastic(Plastic):
    """Mitsuba's ``plastic``, with a perfectly smooth coating."""

    specular_lobe = "DeltaReflection"
    parameter_names = ("eta", "diffuse_reflectance", "specular_reflectance")

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.parameters_changed()

    def parameters_changed(self, keys: Any = ()) -> None:
        """Update derived values."""
        self.internal_reflectance = mi.fresnel_diffuse_reflectance(1 / self.eta)
        super().parameters_changed(keys)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Sample a diffuse or the mirror direction; the density of the latter is its discrete probability."""
        sampled, weight = super().sample(context, si, sample1, sample2, active)
        cos_i = mi.Frame3f.cos_theta(si.wi)
        specular = active & (cos_i > 0) & (sampled.sampled_component == 0)
        probability = self._specular_probability(context, si.wi)
        reflectance = self._eval_specular_reflectance(si, specular) * mi.fresnel(cos_i, self.eta)[0]
        sampled.pdf = dr.select(specular, probability, sampled.pdf)
        return sampled, dr.select(specular, reflectance / dr.maximum(probability, EPSILON), weight)

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return value and density of the diffuse lobe; a delta lobe evaluates to zero."""
        _, diffuse = self._enabled(context)
        active &= diffuse & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        probability = 1 - self._specular_probability(context, si.wi)
        density = probability * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        return self._eval_diffuse(si, wo, active) & active, density & active

    def _reflect(self, wi: Any, sample: Any) -> Any:
        return mi.reflect(wi)

    def _transmittance(self, cosine: Any) -> Any:
        return 1 - mi.fresnel(cosine, self.eta)[0]


class RoughPlastic(Plastic):
    """Mitsuba's ``roughplastic``, with a microfacet coating."""

    specular_lobe = "GlossyReflection"
    parameter_names = ("diffuse_reflectance", "alpha", "eta", "specular_reflectance")

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        if self.eta[0] == 1:
            raise ValueError("The interior and exterior indices of refraction must differ!")
        microfacets = mi.MicrofacetDistribution(props)
        if microfacets.is_anisotropic():
            raise ValueError("The 'roughplastic' plugin supports no anisotropic microfacet distributions!")
        self.distribution = int(microfacets.type())
        self.sample_visible = microfacets.sample_visible()
        self.alpha = mi.Float(microfacets.alpha())
        self.parameters_changed()

    def parameters_changed(self, keys: Any = ()) -> None:
        """Update derived values."""
        self.external_transmittance = self._differentiable(external_transmittance)
        self.internal_reflectance = self._differentiable(internal_reflectance)
        dr.make_opaque(self.alpha, self.external_transmittance)
        super().parameters_changed(keys)

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the BSDF value times the cosine of the outgoing direction, and the density of ``sample``."""
        specular, diffuse = self._enabled(context)
        cos_i = mi.Frame3f.cos_theta(si.wi)
        active &= (specular | diffuse) & (cos_i > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        microfacets = self._microfacets()
        half = dr.normalize(wo + si.wi)
        visible = microfacets.eval(half) * microfacets.smith_g1(si.wi, half) / (4 * cos_i)

        value = mi.Spectrum(0)
        if specular:
            fresnel = mi.fresnel(dr.dot(si.wi, half), self.eta)[0]
            reflectance = self._eval_specular_reflectance(si, active)
            value += reflectance * (fresnel * visible * microfacets.smith_g1(wo, half))
        if diffuse:
            value += self._eval_diffuse(si, wo, active)

        density = visible if self.sample_visible else microfacets.pdf(si.wi, half) / (4 * dr.dot(wo, half))
        probability = self._specular_probability(context, si.wi)
        cosine_density = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        density = probability * dr.detach(density) + (1 - probability) * cosine_density
        return value & active, density & active

    def _microfacets(self) -> Any:
        kind = mi.MicrofacetType(self.distribution)
        return mi.MicrofacetDistribution(kind, self.alpha, self.sample_visible)

    def _reflect(self, wi: Any, sample: Any) -> Any:
        normal, _ = self._microfacets().sample(wi, sample)
        return mi.reflect(wi, normal)

    def _transmittance(self, cosine: Any) -> Any:
        position = cosine * (len(COSINES) - 1)
        index = dr.minimum(mi.UInt32(position), len(COSINES) - 2)
        below, above = (dr.gather(mi.Float, self.external_transmittance, index + i) for i in (0, 1))
        return dr.lerp(below, above, position - index)

    def _differentiable(self, function: Callable[[int, float, float], Table]) -> Any:
        """Return a function of roughness and index, with finite-difference derivatives where they are tracked."""
        alpha, eta = self.alpha[0], self.eta[0]
        value = _array(function(self.distribution, alpha, eta))
        if dr.grad_enabled(self.alpha):
            slope = _difference_quotient(lambda x: function(self.distribution, x, eta), alpha, 0.05 * alpha)
            value = dr.replace_grad(value, value + slope * self.alpha)
        if dr.grad_enabled(self.eta):
            # At eta = 1 total internal reflection changes sides, so both points lie on the same side of 1.
            step = max(0.1 * min(abs(eta - 1), 0.2), 1e-4)
            centre = max(eta, 1 + step) if eta >= 1 else min(eta, 1 - step)
            slope = _difference_quotient(lambda x: function(self.distribution, alpha, x), centre, step)
            value = dr.replace_grad(value, value + slope * self.eta)
        return value


def _difference_quotient(function: Callable[[float], Table], x: float, step: float) -> Any:
    """Return a central difference: total reflection makes the tables too rough for a pointwise derivative."""
    low, high = (float(np.float32(x + shift)) for shift in (-step, step))
    return _array((function(high) - function(low)) / (high - low))


def _array(table: Table) -> Any:
    """Copy a table; frozen functions would otherwise keep reading memory that NumPy owns."""
    return mi.Float(table.tolist())


@lru_cache(maxsize=1024)
def external_transmittance(distribution: int, alpha: float, eta: float) -> Table:
    """Return the fraction of light incident at each of ``COSINES`` that a rough coating transmits."""

    def transmitted(microfacets: Any, wi: Any, normal: Any) -> Any:
        fresnel, cos_t, _, inverse = mi.fresnel(dr.dot(wi, normal), dr.opaque(mi.Float, eta))
        wo = mi.refract(wi, normal, cos_t, inverse)
        return dr.select(wo.z < 0, microfacets.smith_g1(wo, normal) * (1 - fresnel), 0)

    return _integrate(distribution, alpha, eta, transmitted)


@lru_cache(maxsize=1024)
def internal_reflectance(distribution: int, alpha: float, eta: float) -> Table:
    """Return the fraction of diffuse light from the inside that a rough coating reflects, ``(1,)``."""

    def reflected(microfacets: Any, wi: Any, normal: Any) -> Any:
        wo = mi.reflect(wi, normal)
        fresnel, *_ = mi.fresnel(dr.dot(wi, normal), dr.opaque(mi.Float, 1 / eta))
        return dr.select(wo.z > 0, microfacets.smith_g1(wo, normal) * fresnel, 0)

    by_cosine = _integrate(distribution, alpha, 1 / eta, reflected)
    return np.array([np.mean(2 * COSINES * by_cosine)])


def _integrate(
    distribution: int, alpha: float, eta: float, scattered: Callable[[Any, Any, Any], Any]
) -> Table:
    """Average over the visible normals at each of ``COSINES``, with Mitsuba's quadrature."""
    resolution = 32 if eta > 1 else 128
    nodes, weights = mi.quad.gauss_legendre(resolution)
    # Scattering is symmetric about the plane of incidence.
    half = dr.arange(mi.UInt32, resolution // 2)
    cosine, u, v = dr.meshgrid(
        mi.Float(COSINES), 0.5 * nodes + 0.5, dr.gather(mi.Float, 0.5 * nodes + 0.5, half), indexing="ij"
    )
    _, *weight = dr.meshgrid(mi.Float(COSINES), weights, dr.gather(mi.Float, weights, half), indexing="ij")
    kind = mi.MicrofacetType(distribution)
    microfacets = mi.MicrofacetDistribution(kind, dr.opaque(mi.Float, alpha), True)
    wi = mi.Vector3f(dr.sqrt(1 - dr.square(cosine)), 0, cosine)
    normal, _ = microfacets.sample(
        wi, mi.Point2f(u, v) if kind == mi.MicrofacetType.Beckmann else mi.Point2f(v, u)
    )
    weighted = 0.5 * weight[0] * weight[1] * scattered(microfacets, wi, normal)
    # In double precision, since the difference quotients are small differences of sums.
    table: Table = dr.block_sum(mi.Float64(weighted), resolution * resolution // 2).numpy()
    return table


mi.register_bsdf("scenecaptum_plastic", SmoothPlastic)
mi.register_bsdf("scenecaptum_roughplastic", RoughPlastic)
