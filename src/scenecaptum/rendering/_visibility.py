"""Primary rays: the objects and texels that each pixel shows, with the fraction of the pixel that each covers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..projection import SurfaceMap, TexelMap
from ..scene import SceneGraph, SceneParameters
from ._backward import one_for_each
from ._registry import shape_index
from ._texels import Indices, ShownTexture

# Rays per pixel, at Hammersley points: no two share a row or column, which locates an axis-aligned edge to
# within 1/16 of a pixel, and the map is the same at every call.
RAYS = 16

# Rays traced at once: each takes about 250 bytes while it is followed through panes and counted.
BATCH = 2**18

# Maximum number of mirrors and panes along a ray.
MAX_SPECULAR_BOUNCES = 12

# What rays do at specular surfaces: end there, or continue. Where a surface reflects and transmits, they are split
# as its light is, or all transmitted or all reflected.
Follow = Literal["nothing", "split", "transmitted", "reflected"]
SAMPLES = {"transmitted": 1 - 2**-24, "reflected": 0.0}  # of lobes, as panes take them


def trace_surfaces(
    graph: SceneGraph,
    parameters: SceneParameters,
    sensor: Any,
    resolution: tuple[int, int],
    textures: Sequence[ShownTexture] = (),
    *,
    follow: Follow = "nothing",
) -> SurfaceMap:
    """Trace primary rays through each pixel and record the first objects that they hit.

    They may ``follow`` specular surfaces: see ``follow_specular``.
    """
    (width, height), (objects, object_of_shape) = resolution, objects_of(graph)
    parts = [
        _Part.of(
            _trace(graph.scene, sensor, resolution, (first, count), textures, follow),
            first,
            object_of_shape,
            textures,
        )
        for first, count in batches(resolution)
    ]
    offsets = np.cumsum([0, *(len(part.pixel) for part in parts)])
    return SurfaceMap(
        shape=(height, width),
        pixel=np.concatenate([part.pixel for part in parts]),
        object_index=np.concatenate([part.object_index for part in parts]),
        fraction=np.concatenate([part.fraction for part in parts]),
        objects=objects,
        parameters=_shown_parameters(graph, parameters),
        texels={
            texture.name: _concatenated([part.texels[i] for part in parts], offsets)
            for i, texture in enumerate(textures)
        },
    )


def visible_shape(interaction: Any) -> Any:
    """Return Dr.Jit's index of the hit shapes: of the instance for a shape in an instance, 0 for none."""
    shape, instance = (
        dr.reinterpret_array(mi.UInt32, pointer) for pointer in (interaction.shape, interaction.instance)
    )
    return dr.select(interaction.is_valid(), dr.select(instance != 0, instance, shape), 0)


@dataclass
class _Hits:
    """The hit of each ray, pixel-major: NumPy arrays with ``RAYS`` elements per pixel."""

    visible_shape: Indices  # as ``shape``, but the instance's index for a shape in an instance
    shape: Indices  # Dr.Jit's index of the hit shape, 0 for none
    valid: NDArray[np.bool_]  # False for rays without a direction, outside a fisheye's circle
    coordinates: list[tuple[NDArray[Any], ...]]  # lookup coordinates of each texture


def _trace(
    scene: Any,
    sensor: Any,
    resolution: tuple[int, int],
    pixels: tuple[int, int],
    textures: Sequence[ShownTexture],
    follow: Follow,
) -> _Hits:
    """Trace the rays of ``pixels``: the first and the number of pixels."""
    first, count = pixels
    with dr.suspend_grad():
        ray, weight, pixel, point = camera_rays(sensor, resolution, first, count)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        interaction, coordinates = hit, []
        if follow != "nothing":
            followed = follow_specular(scene, ray, hit, pixel, point, follow)
            ray, hit = followed.ray, followed.hit
        if textures or follow != "nothing":
            interaction = hit.compute_surface_interaction(ray)
            coordinates = [texture.coordinates(interaction, hit, ray.d) for texture in textures]
        shape = dr.select(interaction.is_valid(), dr.reinterpret_array(mi.UInt32, interaction.shape), 0)
        visible = visible_shape(interaction)
        valid = dr.max(weight) > 0
        dr.eval(visible, shape, valid, coordinates)
    return _Hits(
        visible.numpy().astype(np.int64),
        shape.numpy().astype(np.int64),
        np.broadcast_to(valid.numpy(), count * RAYS),
        [tuple(axis.numpy() for axis in axes) for axes in coordinates],
    )


def batches(resolution: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield the first and the number of the pixels that are traced at once."""
    pixels, step = math.prod(resolution), BATCH // RAYS
    yield from ((first, min(step, pixels - first)) for first in range(0, pixels, step))


def camera_rays(
    sensor: Any, resolution: tuple[int, int], first: int, count: int
) -> tuple[Any, Any, Any, Any]:
    """Return ``RAYS`` rays through each of ``count`` pixels, their weights, pixels and indices in the pixel."""
    index = dr.arange(mi.UInt32, count * RAYS)
    pixel, point = dr.opaque(mi.UInt32, first) + index // RAYS, index % RAYS
    ray, weight = rays_from(sensor, resolution, film_position(resolution, pixel, point))
    return ray, weight, pixel, point


def rays_from(sensor: Any, resolution: tuple[int, int], position: Any) -> tuple[Any, Any]:
    """Return the rays through positions on the film, in pixels, and their weights."""
    sample = position / mi.Point2f(resolution)
    # With differentials, without which an irradiance meter has no rays.
    ray, weight = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, sample, mi.Point2f(0.5))
    return one_for_each(ray, sample), weight


def rays_in(pixels: Indices, rays: int) -> Iterator[tuple[Any, Any]]:
    """Yield the pixels of the rays of some pixels and their indices in these, ``BATCH`` rays at once."""
    step = BATCH // rays
    for part in (pixels[first : first + step] for first in range(0, len(pixels), step)):
        index = dr.arange(mi.UInt32, len(part) * rays)
        yield dr.repeat(mi.UInt32(part), rays), index % rays


def film_position(resolution: tuple[int, int], pixel: Any, point: Any, rays: int = RAYS) -> Any:
    """Return where on the film, in pixels, rays begin that have these indices in these pixels.

    A pixel has ``rays``, a power of two.
    """
    # The point's index in reversed bit order, as a fraction.
    reversed_bits = dr.brev(point) >> (33 - rays.bit_length())
    return mi.Point2f(
        mi.Float(pixel % resolution[0]) + (mi.Float(point) + 0.5) / rays,
        mi.Float(pixel // resolution[0]) + (mi.Float(reversed_bits) + 0.5) / rays,
    )


@dataclass
class Followed:
    """Where rays end that specular surfaces reflect and transmit.

    ``ray`` is the last piece of each and ``hit`` what it meets; ``throughput`` is the part of the light there that
    reaches the camera along split rays, and ``reflected`` whether a surface reflects it that transmits, too.
    """

    ray: Any
    hit: Any
    throughput: Any
    reflected: Any


def follow_specular(
    scene: Any, ray: Any, hit: Any, pixel: Any, point: Any, follow: Follow = "split", lobes: int = RAYS
) -> Followed:
    """Follow rays by specular reflection and transmission to the first surface that also scatters light.

    Where a surface reflects and transmits, the rays of a pixel are split as its light is, into ``lobes``, or
    transmitted, or reflected. Emitters, and surfaces with a smooth lobe too (varnish), end a ray.
    """
    context = mi.BSDFContext()

    def bounced(state: Followed, bounce: Any, active: Any) -> tuple[Followed, Any, Any]:
        si = state.hit.compute_surface_interaction(state.ray, active=active)
        bsdf = si.bsdf()
        # Stratified lobe selection: one ray of the pixel in each part. The strata are permuted at each
        # bounce, so that the lobes of successive surfaces are uncorrelated.
        stratum = ((2 * bounce + 7) * point + 5 * bounce) % lobes
        split = (mi.Float(stratum) + mi.sample_tea_float32(pixel, bounce)) / lobes
        lobe = split if follow == "split" else mi.Float(SAMPLES[follow])
        active &= si.is_valid() & ~si.shape.is_emitter()
        purely_specular = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, value = bsdf.sample(context, si, lobe, mi.Point2f(0.5), active)
        is_null = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        is_delta = purely_specular & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        active &= (is_null | is_delta) & (dr.max(value) > 0)
        is_mirrored = mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection)
        further = si.spawn_ray(si.to_world(sample.wo))
        next_hit = scene.ray_intersect_preliminary(further, active=active)
        next_state = Followed(
            dr.select(active, further, state.ray),
            dr.select(active, next_hit, state.hit),
            dr.select(active, state.throughput * value, state.throughput),
            state.reflected | (active & is_mirrored & (sample.pdf < 1)),
        )
        return next_state, bounce + 1, active

    nothing = dr.zeros(mi.UInt32, dr.width(pixel))
    start = Followed(mi.Ray3f(ray), hit, mi.Color3f(1), nothing > 0)
    # A symbolic loop: its body is compiled once, together with what follows.
    followed: Followed
    followed, _, _ = dr.while_loop(
        (start, nothing, mi.Bool(True)),
        lambda state, bounce, active: active & (bounce < MAX_SPECULAR_BOUNCES),
        bounced,
    )
    return followed


@dataclass
class _Part:
    """The entries of a surface map for some of its pixels."""

    pixel: NDArray[np.int32]
    object_index: NDArray[np.int32]
    fraction: NDArray[np.float32]
    texels: list[TexelMap]

    @staticmethod
    def of(hits: _Hits, first: int, object_of_shape: Indices, textures: Sequence[ShownTexture]) -> _Part:
        """Count the rays of each pixel that hit each object."""
        count = int(object_of_shape.max()) + 1
        pixel = first + np.arange(len(hits.visible_shape)) // RAYS
        valid = hits.valid
        key = (pixel * count + object_of_shape[hits.visible_shape])[valid]
        entries, entry, rays = np.unique(key, return_inverse=True, return_counts=True)
        return _Part(
            pixel=(entries // count).astype(np.int32),
            object_index=(entries % count).astype(np.int32),
            fraction=(rays / RAYS).astype(np.float32),
            texels=[
                _texels(texture, hits.shape[valid], [axis[valid] for axis in axes], entry, rays)
                for texture, axes in zip(textures, hits.coordinates, strict=True)
            ],
        )


def _texels(
    texture: ShownTexture, shape: Indices, coordinates: Sequence[NDArray[Any]], entry: Indices, rays: Indices
) -> TexelMap:
    uses = np.isin(shape, [0] if texture.shapes is None else texture.shapes)
    return texture.lookup.shown(entry[uses], [axis[uses] for axis in coordinates], rays)


def _concatenated(parts: Sequence[TexelMap], offsets: Indices) -> TexelMap:
    return TexelMap(
        entry=np.concatenate(
            [part.entry + np.int32(offset) for part, offset in zip(parts, offsets, strict=False)]
        ),
        texel=np.concatenate([part.texel for part in parts]),
        weight=np.concatenate([part.weight for part in parts]),
    )


def objects_of(graph: SceneGraph) -> tuple[tuple[str, ...], Indices]:
    """Return the names of the shapes of a scene and its background, and their number by Dr.Jit's shape index.

    Dr.Jit counts the shapes of the whole process from 1; 0 is none. Any other shape, and none, is the background.
    """
    shapes = graph.shapes()
    jit_indices = [shape_index(shape) for _, shape, _ in shapes]
    object_of_shape = np.full(max(jit_indices, default=0) + 1, len(shapes), dtype=np.int64)
    object_of_shape[jit_indices] = np.arange(len(shapes))
    return (*(name for name, _, _ in shapes), "background"), object_of_shape


def _shown_parameters(graph: SceneGraph, parameters: SceneParameters) -> tuple[tuple[str, ...], ...]:
    """Return the parameters that each shape of the scene shows, then those of the background."""
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    poses = {name: p for name, p in parameters.items() if p.moves and not p.problem}
    shapes, background = graph.shapes(), graph.background()
    moving = [[name for name, p in poses.items() if shape in p.shapes] for shape, _, _ in shapes]
    sky = {owner for name, node in nodes.items() if node in background for owner in parameters[name].owners}
    moving.append([name for name, p in poses.items() if not p.shapes and sky.intersection(p.owners)])
    return tuple(
        (
            *(name for name, node in nodes.items() if node in below and not parameters[name].problem),
            *poses_of_it,
        )
        for below, poses_of_it in zip([*(below for _, _, below in shapes), background], moving, strict=True)
    )
