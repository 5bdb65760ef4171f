"""Hashes of the arguments of a render."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ..errors import SceneCaptumError


def digest(content: Any) -> str:
    """Return a hash of strings, numbers and tensors, in tuples and mappings.

    Example
    -------
    >>> digest(("picture", {"a": torch.zeros(2), "b": 1})) == digest(("picture", {"b": 1, "a": torch.zeros(2)}))
    True
    >>> digest(torch.zeros(2)) == digest(torch.zeros(2, 1))
    False
    """
    state = hashlib.blake2b(digest_size=16)
    _update(state, content)
    return state.hexdigest()


def _update(state: Any, content: Any) -> None:
    """Update a hash; every item is prefixed with its type and size, so that the encoding is unambiguous."""
    if isinstance(content, torch.Tensor):
        content = content.detach().cpu().contiguous()
        state.update(f"tensor {content.dtype} {tuple(content.shape)} ".encode())
        state.update(content.reshape(-1).view(torch.uint8).numpy())
    elif isinstance(content, np.ndarray):
        state.update(f"array {content.dtype} {content.shape} ".encode())
        state.update(np.ascontiguousarray(content).reshape(-1).view(np.uint8))
    elif isinstance(content, Mapping):
        state.update(f"mapping {len(content)} ".encode())
        for name in sorted(content):
            _update(state, name)
            _update(state, content[name])
    elif isinstance(content, (tuple, list)):
        state.update(f"tuple {len(content)} ".encode())
        for item in content:
            _update(state, item)
    elif content is None or isinstance(content, (str, int, float)):
        text = repr(content).encode()
        state.update(f"{type(content).__name__} {len(text)} ".encode() + text)
    else:
        raise SceneCaptumError(
            f"checkpoint= supports tensors, numbers and strings as arguments, not {type(content).__name__}."
        )
