"""A pilot render: how much single paths contribute to the light of each object, by pixel.

A standard error from the spread of replicates is reliable where many paths make up that spread. Eight replicates
cannot show whether they do. The individual paths of a pilot can.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from ..scene import SceneGraph, SceneParameters
from ._bridge import evaluate
from ._chunks import MAX_SAMPLES
from ._derivative_routes import DIFFERENCE_SPP_DIVISOR, derivative_routes
from ._dr_arrays import owned
from ._frozen import FrozenFunction, clear
from ._importance_maps import ImportanceMaps
from ._live_scene import LiveScene, Values
from ._pixel_sampling import pixel_probabilities
from ._plan import RenderPlan
from ._registry import emitter_index, index_table, shape_index

# Samples of a pilot: relative to those of the estimate, and in all at most.
PILOT_FACTOR, MAX_PILOT_SAMPLES = 4, 2**17

# A lamp that is off gets this fraction of the largest brightness, which hardly adds to the light of the others.
BRIGHTNESS = {"radiance", "intensity", "irradiance", "scale"}
OFF_FACTOR = 1e-6

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
    emitters = {emitter_index(emitter): _names_below(light, below) for emitter, below in graph.emitters()}
    groups = tuple(dict.fromkeys(names for names in (*shapes.values(), *emitters.values()) if names))
    return ParameterGroups(groups, _table(shapes, groups), _table(emitters, groups))


def _names_below(nodes: dict[str, Any], below: Collection[Any]) -> frozenset[str]:
    return frozenset(name for name, node in nodes.items() if node in below)


def _table(names_by_index: dict[int, frozenset[str]], groups: Sequence[frozenset[str]]) -> mi.UInt32:
    group_of = {index: groups.index(names) for index, names in names_by_index.items() if names}
    return index_table(group_of, len(groups))


@dataclass
class Sums:
    """Sums of squares and of fourth powers, in double precision because squares may overflow float32."""

    squares: Any
    fourths: Any

    @classmethod
    def zeros(cls, size: int) -> Sums:
        """Return ``size`` sums of each."""
        arrays = [dr.zeros(dr.float64_array_t(mi.Float), size) for _ in range(2)]
        dr.make_opaque(arrays)
        return cls(*arrays)

    def clear(self) -> None:
        """Set all sums to 0."""
        self.__dict__ |= vars(Sums.zeros(dr.width(self.squares)))


class Moments:
    """Accumulates squares and fourth powers of the contributions of path vertices, by group and block of pixels.

    Not a dataclass, whose fields Dr.Jit would make state variables of the integrator's loop. ``block`` is that of
    each lane, and ``response`` the sensor's to its radiance. ``groups`` are the two tables of ``ParameterGroups``
    and the number of groups; there are ``groups · blocks`` ``sums``.
    """

    def __init__(
        self, groups: tuple[Any, Any, int], block: Any, blocks: int, response: Any, sums: Sums
    ) -> None:
        self.of_shape, self.of_emitter, self.count = groups
        self.block, self.blocks, self.response = block, blocks, response
        self.sums = sums

    def add(
        self, si: Any, hit_emitter: Any, emission: Any, sampled_emitter: Any, direct: Any, indirect: Any
    ) -> None:
        """Add a vertex: emission of the hit emitter, reflected light of the sampled one, and indirect light."""
        shape, instance = (dr.reinterpret_array(mi.UInt32, pointer) for pointer in (si.shape, si.instance))
        self._add(self.of_shape, dr.select(instance != 0, instance, shape), direct + indirect)
        for emitter, light in ((hit_emitter, emission), (sampled_emitter, direct)):
            self._add(self.of_emitter, dr.reinterpret_array(mi.UInt32, emitter), light)

    def _add(self, table: mi.UInt32, jit_index: Any, light: Any) -> None:
        size = dr.sum(dr.abs(light * self.response))
        group = dr.gather(mi.UInt32, table, jit_index, jit_index < dr.width(table))
        active = (size > 0) & (jit_index < dr.width(table)) & (group < self.count)
        sums, index = self.sums, group * self.blocks + self.block
        square = dr.square(type(sums.squares)(size))
        dr.scatter_add(sums.squares, square, index, active)
        dr.scatter_add(sums.fourths, dr.square(square), index, active)


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
    plan: RenderPlan
    integrator: Any
    importance_maps: ImportanceMaps
    moved: Collection[str]  # parameters that are differentiated by differences of paths
    _pilots: dict[int, Pilot] = field(default_factory=dict)
    _originals: Values = field(default_factory=dict)  # those of the cached pilots

    def cumulants(
        self, values: Values, tracked: Sequence[str], adjoint: torch.Tensor, spp: int, replicates: int
    ) -> dict[str, tuple[float, float]]:
        """Return variance and fourth cumulant of the mean over replicates of importance-sampled gradients.

        They are those of the light that each tracked parameter acts on, at the scene's own values; what is black
        there or switched off has a small value instead. Parameters without such light are left out, and so are
        low roughnesses that are differentiated by light tracing.
        """
        adjoint = adjoint.detach().float()
        width, height = self.live.resolution
        with self.live.exclusive():
            routes = derivative_routes(self.parameters, {**self.live.original, **values}, tracked)
            film = self.importance_maps.film
            magnitude = film.rms_adjoint(adjoint) if film else adjoint.norm(dim=-1)
            groups = self.importance_maps.groups(values, routes)
            sampled = {
                name: pixel_probabilities(magnitude, group.maps) * (width * height * spp)
                for group in groups
                for name in group.names
            }
            pilot = self._run(
                max(1, min(PILOT_FACTOR * spp * replicates, MAX_PILOT_SAMPLES // (width * height)))
            )
            difference_spp = max(1, spp // DIFFERENCE_SPP_DIVISOR)
            moved = [name for name in self.moved if name in routes and routes[name].difference is not None]
            maps = self.importance_maps.find_maps(values, moved, None)
            moved_samples = pixel_probabilities(magnitude, maps) * (
                width * height * spp / DIFFERENCE_SPP_DIVISOR
            )
        weights = magnitude.cpu().double().numpy().ravel()
        samples = dict.fromkeys(tracked, np.full_like(weights, difference_spp))
        samples |= sampled | dict.fromkeys(moved, moved_samples)
        left_out = {name for group in groups if group.light_traced for name in group.names}
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
            with self.live.with_values(self._nonzero_values()):
                self._pilots[spp] = self._trace(spp)
        return self._pilots[spp]

    def _nonzero_values(self) -> Values:
        """Return small values for black surfaces and lamps that are off.

        Their light is 0, but its derivative is not. How many paths contribute hardly depends on the value.
        """
        original = self.live.original
        names = sorted(frozenset().union(*self._groups.parameters))
        dark = [name for name in names if not original[name].any()]
        black = [name for name in dark if self.parameters[name].kind == "reflectance"]
        lamps = [name for name in names if self._is_brightness(name)]
        brightest = max((float(original[name].max()) for name in lamps), default=0.0)
        off = OFF_FACTOR * brightest if brightest > 0 else 1.0
        routes = derivative_routes(self.parameters, original, black)
        return {name: route.replay_value for name, route in routes.items()} | {
            name: torch.full_like(original[name], off) for name in lamps if name in dark
        }

    def _is_brightness(self, name: str) -> bool:
        """Whether a parameter is the brightness of a lamp, without texels."""
        parameter = self.parameters[name]
        return parameter.kind == "emitters" and parameter.role in BRIGHTNESS and len(parameter.shape) < 2

    @cached_property
    def _groups(self) -> ParameterGroups:
        return find_parameter_groups(self.live.graph, self.parameters)

    def _trace(self, spp: int) -> Pilot:
        """Trace ``spp`` paths from each pixel and accumulate the moments of their contributions."""
        (width, height), groups = self.live.resolution, self._groups
        side = 1
        while len(groups.parameters) * -(-width // side) * -(-height // side) > MAX_VALUES:
            side += 1
        y, x = np.divmod(np.arange(width * height), width)
        block = y // side * -(-width // side) + x // side
        blocks = int(block.max()) + 1
        tables = groups.of_shape, groups.of_emitter, owned(mi.UInt32(block)), blocks
        shape = len(groups.parameters), blocks
        sums = Sums.zeros(max(1, shape[0] * blocks))
        scene, scalars = self.live.scene, self.live.state.scalars
        for number, pixel in enumerate(_pixels_in_chunks(width * height, spp)):
            if scene.emitters():  # otherwise none can be sampled
                self._kernel(scene, dr.opaque(mi.UInt32, number), scalars, pixel, tables, sums)
                evaluate(sums)
        samples = spp * np.bincount(block)
        squares, fourths = (
            total.numpy()[: shape[0] * blocks].reshape(shape) / samples
            for total in (sums.squares, sums.fourths)
        )
        return Pilot(groups.parameters, squares, fourths, block)

    @cached_property
    def _kernel(self) -> Callable[..., None]:
        """The integrator's ``accumulate_moments``, frozen where possible."""
        integrator, count = self.integrator, len(self._groups.parameters)

        def accumulate(
            sensor: Any,
            scene: Any,
            seed: Any,
            scalars: tuple[float, ...],
            pixel: Any,
            tables: tuple[Any, Any, Any, int],
            sums: Sums,
        ) -> None:
            of_shape, of_emitter, block_of_pixel, blocks = tables
            block = dr.gather(mi.UInt32, block_of_pixel, pixel)

            def make_moments(response: Any) -> Moments:
                return Moments((of_shape, of_emitter, count), block, blocks, response, sums)

            integrator.accumulate_moments(scene, sensor, seed, pixel, make_moments)

        if not self.plan.kind.freezable:
            return partial(accumulate, self.live.sensor)
        return FrozenFunction(accumulate, lambda *arguments: clear(arguments), self.live.sensor)


def _pixels_in_chunks(pixels: int, spp: int) -> Iterator[Any]:
    """Return the pixel of each sample, in as few chunks as fit into memory."""
    at_once = max(1, MAX_SAMPLES // spp)
    for first in range(0, pixels, at_once):
        lane = dr.arange(mi.UInt32, spp * min(at_once, pixels - first))
        pixel = dr.opaque(mi.UInt32, first) + lane // dr.opaque(mi.UInt32, spp)
        dr.eval(pixel)
        yield pixel
