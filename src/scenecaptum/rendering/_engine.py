"""The one place where torch meets Dr.Jit: primal, adjoint and tangent renders as pure functions of tensors.

Imported only once a variant is active (see ``SceneRenderer``). ``dr.wrap`` carries arrays across, but no
derivative graph ever outlives one call: each call writes its own values into the scene, and what it returns
depends on nothing that happens to the scene afterwards.
"""

from __future__ import annotations

import contextlib
import gc
import threading
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ..errors import SceneCaptumError
from . import _integrator  # noqa: F401 -- registers the plugin
from ._plan import RenderPlan
from ._state import SceneState, flat

Values = Mapping[str, torch.Tensor]

# Dr.Jit's state is global to the process, and torch may run a backward pass on another thread.
_LOCK = threading.RLock()

# The engine whose scene is tracked, if any. A call through a virtual function reaches the objects of every scene
# in the process, so what another scene tracks would become part of this one's derivatives.
_tracking: weakref.ref[Engine] | None = None


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
    lifted
        For some parameters the value at which derivatives are taken where their own is exactly 0.
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
        lifted: Mapping[str, float],
    ) -> None:
        self._scene = scene
        self._lifted = lifted
        self._sensor = sensor
        self._resolution = resolution
        self._borrowed = borrowed
        self._state = SceneState(scene, names)
        integrator = plan.create_integrator()
        self._render, self._render_backward = _frozen(integrator, sensor)
        self._render_forward = partial(integrator.render_forward, scene, None, sensor)
        # Decoding textures leaves Dr.Jit with as much memory again that it would keep for later.
        dr.flush_malloc_cache()

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The scene's own values."""
        return self._state.original

    def look(self) -> None:
        """Read a borrowed scene's own values again: its owner may have changed them."""
        if self._borrowed:
            with _LOCK:
                self._state.look()

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render: ``(H, W, 3)`` linear radiance."""
        with self._scene_at_hand():
            # What an earlier adjoint left tracked does no harm here, and writing it again would cost.
            tracked = self._state.leaves.keys()
            stale = self._state.stale(values, tracked)

            def render(*arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                with dr.suspend_grad():
                    return self._render(self._scene, mi.UInt32(seed), spp)

            image: torch.Tensor = _call(render, *stale.values())
            return image

    def adjoint(
        self, values: Values, tracked: Sequence[str], adjoint: torch.Tensor, seed: int, spp: int
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product: for each tracked parameter ``Σ adjoint · ∂image/∂parameter``."""
        with self._scene_at_hand():
            stale = self._state.stale(self._lift(values, tracked), tracked)

            def backward(adjoint: Any, *arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                self._render_backward(self._scene, adjoint, mi.UInt32(seed), spp)
                return [flat(dr.grad(self._state.leaves[name])) for name in tracked]

            gradients = _call(backward, adjoint, *stale.values())
            return tuple(g.reshape(values[n].shape) for g, n in zip(gradients, tracked, strict=True))

    def tangent(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product: the derivative image along ``tangents``."""
        with self._scene_at_hand():
            tracked = tuple(tangents)
            stale = self._state.stale(self._lift(values, tracked), tracked)
            split = len(tangents)

            def forward(*arrays: Any) -> Any:
                self._state.write(stale, arrays[split:], tracked)
                self._state.set_tangents(dict(zip(tracked, arrays[:split], strict=True)))
                return self._render_forward(seed, spp)

            image: torch.Tensor = _call(forward, *tangents.values(), *stale.values())
            return image

    def _lift(self, values: Values, tracked: Collection[str]) -> Values:
        lifted = {n: values[n].clamp_min(self._lifted[n]) for n in tracked if n in self._lifted}
        return {**values, **lifted}

    @contextlib.contextmanager
    def _scene_at_hand(self) -> Iterator[None]:
        """Have the process to ourselves, and leave a borrowed scene as it was found."""
        with _LOCK, _collector_paused():
            self._take_over_tracking()
            self.look()
            size = _film_size(self._sensor)
            _resize(self._sensor, self._resolution)
            try:
                yield
            finally:
                if self._borrowed:
                    self._state.restore()
                    _resize(self._sensor, size)

    def _take_over_tracking(self) -> None:
        global _tracking  # noqa: PLW0603 -- there is one Dr.Jit, and it tracks for the whole process
        previous = _tracking() if _tracking is not None else None
        if previous is not None and previous is not self:
            previous._state.release()
        _tracking = weakref.ref(self)


def _frozen(integrator: Any, sensor: Any) -> tuple[Callable[..., Any], Callable[..., None]]:
    """Return primal and backward render as frozen functions.

    Tracing a room with dozens of materials takes 0.2 s, the same for every pass: so it is done once.
    """

    def render(scene: Any, seed: Any, spp: int) -> Any:
        return integrator.render(scene, sensor, seed=seed, spp=spp)

    def render_backward(scene: Any, adjoint: Any, seed: Any, spp: int) -> None:
        integrator.render_backward(scene, None, adjoint, sensor, seed=seed, spp=spp)

    return dr.freeze(render, warn_after=1000), dr.freeze(render_backward, warn_after=1000)


def _call(function: Callable[..., Any], *tensors: torch.Tensor) -> Any:
    """Call a function of Dr.Jit tensors with torch tensors."""
    try:
        return dr.wrap(source="torch", target="drjit")(function)(
            *(tensor.detach().to(torch.float32).contiguous() for tensor in tensors)
        )
    except RuntimeError as error:
        if _nothing_attached(error):
            raise SceneCaptumError(NOTHING_ATTACHED) from error
        raise


@contextlib.contextmanager
def _collector_paused() -> Iterator[None]:
    """Keep Python from collecting a scene while Dr.Jit records a frozen function: that aborts the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _film_size(sensor: Any) -> tuple[int, int]:
    width, height = sensor.film().crop_size()
    return int(width), int(height)


def _resize(sensor: Any, size: tuple[int, int]) -> None:
    if _film_size(sensor) != size:
        film = mi.traverse(sensor)
        film["film.size"] = list(size)
        film.update()


NOTHING_ATTACHED = (
    "No derivative reaches any of the inputs: none of them takes part in a path that can be differentiated. Look "
    "at renderer.plan for cautions, and add an input that the picture depends on, such as a light."
)


def _nothing_attached(error: BaseException | None) -> bool:
    """Whether Mitsuba's complaint that nothing is tracked lies at the root of an error."""
    while error is not None:
        if "not attached to the AD graph" in str(error):
            return True
        error = error.__cause__
    return False
