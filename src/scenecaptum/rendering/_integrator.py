"""Path replay for parameters that leave the geometry alone, with derivatives of perfectly specular lobes.

Imported only once a variant is active (see ``SceneRenderer``).

Mitsuba's ``prb`` differentiates the value of a BSDF at the sampled direction. A perfectly specular lobe has no
value there, so mirrors, smooth glass and masks get no derivative, and the specular samples of a smooth plastic get
that of its diffuse lobe. Here the *weight* of a specular sample is differentiated instead. What ``prb`` does for
moving geometry is left out: nothing that can be an input moves it.

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

from ._backward import ChoosingIntegrator

# Into how many samples the light on a glossy surface is split, where that is what the noise comes from; a square.
SPLIT = 4


@dataclass
class Vertex:
    """A point of a path: where it is, what it is made of, and how the path came there and goes on."""

    si: Any
    bsdf: Any
    throughput: Any
    active: Any
    goes_on: Any


class ReplayIntegrator(ChoosingIntegrator):
    """Path tracer with emitter sampling whose derivative passes replay the primal's paths.

    Parameters are those of ``prb``: ``max_depth``, ``rr_depth``, ``hide_emitters``.
    """

    @dr.syntax
    def sample(  # noqa: PLR0915 -- a recorded loop cannot be split; its parts are the functions below
        self, mode: Any, scene: Any, sampler: Any, ray: Any, active: Any, state_in: Any = None, **options: Any
    ) -> Any:
        """Trace a path; in a derivative pass, propagate from or to the radiance that each vertex sends on.

        ``state_in`` is the radiance of the primal path. Subtracting what each vertex adds leaves what all later
        vertices add, which is what the derivative of a vertex's BSDF multiplies.

        With ``seen``, marks of some shapes, nothing is propagated but to where the camera sees these, directly or
        by specular reflection. ``arriving`` is where to add up the light that reaches the ray's origin: a target,
        each ray's place in it, and how many lengths of path to tell apart. The ``counter`` of a pilot is told the
        light of every vertex, which takes ``state_in`` and no derivatives.
        """
        primal = mode == dr.ADMode.Primal
        adjoint = options.get("δL")
        seen = options.get("seen")
        arriving = options.get("arriving")
        counter: Any = options.get("counter")
        specular = _may_be_specular(scene)

        ray = mi.Ray3f(dr.detach(ray))
        if dr.hint(self.hide_emitters, mode="scalar"):
            ray = _beyond_emitters(scene, ray, mi.Bool(active))
        active = mi.Bool(active)
        radiance = mi.Spectrum(0 if state_in is None else state_in)
        derivative = mi.Spectrum(0 if adjoint is None else adjoint)
        throughput = mi.Spectrum(1)
        eta = mi.Float(1)
        depth = mi.UInt32(0)
        hit_anything = mi.Bool(False)
        seen_directly = mi.Bool(True)  # from the camera, through nothing but masks
        previous = dr.zeros(mi.SurfaceInteraction3f)
        previous_pdf = mi.Float(1)
        previous_specular = mi.Bool(True)

        while dr.hint(active, max_iterations=self.max_depth, label=f"Path replay ({mode.name})"):
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=depth == 0, active=active)
            goes_on = active & (depth + 1 < self.max_depth) & si.is_valid()
            vertex = Vertex(si, si.bsdf(ray), throughput, active, goes_on)
            shown = active & ~(seen_directly & mi.Bool(self.hide_emitters))
            emitted = _emitted(scene, vertex, shown, previous, previous_pdf, previous_specular, primal)
            number = sampler.next_2d()
            reflected = _reflected(scene, number, vertex, primal)
            # Drawn once, since a specular lobe is sampled again for its derivative.
            numbers = sampler.next_1d(), sampler.next_2d()
            direction, weight = vertex.bsdf.sample(mi.BSDFContext(), si, *numbers, goes_on)

            if dr.hint(counter is not None, mode="scalar"):
                radiance -= emitted + reflected
                met = mi.DirectionSample3f(scene, si=si, ref=previous).emitter
                later = dr.select(goes_on & ~_is_rounding(radiance, state_in), radiance, 0)
                counter.add(si, met, emitted, _chosen(scene, number), reflected, later)
            elif dr.hint(primal, mode="scalar"):
                radiance += emitted + reflected
            else:
                radiance -= dr.detach(emitted + reflected)
                later = mi.Spectrum(radiance)
                if dr.hint(seen is not None, mode="scalar"):
                    split = _is_split(vertex)
                    later -= _arriving(scene, vertex, direction, weight, split)
                with dr.resume_grad():
                    if dr.hint(seen is not None, mode="scalar"):
                        reflected = dr.select(split, dr.detach(reflected), reflected)
                    scattering = _scattering(vertex, direction, numbers, specular)
                    total = emitted + reflected + later * dr.relative_grad(scattering)
                    if dr.hint(not dr.grad_enabled(total), mode="scalar"):
                        raise RuntimeError("the contribution is not attached to the AD graph")
                    derivative = _propagated(mode, derivative, total)
                if dr.hint(seen is not None, mode="scalar"):
                    derivative = _propagated_direct_light(
                        mode, scene, sampler.apart(), vertex, derivative, split
                    )
            if dr.hint(arriving is not None, mode="scalar"):
                _record(arriving, depth, emitted, reflected, active)

            previous = dr.detach(si, True)
            previous_pdf = direction.pdf
            previous_specular = mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
            seen_directly &= mi.has_flag(direction.sampled_type, mi.BSDFFlags.Null)
            ray = si.spawn_ray(si.to_world(direction.wo))
            eta *= direction.eta
            throughput *= weight
            hit_anything |= active & si.is_valid()

            if dr.hint(seen is not None, mode="scalar"):
                goes_on &= (depth > 0) | previous_specular | (_is_among(seen, si) & mi.Bool(primal))

            # Deep paths end at random; η² undoes the compression of radiance inside glass.
            brightest = dr.max(throughput)
            survival = dr.minimum(brightest * eta**2, 0.95)
            roulette = depth >= self.rr_depth
            throughput[roulette] *= dr.rcp(survival)
            active = goes_on & (brightest != 0) & (~roulette | (sampler.next_1d() < survival))
            depth[si.is_valid()] += 1

        return radiance if primal else derivative, hit_anything, [], radiance


def _may_be_specular(scene: Any) -> bool:
    """Whether a material may have a perfectly specular lobe: what an instance shows is not among the shapes."""
    return any(
        shape.class_name() == "Instance" or mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)
        for shape in scene.shapes()
    )


@dr.syntax
def _beyond_emitters(scene: Any, ray: Any, active: Any) -> Any:
    """Return the ray, started behind the lights that it meets first."""
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True, active=active)
        active &= si.is_valid() & si.shape.is_emitter()
        ray = dr.select(active, si.spawn_ray(ray.d), ray)
    return ray


def _emitted(
    scene: Any, vertex: Vertex, shown: Any, previous: Any, pdf: Any, specular: Any, primal: bool
) -> Any:
    """Return what the surface emits, weighted against having sampled it from the previous vertex."""
    found = mi.DirectionSample3f(scene, si=vertex.si, ref=previous)
    weight = mis_weight(pdf, scene.pdf_emitter_direction(previous, found, ~specular))
    with dr.resume_grad(when=not primal):
        return vertex.throughput * weight * found.emitter.eval(vertex.si, shown)


def _reflected(scene: Any, number: Any, vertex: Vertex, primal: bool) -> Any:
    """Return the light of a sampled emitter that the surface reflects."""
    active = vertex.goes_on & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
    light, incoming = scene.sample_emitter_direction(vertex.si, number, True, active)
    active &= light.pdf != 0
    with dr.resume_grad(when=not primal):
        if primal:
            pass
        elif any(emitter.class_name() == "DirectionalArea" for emitter in scene.emitters()):
            # Such a light cannot be asked what it sends: the sample is drawn again instead.
            incoming = scene.sample_emitter_direction(vertex.si, number, True, active)[1]
        else:
            attached = scene.eval_emitter_direction(vertex.si, light, active)
            incoming = dr.replace_grad(incoming, dr.select(active, attached / dr.detach(light.pdf), 0))
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si, vertex.si.to_local(light.d), active)
        weight = dr.detach(dr.select(light.delta, 1, mis_weight(light.pdf, pdf)))
        return vertex.throughput * weight * value * incoming


def _is_rounding(rest: Any, whole: Any) -> Any:
    """Whether what is left of a sum, after parts of it were subtracted, is too small to tell."""
    return dr.max(dr.abs(rest)) < 1e-6 * dr.max(dr.abs(whole))


def _chosen(scene: Any, number: Any) -> Any:
    """Return the emitter that a scene samples with a random point."""
    index, _, _ = scene.sample_emitter(number.x)
    return dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)


def _is_among(shapes: Any, si: Any) -> Any:
    """Whether a surface belongs to one of the shapes, marked by the numbers that Dr.Jit gives them."""
    number = dr.reinterpret_array(mi.UInt32, si.shape)
    return dr.gather(mi.Bool, shapes, number, number < dr.width(shapes))


def _record(arriving: Any, depth: Any, emitted: Any, reflected: Any, active: Any) -> None:
    """Add up what reaches the origin of a ray by segments on the way, without the emitters that it meets."""
    target, start, lengths = arriving
    for light, segments in ((emitted, depth + 1), (reflected, depth + 2)):
        index = start + dr.minimum(segments, lengths) - 1
        dr.scatter_add(target, light, index, active & (segments > 1))


def _is_split(vertex: Vertex) -> Any:
    """Whether a surface is glossy and nothing else: what falls on it is sampled many times."""
    flags = vertex.bsdf.flags()
    diffuse = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    return vertex.goes_on & mi.has_flag(flags, mi.BSDFFlags.Glossy) & ~diffuse


def _arriving(scene: Any, vertex: Vertex, direction: Any, weight: Any, active: Any) -> Any:
    """Return what the path will find to be emitted from the sampled direction."""
    active = active & ~mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
    throughput = vertex.throughput * weight
    return dr.select(active, throughput * _seen(scene, vertex.si, direction, active), 0)


def _seen(scene: Any, si: Any, direction: Any, active: Any) -> Any:
    """Return what is emitted from a sampled direction, weighted against having sampled the emitter."""
    hit = scene.ray_intersect(si.spawn_ray(si.to_world(direction.wo)), active)
    found = mi.DirectionSample3f(scene, si=hit, ref=si)
    weight = mis_weight(direction.pdf, scene.pdf_emitter_direction(si, found, active))
    return weight * found.emitter.eval(hit, active)


def _propagated(mode: Any, derivative: Any, total: Any) -> Any:
    """Propagate to a radiance or from it; return its adjoint, or the sum of the derivatives so far."""
    if mode == dr.ADMode.Backward:
        dr.backward_from(derivative * total)
        return derivative
    return derivative + dr.forward_to(total)


@dr.syntax
def _propagated_direct_light(
    mode: Any, scene: Any, sampler: Any, vertex: Vertex, derivative: Any, active: Any
) -> Any:
    """Do as ``_propagated`` with what a surface makes of direct light, from stratified samples of both.

    A lobe's derivative with respect to its roughness is positive here and negative there, which cancels within a
    vertex only where enough samples are taken of it.
    """
    context, si = mi.BSDFContext(), vertex.si
    side = math.isqrt(SPLIT)
    index = mi.UInt32(0)
    active = mi.Bool(active)
    while active & (index < SPLIT):
        corner = mi.Point2f(index % side, index // side)
        direction, _ = vertex.bsdf.sample(
            context, si, sampler.next_1d(), (corner + sampler.next_2d()) / side, active
        )
        rough = active & (direction.pdf > 0) & ~mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
        seen = vertex.throughput * _seen(scene, si, direction, rough) / direction.pdf
        number = (corner + sampler.next_2d()) / side
        with dr.resume_grad():
            value = vertex.bsdf.eval(context, si, direction.wo, rough)
            total = dr.select(rough, seen * value, 0) + _reflected(scene, number, vertex, False)
            derivative = _propagated(mode, derivative, total / SPLIT)
        index += 1
    return derivative


def _scattering(vertex: Vertex, direction: Any, numbers: tuple[Any, Any], specular: bool) -> Any:
    """Return, up to a factor, what the surface passes on from the sampled direction, with its derivatives."""
    context = mi.BSDFContext()
    if not specular:
        return vertex.bsdf.eval(context, vertex.si, direction.wo, vertex.goes_on)
    is_specular = mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
    is_null = mi.has_flag(direction.sampled_type, mi.BSDFFlags.Null)
    rough = vertex.bsdf.eval(context, vertex.si, direction.wo, vertex.goes_on & ~is_specular)
    # The probability of the lobe cancels in the primal; its derivative must not.
    again, weight = vertex.bsdf.sample(context, vertex.si, *numbers, vertex.goes_on & is_specular & ~is_null)
    # Masks leave that probability out of the weight's derivative, but can be asked what they let pass.
    passed = vertex.bsdf.eval_null_transmission(vertex.si, vertex.goes_on & is_null)
    return dr.select(is_null, passed, dr.select(is_specular, weight * again.pdf, rough))


mi.register_integrator("scenecaptum_replay", ReplayIntegrator)
