"""Summary of parameter values for a result."""

from __future__ import annotations

from collections.abc import Mapping

import torch

_MAX_NUMBERS = 16  # a 4 × 4 transform


def summarize(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return small values as they are, means over the texels of textures, and nothing for long vectors."""
    means = {
        name: value.reshape(-1, value.shape[-1]).mean(0) if value.ndim > 1 else value
        for name, value in values.items()
    }
    return {
        name: value.detach().clone() for name, value in means.items() if 0 < value.numel() <= _MAX_NUMBERS
    }
