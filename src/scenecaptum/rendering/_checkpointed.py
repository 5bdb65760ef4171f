"""An engine that stores its results in a checkpoint folder, and fingerprints of scenes to identify them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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
from ._turning_camera import TurningCamera


@dataclass(eq=False)
class CheckpointedEngine:
    """An engine that computes only what the checkpoint does not contain; its methods are those of ``Engine``."""

    engine: Engine
    checkpoint: Checkpoint
    fingerprint: str  # of everything but the arguments that a result depends on
    device: torch.device

    def primal(self, values: Values, seed: int, spp: int, tracked: Sequence[str] = ()) -> torch.Tensor:
        """Render, or return the stored image."""
        render = partial(self.engine.primal, values, seed, spp, tracked)
        return self._take("picture", (values, seed, spp), lambda: (render(),))[0]

    def vjp(self, *arguments: Any, importance_sampling: bool = False) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product."""
        return self._take(
            "gradient",
            (*arguments, importance_sampling),
            lambda: self.engine.vjp(*arguments, importance_sampling=importance_sampling),
        )

    def jvp(self, *arguments: Any) -> torch.Tensor:
        """Return the Jacobian–vector product."""
        return self._take("derivative image", arguments, lambda: (self.engine.jvp(*arguments),))[0]

    def step_changes(self, values: Values, names: Sequence[str], *arguments: Any) -> dict[str, torch.Tensor]:
        """Return the changes of the gradients of poses with doubled steps."""
        changes = self._take(
            "step changes",
            (values, tuple(names), *arguments),
            lambda: tuple(self.engine.step_changes(values, names, *arguments).values()),
        )
        return dict(zip(names, changes, strict=True))

    def range_changes(
        self, values: Values, directions: Mapping[str, torch.Tensor], *arguments: Any
    ) -> dict[str, torch.Tensor]:
        """Return the mean gradients of poses over their ranges."""
        changes = self._take(
            "range changes",
            (values, directions, *arguments),
            lambda: tuple(self.engine.range_changes(values, directions, *arguments).values()),
        )
        return dict(zip(directions, changes, strict=True))

    @property
    def camera(self) -> TurningCamera:
        """What the engine knows of its camera."""
        return self.engine.camera

    def _take(
        self, kind: str, arguments: Any, render: Callable[[], tuple[torch.Tensor, ...]]
    ) -> tuple[torch.Tensor, ...]:
        return self.checkpoint.get_or_render((kind, self.fingerprint, arguments), render, self.device)


def scene_contents(scene: Any) -> str:
    """Return a hash of a scene: its plugins, their settings and all arrays, as far as Mitsuba exposes them."""
    return digest(_contents(scene))


def fingerprint(scene: str, sensor: Any, settings: Mapping[str, Any]) -> str:
    """Return a hash of a scene's contents, a sensor, the render settings and the package versions."""
    versions = [version(package) for package in ("scenecaptum", "mitsuba", "drjit")]
    return digest((scene, _contents(sensor), dict(settings), versions, mi.variant()))


def _contents(node: Any) -> tuple[str, dict[str, Any]]:
    parameters = mi.traverse(node)
    numbers = {name: _plain(parameters[name]) for name in parameters.keys()}  # noqa: SIM118 -- not a dict
    return without_addresses(str(node)), numbers


def _plain(value: Any) -> Any:
    """Return a Mitsuba value as numbers, or as the text that it prints."""
    value = getattr(value, "matrix", value)
    if not dr.is_array_v(value):
        return value if isinstance(value, (int, float, str)) else without_addresses(str(value))
    value = dr.detach(value)
    array = value.array if dr.is_tensor_v(value) else dr.ravel(value) if dr.depth_v(value) > 1 else value
    return np.array(array)
