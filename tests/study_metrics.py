"""Metrics for studies, which their workers import."""

from __future__ import annotations

import os

import torch


def brightness(image: torch.Tensor) -> torch.Tensor:
    """Return the mean radiance."""
    return image.mean()


def broken(image: torch.Tensor) -> torch.Tensor:
    """Raise an error."""
    raise ValueError("this metric has no value")


def aborts(image: torch.Tensor) -> torch.Tensor:
    """End the process, as a crash of the renderer does."""
    os.abort()
