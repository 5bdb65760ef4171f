"""Path replay with derivatives of delta lobes, for parameters that do not move geometry.

Mitsuba's ``prb`` differentiates the BSDF value at the sampled direction. A delta lobe has no value there, so
mirrors, smooth glass and masks get no derivative, and the specular samples of a smooth plastic get the
derivative of its diffuse lobe. Here the *weight* of a delta sample is differentiated instead. ``prb``'s terms
for moving geometry are left out, because no input moves geometry.

References
----------
Vicini, Speierer and Jakob, "Path Replay Backpropagation", ACM Transactions on Graphics 40(4), 2021.
Zeltner, Speierer, Georgiev and Jakob, "Monte Carlo Estimators for Differential Light Transport", ibid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from .._backward import AdjointSampledIntegrator
from ._lobe_samples import antithetic_point
from .path_differences import mark_met, moved_bsdf

# Direct-light samples at a surface whose glossy lobe dominates the noise of the derivative; an even square number.
GLOSSY_SPLIT = 4


@dataclass
class Vertex:
    """A path vertex: interaction, BSDF, path throughput, and which lanes arrive and continue."""

    si: Any
    bsdf: Any
    throughput: Any
    active: Any
    active_next: Any


class ReplayIntegrator(AdjointSampledIntegrator):
    """Path tracer with emitter sampling whose differential pass replays the paths of the primal pass.

    Parameters are those of ``prb``: ``max_depth``, ``rr_depth``, ``hide_emitters``.
    """

    @dr.syntax
    def sample(  # noqa: PLR0912, PLR0915 -- a recorded loop cannot be split; its parts are the functions below
        self, mode: Any, scene: Any, sampler: Any, ray: Any, active: Any, state_in: Any = None, **options: Any
    ) -> Any:
        """Trace a path; in a differential pass, propagate derivatives from or to each vertex's outgoing radiance.

        ``state_in`` is the radiance of the primal path. Subtracting each vertex's contribution leaves that of all
        later vertices, which is the factor of the derivative of the vertex's BSDF.

        Options
        -------
        light_traced
            Mask of the shapes that light tracing handles. Derivatives are then propagated only along paths from
            the camera whose first vertex is on one of these shapes or specular, and at other first vertices.
        incident
            Where to accumulate the light that reaches the ray's origin, by path length: a target array, each ray's
            offset in it, and the number of lengths.
        met
            Where to mark the materials that each path meets: see ``path_differences.mark_met``.
        moved
            A material for each path and the copy that replaces it: see ``path_differences.moved_bsdf``.
        sky
            What becomes of the light of the sky, which alone counts: see ``SkyLight``.
        moments
            The accumulator of a pilot, which gets the contributions of every vertex. Needs ``state_in``; nothing
            is differentiated.
        """
        primal = mode == dr.ADMode.Primal
        delta_L = options.get("δL")
        light_traced = options.get("light_traced")
        incident = options.get("incident")
        met: Any = options.get("met")
        moved: Any = options.get("moved")
        sky: Any = options.get("sky")
        moments: Any = options.get("moments")
        has_delta_lobes = may_have_delta_lobes(scene)

        # Loop state
        ray = mi.Ray3f(dr.detach(ray))
        if dr.hint(self.hide_emitters, mode="scalar"):
            ray = skip_emitters(scene, ray, mi.Bool(active))
        active = mi.Bool(active)
        L = mi.Spectrum(0 if state_in is None else state_in)  # radiance accumulator
        delta_L = mi.Spectrum(0 if delta_L is None else delta_L)  # adjoint or differential radiance
        throughput = mi.Spectrum(1)
        eta = mi.Float(1)
        depth = mi.UInt32(0)
        valid_ray = mi.Bool(False)
        seen_directly = mi.Bool(self.receiver is None)  # from the camera, through nothing but masks
        si_prev = dr.zeros(mi.SurfaceInteraction3f)
        bsdf_pdf_prev = mi.Float(1)
        bsdf_delta_prev = mi.Bool(True)

        # On a sensor grid, rays start at a white surface, which is lit like any other.
        if dr.hint(self.receiver is not None, mode="scalar"):
            si_prev, bsdf_delta_prev = self.receiver, mi.Bool(False)
            bsdf_pdf_prev = _white_value(si_prev, ray.d)
            random = sampler.next_2d()
            Lr_dir = _light_on_white(scene, random, si_prev, active, primal, sky)
            if dr.hint(moments is not None, mode="scalar"):
                L -= Lr_dir
                emitter = _sampled_emitter(scene, random)
                moments.add(si_prev, emitter, mi.Spectrum(0), emitter, Lr_dir, mi.Spectrum(0))
            elif dr.hint(primal, mode="scalar"):
                L += Lr_dir
            else:
                L -= dr.detach(Lr_dir)
                with dr.resume_grad():
                    if dr.hint(dr.grad_enabled(Lr_dir), mode="scalar"):  # materials do not change it
                        delta_L = _propagate(mode, delta_L, Lr_dir)

        while dr.hint(active, max_iterations=self.max_depth, label=f"Path replay ({mode.name})"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
            active_next = active & (depth + 1 < self.max_depth) & si.is_valid()
            bsdf = si.bsdf(ray)
            if dr.hint(moved is not None, mode="scalar"):
                bsdf = moved_bsdf(bsdf, moved)
            vertex = Vertex(si, bsdf, throughput, active, active_next)
            if dr.hint(met is not None, mode="scalar"):
                mark_met(met, bsdf, active_next)

            # Emission
            visible = active & ~(seen_directly & mi.Bool(self.hide_emitters))
            Le = emitted_radiance(scene, vertex, visible, si_prev, bsdf_pdf_prev, bsdf_delta_prev, primal)
            if dr.hint(sky is not None, mode="scalar"):
                Le = sky.escaped(Le, si, ray.d)

            # Emitter sampling
            emitter_random = sampler.next_2d()
            Lr_dir = _direct_light(scene, emitter_random, vertex, primal, sky)

            # BSDF sampling; the random numbers are kept to sample a delta lobe again for its derivative
            bsdf_random = sampler.next_1d(), sampler.next_2d()
            bsdf_sample, bsdf_weight = vertex.bsdf.sample(mi.BSDFContext(), si, *bsdf_random, active_next)

            # Accumulation, or differential phase
            if dr.hint(moments is not None, mode="scalar"):
                L -= Le + Lr_dir
                hit_emitter = mi.DirectionSample3f(scene, si=si, ref=si_prev).emitter
                Lr_ind = dr.select(active_next & ~is_rounding_error(L, state_in), L, 0)
                moments.add(si, hit_emitter, Le, _sampled_emitter(scene, emitter_random), Lr_dir, Lr_ind)
            elif dr.hint(primal, mode="scalar"):
                L += Le + Lr_dir
            else:
                L -= dr.detach(Le + Lr_dir)
                L_ind = mi.Spectrum(L)
                if dr.hint(light_traced is not None, mode="scalar"):
                    split = _is_glossy(vertex)
                    L_ind -= _bsdf_sampled_direct_light(scene, vertex, bsdf_sample, bsdf_weight, split)
                with dr.resume_grad():
                    if dr.hint(light_traced is not None, mode="scalar"):
                        Lr_dir = dr.select(split, dr.detach(Lr_dir), Lr_dir)
                    value = scattering_value(vertex, bsdf_sample, bsdf_random, has_delta_lobes)
                    Lo = Le + Lr_dir + L_ind * dr.relative_grad(value)
                    if dr.hint(not dr.grad_enabled(Lo), mode="scalar"):
                        raise RuntimeError("the contribution is not attached to the AD graph")
                    delta_L = _propagate(mode, delta_L, Lo)
                if dr.hint(light_traced is not None, mode="scalar"):
                    delta_L = _propagate_split_direct_light(
                        mode, scene, sampler.fork(), vertex, delta_L, split
                    )
            if dr.hint(incident is not None, mode="scalar"):
                _record_incident(incident, depth, Le, Lr_dir, active)

            if dr.hint(sky is not None and sky.direct, mode="scalar"):
                active_next &= is_transmitted(bsdf_sample)

            # Next vertex
            si_prev = dr.detach(si, True)
            bsdf_pdf_prev = bsdf_sample.pdf
            bsdf_delta_prev = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
            seen_directly &= mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
            eta *= bsdf_sample.eta
            throughput *= bsdf_weight
            valid_ray |= active & si.is_valid()

            if dr.hint(light_traced is not None, mode="scalar"):
                active_next &= (depth > 0) | bsdf_delta_prev | is_in_mask(light_traced, si)

            # Russian roulette; η² undoes the scaling of radiance inside glass
            throughput_max = dr.max(throughput)
            rr_prob = dr.minimum(throughput_max * eta**2, 0.95)
            rr_active = depth >= self.rr_depth
            throughput[rr_active] *= dr.rcp(rr_prob)
            active = active_next & (throughput_max != 0) & (~rr_active | (sampler.next_1d() < rr_prob))
            depth[si.is_valid()] += 1

        return L if primal else delta_L, valid_ray, [], L


def may_have_delta_lobes(scene: Any) -> bool:
    """Whether any material may have a delta lobe; shapes inside instances cannot be inspected."""
    return any(
        shape.class_name() == "Instance" or mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)
        for shape in scene.shapes()
    )


@dr.syntax
def skip_emitters(scene: Any, ray: Any, active: Any) -> Any:
    """Return the ray with its origin moved behind the emitters that it hits first."""
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True, active=active)
        active &= si.is_valid() & si.shape.is_emitter()
        ray = dr.select(active, si.spawn_ray(ray.d), ray)
    return ray


def emitted_radiance(
    scene: Any, vertex: Vertex, visible: Any, si_prev: Any, pdf_prev: Any, delta_prev: Any, primal: bool
) -> Any:
    """Return ``Le``, MIS-weighted against emitter sampling at the previous vertex."""
    ds = mi.DirectionSample3f(scene, si=vertex.si, ref=si_prev)
    mis = mis_weight(pdf_prev, scene.pdf_emitter_direction(si_prev, ds, ~delta_prev))
    with dr.resume_grad(when=not primal):
        return vertex.throughput * mis * ds.emitter.eval(vertex.si, visible)


def _direct_light(scene: Any, random: Any, vertex: Vertex, primal: bool, sky: Any = None) -> Any:
    """Return ``Lr_dir``, the reflected light of a sampled emitter."""
    if sky is not None and sky.direct:
        return mi.Spectrum(0)
    active = vertex.active_next & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, emitter_weight, active = _sample_emitter_direction(scene, random, vertex.si, active, primal)
    with dr.resume_grad(when=not primal):
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si, vertex.si.to_local(ds.d), active)
        mis = dr.detach(dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf)))
        light = vertex.throughput * mis * value * emitter_weight
        return light if sky is None else sky.sampled(light, ds)


def _sample_emitter_direction(
    scene: Any, random: Any, si: Any, active: Any, primal: bool
) -> tuple[Any, Any, Any]:
    """Return a sampled direction to an emitter, its weight with derivatives, and where there is one."""
    ds, emitter_weight = scene.sample_emitter_direction(si, random, True, active)
    active = active & (ds.pdf != 0)
    if primal:
        return ds, emitter_weight, active
    with dr.resume_grad():
        if any(emitter.class_name() == "DirectionalArea" for emitter in scene.emitters()):
            # This emitter cannot be evaluated in a direction, so it is sampled again.
            return ds, scene.sample_emitter_direction(si, random, True, active)[1], active
        attached = scene.eval_emitter_direction(si, ds, active)
        weight = dr.replace_grad(emitter_weight, dr.select(active, attached / dr.detach(ds.pdf), 0))
        return ds, weight, active


def _white_value(receiver: Any, direction: Any) -> Any:
    """Return the value and the density of a white diffuse surface: the cosine over π."""
    return dr.maximum(dr.dot(receiver.n, direction), 0) * dr.inv_pi


def _light_on_white(scene: Any, random: Any, receiver: Any, active: Any, primal: bool, sky: Any) -> Any:
    """Return what a white diffuse surface reflects of a sampled emitter."""
    ds, weight, active = _sample_emitter_direction(
        scene, random, receiver, active & receiver.is_valid(), primal
    )
    value = _white_value(receiver, ds.d)
    mis = dr.detach(dr.select(ds.delta, 1, mis_weight(ds.pdf, value)))
    with dr.resume_grad(when=not primal):
        light = dr.select(active, mis * value * weight, 0)
        return light if sky is None else sky.sampled(light, ds)


def is_rounding_error(remainder: Any, total: Any) -> Any:
    """Whether the remainder of a sum after subtractions is as small as their rounding errors."""
    return dr.max(dr.abs(remainder)) < 1e-6 * dr.max(dr.abs(total))


def _sampled_emitter(scene: Any, random: Any) -> Any:
    """Return the emitter that the scene samples with a random point."""
    index, _, _ = scene.sample_emitter(random.x)
    return dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)


def is_in_mask(shape_mask: Any, si: Any) -> Any:
    """Whether the interaction's shape is in a mask over Dr.Jit's shape indices."""
    index = dr.reinterpret_array(mi.UInt32, si.shape)
    return dr.gather(mi.Bool, shape_mask, index, index < dr.width(shape_mask))


def _record_incident(incident: Any, depth: Any, Le: Any, Lr_dir: Any, active: Any) -> None:
    """Accumulate the light that reaches a ray's origin by path length, except from emitters that the ray hits."""
    target, offset, lengths = incident
    for light, segments in ((Le, depth + 1), (Lr_dir, depth + 2)):
        index = offset + dr.minimum(segments, lengths) - 1
        # Each ray has entries of its own. Other modes copy the array, whose size a frozen function must know.
        dr.scatter_add(target, light, index, active & (segments > 1), dr.ReduceMode.NoConflicts)


def _is_glossy(vertex: Vertex) -> Any:
    """Whether a surface has a glossy lobe: its direct light is sampled ``GLOSSY_SPLIT`` times."""
    return vertex.active_next & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Glossy)


def _bsdf_sampled_direct_light(
    scene: Any, vertex: Vertex, bsdf_sample: Any, bsdf_weight: Any, active: Any
) -> Any:
    """Return the ``Le`` that the path will add at its next vertex."""
    active = active & ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    throughput = vertex.throughput * bsdf_weight
    return dr.select(active, throughput * _incident_emission(scene, vertex.si, bsdf_sample, active), 0)


def _incident_emission(scene: Any, si: Any, bsdf_sample: Any, active: Any) -> Any:
    """Return the emission that arrives from a BSDF-sampled direction, MIS-weighted against emitter sampling."""
    hit = scene.ray_intersect(si.spawn_ray(si.to_world(bsdf_sample.wo)), active)
    ds = mi.DirectionSample3f(scene, si=hit, ref=si)
    mis = mis_weight(bsdf_sample.pdf, scene.pdf_emitter_direction(si, ds, active))
    return mis * ds.emitter.eval(hit, active)


def is_valid_sample(bsdf_sample: Any, weight: Any) -> Any:
    """Whether a sample is of a lobe that has values.

    For a direction on the wrong side of a surface, a rough dielectric returns a weight of 0 and a wrong density.
    """
    is_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    return (bsdf_sample.pdf > 0) & (dr.max(weight) > 0) & ~is_delta


def is_transmitted(bsdf_sample: Any) -> Any:
    """Whether a sample passes through a surface without being scattered: a pane, or a gap of cloth."""
    return mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null) | mi.has_flag(
        bsdf_sample.sampled_type, mi.BSDFFlags.DeltaTransmission
    )


def _propagate(mode: Any, delta_L: Any, Lo: Any) -> Any:
    """Propagate from or to ``Lo``; return the adjoint radiance, or the sum of the derivatives so far."""
    if mode == dr.ADMode.Backward:
        dr.backward_from(delta_L * Lo)
        return delta_L
    return delta_L + dr.forward_to(Lo)


@dr.syntax
def _propagate_split_direct_light(
    mode: Any, scene: Any, sampler: Any, vertex: Vertex, delta_L: Any, active: Any
) -> Any:
    """Propagate from or to a surface's reflected direct light, with stratified BSDF and emitter samples.

    The derivative of a lobe with respect to its roughness changes sign over the lobe. It cancels within a vertex
    only with several samples of the lobe, which are antithetic pairs.
    """
    context, si = mi.BSDFContext(), vertex.si
    side = math.isqrt(GLOSSY_SPLIT)
    index = mi.UInt32(0)
    active = mi.Bool(active)
    lobe_random, point_random = mi.Float(0), mi.Point2f(0)
    while active & (index < GLOSSY_SPLIT):
        outer = index % 2 == 1
        lobe_random = dr.select(outer, lobe_random, sampler.next_1d())
        point_random = dr.select(outer, point_random, sampler.next_2d())
        point = antithetic_point(point_random, index // 2, GLOSSY_SPLIT // 2, outer)
        bsdf_sample, weight = vertex.bsdf.sample(context, si, lobe_random, point, active)
        smooth = active & is_valid_sample(bsdf_sample, weight)
        emission = vertex.throughput * _incident_emission(scene, si, bsdf_sample, smooth) / bsdf_sample.pdf
        stratum = mi.Point2f(index % side, index // side)
        emitter_random = (stratum + sampler.next_2d()) / side
        with dr.resume_grad():
            value = vertex.bsdf.eval(context, si, bsdf_sample.wo, smooth)
            Lo = dr.select(smooth, emission * value, 0) + _direct_light(scene, emitter_random, vertex, False)
            delta_L = _propagate(mode, delta_L, Lo / GLOSSY_SPLIT)
        index += 1
    return delta_L


def scattering_value(vertex: Vertex, bsdf_sample: Any, random: tuple[Any, Any], has_delta_lobes: bool) -> Any:
    """Return the scattered fraction of the light from the sampled direction, up to a factor, with derivatives."""
    context = mi.BSDFContext()
    if not has_delta_lobes:
        return vertex.bsdf.eval(context, vertex.si, bsdf_sample.wo, vertex.active_next)
    is_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    is_null = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
    smooth_value = vertex.bsdf.eval(context, vertex.si, bsdf_sample.wo, vertex.active_next & ~is_delta)
    # The lobe's probability cancels in the primal pass. Its derivative must not.
    delta_sample, weight = vertex.bsdf.sample(
        context, vertex.si, *random, vertex.active_next & is_delta & ~is_null
    )
    # The weight of a mask's null sample leaves that probability's derivative out; its transmission does not.
    transmission = vertex.bsdf.eval_null_transmission(vertex.si, vertex.active_next & is_null)
    return dr.select(is_null, transmission, dr.select(is_delta, weight * delta_sample.pdf, smooth_value))


mi.register_integrator("scenecaptum_replay", ReplayIntegrator)
