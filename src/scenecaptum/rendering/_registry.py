"""Dr.Jit's registry, which numbers the shapes, emitters and materials of all scenes in the process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ._dr_arrays import owned


def shape_index(shape: Any) -> int:
    """Return Dr.Jit's index of a shape."""
    return _index(mi.ShapePtr(shape))


def emitter_index(emitter: Any) -> int:
    """Return Dr.Jit's index of an emitter."""
    return _index(mi.EmitterPtr(emitter))


def bsdf_index(bsdf: Any) -> int:
    """Return Dr.Jit's index of a material."""
    return _index(mi.BSDFPtr(bsdf))


def _index(pointer: Any) -> int:
    return int(dr.reinterpret_array(mi.UInt32, pointer)[0])


def index_table(values: Mapping[int, int], other: int) -> mi.UInt32:
    """Return a table of values by Dr.Jit's index, with ``other`` for the indices that have none.

    Its length is 3·2ⁿ, which is hardly ever a number of samples plus one: a frozen function is recorded again
    where two arrays of different lengths have the same.
    """
    length = 3
    while length <= max(values, default=0):
        length *= 2
    table = np.full(length, other, np.uint32)
    table[list(values)] = list(values.values())
    return owned(mi.UInt32(table))
