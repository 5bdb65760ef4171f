"""Calls of Dr.Jit functions with torch tensors; no graph of derivatives outlives a call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import torch

from ..backend import device
from ..errors import SceneCaptumError

NO_DERIVATIVE = (
    "No derivative reaches any of the inputs: none of them affects a path that can be differentiated. See "
    "renderer.plan for cautions, and add an input that the image depends on, such as a light."
)


def call_with_torch(function: Callable[..., Any], *tensors: torch.Tensor) -> Any:
    """Call a function of Dr.Jit tensors with torch tensors, and return tensors in torch's own memory.

    A tensor in Dr.Jit's memory would be freed by whoever drops it last, without the lock.
    """
    try:
        result = dr.wrap(source="torch", target="drjit")(function)(
            *(tensor.detach().to(device(), torch.float32).contiguous() for tensor in tensors)
        )
        return _clone(result)
    except RuntimeError as error:
        if is_detached_error(error):
            raise SceneCaptumError(NO_DERIVATIVE) from error
        raise


def _clone(result: Any) -> Any:
    if isinstance(result, torch.Tensor):
        return result.clone()
    return [_clone(one) for one in result] if isinstance(result, (list, tuple)) else result


def evaluate(*images: Any) -> Any:
    """Evaluate and wait: otherwise Dr.Jit would start the next chunk beside this one, with memory of its own."""
    dr.eval(*images)
    dr.sync_thread()
    return images[0] if images else None


def is_detached_error(error: BaseException) -> bool:
    """Whether an error was caused by Mitsuba finding nothing attached to the AD graph."""
    return "not attached to the AD graph" in full_message(error)


def full_message(error: BaseException | None) -> str:
    """Return the messages of an error and of its causes."""
    return "" if error is None else f"{error} {full_message(error.__cause__)}"
