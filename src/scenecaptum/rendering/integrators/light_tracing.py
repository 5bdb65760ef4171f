"""Derivatives of a material by light tracing that starts on its surface.

Path replay finds a surface outside the camera's view only by chance, and the emitter in its reflection by
chance again. The derivative with respect to a low roughness is large, of one sign in the middle of the lobe and
of the other sign around it, and cancels only over many samples of the lobe. Here a light subpath is built that
ends at a sampled point of the surface. The lobe is then sampled in strata, and each sample continues as a light
path that connects to the camera at every surface it hits.

Light that the surface sends to the camera directly or by specular reflection is not found by these paths. It is
left to path replay, which then ends its paths at their first non-specular vertex, except on a sampled surface:
a connection from a narrow lobe to the camera would be rare and large, so these paths are path replay's too.

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

from ...scene import SceneGraph
from .._backward import CameraAdjoint, filtered_adjoint
from .._plan import RenderPlan
from .._registry import index_table, shape_index
from .._sampler import SobolSampler
from .._sensors import allows_light_tracing
from .path import is_in_mask, is_valid_sample

LOBE_STRATA = 16  # a square number
PATHS_PER_SAMPLE = 2  # light paths per path-replay sample, for direct and for indirect light each


@dataclass
class SampledShapes:
    """Shapes whose surfaces are sampled, with their probabilities, in Dr.Jit arrays."""

    index: mi.UInt32  # into ``scene.shapes()``
    cdf: mi.Float  # cumulative probabilities of the shapes
    density: mi.Float  # probability density of a point, per unit of area
    mask: mi.Bool  # for each of Dr.Jit's shape indices, whether the shape is sampled


def find_sampled_shapes(
    graph: SceneGraph,
    params_by_shape: Sequence[Collection[str]],
    sensor: Any,
    plan: RenderPlan,
    names: Sequence[str],
) -> SampledShapes | None:
    """Return the shapes that use any of the named parameters, with equal total probability per parameter.

    ``params_by_shape`` are the parameters that each shape of the scene uses. Returns None where light paths cannot
    be connected to the camera, where a shape cannot be sampled, or where a bump or normal map makes scattering
    non-reciprocal.
    """
    if not plan.kind.light_tracing or plan.hide_emitters or not allows_light_tracing(graph, sensor):
        return None
    shapes = graph.scene.shapes()
    areas, probabilities = np.ones(len(shapes)), np.zeros(len(shapes))
    for name in names:
        users = [k for k in range(len(shapes)) if name in params_by_shape[k]]
        try:
            areas[users] = [_area(shapes[k]) for k in users]
        except (RuntimeError, NotImplementedError):
            return None
        if users:
            probabilities[users] += areas[users] / areas[users].sum()
    index = np.flatnonzero(probabilities)
    if not len(index):
        return None
    mask = index_table({shape_index(shapes[k]): 1 for k in index}, 0)
    probabilities = probabilities[index] / probabilities.sum()
    return SampledShapes(
        mi.UInt32(index),
        mi.Float(probabilities.cumsum()),
        mi.Float(probabilities / areas[index]),
        mask == 1,
    )


def _area(shape: Any) -> float:
    """Return a shape's area, from the pdf of a sampled point; raises where points cannot be sampled."""
    return float(1 / shape.sample_position(0.0, mi.Point2f(0.5)).pdf[0])


@dataclass
class LightSubpath:
    """Light subpaths that end at sampled surface points: the points, the incident directions and the light.

    ``radiance`` has for each subpath the incident radiance of at most 1, 2, … ``lengths`` segments, divided by the
    probability density of the subpath's end.
    """

    si: Any
    incident: Any
    active: Any
    radiance: Any
    lengths: int


@dataclass
class LightPaths:
    """Arrays of Dr.Jit as long as each launch of ``trace_light_backward``, which are used up by one call.

    They are arguments because a frozen function can only guess the sizes of arrays that it creates itself.
    """

    count: Any  # of subpaths of each kind
    index: Any  # of each subpath
    lane: Any  # of each sample of a lobe
    incident: Any  # zeros for each subpath and each length that it may have
    radiance: Any  # likewise

    @classmethod
    def beside(cls, samples: int, max_depth: int) -> LightPaths:
        """Return the arrays for the paths beside a number of samples of path replay."""
        count = max(1, PATHS_PER_SAMPLE * samples // LOBE_STRATA)
        # A kernel is recorded again where two arrays of different lengths have the same: not that of the adjoint.
        count += (1 - count) % 3
        index, lane = dr.arange(mi.UInt32, count), dr.arange(mi.UInt32, count * LOBE_STRATA)
        paths = cls(dr.opaque(mi.Float, count), index, lane, *_zeros(count * _lengths(max_depth)))
        dr.eval(index, lane)
        return paths

    def clear(self) -> None:
        """Set all light to 0."""
        self.incident, self.radiance = _zeros(dr.width(self.incident))


def _zeros(entries: int) -> tuple[Any, Any]:
    arrays = dr.zeros(mi.Spectrum, entries), dr.zeros(mi.Spectrum, entries)
    dr.make_opaque(arrays)
    return arrays


def _lengths(max_depth: int) -> int:
    """Return the number of entries of a subpath, one for each length; without a depth limit there is one."""
    return max_depth if max_depth < 2**31 else 1


def trace_light_backward(
    integrator: Any, scene: Any, camera: CameraAdjoint, shapes: SampledShapes, paths: LightPaths, seed: Any
) -> None:
    """Backpropagate an adjoint to the parameters of the sampled shapes, for the paths that path replay omits.

    ``integrator`` is a ``ReplayIntegrator``.
    """
    with dr.suspend_grad():
        for number, sample_subpath in enumerate((_sample_direct_light, _sample_indirect_light)):
            sampler = SobolSampler.at(paths.index, _derive_seed(seed, 2 * number))
            point = _sample_surface_point(scene, camera.sensor, shapes, sampler, paths.count)
            subpath = sample_subpath(integrator, scene, point, sampler, paths)
            dr.eval(subpath)
            sampler = SobolSampler.at(paths.lane, _derive_seed(seed, 2 * number + 1))
            _propagate(integrator, scene, camera, sampler, paths.lane, subpath, shapes.mask)
            dr.eval()


def _sample_direct_light(
    integrator: Any, scene: Any, point: Any, sampler: SobolSampler, paths: LightPaths
) -> LightSubpath:
    """Sample directions from which an emitter illuminates points of surfaces."""
    si, density, valid = point
    ds, emitter_weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, valid)
    active = valid & (ds.pdf > 0)
    return LightSubpath(si, si.to_local(ds.d), active, dr.select(active, emitter_weight / density, 0), 1)


def _sample_indirect_light(
    integrator: Any, scene: Any, point: Any, sampler: SobolSampler, paths: LightPaths
) -> LightSubpath:
    """Sample directions from which other surfaces illuminate points of surfaces."""
    si, density, valid = point
    # The back side matters where the BSDF transmits or reflects light there.
    behind = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide) & (sampler.next_1d() < 0.5)
    direction = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    density *= mi.warp.square_to_cosine_hemisphere_pdf(direction)
    density *= dr.select(mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide), 0.5, 1)
    direction.z *= dr.select(behind, -1, 1)

    lengths = _lengths(integrator.max_depth)
    offset = paths.index * lengths
    integrator.sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=si.spawn_ray(si.to_world(direction)),
        active=valid,
        incident=(paths.incident, offset, lengths),
    )
    dr.eval(paths.incident)
    total = mi.Spectrum(0)
    for length in range(lengths):
        total += dr.gather(mi.Spectrum, paths.incident, offset + length) / density
        dr.scatter(paths.radiance, total, offset + length)
    return LightSubpath(si, direction, valid, paths.radiance, lengths)


def _propagate(
    integrator: Any,
    scene: Any,
    camera: CameraAdjoint,
    sampler: SobolSampler,
    lane: Any,
    subpath: LightSubpath,
    shape_mask: Any,
) -> None:
    """Continue each subpath in all strata of the lobe, and backpropagate what reaches the camera."""
    index, stratum = lane // LOBE_STRATA, lane % LOBE_STRATA
    si, active = (
        dr.gather(mi.SurfaceInteraction3f, subpath.si, index),
        dr.gather(mi.Bool, subpath.active, index),
    )
    incident = dr.gather(mi.Vector3f, subpath.incident, index)

    side = math.isqrt(LOBE_STRATA)
    point = (mi.Point2f(stratum % side, stratum // side) + sampler.next_2d()) / side
    si.wi = incident
    bsdf_sample, weight = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), point, active)
    active &= is_valid_sample(bsdf_sample, weight)
    ray = si.spawn_ray(si.to_world(bsdf_sample.wo))

    def radiance(segments: Any, active: Any) -> Any:
        """Return the light of each subpath with at most the given number of segments."""
        entry = index * subpath.lengths + dr.minimum(segments, subpath.lengths) - 1
        return dr.gather(mi.Spectrum, subpath.radiance, entry, active)

    def connect(sampler: SobolSampler, si: Any, active: Any) -> Any:
        """Return the contribution of a connection to the camera, except from surfaces of low roughness."""
        active = active & ~is_in_mask(shape_mask, si)
        return _connect_to_camera(scene, camera, sampler, si, active)

    received = _trace_to_camera(integrator, scene, sampler, ray, active, connect, radiance)
    received = dr.select(active, received * abs(dr.dot(si.n, ray.d)) / (bsdf_sample.pdf * LOBE_STRATA), 0)
    # The light path runs towards the camera, but the path from the camera is differentiated.
    si.wi = bsdf_sample.wo
    with dr.resume_grad():
        value = si.bsdf().eval(mi.BSDFContext(), si, incident, active)
        # Keep the edges, because arrays that a material derives from its parameters are used again.
        dr.backward_from(received * value, flags=dr.ADFlag.ClearVertices)


def _sample_surface_point(
    scene: Any, sensor: Any, shapes: SampledShapes, sampler: SobolSampler, count: Any
) -> tuple[Any, Any, Any]:
    """Return random surface points, their density times ``count``, and whether a ray confirmed them."""
    time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    random = sampler.next_1d()
    index = dr.binary_search(
        0, dr.width(shapes.cdf) - 1, lambda k: dr.gather(mi.Float, shapes.cdf, k) <= random
    )
    shape = dr.gather(mi.ShapePtr, scene.shapes_dr(), dr.gather(mi.UInt32, shapes.index, index))
    point = shape.sample_position(time, sampler.next_2d())
    # A ray from just above the point gives its surface interaction.
    above = 2 * mi.math.RayEpsilon * (1 + dr.max(abs(point.p)))
    si = scene.ray_intersect(mi.Ray3f(point.p + above * point.n, -point.n, 2 * above, time, []))
    return si, dr.gather(mi.Float, shapes.density, index) * count, si.is_valid() & (si.shape == shape)


@dr.syntax
def _trace_to_camera(
    integrator: Any,
    scene: Any,
    sampler: SobolSampler,
    ray: Any,
    active: Any,
    connect: Any,
    radiance: Any,
) -> Any:
    """Return the adjoint-weighted light that paths bring to the camera, with a connection at every vertex."""
    received = mi.Spectrum(0)
    throughput = mi.Spectrum(1)
    active = mi.Bool(active)
    segments = mi.UInt32(2)  # from the camera to the start of the ray
    while active:
        active &= segments < integrator.max_depth
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        connection = connect(sampler, si, active)
        received += dr.select(
            active, throughput * connection * radiance(integrator.max_depth - segments, active), 0
        )

        bsdf_sample, weight = si.bsdf().sample(
            mi.BSDFContext(mi.TransportMode.Importance), si, sampler.next_1d(), sampler.next_2d(), active
        )
        throughput *= weight * _shading_normal_correction(si, bsdf_sample.wo)
        ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
        segments += 1
        rr_prob = dr.minimum(dr.max(throughput), 0.95)
        rr_active = segments > integrator.rr_depth
        throughput[rr_active] *= dr.rcp(rr_prob)
        active &= (rr_prob > 0) & (~rr_active | (sampler.next_1d() < rr_prob))
    return received


def _connect_to_camera(scene: Any, camera: CameraAdjoint, sampler: SobolSampler, si: Any, active: Any) -> Any:
    """Return the adjoint-weighted contribution of a connection from a surface to the camera."""
    sensor = camera.sensor
    film = sensor.film()
    size = film.crop_size()
    ds, importance = sensor.sample_direction(si, sampler.next_2d(), active)
    active = active & (ds.pdf > 0)
    # Nothing in front of the near plane occludes.
    ahead = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
    ray = si.spawn_ray_to(ds.p)
    ray.maxt *= 1 + sensor.near_clip() / (ds.dist * dr.dot(ds.d, ahead))
    active &= ~scene.ray_test(ray, active)
    wo = si.to_local(ds.d)
    value = si.bsdf().eval(mi.BSDFContext(mi.TransportMode.Importance), si, wo, active)
    point = dr.clip(ds.uv, 0, mi.Point2f(size) - 1e-3)
    pixel = mi.UInt32(point.y) * size.x + mi.UInt32(point.x)
    adjoint = filtered_adjoint(film, camera.adjoint, *camera.profile, pixel, point)
    correction = _shading_normal_correction(si, wo)
    return dr.select(active, value * correction * importance * adjoint * dr.prod(size), 0)


def _shading_normal_correction(si: Any, wo: Any) -> Any:
    """Return the ratio of a light path's weight to that of the same path from the camera."""
    geometric_i, geometric_o = (abs(dr.dot(si.n, si.to_world(direction))) for direction in (si.wi, wo))
    factor = geometric_o * abs(mi.Frame3f.cos_theta(si.wi)) / (geometric_i * abs(mi.Frame3f.cos_theta(wo)))
    return dr.select(dr.isfinite(factor), factor, 0)


def _derive_seed(seed: Any, number: int) -> Any:
    """Return one of several seeds that are independent of each other and of the seed itself."""
    return mi.sample_tea_32(seed, mi.UInt32(number + 1))[0]
