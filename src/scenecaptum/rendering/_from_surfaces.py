"""Derivatives of a material from samples that start on its surface, where light and importance meet.

Imported only once a variant is active (see ``SceneRenderer``).

Path replay finds a surface that the camera does not see by chance, and the lamp in its reflection by chance again;
while the derivative with respect to a low roughness is large, of one sign in the middle of the lobe and of the
other around it, and cancels only over many samples of the lobe. Here a point of the surface is chosen and a
direction from which light reaches it. Then the lobe is sampled in strata, and each sample goes on as a particle
that is connected to the camera from every surface that it meets.

What the camera sees of the surface, directly or by specular reflection, no particle can find: that is left to path
replay, which ends its paths at the first vertex where they are scattered otherwise.

References
----------
Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997, chapter 5 (particles, shading normals).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene._graph import SceneGraph
from ._backward import read_adjoint
from ._plan import RenderPlan
from ._sampler import SobolSampler

STRATA = 16  # of a lobe; a square number
PARTICLES = 2  # for each sample of path replay, by light straight from emitters and by other light alike
CAMERAS = ("PerspectiveCamera", "ThinLensCamera")  # which particles can be connected to


@dataclass
class Surfaces:
    """Shapes to start from, and how often, in Dr.Jit arrays.

    Attributes
    ----------
    index
        Their places in ``scene.shapes()``.
    until
        The share of all samples that start on this shape or on one before it.
    density
        The share of all samples that start on a unit of its area.
    among
        For each number that Dr.Jit gives a shape, whether it is one of these.
    """

    index: mi.UInt32
    until: mi.Float
    density: mi.Float
    among: mi.Bool


def find_surfaces(
    graph: SceneGraph, worn: Sequence[Collection[str]], sensor: Any, plan: RenderPlan, names: Sequence[str]
) -> Surfaces | None:
    """Return the shapes that show any of the parameters, each parameter as often as the others.

    ``worn`` are the parameters that each shape of the scene shows. None is returned where a particle cannot be
    connected to the camera, where a shape cannot be sampled, or where a bump or normal map lets light pass
    otherwise in one direction than in the other.
    """
    film = sensor.film()
    if (
        plan.integrator != "scenecaptum_replay"
        or plan.hide_emitters
        or sensor.class_name() not in CAMERAS
        or list(film.size()) != list(film.crop_size())
        or graph.class_names() & {"Instance", "BumpMap", "NormalMap"}
    ):
        return None
    shapes = graph.scene.shapes()
    areas, shares = np.ones(len(shapes)), np.zeros(len(shapes))
    for name in names:
        showing = [k for k in range(len(shapes)) if name in worn[k]]
        try:
            areas[showing] = [_area(shapes[k]) for k in showing]
        except (RuntimeError, NotImplementedError):
            return None
        if showing:
            shares[showing] += areas[showing] / areas[showing].sum()
    index = np.flatnonzero(shares)
    if not len(index):
        return None
    numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shapes[k]))[0]) for k in index]
    among = np.zeros(max(numbers) + 1, bool)
    among[numbers] = True
    shares = shares[index] / shares.sum()
    return Surfaces(
        mi.UInt32(index), mi.Float(shares.cumsum()), mi.Float(shares / areas[index]), mi.Bool(among)
    )


def _area(shape: Any) -> float:
    """Return a shape's area, from the density of a sampled point; raises where points cannot be sampled."""
    return float(1 / shape.sample_position(0.0, mi.Point2f(0.5)).pdf[0])


@dataclass
class Starts:
    """Points of surfaces and, for each, a direction from which light reaches it.

    ``light`` holds for each start the radiance that arrives from there by at most 1, 2, … ``lengths`` segments,
    divided by the density of the start.
    """

    si: Any
    incoming: Any
    lit: Any
    light: Any
    lengths: int


@dataclass
class Receiver:
    """What a particle is worth: a sensor, the adjoint of its picture, and its film's filter.

    ``adjoint`` and ``profile`` are those of ``ChoosingIntegrator.propagate``.
    """

    sensor: Any
    adjoint: Any
    profile: tuple[Any, int]


def propagate_from_surfaces(
    integrator: Any, scene: Any, receiver: Receiver, surfaces: Surfaces, seed: Any, samples: int
) -> None:
    """Carry an adjoint to the tracked parameters of surfaces, for all that path replay leaves out.

    Parameters
    ----------
    integrator
        A ``ReplayIntegrator``.
    receiver
        Where particles are received.
    surfaces
        Where to start.
    seed
        Seed of the samples.
    samples
        How many samples path replay takes.
    """
    count = max(1, PARTICLES * samples // STRATA)
    with dr.suspend_grad():
        for number, lit in enumerate((_lit_by_emitters, _lit_by_surfaces)):
            sampler = SobolSampler.of(count, _another(seed, 2 * number))
            start = _point(scene, receiver.sensor, surfaces, sampler, count)
            starts = lit(integrator, scene, start, sampler)
            dr.eval(starts)
            sampler = SobolSampler.of(count * STRATA, _another(seed, 2 * number + 1))
            _propagate(integrator, scene, receiver, sampler, starts)
            dr.eval()


def _lit_by_emitters(integrator: Any, scene: Any, start: Any, sampler: SobolSampler) -> Starts:
    """Choose directions from which an emitter shines on points of surfaces."""
    si, density, found = start
    lamp, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, found)
    lit = found & (lamp.pdf > 0)
    return Starts(si, si.to_local(lamp.d), lit, dr.select(lit, light / density, 0), 1)


def _lit_by_surfaces(integrator: Any, scene: Any, start: Any, sampler: SobolSampler) -> Starts:
    """Choose directions from which other surfaces send light to points of surfaces."""
    si, density, found = start
    # The back of a surface counts where light may come through it, or falls on it.
    behind = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide) & (sampler.next_1d() < 0.5)
    direction = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    density *= mi.warp.square_to_cosine_hemisphere_pdf(direction)
    density *= dr.select(mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide), 0.5, 1)
    direction.z *= dr.select(behind, -1, 1)

    # Without a limit to the length of paths one number is enough.
    lengths = integrator.max_depth if integrator.max_depth < 2**31 else 1
    count = dr.width(density)
    first = dr.arange(mi.UInt32, count) * lengths
    arriving = dr.zeros(mi.Spectrum, count * lengths)
    integrator.sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=si.spawn_ray(si.to_world(direction)),
        active=found,
        arriving=(arriving, first, lengths),
    )
    dr.eval(arriving)
    light = dr.zeros(mi.Spectrum, count * lengths)
    total = mi.Spectrum(0)
    for length in range(lengths):
        total += dr.gather(mi.Spectrum, arriving, first + length) / density
        dr.scatter(light, total, first + length)
    return Starts(si, direction, found, light, lengths)


def _propagate(
    integrator: Any, scene: Any, receiver: Receiver, sampler: SobolSampler, starts: Starts
) -> None:
    """Send particles from each start, and carry to its surface what the camera makes of them."""
    particle = dr.arange(mi.UInt32, dr.width(starts.lit) * STRATA)
    start, stratum = particle // STRATA, particle % STRATA
    si, lit = dr.gather(mi.SurfaceInteraction3f, starts.si, start), dr.gather(mi.Bool, starts.lit, start)
    incoming = dr.gather(mi.Vector3f, starts.incoming, start)

    side = math.isqrt(STRATA)
    point = (mi.Point2f(stratum % side, stratum // side) + sampler.next_2d()) / side
    si.wi = incoming
    direction, _ = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), point, lit)
    lit &= (direction.pdf > 0) & ~mi.has_flag(direction.sampled_type, mi.BSDFFlags.Delta)
    ray = si.spawn_ray(si.to_world(direction.wo))

    def light(segments: Any, active: Any) -> Any:
        """Return what reaches the start of each particle by at most so many segments."""
        index = start * starts.lengths + dr.minimum(segments, starts.lengths) - 1
        return dr.gather(mi.Spectrum, starts.light, index, active)

    received = _received(integrator, scene, receiver, sampler, ray, lit, light)
    received = dr.select(lit, received * abs(dr.dot(si.n, ray.d)) / (direction.pdf * STRATA), 0)
    # A particle goes from the light to the camera, but what is differentiated is the path from the camera.
    si.wi = direction.wo
    with dr.resume_grad():
        value = si.bsdf().eval(mi.BSDFContext(), si, incoming, lit)
        # What a material derives from its parameters stays attached to them, for the next call.
        dr.backward_from(received * value, flags=dr.ADFlag.ClearVertices)


def _point(
    scene: Any, sensor: Any, surfaces: Surfaces, sampler: SobolSampler, count: int
) -> tuple[Any, Any, Any]:
    """Return random points of the surfaces, so many per unit of area, and whether they were found there."""
    time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    number = sampler.next_1d()
    chosen = dr.binary_search(
        0, dr.width(surfaces.until) - 1, lambda k: dr.gather(mi.Float, surfaces.until, k) <= number
    )
    shape = dr.gather(mi.ShapePtr, scene.shapes_dr(), dr.gather(mi.UInt32, surfaces.index, chosen))
    point = shape.sample_position(time, sampler.next_2d())
    # A ray from just above tells what the surface is like there.
    above = 2 * mi.math.RayEpsilon * (1 + dr.max(abs(point.p)))
    si = scene.ray_intersect(mi.Ray3f(point.p + above * point.n, -point.n, 2 * above, time, []))
    return si, dr.gather(mi.Float, surfaces.density, chosen) * count, si.is_valid() & (si.shape == shape)


@dr.syntax
def _received(
    integrator: Any, scene: Any, receiver: Receiver, sampler: SobolSampler, ray: Any, active: Any, light: Any
) -> Any:
    """Return what the camera receives of particles, each weighted by the light that reaches its start."""
    received = mi.Spectrum(0)
    throughput = mi.Spectrum(1)
    active = mi.Bool(active)
    before = mi.UInt32(2)  # segments from the camera to the start
    while active:
        active &= before < integrator.max_depth
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        caught = _caught(scene, receiver, sampler, si, active)
        received += dr.select(active, throughput * caught * light(integrator.max_depth - before, active), 0)

        direction, weight = si.bsdf().sample(
            mi.BSDFContext(mi.TransportMode.Importance), si, sampler.next_1d(), sampler.next_2d(), active
        )
        throughput *= weight * _reversal(si, direction.wo)
        ray = si.spawn_ray(si.to_world(direction.wo))
        before += 1
        survival = dr.minimum(dr.max(throughput), 0.95)
        roulette = before > integrator.rr_depth
        throughput[roulette] *= dr.rcp(survival)
        active &= (survival > 0) & (~roulette | (sampler.next_1d() < survival))
    return received


def _caught(scene: Any, receiver: Receiver, sampler: SobolSampler, si: Any, active: Any) -> Any:
    """Return what the camera catches of a particle that the surface scatters towards it."""
    sensor = receiver.sensor
    film = sensor.film()
    size = film.crop_size()
    place, importance = sensor.sample_direction(si, sampler.next_2d(), active)
    active = active & (place.pdf > 0)
    # Nothing hides what lies before the near plane.
    ahead = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
    ray = si.spawn_ray_to(place.p)
    ray.maxt *= 1 + sensor.near_clip() / (place.dist * dr.dot(place.d, ahead))
    active &= ~scene.ray_test(ray, active)
    outgoing = si.to_local(place.d)
    value = si.bsdf().eval(mi.BSDFContext(mi.TransportMode.Importance), si, outgoing, active)
    point = dr.clip(place.uv, 0, mi.Point2f(size) - 1e-3)
    pixel = mi.UInt32(point.y) * size.x + mi.UInt32(point.x)
    read = read_adjoint(film, receiver.adjoint, *receiver.profile, pixel, point)
    return dr.select(active, value * _reversal(si, outgoing) * importance * read * dr.prod(size), 0)


def _reversal(si: Any, outgoing: Any) -> Any:
    """Return by how much a particle's weight differs from that of the same path from the camera."""
    arrived, leaves = (abs(dr.dot(si.n, si.to_world(direction))) for direction in (si.wi, outgoing))
    factor = leaves * abs(mi.Frame3f.cos_theta(si.wi)) / (arrived * abs(mi.Frame3f.cos_theta(outgoing)))
    return dr.select(dr.isfinite(factor), factor, 0)


def _another(seed: Any, number: int) -> Any:
    """Return a seed that is independent of the seed itself."""
    return mi.sample_tea_32(seed, mi.UInt32(number + 1))[0]
