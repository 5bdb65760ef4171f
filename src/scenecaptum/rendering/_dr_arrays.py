"""Copies of Dr.Jit arrays, and their shapes in torch."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def flat(value: Any) -> Any:
    """Return a Dr.Jit scalar, colour or tensor as a tensor of its shape in torch."""
    if isinstance(value, float):
        return mi.TensorXf(mi.Float(value), shape=())
    if dr.is_tensor_v(value):
        return value
    if dr.depth_v(value) > 1:
        return mi.TensorXf(dr.ravel(value), shape=(dr.size_v(value),))
    width = dr.width(value)
    return mi.TensorXf(value, shape=() if width == 1 else (width,))


def owned(value: Any) -> Any:
    """Copy into Dr.Jit's own memory.

    A frozen function would keep reading borrowed memory. And NumPy's arrays start at any address, but a kernel is
    compiled for memory that is aligned, or for any.
    """
    array = value.array if dr.is_tensor_v(value) else value
    # Dr.Jit cannot optimize away the addition of an opaque zero.
    copied = array + dr.opaque(type(array), 0)
    dr.eval(copied)
    return type(value)(copied, shape=value.shape) if dr.is_tensor_v(value) else copied
