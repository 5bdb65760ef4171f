"""Primary rays: which objects and texels each pixel shows, and how much of the pixel each covers.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..scene import SceneParameters, SurfaceMap, TexelMap
from ..scene._graph import SceneGraph
from ._texels import Indices, ShownTexture, number_of

# Hammersley points: 16 rays a pixel, no two in one row or column, so that an edge along either axis is located to
# within 1/16 of a pixel; and the same map at every call.
RAYS = 16

# Rays at a time: what is kept of each takes some 100 bytes.
BATCH = 2**20

# How many mirrors and panes a ray passes at most.
BOUNCES = 12


def trace_surfaces(
    graph: SceneGraph,
    parameters: SceneParameters,
    sensor: Any,
    resolution: tuple[int, int],
    textures: Sequence[ShownTexture] = (),
    *,
    through: bool = False,
) -> SurfaceMap:
    """Trace primary rays through each pixel and record what they meet first.

    With ``through`` rays go on where a surface only mirrors or lets pass: see ``follow_specular``.
    """
    shapes = graph.shapes()
    width, height = resolution
    objects = (*(name for name, _, _ in shapes), "background")
    index_of = _index_of([shape for _, shape, _ in shapes])
    pixels, step = width * height, BATCH // RAYS
    parts = [
        _Part.of(
            _trace(graph.scene, sensor, resolution, (first, min(step, pixels - first)), textures, through),
            first,
            index_of,
            textures,
        )
        for first in range(0, pixels, step)
    ]
    offsets = np.cumsum([0, *(len(part.pixel) for part in parts)])
    return SurfaceMap(
        shape=(height, width),
        pixel=np.concatenate([part.pixel for part in parts]),
        object_index=np.concatenate([part.object_index for part in parts]),
        fraction=np.concatenate([part.fraction for part in parts]),
        objects=objects,
        parameters=_shown_parameters(
            graph, parameters, [*(below for _, _, below in shapes), graph.background()]
        ),
        texels={
            texture.name: _joined([part.texels[i] for part in parts], offsets)
            for i, texture in enumerate(textures)
        },
    )


@dataclass
class _Hits:
    """What each ray meets, pixel-major: NumPy arrays with ``RAYS`` elements per pixel.

    ``seen`` and ``shape`` are numbers that Dr.Jit gives shapes, 0 for nothing; for a shape of an instance
    ``seen`` is that of the instance. ``looks`` is whether the sensor looks anywhere: it does not outside a
    fisheye's circle. ``places`` are points of each texture.
    """

    seen: Indices
    shape: Indices
    looks: NDArray[np.bool_]
    places: list[tuple[NDArray[Any], ...]]


def _trace(
    scene: Any,
    sensor: Any,
    resolution: tuple[int, int],
    pixels: tuple[int, int],
    textures: Sequence[ShownTexture],
    through: bool,
) -> _Hits:
    """Trace the rays of ``pixels``, the first and their count."""
    first, count = pixels
    with dr.suspend_grad():
        ray, weight, pixel, point = camera_rays(sensor, resolution, first, count)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        met, direction, places = hit, ray.d, []
        if textures or through:
            met = hit.compute_surface_interaction(ray)
            if through:
                met, hit, direction = follow_specular(scene, met, hit, direction, pixel, point)
            places = [texture.place(met, hit, direction) for texture in textures]
        shape, instance = (dr.reinterpret_array(mi.UInt32, one) for one in (met.shape, met.instance))
        shape = dr.select(met.is_valid(), shape, 0)
        seen = dr.select(met.is_valid() & (instance != 0), instance, shape)
        looks = dr.max(weight) > 0
        dr.eval(seen, shape, looks, places)
    return _Hits(
        seen.numpy().astype(np.int64),
        shape.numpy().astype(np.int64),
        np.broadcast_to(looks.numpy(), count * RAYS),
        [tuple(one.numpy() for one in place) for place in places],
    )


def camera_rays(
    sensor: Any, resolution: tuple[int, int], first: int, count: int
) -> tuple[Any, Any, Any, Any]:
    """Return ``RAYS`` rays through each of ``count`` pixels, their weights, pixels and numbers in the pixel."""
    width, height = resolution
    index = dr.arange(mi.UInt32, count * RAYS)
    pixel, point = dr.opaque(mi.UInt32, first) + index // RAYS, index % RAYS
    # The bits of the point's number reversed, as a fraction.
    reversed_bits = ((point & 1) << 3) | ((point & 2) << 1) | ((point & 4) >> 1) | ((point & 8) >> 3)
    position = mi.Point2f(
        (mi.Float(pixel % width) + (mi.Float(point) + 0.5) / RAYS) / width,
        (mi.Float(pixel // width) + (mi.Float(reversed_bits) + 0.5) / RAYS) / height,
    )
    ray, weight = sensor.sample_ray(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    return ray, weight, pixel, point


def follow_specular(
    scene: Any, si: Any, hit: Any, direction: Any, pixel: Any, point: Any
) -> tuple[Any, Any, Any]:
    """Follow rays off mirrors and through panes, glass and the holes of masks to the first other surface.

    Where a surface both mirrors and lets pass, the rays of a pixel part as its light does. A light, or a surface
    that scatters light too (varnish), ends them.
    """
    context = mi.BSDFContext()
    for number in range(BOUNCES):
        # A number in the code would have the kernel compiled anew for each bounce.
        bounce = dr.opaque(mi.UInt32, number)
        bsdf = si.bsdf()
        # One ray in each sixteenth of the lobes' probabilities, at a random point of it; in another order at each
        # surface, so that how a ray fared at one does not tell how it fares at the next.
        stratum = ((2 * bounce + 7) * point + 5 * bounce) % RAYS
        lobe = (mi.Float(stratum) + mi.sample_tea_float32(pixel, bounce)) / RAYS
        onwards = si.is_valid() & ~si.shape.is_emitter()
        clear = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, value = bsdf.sample(context, si, lobe, mi.Point2f(0.5), onwards)
        passes = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        mirrors = clear & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        onwards &= (passes | mirrors) & (dr.max(value) > 0)
        if not dr.any(onwards):
            break
        ray = si.spawn_ray(si.to_world(sample.wo))
        direction = dr.select(onwards, ray.d, direction)
        next_hit = scene.ray_intersect_preliminary(ray, active=onwards)
        si = dr.select(onwards, next_hit.compute_surface_interaction(ray, active=onwards), si)
        hit = dr.select(onwards, next_hit, hit)
        dr.eval(si, hit, direction)
    return si, hit, direction


@dataclass
class _Part:
    """The entries of a map for some of its pixels."""

    pixel: NDArray[np.int32]
    object_index: NDArray[np.int32]
    fraction: NDArray[np.float32]
    texels: list[TexelMap]

    @staticmethod
    def of(hits: _Hits, first: int, index_of: Indices, textures: Sequence[ShownTexture]) -> _Part:
        """Count what rays have met; ``index_of`` are the objects by the number that Dr.Jit gives them."""
        count = int(index_of.max()) + 1
        pixel = first + np.arange(len(hits.seen)) // RAYS
        looks = hits.looks
        key = (pixel * count + index_of[hits.seen])[looks]
        entries, entry, rays = np.unique(key, return_inverse=True, return_counts=True)
        return _Part(
            pixel=(entries // count).astype(np.int32),
            object_index=(entries % count).astype(np.int32),
            fraction=(rays / RAYS).astype(np.float32),
            texels=[
                _texels(texture, hits.shape[looks], [one[looks] for one in place], entry, rays)
                for texture, place in zip(textures, hits.places, strict=True)
            ],
        )


def _texels(
    texture: ShownTexture, shape: Indices, place: Sequence[NDArray[Any]], entry: Indices, rays: Indices
) -> TexelMap:
    showing = np.isin(shape, [0] if texture.shapes is None else texture.shapes)
    return texture.lookup.shown(entry[showing], [one[showing] for one in place], rays)


def _joined(parts: Sequence[TexelMap], offsets: Indices) -> TexelMap:
    return TexelMap(
        entry=np.concatenate(
            [part.entry + np.int32(offset) for part, offset in zip(parts, offsets, strict=False)]
        ),
        texel=np.concatenate([part.texel for part in parts]),
        weight=np.concatenate([part.weight for part in parts]),
    )


def _index_of(shapes: list[Any]) -> Indices:
    """Index into ``shapes`` by the number that Dr.Jit gives a shape, ``len(shapes)`` for any other and nothing.

    Dr.Jit numbers the shapes of the whole process from 1; 0 is nothing.
    """
    numbers = [number_of(shape) for shape in shapes]
    index = np.full(max(numbers, default=0) + 1, len(shapes), dtype=np.int64)
    index[numbers] = np.arange(len(shapes))
    return index


def _shown_parameters(
    graph: SceneGraph, parameters: SceneParameters, held: list[set[Any]]
) -> tuple[tuple[str, ...], ...]:
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    return tuple(
        tuple(name for name, node in nodes.items() if node in below and not parameters[name].problem)
        for below in held
    )
