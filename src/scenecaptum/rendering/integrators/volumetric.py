"""Path replay through fog, smoke and other participating media.

Surfaces are treated as in ``path``. Free-flight sampling keeps the variance of derivatives bounded where there is
nothing to scatter: every crossing of a medium has a minimum probability of an interaction, even at density 0, and
null collisions keep a positive weight. Transmittance through a homogeneous medium is analytic. Where a path weight
is exactly 0 (a black albedo, an empty voxel), the path is still followed: the derivative of that weight multiplies
the radiance beyond it.

References
----------
Vicini, Speierer and Jakob, "Path Replay Backpropagation", ACM Transactions on Graphics 40(4), 2021.
Nimier-David, Müller, Keller and Jakob, "Unbiased Inverse Volume Rendering with Differential Trackers", ACM
Transactions on Graphics 41(4), 2022.
Novák, Georgiev, Hanika and Jarosz, "Monte Carlo Methods for Volumetric Light Transport Simulation", Computer
Graphics Forum 37(2), 2018.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import mis_weight

from .._backward import AdjointSampledIntegrator
from .path import (
    Vertex,
    emitted_radiance,
    is_rounding_error,
    may_have_delta_lobes,
    scattering_value,
    skip_emitters,
)

# Minimum expected number of interactions per crossing of a medium. Only interactions carry the in-scattered
# part of the derivative with respect to density, so at density 0 a sampler without a minimum would never see
# it.
MIN_EXPECTED_INTERACTIONS = 0.1

# Majorant of the tentative collisions, relative to the greatest density. The derivative of a null collision's
# weight 1 - q is -1 / (1 - q): with a factor of 1 it would be unbounded in the densest voxel.
MAJORANT_FACTOR = 1.25

# Finite stand-in for a ray's infinite length, which would make 0 · ∞ of a clear medium; beyond every scene.
MAX_DISTANCE = 1e20


@dataclass
class MediaTypes:
    """Which kinds of media a scene contains; code for the others is not traced."""

    homogeneous: bool
    heterogeneous: bool


@dataclass
class FreeFlight:
    """A sampled free flight: to a scattering event in the medium, or through to the surface.

    ``pdf`` is its probability density, ``null_weight`` the weight of its null collisions.
    """

    mei: Any
    inside: Any
    scattered: Any
    pdf: Any
    null_weight: Any


@dataclass
class MediumScatter:
    """A scattering event in a medium."""

    mei: Any
    phase: Any
    active: Any


@dataclass
class EmitterSample:
    """A sampled emitter, the transmittance towards it, and the sampler state to estimate that again."""

    ref: Any
    ds: Any
    weight: Any
    medium: Any
    active: Any
    transmittance: Any
    sampler: Any


class VolumetricReplayIntegrator(AdjointSampledIntegrator):
    """Volumetric path tracer with emitter sampling whose differential pass replays the paths of the primal pass.

    Parameters are those of ``volpath``: ``max_depth``, ``rr_depth``, ``hide_emitters``.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self._camera_medium: Any = None
        self._follow_zero_weights = False

    def render(self, scene: Any, sensor: Any = 0, *args: Any, **options: Any) -> Any:
        """Render, starting in the camera's medium."""
        self._prepare(scene, sensor, derivatives=False)
        return super().render(scene, sensor, *args, **options)

    def render_samples(self, scene: Any, sensor: Any, *args: Any) -> Any:
        """Render an image from given samples."""
        self._prepare(scene, sensor, derivatives=False)
        return super().render_samples(scene, sensor, *args)

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, *args: Any, **options: Any) -> Any:
        """Propagate the tangents of the tracked parameters to an image."""
        self._prepare(scene, sensor, derivatives=True)
        return super().render_forward(scene, params, sensor, *args, **options)

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, *args: Any, **options: Any
    ) -> None:
        """Backpropagate an adjoint image to the tracked parameters."""
        self._prepare(scene, sensor, derivatives=True)
        super().render_backward(scene, params, grad_in, sensor, *args, **options)

    def render_backward_pixels(self, scene: Any, sensor: Any, *args: Any, **options: Any) -> None:
        """Backpropagate an adjoint image to the tracked parameters with samples in given pixels."""
        self._prepare(scene, sensor, derivatives=True)
        super().render_backward_pixels(scene, sensor, *args, **options)

    def accumulate_moments(self, scene: Any, sensor: Any, *args: Any, **options: Any) -> Any:
        """Accumulate moments of the vertices' contributions for a pilot."""
        self._prepare(scene, sensor, derivatives=True)
        return super().accumulate_moments(scene, sensor, *args, **options)

    def _prepare(self, scene: Any, sensor: Any, *, derivatives: bool) -> None:
        camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        self._camera_medium = camera.get_medium()
        self._follow_zero_weights = derivatives

    @dr.syntax
    def sample(  # noqa: PLR0915 -- a recorded loop cannot be split; its parts are the functions below
        self, mode: Any, scene: Any, sampler: Any, ray: Any, active: Any, state_in: Any = None, **options: Any
    ) -> Any:
        """Trace a path; in a differential pass, propagate derivatives from or to each vertex's outgoing radiance.

        ``state_in`` is the result of the primal path: its radiance ``L``, and the radiance ``L_blocked`` beyond
        its first weight of exactly 0. Each channel is ``unblocked`` up to that weight, which ``throughput``
        leaves out.
        """
        primal = mode == dr.ADMode.Primal
        delta_L = options.get("δL")
        moments: Any = options.get("moments")
        follow = self._follow_zero_weights
        media = _media_types(scene, self._camera_medium)
        has_delta_lobes = may_have_delta_lobes(scene)

        # Loop state
        ray = mi.Ray3f(dr.detach(ray))
        active = mi.Bool(active)
        medium = mi.MediumPtr(self._camera_medium)
        L = mi.Spectrum(0 if state_in is None else state_in[0])
        L_blocked = mi.Spectrum(0 if state_in is None else state_in[1])
        delta_L = mi.Spectrum(0 if delta_L is None else delta_L)
        throughput = mi.Spectrum(1)
        unblocked = throughput > 0
        eta = mi.Float(1)
        depth = mi.UInt32(0)
        valid_ray = mi.Bool(False)
        ref_prev = dr.zeros(mi.Interaction3f)
        pdf_prev = mi.Float(1)
        delta_prev = mi.Bool(True)

        while dr.hint(active, label=f"Volumetric path replay ({mode.name})"):
            si, length = _intersect(scene, ray, depth == 0, active, bool(self.hide_emitters))
            adjoint = delta_L if mode == dr.ADMode.Backward else mi.Spectrum(1)

            # Free flight to a scattering event in the medium, or to the surface
            flight, tangent = _sample_free_flight(
                mode,
                media,
                sampler,
                medium,
                ray,
                length=length,
                throughput=_sampling_throughput(throughput, unblocked),
                active=active,
                adjoint=adjoint * L,
            )
            with dr.resume_grad(when=not primal):
                flight_weight = _free_flight_weight(media, medium, flight)
                attached = dr.grad_enabled(flight_weight)
                detached_weight = dr.detach(flight_weight)
                if dr.hint(not primal, mode="scalar"):
                    delta_L += tangent
                    incident = _incident_over_weight(
                        L, L_blocked, detached_weight, detached_weight, unblocked
                    )
                    delta_L += _propagate(mode, adjoint * incident * flight_weight)
                flight_weight = detached_weight
            throughput, unblocked = _multiply_throughput(
                throughput * flight.null_weight, unblocked, detached_weight, follow
            )

            # The vertex: on a surface or in the medium
            not_last = depth + 1 < self.max_depth
            at_surface = active & ~flight.scattered
            in_medium = active & flight.scattered & not_last
            bsdf = si.bsdf(ray)
            surface_next = (
                at_surface & si.is_valid() & (not_last | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null))
            )
            vertex = Vertex(si, bsdf, throughput, at_surface, surface_next)
            phase = dr.select(in_medium, medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))
            scatter = MediumScatter(flight.mei, phase, in_medium)

            # Emitter sampling
            emitter_sample = _sample_emitter(
                media, scene, sampler, vertex, scatter, medium, surface_next & not_last
            )

            # BSDF or phase function sampling; the random numbers are kept to sample a delta lobe again
            random = sampler.next_1d(), sampler.next_2d()
            bsdf_sample, weight = bsdf.sample(mi.BSDFContext(), si, *random, surface_next)
            context = mi.PhaseFunctionContext()
            phase_wo, phase_weight, phase_pdf = phase.sample(context, scatter.mei, *random, in_medium)
            weight = dr.select(in_medium, phase_weight, weight)
            pdf = dr.select(in_medium, phase_pdf, bsdf_sample.pdf)

            # Emission and direct light
            visible = at_surface & ~((depth == 0) & mi.Bool(self.hide_emitters))
            Le = emitted_radiance(scene, vertex, visible, ref_prev, pdf_prev, delta_prev, primal)
            Lr_dir = _direct_light(scene, vertex, scatter, emitter_sample, primal)
            detached_sum, detached_Lr_dir = dr.detach(Le + Lr_dir), dr.detach(Lr_dir)

            # Accumulation, or differential phase
            if dr.hint(moments is not None, mode="scalar"):
                L -= dr.select(unblocked, detached_sum, 0)
                hit_emitter = mi.DirectionSample3f(scene, si=si, ref=ref_prev).emitter
                Lr_ind = dr.select(surface_next & ~is_rounding_error(L, state_in[0]), L, 0)
                moments.add(si, hit_emitter, Le, emitter_sample.ds.emitter, Lr_dir, Lr_ind)
            elif dr.hint(primal, mode="scalar"):
                L += dr.select(unblocked, detached_sum, 0)
                L_blocked += dr.select(unblocked, 0, detached_sum)
            else:
                L -= dr.select(unblocked, detached_sum, 0)
                with dr.resume_grad():
                    value = scattering_value(vertex, bsdf_sample, random, has_delta_lobes)
                    phase_value, _ = phase.eval_pdf(context, scatter.mei, phase_wo, in_medium)
                    value = dr.select(in_medium, phase_value, value)
                    incident = _incident_over_weight(L, L_blocked, dr.detach(value), weight, unblocked)
                    incident *= dr.select(weight == 0, dr.select(pdf > 0, dr.rcp(pdf), 0), 1)
                    Lo = dr.select(unblocked, Le + Lr_dir, 0) + incident * value
                    if dr.hint(not (attached or dr.grad_enabled(Lo)), mode="scalar"):
                        raise RuntimeError("the contribution is not attached to the AD graph")
                    delta_L += _propagate(mode, adjoint * Lo)
                # A nested loop cannot propagate derivatives while variables of this loop are attached.
                Le = Lr_dir = value = phase_value = Lo = detached_sum
                detached_Lr_dir = adjoint * dr.select(unblocked, detached_Lr_dir, 0)
                _, tangent = _shadow_transmittance(
                    mode, media, scene, emitter_sample.sampler, emitter_sample, detached_Lr_dir
                )
                delta_L += tangent

            # Next vertex; null interactions (index-matched boundaries, holes of masks) do not count as one
            is_null = surface_next & mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Null)
            scattered = (surface_next & ~is_null) | in_medium
            is_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
            is_delta = dr.select(in_medium, ~medium.use_emitter_sampling(), is_delta)
            ref_prev = dr.select(scattered, _vertex_interaction(scatter, si), ref_prev)
            pdf_prev = dr.select(scattered, pdf, pdf_prev)
            delta_prev = dr.select(scattered, is_delta, delta_prev)
            valid_ray |= active & (flight.scattered | (si.is_valid() & ~is_null))
            depth[scattered] += 1

            throughput, unblocked = _multiply_throughput(throughput, unblocked, weight, follow)
            eta[surface_next] *= bsdf_sample.eta
            ray = dr.select(
                in_medium, scatter.mei.spawn_ray(phase_wo), si.spawn_ray(si.to_world(bsdf_sample.wo))
            )
            enters = surface_next & si.is_medium_transition()
            medium = dr.select(enters, si.target_medium(ray.d), medium)

            # Russian roulette; η² undoes the scaling of radiance inside glass
            active = (surface_next | in_medium) & (depth < self.max_depth) & (pdf > 0)
            if dr.hint(primal, mode="scalar"):
                active &= dr.any(throughput != 0)
            else:
                active &= dr.any(unblocked & (throughput != 0))
            rr_prob = dr.minimum(dr.max(_sampling_throughput(throughput, unblocked)) * eta**2, 0.95)
            rr_active = depth > self.rr_depth
            throughput[rr_active] *= dr.rcp(rr_prob)
            active &= ~rr_active | (sampler.next_1d() < rr_prob)

        return L if primal else delta_L, valid_ray, [], (L, L_blocked)


def _media_types(scene: Any, camera_medium: Any) -> MediaTypes:
    """Return the kinds of media in the scene; shapes inside instances cannot be inspected."""
    shapes = scene.shapes()
    media = [m for shape in shapes for m in (shape.interior_medium(), shape.exterior_medium())]
    homogeneous = [m.is_homogeneous() for m in (*media, camera_medium) if m is not None]
    hidden = any(shape.class_name() == "Instance" for shape in shapes)
    return MediaTypes(hidden or any(homogeneous), hidden or not all(homogeneous))


def _intersect(scene: Any, ray: Any, first: Any, active: Any, hide_emitters: bool) -> tuple[Any, Any]:
    """Return the surface that the ray hits and its distance, skipping hidden emitters."""
    if not hide_emitters:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=first, active=active)
        return si, si.t
    start = skip_emitters(scene, ray, active & first)
    si = scene.ray_intersect(start, mi.RayFlags.All, coherent=first, active=active)
    return si, si.t + dr.dot(start.o - ray.o, ray.d)


def _sampling_throughput(throughput: Any, unblocked: Any) -> Any:
    """Return the throughput for sampling decisions: that of the unblocked channels, if there are any."""
    weight = dr.select(unblocked, throughput, 0)
    return dr.select(dr.any(weight != 0), weight, throughput)


def _multiply_throughput(throughput: Any, unblocked: Any, weight: Any, follow: bool) -> tuple[Any, Any]:
    """Multiply the throughput by a weight; with ``follow``, leave out each channel's first weight of 0."""
    if not follow:
        return throughput * weight, unblocked
    blocked_here = unblocked & (weight == 0)
    return throughput * dr.select(blocked_here, 1, weight), unblocked & ~blocked_here


def _incident_over_weight(L: Any, L_blocked: Any, value: Any, weight: Any, unblocked: Any) -> Any:
    """Return the factor of a weight's derivative: the radiance beyond it, without the weight itself."""
    radiance = dr.select(value != 0, L / value, 0)
    return dr.select(unblocked, dr.select(weight != 0, radiance, L_blocked), 0)


def _vertex_interaction(scatter: MediumScatter, si: Any) -> Any:
    """Return the vertex, on a surface or in a medium, as a plain interaction."""
    interaction = dr.zeros(mi.Interaction3f)
    interaction.p = dr.select(scatter.active, scatter.mei.p, si.p)
    interaction.n = dr.select(scatter.active, 0, si.n)
    interaction.t = dr.select(scatter.active, scatter.mei.t, si.t)
    interaction.time = si.time
    interaction.wavelengths = si.wavelengths
    return interaction


def _medium_interaction(medium: Any, ray: Any, t: Any) -> Any:
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.medium = medium
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.t = t
    mei.p = ray(t)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    return mei


def _channel_probabilities(throughput: Any) -> Any:
    """Return probabilities in proportion to the throughput, which keep path weights from growing."""
    total = dr.sum(dr.abs(throughput))
    return dr.select(total > 0, dr.abs(throughput) / total, 1 / len(throughput))


def _sample_free_flight(
    mode: Any,
    media: MediaTypes,
    sampler: Any,
    medium: Any,
    ray: Any,
    *,
    length: Any,
    throughput: Any,
    active: Any,
    adjoint: Any,
) -> tuple[FreeFlight, Any]:
    """Sample whether and where the ray scatters before ``length``.

    In a differential pass, ``adjoint`` times the relative derivative of the null collisions is propagated, and
    returned in forward mode.
    """
    inside = active & (medium != None)  # noqa: E711 -- an array of pointers
    length = dr.minimum(length, MAX_DISTANCE)
    t = mi.Float(length)
    scattered = mi.Bool(False)
    pdf = mi.Float(1)
    null_weight = mi.Spectrum(1)
    tangent = mi.Spectrum(0)

    homogeneous = inside & medium.is_homogeneous()
    if media.homogeneous:
        probability = _channel_probabilities(throughput)
        sigma_t = dr.maximum(
            medium.get_majorant(_medium_interaction(medium, ray, t), homogeneous),
            _min_interaction_rate(length),
        )
        sigma_t = dr.detach(sigma_t)
        channel_random, distance_random = sampler.next_2d()
        sampled_t = -dr.log(1 - distance_random) / _select_channel(sigma_t, probability, channel_random)
        t = dr.select(homogeneous, dr.minimum(sampled_t, length), t)
        scattered = homogeneous & (sampled_t < length)
        sampled_pdf = dr.sum(probability * dr.exp(-sigma_t * t) * dr.select(scattered, sigma_t, 1))
        pdf = dr.select(homogeneous, sampled_pdf, pdf)
    if media.heterogeneous:
        heterogeneous = inside & ~medium.is_homogeneous()
        tracked_t, is_real, tracked_pdf, null_weight, tangent = _delta_tracking(
            mode,
            sampler,
            medium,
            ray,
            length=length,
            throughput=throughput,
            active=heterogeneous,
            adjoint=adjoint,
        )
        t = dr.select(heterogeneous, tracked_t, t)
        scattered |= is_real
        pdf = dr.select(heterogeneous, tracked_pdf, pdf)

    return FreeFlight(_medium_interaction(medium, ray, t), inside, scattered, pdf, null_weight), tangent


def _free_flight_weight(media: MediaTypes, medium: Any, flight: FreeFlight) -> Any:
    """Return the weight of a free flight over its pdf, without its null collisions."""
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(flight.mei, flight.inside)
    weight = dr.select(flight.scattered, sigma_s, 1)
    if media.homogeneous:
        homogeneous = flight.inside & medium.is_homogeneous()
        weight *= dr.select(homogeneous, dr.exp(-sigma_t * flight.mei.t), 1)
    return dr.select(flight.inside, weight * dr.select(flight.pdf > 0, dr.rcp(flight.pdf), 0), 1)


def _propagate(mode: Any, contribution: Any) -> Any:
    """Propagate a contribution's derivative; return it in forward mode."""
    if not dr.grad_enabled(contribution):
        return mi.Spectrum(0)
    if mode == dr.ADMode.Forward:
        return dr.forward_to(contribution)
    dr.backward_from(contribution)
    return mi.Spectrum(0)


def _min_interaction_rate(length: Any) -> Any:
    """Return the rate at which a crossing has ``MIN_EXPECTED_INTERACTIONS``."""
    return MIN_EXPECTED_INTERACTIONS / dr.maximum(length, 1 / MAX_DISTANCE)


def _select_channel(values: Any, probability: Any, random: Any) -> Any:
    """Return one of the values, sampled with the given probabilities."""
    selected = values[0]
    cdf = probability[0]
    for value, part in zip(values[1:], probability[1:], strict=True):
        selected = dr.select(random < cdf, selected, value)
        cdf = cdf + part  # not in place, which would change the probabilities
    return selected


def _medium_segment(medium: Any, ray: Any, length: Any, active: Any) -> tuple[Any, Any, Any]:
    """Return where the ray enters and leaves the medium's bounding box, and the majorant between."""
    hits, near, far = medium.intersect_aabb(ray)
    near = dr.maximum(near, 0)
    far = dr.minimum(far, length)
    far = dr.select(hits & active, far, near)
    greatest = dr.max(medium.get_majorant(_medium_interaction(medium, ray, near), active))
    majorant = dr.maximum(MAJORANT_FACTOR * greatest, _min_interaction_rate(far - near))
    return near, far, dr.detach(majorant)


@dr.syntax
def _delta_tracking(
    mode: Any, sampler: Any, medium: Any, ray: Any, *, length: Any, throughput: Any, active: Any, adjoint: Any
) -> Any:
    """Sample tentative collisions until one is real or the ray leaves the medium."""
    near, far, majorant = _medium_segment(medium, ray, length, active)
    min_probability = dr.minimum(0.5, _min_interaction_rate(far - near) / majorant)
    t = mi.Float(near)
    is_real = mi.Bool(False)
    pdf = mi.Float(1)
    null_weight = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    tracking = mi.Bool(active)
    while dr.hint(tracking, label=f"Delta tracking ({mode.name})"):
        t -= dr.log(1 - sampler.next_1d()) / majorant
        tracking &= t < far
        mei = _medium_interaction(medium, ray, t)
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            _, _, sigma_t = medium.get_scattering_coefficients(mei, tracking)
            null_probability = 1 - sigma_t / majorant
            real_probability = dr.detach(
                dr.sum(_channel_probabilities(throughput * null_weight) * (1 - null_probability))
            )
            probability = dr.clip(real_probability, min_probability, 0.9)
            is_real = tracking & (sampler.next_1d() < probability)
            tracking &= ~is_real
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(
                    mode, dr.select(tracking, adjoint * dr.relative_grad(null_probability), 0)
                )
        pdf = dr.select(is_real, majorant * probability, pdf)
        null_weight *= dr.select(tracking, dr.detach(null_probability) / (1 - probability), 1)
    return t, is_real, pdf, null_weight, tangent


def _sample_emitter(
    media: MediaTypes,
    scene: Any,
    sampler: Any,
    vertex: Vertex,
    scatter: MediumScatter,
    medium: Any,
    at_surface: Any,
) -> EmitterSample:
    """Sample an emitter for next-event estimation at the surface or in the medium."""
    at_surface = at_surface & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
    active = at_surface | (scatter.active & medium.use_emitter_sampling())
    ref = _vertex_interaction(scatter, vertex.si)
    ds, weight = scene.sample_emitter_direction(ref, sampler.next_2d(), False, active)
    active &= ds.pdf != 0
    enters = at_surface & vertex.si.is_medium_transition()
    medium = dr.select(enters, vertex.si.target_medium(ds.d), medium)
    sample = EmitterSample(ref, ds, weight, medium, active, mi.Spectrum(1), sampler.clone())
    sample.transmittance, _ = _shadow_transmittance(
        dr.ADMode.Primal, media, scene, sampler, sample, mi.Spectrum(0)
    )
    return sample


def _direct_light(
    scene: Any, vertex: Vertex, scatter: MediumScatter, sample: EmitterSample, primal: bool
) -> Any:
    """Return ``Lr_dir``, the light of the sampled emitter that the surface or the medium scatters."""
    with dr.resume_grad(when=not primal):
        emitter_weight = sample.weight
        if not primal:
            attached = scene.eval_emitter_direction(sample.ref, sample.ds, sample.active)
            emitter_weight = dr.select(sample.active, attached / dr.detach(sample.ds.pdf), 0)
        wo = vertex.si.to_local(sample.ds.d)
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si, wo, sample.active & ~scatter.active)
        context = mi.PhaseFunctionContext(None)
        phase_value, phase_pdf = scatter.phase.eval_pdf(
            context, scatter.mei, sample.ds.d, sample.active & scatter.active
        )
        value = dr.select(scatter.active, phase_value, value)
        pdf = dr.select(scatter.active, phase_pdf, pdf)
        mis = dr.detach(dr.select(sample.ds.delta, 1, mis_weight(sample.ds.pdf, pdf)))
        Lr_dir = vertex.throughput * mis * value * emitter_weight * sample.transmittance
        return dr.select(sample.active, Lr_dir, 0)


@dr.syntax
def _shadow_transmittance(
    mode: Any, media: MediaTypes, scene: Any, sampler: Any, sample: EmitterSample, adjoint: Any
) -> Any:
    """Return the transmittance to the emitter through media, masks and index-matched boundaries.

    In a differential pass, ``adjoint`` times its relative derivative is propagated.
    """
    target = sample.ds.p
    ray = sample.ref.spawn_ray_to(target)
    medium = sample.medium
    transmittance = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    active = mi.Bool(sample.active)
    while dr.hint(active, label=f"Shadow ray ({mode.name})"):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = active & si.is_valid()
        length = dr.minimum(si.t, ray.maxt)
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            factor = dr.select(hit, si.bsdf().eval_null_transmission(si, hit), 1)
            unoccluded = active & dr.any(factor != 0)
            inside = unoccluded & (medium != None)  # noqa: E711 -- an array of pointers
            if dr.hint(media.homogeneous, mode="scalar"):
                homogeneous = inside & medium.is_homogeneous()
                sigma_t = medium.get_majorant(_medium_interaction(medium, ray, length), homogeneous)
                factor *= dr.select(homogeneous, dr.exp(-sigma_t * length), 1)
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(mode, dr.select(active, adjoint * dr.relative_grad(factor), 0))
            factor = dr.detach(factor)
        transmittance *= dr.select(active, factor, 1)
        if dr.hint(media.heterogeneous, mode="scalar"):
            heterogeneous = inside & ~medium.is_homogeneous()
            estimate, change = _ratio_tracking(mode, sampler, medium, ray, length, heterogeneous, adjoint)
            transmittance *= estimate
            tangent += change
        active = unoccluded & hit & dr.any(transmittance != 0)
        enters = active & si.is_medium_transition()
        medium = dr.select(enters, si.target_medium(ray.d), medium)
        ray = dr.select(active, si.spawn_ray_to(target), ray)
    return transmittance, tangent


@dr.syntax
def _ratio_tracking(
    mode: Any, sampler: Any, medium: Any, ray: Any, length: Any, active: Any, adjoint: Any
) -> Any:
    """Estimate the transmittance as the product of the null-collision probabilities at tentative collisions."""
    near, far, majorant = _medium_segment(medium, ray, length, active)
    t = mi.Float(near)
    transmittance = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    tracking = mi.Bool(active)
    while dr.hint(tracking, label=f"Ratio tracking ({mode.name})"):
        t -= dr.log(1 - sampler.next_1d()) / majorant
        tracking &= t < far
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            _, _, sigma_t = medium.get_scattering_coefficients(_medium_interaction(medium, ray, t), tracking)
            null_probability = dr.select(tracking, 1 - sigma_t / majorant, 1)
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(
                    mode, dr.select(tracking, adjoint * dr.relative_grad(null_probability), 0)
                )
        transmittance *= dr.detach(null_probability)
    return transmittance, tangent


mi.register_integrator("scenecaptum_volumetric_replay", VolumetricReplayIntegrator)
