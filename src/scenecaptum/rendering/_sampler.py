"""Low-discrepancy random numbers over all samples of a render: Owen-scrambled Sobol points.

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
    """Sampler with the interface of Mitsuba's: each call draws one or two more dimensions of one point per lane.

    Adjacent lanes have adjacent points of the sequence: each aligned block of 2ⁿ lanes is stratified in each
    dimension drawn, and so are all lanes together. Successive dimensions are independent, and so are seeds.
    """

    DRJIT_STRUCT = {"_index": mi.UInt32, "_seed": mi.UInt32, "_drawn": mi.UInt32}  # noqa: RUF012

    def __init__(self, index: Any = None, seed: Any = None, drawn: Any = None) -> None:
        self._index = index  # of the point, in reversed bit order
        self._seed = seed
        self._drawn = drawn

    @staticmethod
    def of(lanes: int, seed: Any) -> SobolSampler:
        """Return a sampler with the given number of lanes."""
        return SobolSampler(dr.brev(dr.arange(mi.UInt32, lanes)), mi.UInt32(seed), dr.zeros(mi.UInt32, lanes))

    @staticmethod
    def at(lane: Any, seed: Any) -> SobolSampler:
        """Return a sampler for the given lanes: those whose numbers are equal draw the same."""
        return SobolSampler(dr.brev(lane), mi.UInt32(seed), mi.UInt32(0))

    def clone(self) -> SobolSampler:
        """Return a copy that draws the same numbers."""
        return SobolSampler(mi.UInt32(self._index), mi.UInt32(self._seed), mi.UInt32(self._drawn))

    def fork(self) -> SobolSampler:
        """Return an independent sampler; drawing from it does not advance this one."""
        return SobolSampler(mi.UInt32(self._index), ~self._seed, mi.UInt32(self._drawn))

    def next_1d(self, active: Any = True) -> Any:
        """Draw a number in [0, 1)."""
        first, _, seed_x, _ = self._draw()
        return _to_unit_interval(_scramble(first, seed_x))

    def next_2d(self, active: Any = True) -> Any:
        """Draw a point in [0, 1)²."""
        first, second, seed_x, seed_y = self._draw()
        return mi.Point2f(
            _to_unit_interval(_scramble(first, seed_x)), _to_unit_interval(_scramble(second, seed_y))
        )

    def _draw(self) -> tuple[Any, Any, Any, Any]:
        order_seed, seed_x = mi.sample_tea_32(self._seed, self._drawn)
        seed_y = (order_seed ^ 0x9E3779B9) * 0x85EBCA6B + seed_x
        self._drawn += 1
        first = _hash(self._index, order_seed)
        return first, _second_dimension(first), seed_x, seed_y


def _second_dimension(first: Any) -> Any:
    """Return a Sobol point's second coordinate from its first: its generator matrix is Pascal's triangle mod 2."""
    bits = mi.UInt32(first)
    for shift, mask in ((16, 0xFFFF0000), (8, 0xFF00FF00), (4, 0xF0F0F0F0), (2, 0xCCCCCCCC), (1, 0xAAAAAAAA)):
        bits ^= (bits << shift) & mask
    return bits


def _scramble(bits: Any, seed: Any) -> Any:
    return dr.brev(_hash(dr.brev(bits), seed))


def _hash(bits: Any, seed: Any) -> Any:
    """Flip each bit at random, depending on the bits below it."""
    bits = bits ^ (bits * 0x3D20ADEA)
    bits += seed
    bits *= (seed >> 16) | 1
    bits ^= bits * 0x05526C56
    bits ^= bits * 0x53A22864
    return bits


def _to_unit_interval(bits: Any) -> Any:
    return mi.Float(bits >> 8) * 2**-24
