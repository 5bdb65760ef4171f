"""Random numbers that spread evenly over all samples of a picture: Owen-scrambled Sobol points.

Imported only once a variant is active (see ``SceneRenderer``).

References
----------
Burley, "Practical Hash-based Owen Scrambling", Journal of Computer Graphics Techniques 9(4), 2020.
Laine and Karras, "Stratified Sampling for Stochastic Transparency", Computer Graphics Forum 30(4), 2011.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


class SobolSampler:
    """Hands out the coordinates of one point per lane, as Mitsuba's samplers do, in one or two dimensions at once.

    Neighbouring lanes have neighbouring points: any aligned 2ⁿ of them are evenly spread in each coordinate that
    is drawn, and so are all of them. Coordinates drawn one after the other are independent, as are seeds.
    """

    DRJIT_STRUCT = {"_index": mi.UInt32, "_seed": mi.UInt32, "_drawn": mi.UInt32}  # noqa: RUF012

    def __init__(self, index: Any = None, seed: Any = None, drawn: Any = None) -> None:
        self._index = index  # of the point, its bits reversed
        self._seed = seed
        self._drawn = drawn

    @staticmethod
    def of(lanes: int, seed: Any) -> SobolSampler:
        """Return a sampler for so many lanes."""
        index = dr.brev(dr.arange(mi.UInt32, lanes))
        return SobolSampler(index, mi.UInt32(seed), dr.zeros(mi.UInt32, lanes))

    def clone(self) -> SobolSampler:
        """Return another that will draw the same."""
        return SobolSampler(mi.UInt32(self._index), mi.UInt32(self._seed), mi.UInt32(self._drawn))

    def apart(self) -> SobolSampler:
        """Return another whose numbers are independent of this one's: what it draws is not drawn here."""
        return SobolSampler(mi.UInt32(self._index), ~self._seed, mi.UInt32(self._drawn))

    def next_1d(self, active: Any = True) -> Any:
        """Draw a number in [0, 1)."""
        first, _, along, _ = self._draw()
        return _unit(_scrambled(first, along))

    def next_2d(self, active: Any = True) -> Any:
        """Draw a point in [0, 1)²."""
        first, second, along, across = self._draw()
        return mi.Point2f(_unit(_scrambled(first, along)), _unit(_scrambled(second, across)))

    def _draw(self) -> tuple[Any, Any, Any, Any]:
        order, along = mi.sample_tea_32(self._seed, self._drawn)
        across = (order ^ 0x9E3779B9) * 0x85EBCA6B + along
        self._drawn += 1
        first = _hash(self._index, order)
        return first, _second(first), along, across


def _second(first: Any) -> Any:
    """Return the second coordinate of a Sobol point from its first: bits are summed as in Pascal's triangle."""
    bits = mi.UInt32(first)
    for shift, mask in ((16, 0xFFFF0000), (8, 0xFF00FF00), (4, 0xF0F0F0F0), (2, 0xCCCCCCCC), (1, 0xAAAAAAAA)):
        bits ^= (bits << shift) & mask
    return bits


def _scrambled(bits: Any, seed: Any) -> Any:
    return dr.brev(_hash(dr.brev(bits), seed))


def _hash(bits: Any, seed: Any) -> Any:
    """Change each bit at random, depending on those below it."""
    bits = bits ^ (bits * 0x3D20ADEA)
    bits += seed
    bits *= (seed >> 16) | 1
    bits ^= bits * 0x05526C56
    bits ^= bits * 0x53A22864
    return bits


def _unit(bits: Any) -> Any:
    return mi.Float(bits >> 8) * 2**-24
