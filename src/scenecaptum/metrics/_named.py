"""Metrics that have a name on the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from typing import NamedTuple

import torch


class NamedMetric(NamedTuple):
    """A metric that can be created from a sensor and options alone; ``description`` says what it measures.

    ``create`` is the metric's class, or a function that returns it. It is given the camera as ``camera``, the
    points of a sensor grid as ``grid``, and every option of the command line under its own name, as far as it has
    these parameters.
    """

    create: Callable[..., Callable[[torch.Tensor], torch.Tensor]]
    description: str

    @property
    def parameters(self) -> Collection[str]:
        """The names of the parameters of ``create``."""
        return inspect.signature(self.create).parameters.keys()
