"""Smooth glass whose index of refraction is data of a kernel.

Imported only once a variant is active (see ``load_scene``).

Mitsuba's ``dielectric`` stores its index as a plain number, a literal in kernels, which would have to be recorded
and compiled again for each value. This plugin does the same arithmetic with the same random numbers, so images are
identical.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ._graph import children

TEXTURES = ("specular_reflectance", "specular_transmittance")


class SmoothDielectric(mi.BSDF):
    """Mitsuba's ``dielectric``."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        inside = mi.lookup_ior(props, "int_ior", "bk7")
        outside = mi.lookup_ior(props, "ext_ior", "air")
        if inside < 0 or outside < 0:
            raise ValueError("The interior and exterior indices of refraction must be positive!")
        self.eta = mi.Float(inside / outside)
        for name in TEXTURES:
            setattr(self, name, props.get_texture(name) if name in props else None)
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        reflection = mi.BSDFFlags.DeltaReflection | sides
        transmission = mi.BSDFFlags.DeltaTransmission | sides | mi.BSDFFlags.NonSymmetric
        # Plain numbers: see ``Plastic``.
        self.m_components = [int(reflection), int(transmission)]
        self.m_flags = int(reflection | transmission)
        self.parameters_changed()

    @staticmethod
    def with_textures_of(original: Any) -> SmoothDielectric:
        """Return a material with the textures of another ``dielectric``, and an index of its own."""
        copy = SmoothDielectric(mi.Properties("scenecaptum_dielectric"))
        for name, texture in children(original):
            setattr(copy, name, texture)
        return copy

    def class_name(self) -> str:
        """Return the name of the Mitsuba class that this one replaces."""
        return "SmoothDielectric"

    def to_string(self) -> str:
        """List the parameters."""
        lines = (f"  {name} = {getattr(self, name)}" for name in ("eta", *TEXTURES))
        return "\n".join(("SmoothDielectric[", *lines, "]"))

    def traverse(self, callback: Any) -> None:
        """Report textures and parameters under Mitsuba's names."""
        # Path replay does not differentiate the directions of refracted light.
        callback.put("eta", self.eta, mi.ParamFlags.NonDifferentiable)
        for name in TEXTURES:
            if (texture := getattr(self, name)) is not None:
                callback.put(name, texture, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Keep the index out of the code of kernels."""
        dr.make_opaque(self.eta)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Sample reflection or refraction; the density is the discrete probability of the choice."""
        lobes = (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
        enabled = [context.is_enabled(lobe, index) for index, lobe in enumerate(lobes)]
        reflected, cos_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.eta)
        sampled = dr.zeros(mi.BSDFSample3f)
        if not any(enabled):
            return sampled, mi.Spectrum(0)
        if all(enabled):
            reflects = active & (sample1 <= reflected)
            sampled.pdf = dr.detach(dr.select(reflects, reflected, 1 - reflected))
            weight = mi.Spectrum(1)
        else:
            reflects = active & mi.Bool(enabled[0])
            sampled.pdf = mi.Float(1)
            weight = mi.Spectrum(reflected if enabled[0] else 1 - reflected)
        refracts = active & ~reflects
        sampled.sampled_component = dr.select(reflects, mi.UInt32(0), mi.UInt32(1))
        sampled.sampled_type = dr.select(reflects, *(mi.UInt32(int(lobe)) for lobe in lobes))
        sampled.wo = dr.select(reflects, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
        sampled.eta = dr.select(reflects, 1, eta_it)
        for name, selected in zip(TEXTURES, (reflects, refracts), strict=True):
            if (texture := getattr(self, name)) is not None:
                weight[selected] *= texture.eval(si, selected)
        # Refraction changes the solid angle of light.
        factor = eta_ti if context.mode == mi.TransportMode.Radiance else mi.Float(1)
        weight[refracts] *= dr.square(factor)
        return sampled, weight & active

    def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return 0: both lobes are perfectly specular."""
        return mi.Spectrum(0)

    def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return 0: both lobes are perfectly specular."""
        return mi.Float(0)

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return 0 twice: both lobes are perfectly specular."""
        return mi.Spectrum(0), mi.Float(0)


mi.register_bsdf("scenecaptum_dielectric", SmoothDielectric)
