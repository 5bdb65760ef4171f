"""Primary rays: which objects each pixel shows, and how much of the pixel each covers.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..scene import SceneParameters, SurfaceMap
from ..scene._graph import SceneGraph

# Hammersley points: 16 rays a pixel, no two in one row or column, so that an edge along either axis is located to
# within 1/16 of a pixel; and the same map at every call.
RAYS = 16


def trace_surfaces(
    graph: SceneGraph, parameters: SceneParameters, sensor: Any, resolution: tuple[int, int]
) -> SurfaceMap:
    """Trace primary rays through each pixel and record the objects that they meet first."""
    shapes = graph.shapes()
    width, height = resolution
    met = _first_hits(graph.scene, sensor, resolution, [shape for _, shape, _ in shapes])
    objects = (*(name for name, _, _ in shapes), "background")
    count = len(objects)

    pixel = np.repeat(np.arange(width * height), RAYS)
    shown = met >= 0
    entries, hits = np.unique((pixel * count + met)[shown], return_counts=True)
    return SurfaceMap(
        shape=(height, width),
        pixel=(entries // count).astype(np.int32),
        object_index=(entries % count).astype(np.int32),
        fraction=(hits / RAYS).astype(np.float32),
        objects=objects,
        parameters=_shown_parameters(
            graph, parameters, [*(below for _, _, below in shapes), graph.background()]
        ),
    )


def _first_hits(scene: Any, sensor: Any, resolution: tuple[int, int], shapes: list[Any]) -> NDArray[np.int64]:
    """Index into ``shapes`` of what each ray meets first, ``len(shapes)`` for nothing; pixel-major.

    It is -1 where the sensor looks nowhere: outside a fisheye's circle.
    """
    width, height = resolution
    index = dr.arange(mi.UInt32, width * height * RAYS)
    pixel, point = index // RAYS, index % RAYS
    # The bits of the point's number reversed, as a fraction.
    reversed_bits = ((point & 1) << 3) | ((point & 2) << 1) | ((point & 4) >> 1) | ((point & 8) >> 3)
    position = mi.Point2f(
        (mi.Float(pixel % width) + (mi.Float(point) + 0.5) / RAYS) / width,
        (mi.Float(pixel // width) + (mi.Float(reversed_bits) + 0.5) / RAYS) / height,
    )
    with dr.suspend_grad():
        ray, weight = sensor.sample_ray(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        shape, instance = (dr.reinterpret_array(mi.UInt32, one) for one in (hit.shape, hit.instance))
        registry = dr.select(hit.is_valid(), dr.select(instance != 0, instance, shape), 0)

    # Dr.Jit numbers the shapes of the whole process from 1; 0 is nothing.
    numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
    to_index = np.full(max(numbers, default=0) + 1, len(shapes), dtype=np.int64)
    to_index[numbers] = np.arange(len(shapes))
    met: NDArray[np.int64] = to_index[registry.numpy()]
    looks = np.broadcast_to((dr.max(weight) > 0).numpy(), met.shape)
    return np.where(looks, met, -1)


def _shown_parameters(
    graph: SceneGraph, parameters: SceneParameters, held: list[set[Any]]
) -> tuple[tuple[str, ...], ...]:
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    return tuple(
        tuple(name for name, node in nodes.items() if node in below and not parameters[name].problem)
        for below in held
    )
