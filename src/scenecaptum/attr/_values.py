"""What the parameters were: small values whole, textures as their mean colour."""

from __future__ import annotations

from collections.abc import Mapping

import torch

_MOST_NUMBERS = 16  # a 4 × 4 transform


def summarise(values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return values worth keeping beside a result: a texture's mean over its texels, nothing for a long vector."""
    means = {
        name: value.reshape(-1, value.shape[-1]).mean(0) if value.ndim > 1 else value
        for name, value in values.items()
    }
    return {
        name: value.detach().clone() for name, value in means.items() if 0 < value.numel() <= _MOST_NUMBERS
    }
