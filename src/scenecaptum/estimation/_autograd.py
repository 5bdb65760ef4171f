"""Gradients where the caller has disabled them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from ..errors import SceneCaptumError


@contextlib.contextmanager
def gradients_enabled() -> Iterator[None]:
    """Record gradients inside, also under ``torch.no_grad()``; as a context or a decorator.

    Raises under ``torch.inference_mode()``: the tensors that are created there can never have gradients.
    """
    if torch.is_inference_mode_enabled():
        raise SceneCaptumError(
            "Gradients cannot be computed under torch.inference_mode(): leave it, or use torch.no_grad(), under "
            "which they can."
        )
    with torch.enable_grad():
        yield
