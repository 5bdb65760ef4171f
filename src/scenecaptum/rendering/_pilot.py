"""A pilot: how large the contributions are that single paths make to the light of each object, by pixel.

Imported only once a variant is active (see ``SceneRenderer``).

A standard error from the spread of replicates can be trusted where many paths make up that spread. Eight
replicates do not tell whether they do; the paths of a pilot do, because each of them is looked at.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..scene import SceneParameters
from ..scene._graph import SceneGraph
from ._texels import number_of

# Numbers that a pilot keeps at most, of each kind: beyond, the pixels of a block share theirs.
MOST = 2**22


@dataclass(frozen=True)
class Rows:
    """Which surfaces and emitters are told apart: those that show the same parameters share a row.

    Attributes
    ----------
    parameters
        For each row, the parameters on which the light that is counted there depends directly.
    of_shape, of_emitter
        The row for each number that Dr.Jit gives a shape or an emitter; for others, one beyond the last.
    """

    parameters: tuple[frozenset[str], ...]
    of_shape: mi.UInt32
    of_emitter: mi.UInt32


def find_rows(graph: SceneGraph, parameters: SceneParameters) -> Rows:
    """Tell the surfaces and emitters of a scene apart by their parameters."""
    nodes = {name: node for name, (_, _, node, _) in mi.traverse(graph.scene).properties.items()}
    able = {
        n: node for n, node in nodes.items() if not parameters[n].problem and parameters[n].kind != "media"
    }
    light = {n: node for n, node in able.items() if parameters[n].kind == "emitters"}
    matter = {n: node for n, node in able.items() if n not in light}
    shapes = {number_of(shape): _shown(matter, below) for _, shape, below in graph.shapes()}
    emitters = {_number_of_emitter(one): _shown(light, below) for one, below in graph.emitters()}
    found = tuple(dict.fromkeys(names for names in (*shapes.values(), *emitters.values()) if names))
    return Rows(found, _table(shapes, found), _table(emitters, found))


def _shown(nodes: dict[str, Any], below: Collection[Any]) -> frozenset[str]:
    return frozenset(name for name, node in nodes.items() if node in below)


def _table(shown: dict[int, frozenset[str]], rows: Sequence[frozenset[str]]) -> mi.UInt32:
    table = np.full(max(shown, default=0) + 1, len(rows), np.uint32)
    for number, names in shown.items():
        if names:
            table[number] = rows.index(names)
    return mi.UInt32(table)


def _number_of_emitter(emitter: Any) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0])


class Counter:
    """Adds up squares and fourth powers of the light of vertices, by row and block of pixels.

    Not a dataclass: Dr.Jit would make all of it variables of the loop that tells it of light.

    Parameters
    ----------
    rows
        What is told apart.
    block, blocks
        The block of pixels that each lane belongs to, and how many blocks there are.
    response
        What the sensor makes of each lane's radiance.
    squares, fourths
        The sums, of ``rows · blocks`` elements. In double precision: radiance may be anything that float32 holds.
    """

    def __init__(
        self, rows: Rows, block: Any, blocks: int, response: Any, squares: Any, fourths: Any
    ) -> None:
        self.rows, self.block, self.blocks, self.response = rows, block, blocks, response
        self.squares, self.fourths = squares, fourths

    def add(self, si: Any, met: Any, emitted: Any, chosen: Any, reflected: Any, later: Any) -> None:
        """Count what an emitter that was ``met`` emits, and what the surface passes on.

        That is ``reflected`` light of a ``chosen`` emitter, and ``later`` light that the path goes on to.
        """
        shape, instance = (dr.reinterpret_array(mi.UInt32, one) for one in (si.shape, si.instance))
        self._count(self.rows.of_shape, dr.select(instance != 0, instance, shape), reflected + later)
        for emitter, light in ((met, emitted), (chosen, reflected)):
            self._count(self.rows.of_emitter, dr.reinterpret_array(mi.UInt32, emitter), light)

    def _count(self, table: mi.UInt32, number: Any, light: Any) -> None:
        size = dr.sum(dr.abs(light * self.response))
        row = dr.gather(mi.UInt32, table, number, number < dr.width(table))
        active = (size > 0) & (number < dr.width(table)) & (row < len(self.rows.parameters))
        square, index = dr.square(type(self.squares)(size)), row * self.blocks + self.block
        dr.scatter_add(self.squares, square, index, active)
        dr.scatter_add(self.fourths, dr.square(square), index, active)


@dataclass(frozen=True)
class Pilot:
    """Mean powers, over samples in a pixel, of the contributions that vertices make to the light of rows.

    Attributes
    ----------
    parameters
        Those of each row.
    squares, fourths
        ``(rows, blocks)``.
    block
        The block of each pixel, ``(H·W,)``.
    """

    parameters: tuple[frozenset[str], ...]
    squares: NDArray[np.float64]
    fourths: NDArray[np.float64]
    block: NDArray[np.intp]

    def spread(
        self, name: str, strength: NDArray[np.float64], samples: NDArray[np.float64]
    ) -> tuple[float, float] | None:
        """Return variance and fourth cumulant of an estimate of a parameter's light, seen through an adjoint.

        Contributions are taken for rare events, each of which happens or not; a few numbers of these make up a
        sum whose cumulants are those of a compound Poisson distribution.

        Parameters
        ----------
        name
            The parameter.
        strength
            Magnitude of the adjoint in each pixel, ``(H·W,)``.
        samples
            How many samples of each pixel the estimate has, ``(H·W,)``.

        Returns
        -------
        tuple or None
            None where the parameter belongs to no surface and no emitter.
        """
        rows = [row for row, names in enumerate(self.parameters) if name in names]
        if not rows:
            return None
        by_block = (
            np.bincount(self.block, strength**2 / samples, self.squares.shape[1]),
            np.bincount(self.block, strength**4 / samples**3, self.fourths.shape[1]),
        )
        return float(self.squares[rows].sum(0) @ by_block[0]), float(self.fourths[rows].sum(0) @ by_block[1])


def take_pilot(integrator: Any, scene: Any, sensor: Any, rows: Rows, spp: int, seed: int) -> Pilot:
    """Trace ``spp`` paths from each pixel and count their light."""
    width, height = sensor.film().crop_size()
    edge = 1
    while len(rows.parameters) * -(-width // edge) * -(-height // edge) > MOST:
        edge += 1
    y, x = np.divmod(np.arange(width * height), width)
    block = y // edge * -(-width // edge) + x // edge
    of_pixel, blocks = mi.UInt32(block), int(block.max()) + 1
    shape = len(rows.parameters), blocks
    sums = [dr.zeros(dr.float64_array_t(mi.Float), max(1, shape[0] * blocks)) for _ in range(2)]

    def counter(pixel: Any, response: Any) -> Counter:
        return Counter(rows, dr.gather(mi.UInt32, of_pixel, pixel), blocks, response, *sums)

    if scene.emitters():  # of which one is sampled
        integrator.count(scene, sensor, spp, seed, counter)
    samples = spp * np.bincount(block)
    squares, fourths = (one.numpy()[: shape[0] * blocks].reshape(shape) / samples for one in sums)
    return Pilot(rows.parameters, squares, fourths, block)
