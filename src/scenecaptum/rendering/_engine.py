"""The one place where torch meets Dr.Jit: primal, adjoint and tangent renders as pure functions of tensors.

Imported only once a variant is active (see ``SceneRenderer``). ``dr.wrap`` carries arrays across, but no
derivative graph ever outlives one call: each call writes its own values into the scene, and what it returns
depends on nothing that happens to the scene afterwards.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ..errors import SceneCaptumError
from ._plan import RenderPlan
from ._state import SceneState, flat

# Dr.Jit's state is global to the process, and torch may run a backward pass on another thread.
_LOCK = threading.RLock()

Values = Mapping[str, torch.Tensor]


class Engine:
    """Renders a scene and its derivatives for given parameter values.

    Parameters
    ----------
    scene, sensor
        The live scene and one of its sensors.
    names
        The parameters that may be given values.
    plan
        How to render.
    resolution
        ``(width, height)`` in pixels.
    borrowed
        Whether the scene belongs to the caller and must be left as it was found.
    """

    def __init__(
        self,
        scene: Any,
        sensor: Any,
        names: Sequence[str],
        plan: RenderPlan,
        resolution: tuple[int, int],
        *,
        borrowed: bool,
    ) -> None:
        self._scene = scene
        self._sensor = sensor
        self._integrator = plan.create_integrator()
        self._resolution = resolution
        self._found_resolution = _film_size(sensor)
        self._borrowed = borrowed
        self._state = SceneState(scene, names, borrowed=borrowed)
        # Decoding textures leaves Dr.Jit with as much memory again that it would keep for later.
        dr.flush_malloc_cache()
        # Tracing a room with dozens of materials takes 0.2 s, the same for every pass: it is done once.
        self._frozen_render = dr.freeze(self._render, warn_after=1000)
        self._frozen_backward = dr.freeze(self._backward, warn_after=1000)

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The scene's own values."""
        return self._state.original

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render: ``(H, W, 3)`` linear radiance."""
        with _LOCK:
            tracked = self._state.leaves.keys() & values.keys()
            # What an earlier adjoint left tracked does no harm here, and writing it again would cost.
            stale = self._state.stale(values, tracked)

            def render(*arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                with dr.suspend_grad():
                    return self._frozen_render(self._scene, mi.UInt32(seed), spp)

            image: torch.Tensor = self._run(render, *stale.values())
            return image

    def adjoint(
        self, values: Values, tracked: Sequence[str], adjoint: torch.Tensor, seed: int, spp: int
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product: for each tracked parameter ``Σ adjoint · ∂image/∂parameter``."""
        with _LOCK:
            stale = self._state.stale(values, tracked)

            def backward(adjoint: Any, *arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                self._frozen_backward(self._scene, adjoint, mi.UInt32(seed), spp)
                return [flat(dr.grad(self._state.leaves[name])) for name in tracked]

            gradients = self._run(backward, adjoint.contiguous(), *stale.values())
            return tuple(g.reshape(values[n].shape) for g, n in zip(gradients, tracked, strict=True))

    def tangent(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product: the derivative image along ``tangents``."""
        with _LOCK:
            tracked = tuple(tangents)
            stale = self._state.stale(values, tracked)
            split = len(tangents)

            def forward(*arrays: Any) -> Any:
                self._state.write(stale, arrays[split:], tracked)
                self._state.set_tangents(dict(zip(tracked, arrays[:split], strict=True)))
                return self._integrator.render_forward(self._scene, None, self._sensor, seed, spp)

            image: torch.Tensor = self._run(forward, *tangents.values(), *stale.values())
            return image

    def _render(self, scene: Any, seed: Any, spp: int) -> Any:
        return self._integrator.render(scene, self._sensor, seed=seed, spp=spp)

    def _backward(self, scene: Any, adjoint: Any, seed: Any, spp: int) -> None:
        self._integrator.render_backward(scene, None, adjoint, self._sensor, seed=seed, spp=spp)

    def _run(self, function: Callable[..., Any], *tensors: torch.Tensor) -> Any:
        """Call a function of Dr.Jit tensors with torch tensors, leaving a borrowed scene as it was found."""
        try:
            self._resize(self._resolution)
            return dr.wrap(source="torch", target="drjit")(function)(
                *(tensor.detach().to(torch.float32).contiguous() for tensor in tensors)
            )
        except RuntimeError as error:
            if _nothing_attached(error):
                raise SceneCaptumError(NOTHING_ATTACHED) from error
            raise
        finally:
            if self._borrowed:
                self._state.restore()
                self._resize(self._found_resolution)

    def _resize(self, resolution: tuple[int, int]) -> None:
        if _film_size(self._sensor) != resolution:
            film = mi.traverse(self._sensor)
            film["film.size"] = list(resolution)
            film.update()


def _film_size(sensor: Any) -> tuple[int, int]:
    width, height = sensor.film().crop_size()
    return int(width), int(height)


NOTHING_ATTACHED = (
    "No derivative reaches any of the inputs: path replay finds none through perfectly smooth mirrors and glass. "
    "renderer.plan lists the cautions; add an input with a rough or diffuse surface, or a light."
)


def _nothing_attached(error: BaseException | None) -> bool:
    """Whether Mitsuba's complaint that nothing is tracked lies at the root of an error."""
    while error is not None:
        if "not attached to the AD graph" in str(error):
            return True
        error = error.__cause__
    return False
