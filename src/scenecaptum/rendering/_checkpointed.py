"""An engine whose passes are kept in a folder, and what tells them from those of any other scene.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..checkpoint import Checkpoint, digest
from ..scene._naming import without_addresses
from ._engine import Engine, Values


class CheckpointedEngine:
    """An engine that is asked only for what the checkpoint does not have.

    Parameters
    ----------
    engine
        What renders.
    checkpoint
        Where passes are kept.
    fingerprint
        Of the scene and how it is rendered: what a pass follows from beside its arguments.
    """

    def __init__(self, engine: Engine, checkpoint: Checkpoint, fingerprint: str) -> None:
        self.engine = engine
        self._checkpoint = checkpoint
        self._fingerprint = fingerprint

    def __getattr__(self, name: str) -> Any:
        return getattr(self.engine, name)

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render, or return the picture that was rendered before."""
        (image,) = self._take(
            "picture", (values, seed, spp), lambda: (self.engine.primal(values, seed, spp),)
        )
        return image

    def adjoint(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        choose: bool = False,
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product, as ``Engine.adjoint``."""
        return self._take(
            "gradient",
            (values, tuple(tracked), adjoint, seed, spp, choose),
            lambda: self.engine.adjoint(values, tracked, adjoint, seed, spp, choose=choose),
        )

    def tangent(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product, as ``Engine.tangent``."""
        (image,) = self._take(
            "derivative image",
            (values, tangents, seed, spp),
            lambda: (self.engine.tangent(values, tangents, seed, spp),),
        )
        return image

    def _take(
        self, kind: str, asked: Any, render: Callable[[], tuple[torch.Tensor, ...]]
    ) -> tuple[torch.Tensor, ...]:
        return self._checkpoint.take((kind, self._fingerprint, asked), render, self.engine.device)


def scene_contents(scene: Any) -> str:
    """Return a hash of all that Mitsuba tells of a scene: its plugins and their settings, and every array."""
    parameters = mi.traverse(scene)
    numbers = {name: _plain(parameters[name]) for name in parameters.keys()}  # noqa: SIM118
    return digest((without_addresses(str(scene)), numbers))


def fingerprint(scene: str, sensor: Any, settings: Mapping[str, Any]) -> str:
    """Return a hash of a scene's contents, a sensor, how they are rendered and by which versions."""
    versions = [version(package) for package in ("scenecaptum", "mitsuba", "drjit")]
    parameters = mi.traverse(sensor)
    numbers = {name: _plain(parameters[name]) for name in parameters.keys()}  # noqa: SIM118
    camera = without_addresses(str(sensor)), numbers
    return digest((scene, camera, dict(settings), versions, mi.variant()))


def _plain(value: Any) -> Any:
    """Return a value of Mitsuba's as numbers, or as the text that it prints."""
    value = getattr(value, "matrix", value)
    if not dr.is_array_v(value):
        return value if isinstance(value, (int, float, str)) else without_addresses(str(value))
    value = dr.detach(value)
    array = value.array if dr.is_tensor_v(value) else dr.ravel(value) if dr.depth_v(value) > 1 else value
    return np.array(array)
