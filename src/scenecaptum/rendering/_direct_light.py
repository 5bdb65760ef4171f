"""The light that lamps and the sky send to pixels directly: through panes, and by way of panes and mirrors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from ..scene import SceneGraph
from ._seen_lamps import Reflection
from ._texels import Indices
from ._visibility import (
    RAYS,
    Follow,
    film_position,
    follow_specular,
    objects_of,
    rays_from,
    rays_in,
    visible_shape,
)

Floats = NDArray[np.float32]


class _Rays(NamedTuple):
    """From how many positions in a pixel rays start, and how many from each: a pane reflects a twelfth of them."""

    positions: int
    turns: int


# In every pixel, and at the edges of what panes reflect.
COARSE, FINE = _Rays(RAYS, 4), _Rays(64, 64)


class _Light(NamedTuple):
    """What the rays of some pixels meet: the object, its radiance, and whether a pane reflects that.

    ``(pixels, rays)``; the radiance is ``(3, pixels, rays)``.
    """

    pixels: Indices
    met: Indices
    radiance: Floats
    reflected: NDArray[np.bool_]


def trace_light(graph: SceneGraph, sensor: Any, resolution: tuple[int, int]) -> dict[str, torch.Tensor]:
    """Return the radiance that each emitter sends to each pixel directly.

    ``(H, W, 3)``, by the names of ``trace_surfaces``. Emitters that no ray meets are left out.
    """
    (width, height), (objects, _) = resolution, objects_of(graph)
    light: dict[str, Floats] = {}
    for found in _in_pixels(graph, sensor, resolution, np.arange(height * width), COARSE):
        for index in np.unique(found.met[found.radiance.any(0)]):
            seen = light.setdefault(objects[index], np.zeros((3, height * width), np.float32))
            seen[:, found.pixels] = (found.radiance * (found.met == index)).mean(-1)
    return {name: _picture(seen, resolution) for name, seen in light.items()}


def trace_reflections(graph: SceneGraph, sensor: Any, resolution: tuple[int, int]) -> dict[str, Reflection]:
    """Return what panes reflect of emitters, by the names of ``trace_surfaces``.

    Mirrors, which transmit nothing, are no panes.
    """
    nodes = {node for _, _, below in graph.shapes() for node in below}
    if not any(_is_of_panes(node) for node in nodes if isinstance(node, mi.BSDF)):
        return {}
    seen = _reflected(graph, sensor, resolution, np.arange(resolution[0] * resolution[1]), COARSE)
    edges = _edges(seen, resolution)
    fine = _reflected(graph, sensor, resolution, edges, FINE)
    for name in {*seen, *fine}:
        seen[name][:, edges] = fine[name][:, edges]
    return {name: _reflection(one, resolution) for name, one in seen.items()}


def _reflected(
    graph: SceneGraph, sensor: Any, resolution: tuple[int, int], pixels: Indices, rays: _Rays
) -> defaultdict[str, Floats]:
    """Return the radiance that panes reflect of each emitter to each pixel, and the fraction that it covers.

    ``(4, H * W)``. Rays that are split as the light is tell the radiance. Of those, a pane reflects too few to
    tell how much of a pixel a lamp covers, so that all are reflected for this.
    """
    objects, _ = objects_of(graph)
    seen: defaultdict[str, Floats] = defaultdict(
        lambda: np.zeros((4, resolution[0] * resolution[1]), np.float32)
    )
    for found in _in_pixels(graph, sensor, resolution, pixels, rays):
        for index, own in _emitters(found):
            seen[objects[index]][:3, found.pixels] = (found.radiance * own).mean(-1)
    for found in _in_pixels(graph, sensor, resolution, pixels, rays._replace(turns=1), "reflected"):
        for index, own in _emitters(found):
            seen[objects[index]][3, found.pixels] = own.mean(-1)
    return seen


def _emitters(found: _Light) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Yield the emitters that panes reflect, with the rays that meet them."""
    is_lit = found.reflected & found.radiance.any(0)
    yield from ((index, is_lit & (found.met == index)) for index in np.unique(found.met[is_lit]))


def _edges(seen: Mapping[str, Floats], resolution: tuple[int, int]) -> Indices:
    """Return the pixels that show a part of a reflection, and those beside them."""
    edges = torch.zeros(resolution[::-1], dtype=torch.bool)
    for one in seen.values():
        light = _picture(one, resolution)
        shows, gaps = (
            functional.max_pool2d(mask.float()[None], 3, 1, 1)[0] > 0
            for mask in (light.amax(-1) > 0, light[..., 3] < 1)
        )
        edges |= shows & gaps
    return edges.flatten().nonzero()[:, 0].numpy()


def _reflection(seen: Floats, resolution: tuple[int, int]) -> Reflection:
    light = _picture(seen, resolution)
    mean, fraction = light[..., :3], light[..., 3]
    # What only the second of two panes reflects covers whole pixels, as far as is known.
    fraction = torch.where((fraction == 0) & (mean.amax(-1) > 0), 1.0, fraction)
    # A pixel that a lamp hardly covers has few rays that tell its radiance.
    summed = functional.avg_pool2d(torch.cat([mean, fraction[..., None]], -1).movedim(-1, 0), 3, 1, 1)
    around = (summed[:3] / summed[3].clamp_min(torch.finfo().tiny)).movedim(0, -1)
    return Reflection(torch.where(fraction[..., None] > 0, around, 0.0), fraction)


def _picture(values: Floats, resolution: tuple[int, int]) -> torch.Tensor:
    """Return channels of pixels, ``(C, H * W)``, as ``(H, W, C)``."""
    width, height = resolution
    return torch.from_numpy(values).T.reshape(height, width, -1)


def _is_of_panes(material: Any) -> bool:
    """Whether a material reflects and transmits without scattering."""
    flags = material.flags()
    transmits = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Null
    return bool(mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) and flags & transmits)


def _in_pixels(
    graph: SceneGraph,
    sensor: Any,
    resolution: tuple[int, int],
    pixels: Indices,
    rays: _Rays,
    follow: Follow = "split",
) -> Iterator[_Light]:
    """Yield what the rays of some pixels meet, of as many pixels as are traced at once."""
    _, object_of_shape = objects_of(graph)
    (positions, turns), scene = rays, graph.scene
    for pixel, index in rays_in(pixels, positions * turns):
        position, turn = index // turns, index % turns
        with dr.suspend_grad():
            ray, weight = rays_from(sensor, resolution, film_position(resolution, pixel, position, positions))
            hit = scene.ray_intersect_preliminary(ray, coherent=True)
            # The rays of a position take lobes at equal distances, and those of the pixel all lobes as often.
            lobe = position + turn * (positions // turns)
            followed = follow_specular(scene, ray, hit, pixel, lobe, follow, positions)
            interaction = followed.hit.compute_surface_interaction(followed.ray)
            light = followed.throughput * interaction.emitter(scene).eval(interaction) & (dr.max(weight) > 0)
            shape, reflected = visible_shape(interaction), followed.reflected
            dr.eval(shape, light, reflected)
        size = dr.width(index)
        yield _Light(
            pixel.numpy()[:: positions * turns].astype(np.int64),
            object_of_shape[shape.numpy()].reshape(-1, positions * turns),
            np.broadcast_to(light.numpy(), (3, size)).reshape(3, -1, positions * turns),
            np.broadcast_to(reflected.numpy(), size).reshape(-1, positions * turns),
        )
