"""Path replay through fog, smoke and other participating media.

Imported only once a variant is active (see ``SceneRenderer``).

Surfaces are treated as in ``_integrator``. What a ray meets inside a medium is sampled so that derivatives keep a
bounded variance where there is nothing to scatter: every crossing of a medium has some chance of an interaction,
even at density 0, and null collisions never lose all their weight. Transmittance through a homogeneous medium is
known exactly. Where a path has a weight of exactly 0 (a black albedo, an empty voxel), it is followed further:
the derivative of that weight multiplies what lies beyond.

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

from ._backward import ChoosingIntegrator
from ._integrator import (
    Vertex,
    _beyond_emitters,
    _emitted,
    _is_rounding,
    _may_be_specular,
    _scattering,
)

# Expected interactions that a crossing of a medium is given at least. The in-scattered part of the derivative by
# density is carried by interactions alone: at a density of 0 a sampler without this would never see it.
CHANCE = 0.1

# How far the rate of tentative collisions lies above the greatest density. The derivative of a null collision's
# weight 1 - q is -1 / (1 - q): at a margin of 1 it would grow without bound in the densest voxel.
MARGIN = 1.25

# Beyond every scene; a finite stand-in for a ray's endless length, which would make 0 · ∞ of a clear medium.
FAR = 1e20


@dataclass
class Media:
    """Which kinds of media a scene holds, so that no other is traced."""

    homogeneous: bool
    heterogeneous: bool


@dataclass
class Flight:
    """How far a ray got in a medium: to a scattering event, or through to the surface.

    ``density`` is the probability density of that, ``passed`` the weight of the null collisions on the way.
    """

    event: Any
    inside: Any
    scattered: Any
    density: Any
    passed: Any


@dataclass
class Fog:
    """A scattering event in a medium."""

    event: Any
    phase: Any
    active: Any


@dataclass
class Lamp:
    """A sampled emitter, how much of its light arrives, and the random numbers that this was found with."""

    place: Any
    light: Any
    incoming: Any
    medium: Any
    active: Any
    clear: Any
    numbers: Any


class VolumetricReplayIntegrator(ChoosingIntegrator):
    """Volumetric path tracer with emitter sampling whose derivative passes replay the primal's paths.

    Parameters are those of ``volpath``: ``max_depth``, ``rr_depth``, ``hide_emitters``.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self._around_camera: Any = None
        self._for_derivatives = False

    def render(self, scene: Any, sensor: Any = 0, *args: Any, **options: Any) -> Any:
        """Render, starting in the medium that the camera stands in."""
        self._prepare(scene, sensor, derivatives=False)
        return super().render(scene, sensor, *args, **options)

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, *args: Any, **options: Any) -> Any:
        """Carry the tangents of the tracked parameters to an image."""
        self._prepare(scene, sensor, derivatives=True)
        return super().render_forward(scene, params, sensor, *args, **options)

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, *args: Any, **options: Any
    ) -> None:
        """Carry the adjoint of an image to the tracked parameters."""
        self._prepare(scene, sensor, derivatives=True)
        super().render_backward(scene, params, grad_in, sensor, *args, **options)

    def propagate(self, scene: Any, sensor: Any, *args: Any, **options: Any) -> None:
        """Carry an adjoint image to the tracked parameters, from samples of given pixels."""
        self._prepare(scene, sensor, derivatives=True)
        super().propagate(scene, sensor, *args, **options)

    def count(self, scene: Any, sensor: Any, *args: Any, **options: Any) -> Any:
        """Count the light of vertices for a pilot."""
        self._prepare(scene, sensor, derivatives=True)
        return super().count(scene, sensor, *args, **options)

    def _prepare(self, scene: Any, sensor: Any, *, derivatives: bool) -> None:
        camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        self._around_camera = camera.get_medium()
        self._for_derivatives = derivatives

    @dr.syntax
    def sample(  # noqa: PLR0915 -- a recorded loop cannot be split; its parts are the functions below
        self, mode: Any, scene: Any, sampler: Any, ray: Any, active: Any, state_in: Any = None, **options: Any
    ) -> Any:
        """Trace a path; in a derivative pass, propagate from or to the radiance that each vertex sends on.

        ``state_in`` is what the primal path found: its radiance, and the radiance that a weight of exactly 0 kept
        from it. Each channel is ``lit`` until the first such weight, which ``throughput`` leaves out.
        """
        primal = mode == dr.ADMode.Primal
        given = options.get("δL")
        counter: Any = options.get("counter")
        follow = self._for_derivatives
        media = _media(scene, self._around_camera)
        specular = _may_be_specular(scene)

        ray = mi.Ray3f(dr.detach(ray))
        active = mi.Bool(active)
        medium = mi.MediumPtr(self._around_camera)
        radiance = mi.Spectrum(0 if state_in is None else state_in[0])
        lost = mi.Spectrum(0 if state_in is None else state_in[1])
        derivative = mi.Spectrum(0 if given is None else given)
        throughput = mi.Spectrum(1)
        lit = throughput > 0
        eta = mi.Float(1)
        depth = mi.UInt32(0)
        hit_anything = mi.Bool(False)
        previous = dr.zeros(mi.Interaction3f)
        previous_pdf = mi.Float(1)
        previous_specular = mi.Bool(True)

        while dr.hint(active, label=f"Volumetric path replay ({mode.name})"):
            si, length = _intersect(scene, ray, depth == 0, active, bool(self.hide_emitters))
            adjoint = derivative if mode == dr.ADMode.Backward else mi.Spectrum(1)

            # To a scattering event in the medium, or to the surface.
            chances = _chances(throughput, lit)
            flight, tangent = _fly(
                mode,
                media,
                sampler,
                medium,
                ray,
                length=length,
                throughput=chances,
                active=active,
                adjoint=adjoint * radiance,
            )
            with dr.resume_grad(when=not primal):
                passage = _passage(media, medium, flight)
                attached = dr.grad_enabled(passage)
                reached = dr.detach(passage)
                if dr.hint(not primal, mode="scalar"):
                    derivative += tangent
                    beyond = _beyond(radiance, lost, reached, reached, lit)
                    derivative += _propagate(mode, adjoint * beyond * passage)
                passage = reached
            throughput, lit = _pass_on(throughput * flight.passed, lit, reached, follow)

            deeper = depth + 1 < self.max_depth
            at_surface = active & ~flight.scattered
            in_medium = active & flight.scattered & deeper
            bsdf = si.bsdf(ray)
            goes_on = at_surface & si.is_valid() & (deeper | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null))
            vertex = Vertex(si, bsdf, throughput, at_surface, goes_on)
            phase = dr.select(in_medium, medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))
            fog = Fog(flight.event, phase, in_medium)

            lamp = _sample_light(media, scene, sampler, vertex, fog, medium, goes_on & deeper)
            # Drawn once, since a specular lobe is sampled again for its derivative.
            numbers = sampler.next_1d(), sampler.next_2d()
            direction, weight = bsdf.sample(mi.BSDFContext(), si, *numbers, goes_on)
            context = mi.PhaseFunctionContext()
            toward, phase_weight, phase_pdf = phase.sample(context, fog.event, *numbers, in_medium)
            weight = dr.select(in_medium, phase_weight, weight)
            pdf = dr.select(in_medium, phase_pdf, direction.pdf)

            shown = at_surface & ~((depth == 0) & mi.Bool(self.hide_emitters))
            emitted = _emitted(scene, vertex, shown, previous, previous_pdf, previous_specular, primal)
            reflected = _reflected(scene, vertex, fog, lamp, primal)
            found, lighting = dr.detach(emitted + reflected), dr.detach(reflected)
            if dr.hint(counter is not None, mode="scalar"):
                radiance -= dr.select(lit, found, 0)
                met = mi.DirectionSample3f(scene, si=si, ref=previous).emitter
                later = dr.select(goes_on & ~_is_rounding(radiance, state_in[0]), radiance, 0)
                counter.add(si, met, emitted, lamp.light.emitter, reflected, later)
            elif dr.hint(primal, mode="scalar"):
                radiance += dr.select(lit, found, 0)
                lost += dr.select(lit, 0, found)
            else:
                radiance -= dr.select(lit, found, 0)
                with dr.resume_grad():
                    scattering = _scattering(vertex, direction, numbers, specular)
                    value, _ = phase.eval_pdf(context, fog.event, toward, in_medium)
                    scattering = dr.select(in_medium, value, scattering)
                    later = _beyond(radiance, lost, dr.detach(scattering), weight, lit)
                    later *= dr.select(weight == 0, dr.select(pdf > 0, dr.rcp(pdf), 0), 1)
                    total = dr.select(lit, emitted + reflected, 0) + later * scattering
                    if dr.hint(not (attached or dr.grad_enabled(total)), mode="scalar"):
                        raise RuntimeError("the contribution is not attached to the AD graph")
                    derivative += _propagate(mode, adjoint * total)
                # A loop inside this one cannot propagate while derivatives of this one's are at hand.
                emitted = reflected = scattering = value = total = found
                lighting = adjoint * dr.select(lit, lighting, 0)
                _, tangent = _shadow(mode, media, scene, lamp.numbers, lamp, lighting)
                derivative += tangent

            # Index-matched boundaries and masks that let pass count neither as a vertex nor for sampling weights.
            straight = goes_on & mi.has_flag(direction.sampled_type, mi.BSDFFlags.Null)
            turned = (goes_on & ~straight) | in_medium
            is_specular = mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
            is_specular = dr.select(in_medium, ~medium.use_emitter_sampling(), is_specular)
            previous = dr.select(turned, _place(fog, si), previous)
            previous_pdf = dr.select(turned, pdf, previous_pdf)
            previous_specular = dr.select(turned, is_specular, previous_specular)
            hit_anything |= active & (flight.scattered | (si.is_valid() & ~straight))
            depth[turned] += 1

            throughput, lit = _pass_on(throughput, lit, weight, follow)
            eta[goes_on] *= direction.eta
            ray = dr.select(in_medium, fog.event.spawn_ray(toward), si.spawn_ray(si.to_world(direction.wo)))
            crossed = goes_on & si.is_medium_transition()
            medium = dr.select(crossed, si.target_medium(ray.d), medium)

            # Deep paths end at random; η² undoes the compression of radiance inside glass.
            active = (goes_on | in_medium) & (depth < self.max_depth) & (pdf > 0)
            if dr.hint(primal, mode="scalar"):
                active &= dr.any(throughput != 0)
            else:
                active &= dr.any(lit & (throughput != 0))
            survival = dr.minimum(dr.max(_chances(throughput, lit)) * eta**2, 0.95)
            roulette = depth > self.rr_depth
            throughput[roulette] *= dr.rcp(survival)
            active &= ~roulette | (sampler.next_1d() < survival)

        return radiance if primal else derivative, hit_anything, [], (radiance, lost)


def _media(scene: Any, around_camera: Any) -> Media:
    """Find out what kinds of media the scene holds; what an instance shows is not among the shapes."""
    shapes = scene.shapes()
    media = [m for shape in shapes for m in (shape.interior_medium(), shape.exterior_medium())]
    homogeneous = [m.is_homogeneous() for m in (*media, around_camera) if m is not None]
    hidden = any(shape.class_name() == "Instance" for shape in shapes)
    return Media(hidden or any(homogeneous), hidden or not all(homogeneous))


def _intersect(scene: Any, ray: Any, first: Any, active: Any, hide_emitters: bool) -> tuple[Any, Any]:
    """Return the surface that the ray meets and how far it is, looking through lights that are hidden."""
    if not hide_emitters:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=first, active=active)
        return si, si.t
    start = _beyond_emitters(scene, ray, active & first)
    si = scene.ray_intersect(start, mi.RayFlags.All, coherent=first, active=active)
    return si, si.t + dr.dot(start.o - ray.o, ray.d)


def _chances(throughput: Any, lit: Any) -> Any:
    """Return the throughput that random choices go by: that of the lit channels, if there are any."""
    weight = dr.select(lit, throughput, 0)
    return dr.select(dr.any(weight != 0), weight, throughput)


def _pass_on(throughput: Any, lit: Any, weight: Any, follow: bool) -> tuple[Any, Any]:
    """Multiply the throughput by a weight, leaving out each lit channel's first weight of 0 if asked to."""
    if not follow:
        return throughput * weight, lit
    out = lit & (weight == 0)
    return throughput * dr.select(out, 1, weight), lit & ~out


def _beyond(rest: Any, lost: Any, value: Any, weight: Any, lit: Any) -> Any:
    """Return what the derivative of a factor multiplies: all that the path finds beyond it."""
    whole = dr.select(value != 0, rest / value, 0)
    return dr.select(lit, dr.select(weight != 0, whole, lost), 0)


def _place(fog: Fog, si: Any) -> Any:
    """Return where the path turns, as a plain interaction."""
    place = dr.zeros(mi.Interaction3f)
    place.p = dr.select(fog.active, fog.event.p, si.p)
    place.n = dr.select(fog.active, 0, si.n)
    place.t = dr.select(fog.active, fog.event.t, si.t)
    place.time = si.time
    place.wavelengths = si.wavelengths
    return place


def _event(medium: Any, ray: Any, t: Any) -> Any:
    """Return an interaction with the medium."""
    event = dr.zeros(mi.MediumInteraction3f)
    event.medium = medium
    event.wi = -ray.d
    event.sh_frame = mi.Frame3f(event.wi)
    event.t = t
    event.p = ray(t)
    event.time = ray.time
    event.wavelengths = ray.wavelengths
    return event


def _shares(throughput: Any) -> Any:
    """Return the part of each channel in the throughput: a choice by them keeps weights from growing."""
    total = dr.sum(dr.abs(throughput))
    return dr.select(total > 0, dr.abs(throughput) / total, 1 / len(throughput))


def _fly(
    mode: Any,
    media: Media,
    sampler: Any,
    medium: Any,
    ray: Any,
    *,
    length: Any,
    throughput: Any,
    active: Any,
    adjoint: Any,
) -> tuple[Flight, Any]:
    """Sample whether and where the ray is scattered before ``length``.

    In a derivative pass, ``adjoint`` times the relative derivative of the null collisions is propagated here, and
    returned in forward mode.
    """
    inside = active & (medium != None)  # noqa: E711 -- an array of pointers
    length = dr.minimum(length, FAR)
    t = mi.Float(length)
    scattered = mi.Bool(False)
    density = mi.Float(1)
    passed = mi.Spectrum(1)
    tangent = mi.Spectrum(0)

    uniform = inside & medium.is_homogeneous()
    if media.homogeneous:
        share = _shares(throughput)
        rate = dr.maximum(medium.get_majorant(_event(medium, ray, t), uniform), _least_rate(length))
        rate = dr.detach(rate)
        choice, number = sampler.next_2d()
        sampled = -dr.log(1 - number) / _choose(rate, share, choice)
        t = dr.select(uniform, dr.minimum(sampled, length), t)
        scattered = uniform & (sampled < length)
        pdf = dr.sum(share * dr.exp(-rate * t) * dr.select(scattered, rate, 1))
        density = dr.select(uniform, pdf, density)
    if media.heterogeneous:
        varied = inside & ~medium.is_homogeneous()
        t_varied, real, chance, passed, tangent = _track(
            mode, sampler, medium, ray, length=length, throughput=throughput, active=varied, adjoint=adjoint
        )
        t = dr.select(varied, t_varied, t)
        scattered |= real
        density = dr.select(varied, chance, density)

    return Flight(_event(medium, ray, t), inside, scattered, density, passed), tangent


def _passage(media: Media, medium: Any, flight: Flight) -> Any:
    """Return the weight of the flight over its probability density, null collisions apart."""
    scattering, _, extinction = medium.get_scattering_coefficients(flight.event, flight.inside)
    weight = dr.select(flight.scattered, scattering, 1)
    if media.homogeneous:
        uniform = flight.inside & medium.is_homogeneous()
        weight *= dr.select(uniform, dr.exp(-extinction * flight.event.t), 1)
    return dr.select(flight.inside, weight * dr.select(flight.density > 0, dr.rcp(flight.density), 0), 1)


def _propagate(mode: Any, change: Any) -> Any:
    """Propagate a contribution's derivative, and return it in forward mode."""
    if not dr.grad_enabled(change):
        return mi.Spectrum(0)
    if mode == dr.ADMode.Forward:
        return dr.forward_to(change)
    dr.backward_from(change)
    return mi.Spectrum(0)


def _least_rate(length: Any) -> Any:
    """Return the rate of interactions that gives a crossing its chance of one."""
    return CHANCE / dr.maximum(length, 1 / FAR)


def _choose(values: Any, share: Any, number: Any) -> Any:
    """Choose one of the values with probabilities ``share``."""
    chosen = values[0]
    below = share[0]
    for value, part in zip(values[1:], share[1:], strict=True):
        chosen = dr.select(number < below, chosen, value)
        below = below + part  # not in place: that would change the shares
    return chosen


def _span(medium: Any, ray: Any, length: Any, active: Any) -> tuple[Any, Any, Any]:
    """Return where the ray is within the bounds of the medium's data, and the rate of tentative collisions."""
    meets, near, far = medium.intersect_aabb(ray)
    near = dr.maximum(near, 0)
    far = dr.minimum(far, length)
    far = dr.select(meets & active, far, near)
    most = dr.max(medium.get_majorant(_event(medium, ray, near), active))
    rate = dr.maximum(MARGIN * most, _least_rate(far - near))
    return near, far, dr.detach(rate)


@dr.syntax
def _track(
    mode: Any, sampler: Any, medium: Any, ray: Any, *, length: Any, throughput: Any, active: Any, adjoint: Any
) -> Any:
    """Walk from one tentative collision to the next until one is real or the medium is left."""
    near, far, rate = _span(medium, ray, length, active)
    least = dr.minimum(0.5, _least_rate(far - near) / rate)
    t = mi.Float(near)
    real = mi.Bool(False)
    chance = mi.Float(1)
    passed = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    walking = mi.Bool(active)
    while dr.hint(walking, label=f"Tracking ({mode.name})"):
        t -= dr.log(1 - sampler.next_1d()) / rate
        walking &= t < far
        event = _event(medium, ray, t)
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            _, _, extinction = medium.get_scattering_coefficients(event, walking)
            missed = 1 - extinction / rate
            part = dr.detach(dr.sum(_shares(throughput * passed) * (1 - missed)))
            probability = dr.clip(part, least, 0.9)
            real = walking & (sampler.next_1d() < probability)
            walking &= ~real
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(mode, dr.select(walking, adjoint * dr.relative_grad(missed), 0))
        chance = dr.select(real, rate * probability, chance)
        passed *= dr.select(walking, dr.detach(missed) / (1 - probability), 1)
    return t, real, chance, passed, tangent


def _sample_light(
    media: Media, scene: Any, sampler: Any, vertex: Vertex, fog: Fog, medium: Any, at_surface: Any
) -> Lamp:
    """Sample an emitter whose light the surface or the medium may turn towards the camera."""
    at_surface = at_surface & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
    active = at_surface | (fog.active & medium.use_emitter_sampling())
    place = _place(fog, vertex.si)
    light, incoming = scene.sample_emitter_direction(place, sampler.next_2d(), False, active)
    active &= light.pdf != 0
    crosses = at_surface & vertex.si.is_medium_transition()
    medium = dr.select(crosses, vertex.si.target_medium(light.d), medium)
    lamp = Lamp(place, light, incoming, medium, active, mi.Spectrum(1), sampler.clone())
    lamp.clear, _ = _shadow(dr.ADMode.Primal, media, scene, sampler, lamp, mi.Spectrum(0))
    return lamp


def _reflected(scene: Any, vertex: Vertex, fog: Fog, lamp: Lamp, primal: bool) -> Any:
    """Return the light of the sampled emitter that the surface or the medium turns towards the camera."""
    with dr.resume_grad(when=not primal):
        incoming = lamp.incoming
        if not primal:
            attached = scene.eval_emitter_direction(lamp.place, lamp.light, lamp.active)
            incoming = dr.select(lamp.active, attached / dr.detach(lamp.light.pdf), 0)
        wo = vertex.si.to_local(lamp.light.d)
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.si, wo, lamp.active & ~fog.active)
        context = mi.PhaseFunctionContext(None)
        phase_value, phase_pdf = fog.phase.eval_pdf(
            context, fog.event, lamp.light.d, lamp.active & fog.active
        )
        value = dr.select(fog.active, phase_value, value)
        pdf = dr.select(fog.active, phase_pdf, pdf)
        weight = dr.detach(dr.select(lamp.light.delta, 1, mis_weight(lamp.light.pdf, pdf)))
        return dr.select(lamp.active, vertex.throughput * weight * value * incoming * lamp.clear, 0)


@dr.syntax
def _shadow(mode: Any, media: Media, scene: Any, sampler: Any, lamp: Lamp, adjoint: Any) -> Any:
    """Return how much of the light arrives through media, masks and index-matched boundaries.

    In a derivative pass, ``adjoint`` times the relative derivative of that is propagated.
    """
    target = lamp.light.p
    ray = lamp.place.spawn_ray_to(target)
    medium = lamp.medium
    clear = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    active = mi.Bool(lamp.active)
    while dr.hint(active, label=f"Shadow ray ({mode.name})"):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        blocked = active & si.is_valid()
        length = dr.minimum(si.t, ray.maxt)
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            factor = dr.select(blocked, si.bsdf().eval_null_transmission(si, blocked), 1)
            open_way = active & dr.any(factor != 0)
            inside = open_way & (medium != None)  # noqa: E711 -- an array of pointers
            if dr.hint(media.homogeneous, mode="scalar"):
                uniform = inside & medium.is_homogeneous()
                extinction = medium.get_majorant(_event(medium, ray, length), uniform)
                factor *= dr.select(uniform, dr.exp(-extinction * length), 1)
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(mode, dr.select(active, adjoint * dr.relative_grad(factor), 0))
            factor = dr.detach(factor)
        clear *= dr.select(active, factor, 1)
        if dr.hint(media.heterogeneous, mode="scalar"):
            varied = inside & ~medium.is_homogeneous()
            passed, change = _ratio(mode, sampler, medium, ray, length, varied, adjoint)
            clear *= passed
            tangent += change
        active = open_way & blocked & dr.any(clear != 0)
        crossed = active & si.is_medium_transition()
        medium = dr.select(crossed, si.target_medium(ray.d), medium)
        ray = dr.select(active, si.spawn_ray_to(target), ray)
    return clear, tangent


@dr.syntax
def _ratio(mode: Any, sampler: Any, medium: Any, ray: Any, length: Any, active: Any, adjoint: Any) -> Any:
    """Estimate the transmittance by the chances of passing at each tentative collision."""
    near, far, rate = _span(medium, ray, length, active)
    t = mi.Float(near)
    passed = mi.Spectrum(1)
    tangent = mi.Spectrum(0)
    walking = mi.Bool(active)
    while dr.hint(walking, label=f"Ratio tracking ({mode.name})"):
        t -= dr.log(1 - sampler.next_1d()) / rate
        walking &= t < far
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            _, _, extinction = medium.get_scattering_coefficients(_event(medium, ray, t), walking)
            missed = dr.select(walking, 1 - extinction / rate, 1)
            if dr.hint(mode != dr.ADMode.Primal, mode="scalar"):
                tangent += _propagate(mode, dr.select(walking, adjoint * dr.relative_grad(missed), 0))
        passed *= dr.detach(missed)
    return passed, tangent


mi.register_integrator("scenecaptum_volumetric_replay", VolumetricReplayIntegrator)
