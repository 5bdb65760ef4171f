"""An engine that stores its results in a checkpoint folder, and fingerprints of scenes to identify them.

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
from ..scene import without_addresses
from ._engine import Engine
from ._live_scene import Values


class CheckpointedEngine:
    """An engine that computes only what the checkpoint does not contain.

    Parameters
    ----------
    engine
        The engine that renders.
    checkpoint
        Where results are stored.
    fingerprint
        Hash of the scene and the render settings: everything but the arguments that a result depends on.
    device
        The device of images and gradients.
    """

    def __init__(
        self, engine: Engine, checkpoint: Checkpoint, fingerprint: str, device: torch.device
    ) -> None:
        self.engine = engine
        self._checkpoint = checkpoint
        self._fingerprint = fingerprint
        self._device = device

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render, or return the stored image."""
        (image,) = self._take(
            "picture", (values, seed, spp), lambda: (self.engine.primal(values, seed, spp),)
        )
        return image

    def vjp(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        importance_sampling: bool = False,
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product, as ``Engine.vjp``."""
        return self._take(
            "gradient",
            (values, tuple(tracked), adjoint, seed, spp, importance_sampling),
            lambda: self.engine.vjp(
                values, tracked, adjoint, seed, spp, importance_sampling=importance_sampling
            ),
        )

    def jvp(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product, as ``Engine.jvp``."""
        (image,) = self._take(
            "derivative image",
            (values, tangents, seed, spp),
            lambda: (self.engine.jvp(values, tangents, seed, spp),),
        )
        return image

    def _take(
        self, kind: str, arguments: Any, render: Callable[[], tuple[torch.Tensor, ...]]
    ) -> tuple[torch.Tensor, ...]:
        return self._checkpoint.get_or_render((kind, self._fingerprint, arguments), render, self._device)


def scene_contents(scene: Any) -> str:
    """Return a hash of a scene: its plugins, their settings and all arrays, as far as Mitsuba exposes them."""
    parameters = mi.traverse(scene)
    numbers = {name: _plain(parameters[name]) for name in parameters.keys()}  # noqa: SIM118
    return digest((without_addresses(str(scene)), numbers))


def fingerprint(scene: str, sensor: Any, settings: Mapping[str, Any]) -> str:
    """Return a hash of a scene's contents, a sensor, the render settings and the package versions."""
    versions = [version(package) for package in ("scenecaptum", "mitsuba", "drjit")]
    parameters = mi.traverse(sensor)
    numbers = {name: _plain(parameters[name]) for name in parameters.keys()}  # noqa: SIM118
    camera = without_addresses(str(sensor)), numbers
    return digest((scene, camera, dict(settings), versions, mi.variant()))


def _plain(value: Any) -> Any:
    """Return a Mitsuba value as numbers, or as the text that it prints."""
    value = getattr(value, "matrix", value)
    if not dr.is_array_v(value):
        return value if isinstance(value, (int, float, str)) else without_addresses(str(value))
    value = dr.detach(value)
    array = value.array if dr.is_tensor_v(value) else dr.ravel(value) if dr.depth_v(value) > 1 else value
    return np.array(array)
