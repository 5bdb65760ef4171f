"""A pilot render: how much single paths contribute to the light of each object, by pixel.

A standard error from the spread of replicates is reliable where many paths make up that spread. Eight replicates
cannot show whether they do. The individual paths of a pilot can.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from ..scene import SceneGraph, SceneParameters
from ._derivative_routes import DIFFERENCE_SPP_DIVISOR, derivative_routes
from ._importance_maps import ImportanceMaps
from ._live_scene import LiveScene, Values
from ._pixel_sampling import pixel_probabilities
from ._texels import shape_index

# Samples of a pilot: relative to those of the estimate, and in all at most.
PILOT_FACTOR, MAX_PILOT_SAMPLES = 4, 2**17

# Maximum number of accumulated values of each moment; in larger images blocks of pixels share theirs.
MAX_VALUES = 2**22


@dataclass(frozen=True)
class ParameterGroups:
    """Groups of surfaces and emitters that use the same parameters."""

    parameters: tuple[frozenset[str], ...]  # on which the light of each group depends directly
    of_shape: mi.UInt32  # the group of each of Dr.Jit's shape indices; the number of groups for any other
    of_emitter: mi.UInt32  # likewise of emitter indices


def find_parameter_groups(graph: SceneGraph, parameters: SceneParameters) -> ParameterGroups:
    """Group the surfaces and emitters of a scene by their differentiable parameters."""
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    differentiable = {
        n: node for n, node in nodes.items() if not parameters[n].problem and parameters[n].kind != "media"
    }
    light = {n: node for n, node in differentiable.items() if parameters[n].kind == "emitters"}
    matter = {n: node for n, node in differentiable.items() if n not in light}
    shapes = {shape_index(shape): _names_below(matter, below) for _, shape, below in graph.shapes()}
    emitters = {_emitter_index(emitter): _names_below(light, below) for emitter, below in graph.emitters()}
    groups = tuple(dict.fromkeys(names for names in (*shapes.values(), *emitters.values()) if names))
    return ParameterGroups(groups, _table(shapes, groups), _table(emitters, groups))


def _names_below(nodes: dict[str, Any], below: Collection[Any]) -> frozenset[str]:
    return frozenset(name for name, node in nodes.items() if node in below)


def _table(names_by_index: dict[int, frozenset[str]], groups: Sequence[frozenset[str]]) -> mi.UInt32:
    table = np.full(max(names_by_index, default=0) + 1, len(groups), np.uint32)
    for index, names in names_by_index.items():
        if names:
            table[index] = groups.index(names)
    return mi.UInt32(table)


def _emitter_index(emitter: Any) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0])


class Moments:
    """Accumulates squares and fourth powers of the contributions of path vertices, by group and block of pixels.

    Not a dataclass, whose fields Dr.Jit would make state variables of the integrator's loop. ``block`` is that of
    each lane, and ``response`` the sensor's to its radiance. The sums have ``groups · blocks`` elements each, in
    double precision because squares may overflow float32.
    """

    def __init__(
        self, groups: ParameterGroups, block: Any, blocks: int, response: Any, squares: Any, fourths: Any
    ) -> None:
        self.groups, self.block, self.blocks, self.response = groups, block, blocks, response
        self.squares, self.fourths = squares, fourths

    def add(
        self, si: Any, hit_emitter: Any, emission: Any, sampled_emitter: Any, direct: Any, indirect: Any
    ) -> None:
        """Add a vertex: emission of the hit emitter, reflected light of the sampled one, and indirect light."""
        shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance))
        self._add(self.groups.of_shape, dr.select(instance != 0, instance, shape), direct + indirect)
        for emitter, light in ((hit_emitter, emission), (sampled_emitter, direct)):
            self._add(self.groups.of_emitter, dr.reinterpret_array(mi.UInt32, emitter), light)

    def _add(self, table: mi.UInt32, jit_index: Any, light: Any) -> None:
        size = dr.sum(dr.abs(light * self.response))
        group = dr.gather(mi.UInt32, table, jit_index, jit_index < dr.width(table))
        active = (size > 0) & (jit_index < dr.width(table)) & (group < len(self.groups.parameters))
        square, index = dr.square(type(self.squares)(size)), group * self.blocks + self.block
        dr.scatter_add(self.squares, square, index, active)
        dr.scatter_add(self.fourths, dr.square(square), index, active)


@dataclass(frozen=True)
class Pilot:
    """Second and fourth moments, over samples in a pixel, of vertices' contributions to the light of groups."""

    parameters: tuple[frozenset[str], ...]  # of each group
    squares: NDArray[np.float64]  # ``(groups, blocks)``
    fourths: NDArray[np.float64]
    block: NDArray[np.intp]  # of each pixel, ``(H·W,)``

    def cumulants(
        self, name: str, magnitude: NDArray[np.float64], samples: NDArray[np.float64]
    ) -> tuple[float, float] | None:
        """Return variance and fourth cumulant of an estimate of a parameter's light, weighted by an adjoint.

        None where the parameter belongs to no surface and no emitter. ``magnitude`` is that of the adjoint in each
        pixel, ``(H·W,)``, and ``samples`` the number of samples of the estimate there. Contributions are modelled
        as rare events, so that their sum has a compound Poisson distribution.
        """
        groups = [group for group, names in enumerate(self.parameters) if name in names]
        if not groups:
            return None
        by_block = (
            np.bincount(self.block, magnitude**2 / samples, self.squares.shape[1]),
            np.bincount(self.block, magnitude**4 / samples**3, self.fourths.shape[1]),
        )
        return (
            float(self.squares[groups].sum(0) @ by_block[0]),
            float(self.fourths[groups].sum(0) @ by_block[1]),
        )


@dataclass(eq=False, repr=False)
class Pilots:
    """Pilots of a scene for one sensor; cached until the scene's own values change."""

    live: LiveScene
    parameters: SceneParameters
    integrator: Any
    importance_maps: ImportanceMaps
    moved: Collection[str]  # parameters that are differentiated by differences of paths
    _pilots: dict[int, Pilot] = field(default_factory=dict)
    _originals: Values = field(default_factory=dict)  # those of the cached pilots

    def cumulants(
        self, values: Values, tracked: Sequence[str], adjoint: torch.Tensor, spp: int, replicates: int
    ) -> dict[str, tuple[float, float]]:
        """Return variance and fourth cumulant of the mean over replicates of importance-sampled gradients.

        They are those of the light that each tracked parameter acts on, at the scene's own values. Parameters
        without such light are left out, and so are low roughnesses that are differentiated by light tracing.
        """
        adjoint = adjoint.detach().float()
        width, height = self.live.resolution
        with self.live.exclusive():
            routes = derivative_routes(self.parameters, {**self.live.original, **values}, tracked)
            film = self.importance_maps.film
            magnitude = film.rms_adjoint(adjoint) if film else adjoint.norm(dim=-1)
            replayed, *light_traced = self.importance_maps.groups(values, routes)
            sampled = pixel_probabilities(magnitude, replayed.maps) * (width * height * spp)
            pilot = self._run(
                max(1, min(PILOT_FACTOR * spp * replicates, MAX_PILOT_SAMPLES // (width * height)))
            )
            difference_spp = max(1, spp // DIFFERENCE_SPP_DIVISOR)
            moved = [name for name in self.moved if name in routes and routes[name].difference is not None]
            maps = self.importance_maps.find_maps(values, moved, None)
            moved_samples = pixel_probabilities(magnitude, maps) * (width * height * difference_spp)
        weights = magnitude.cpu().double().numpy().ravel()
        samples = dict.fromkeys(tracked, np.full_like(weights, difference_spp))
        samples |= dict.fromkeys(replayed.names, sampled) | dict.fromkeys(moved, moved_samples)
        left_out = {name for group in light_traced for name in group.names}
        found = {
            name: pilot.cumulants(name, weights, replicates * samples[name])
            for name in tracked
            if name not in left_out
        }
        return {name: cumulants for name, cumulants in found.items() if cumulants is not None}

    def _run(self, spp: int) -> Pilot:
        if self._originals is not self.live.original:
            self._originals = self.live.original
            self._pilots.clear()
        if spp not in self._pilots:
            live = self.live
            groups = find_parameter_groups(live.graph, self.parameters)
            with live.with_values({}):
                self._pilots[spp] = run_pilot(self.integrator, live.scene, live.sensor, groups, spp, 0)
        return self._pilots[spp]


def run_pilot(
    integrator: Any, scene: Any, sensor: Any, groups: ParameterGroups, spp: int, seed: int
) -> Pilot:
    """Trace ``spp`` paths from each pixel and accumulate the moments of their contributions."""
    width, height = sensor.film().crop_size()
    side = 1
    while len(groups.parameters) * -(-width // side) * -(-height // side) > MAX_VALUES:
        side += 1
    y, x = np.divmod(np.arange(width * height), width)
    block = y // side * -(-width // side) + x // side
    block_of_pixel, blocks = mi.UInt32(block), int(block.max()) + 1
    shape = len(groups.parameters), blocks
    sums = [dr.zeros(dr.float64_array_t(mi.Float), max(1, shape[0] * blocks)) for _ in range(2)]

    def make_moments(pixel: Any, response: Any) -> Moments:
        return Moments(groups, dr.gather(mi.UInt32, block_of_pixel, pixel), blocks, response, *sums)

    if scene.emitters():  # otherwise none can be sampled
        integrator.accumulate_moments(scene, sensor, spp, seed, make_moments)
    samples = spp * np.bincount(block)
    squares, fourths = (total.numpy()[: shape[0] * blocks].reshape(shape) / samples for total in sums)
    return Pilot(groups.parameters, squares, fourths, block)
