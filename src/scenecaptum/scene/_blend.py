"""A blend of two materials, of which one may be perfectly specular.

Imported only once a variant is active (see ``load_scene``).

Mitsuba 3.9's ``blendbsdf`` adds the discrete probability of a perfectly specular lobe to the density of the other
material, and divides the values of both by the sum: a blend of a mirror and a rough material reflects too little,
by an amount that depends on the other material's parameters. Here the specular lobe is a choice of its own. Blends
without such a lobe give the images of Mitsuba's plugin.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

EPSILON = 1e-30


class BlendBSDF(mi.BSDF):
    """A linear combination of two materials, the second by ``weight``."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        nested = [props[name] for name in props.keys() if isinstance(props[name], mi.BSDF)]  # noqa: SIM118
        if len(nested) != 2:
            raise ValueError(f"A blendbsdf has two nested materials, not {len(nested)}!")
        self.bsdf_0, self.bsdf_1 = nested
        self.weight = props.get_texture("weight", 0.5)
        # Plain numbers: a frozen function traverses the attributes before each launch, and enumerations whole.
        self.m_components = [int(one.flags(i)) for one in nested for i in range(one.component_count())]
        self.m_flags = int(nested[0].flags()) | int(nested[1].flags())

    def class_name(self) -> str:
        """Return the name of the Mitsuba class that this one replaces."""
        return "BlendBSDF"

    def to_string(self) -> str:
        """List the weight and the materials."""
        lines = (f"  {name} = {getattr(self, name)}" for name in ("weight", "bsdf_0", "bsdf_1"))
        return "\n".join(("BlendBSDF[", *lines, "]"))

    def traverse(self, callback: Any) -> None:
        """Report the weight and the materials under Mitsuba's names."""
        for name in ("weight", "bsdf_0", "bsdf_1"):
            callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def sample(
        self, context: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Sample one of the materials; return a direction with the value times cosine, divided by the density.

        The density of a perfectly specular direction is the probability of its choice. Its derivative belongs to
        the value, whatever cancels between the two.
        """
        weight = self._weight(si, active)
        chance = dr.detach(weight)
        takes_second = sample1 <= chance
        first, value_first = self.bsdf_0.sample(
            context, si, (sample1 - chance) / (1 - chance), sample2, active & ~takes_second
        )
        second, value_second = self.bsdf_1.sample(
            context, si, sample1 / chance, sample2, active & takes_second
        )
        second.sampled_component += self.bsdf_0.component_count()
        sampled = dr.select(takes_second, second, first)
        value = dr.select(takes_second, value_second, value_first)
        share = dr.select(takes_second, weight, 1 - weight)

        is_discrete = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        smooth, density = self.eval_pdf(context, si, sampled.wo, active & ~is_discrete)
        value = dr.select(
            is_discrete, value, dr.select(density > 0, smooth / dr.maximum(density, EPSILON), 0)
        )
        sampled.pdf = dr.select(is_discrete, share * sampled.pdf, density)
        return sampled, value & active

    def eval(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the value times the cosine of the outgoing direction, without perfectly specular lobes."""
        return self.eval_pdf(context, si, wo, active)[0]

    def pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Return the density of ``sample``, without perfectly specular lobes."""
        return self.eval_pdf(context, si, wo, active)[1]

    def eval_pdf(self, context: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the value times cosine, and the density."""
        weight = self._weight(si, active)
        first, density_first = self.bsdf_0.eval_pdf(context, si, wo, active)
        second, density_second = self.bsdf_1.eval_pdf(context, si, wo, active)
        return dr.lerp(first, second, weight), dr.lerp(density_first, density_second, weight)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        """Return the fraction of light that passes straight through."""
        first, second = (one.eval_null_transmission(si, active) for one in (self.bsdf_0, self.bsdf_1))
        return dr.lerp(first, second, self._weight(si, active))

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        """Return the diffuse reflectance of both."""
        first, second = (one.eval_diffuse_reflectance(si, active) for one in (self.bsdf_0, self.bsdf_1))
        return dr.lerp(first, second, self._weight(si, active))

    def _weight(self, si: Any, active: Any) -> Any:
        return dr.clip(self.weight.eval_1(si, active), 0, 1)


mi.register_bsdf("scenecaptum_blendbsdf", BlendBSDF)
