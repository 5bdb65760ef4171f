"""A live Mitsuba scene: who may use it, and the values that it has meanwhile."""

from __future__ import annotations

import contextlib
import gc
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ..backend import device, exclusively
from ..scene import SceneGraph
from ._bridge import call_with_torch
from ._sensors import film_size
from ._state import SceneState, Snapshot

Values = Mapping[str, torch.Tensor]

# Dr.Jit keeps freed memory, which makes the next backward pass faster. With more texels it is freed: it would add
# several copies of all textures to the peak.
MAX_CACHED_TEXELS = 2**20

# The scene whose values are tracked, if any. A virtual function call dispatches to the objects of every scene in
# the process, so another scene's tracked values would enter this one's derivatives.
_tracking: weakref.ref[LiveScene] | None = None


class LiveScene:
    """A scene as one of its sensors sees it, at a resolution of ``(width, height)``; one thread at a time uses it.

    All sensors share the ``state``. A ``borrowed`` scene belongs to the caller and is restored after each use.
    """

    def __init__(
        self,
        graph: SceneGraph,
        sensor: Any,
        state: SceneState,
        resolution: tuple[int, int],
        *,
        borrowed: bool,
    ) -> None:
        self.graph = graph
        self.scene = graph.scene
        self.sensor = sensor
        self.state = state
        self.resolution = resolution
        self.device = device()  # of images and gradients
        self.is_borrowed = borrowed
        self._variant = mi.variant()
        self._is_in_use = False
        self._values: Snapshot | None = None  # of the innermost ``with_values``

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The scene's own values: the same dictionary as long as they do not change."""
        return self.state.original

    def refresh_originals(self) -> None:
        """Read a borrowed scene's own values again, because its owner may have changed them."""
        if self.is_borrowed:
            with exclusively(self._variant):
                self.state.refresh_originals()

    def call(
        self,
        function: Callable[..., Any],
        values: Values,
        tracked: Collection[str] | None = None,
        tensors: Collection[torch.Tensor] = (),
    ) -> Any:
        """Give the scene these values, and call a function of Dr.Jit tensors with torch tensors.

        Parameters that are not in ``values`` get the scene's own. Dr.Jit tracks those in ``tracked``, by default
        those that it tracks already: they do no harm to a primal render, and writing them again would take time.
        """
        with self.exclusive():
            tracked = list(self.state.leaves) if tracked is None else tracked
            pending = self.state.pending_writes(self.snapshot(values), tracked)

            def write_and_call(*arrays: Any) -> Any:
                self.state.write(pending, arrays[len(tensors) :], tracked)
                return function(*arrays[: len(tensors)])

            return call_with_torch(write_and_call, *tensors, *pending.values())

    def snapshot(self, values: Values) -> Snapshot:
        """Return the values of all parameters; a snapshot is returned as it is."""
        if isinstance(values, Snapshot):
            return values
        with self.exclusive():
            return self.state.snapshot(values)

    def free_unused(self, texels: int) -> None:
        """Free the memory that Dr.Jit keeps after a backward pass to so many texels, if that is a lot."""
        if texels > MAX_CACHED_TEXELS:
            with self.exclusive():
                dr.flush_malloc_cache()

    @contextlib.contextmanager
    def with_values(self, values: Values) -> Iterator[None]:
        """Give the scene these values, within ``exclusive``; afterwards those of a ``with_values`` around it."""
        with self.exclusive():
            outer, self._values = self._values, self.snapshot(values)
            self.call(lambda: None, self._values)
            try:
                yield
            finally:
                self._values = outer
                if outer is not None:
                    self.call(lambda: None, outer)

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Lock Mitsuba for this thread, and restore a borrowed scene afterwards."""
        with exclusively(self._variant), _collector_paused():
            if self._is_in_use:
                yield
                return
            self._take_over_tracking()
            self.refresh_originals()
            size = film_size(self.sensor)
            _resize(self.sensor, self.resolution)
            self._is_in_use = True
            try:
                yield
            finally:
                self._is_in_use = False
                if self.is_borrowed:
                    self.state.restore()
                    _resize(self.sensor, size)

    def _take_over_tracking(self) -> None:
        global _tracking  # noqa: PLW0603 -- there is one Dr.Jit, and it tracks for the whole process
        previous = _tracking() if _tracking is not None else None
        # The cameras of one renderer share their state.
        if previous is not None and previous.state is not self.state:
            previous.state.release()
        _tracking = weakref.ref(self)


@contextlib.contextmanager
def _collector_paused() -> Iterator[None]:
    """Pause garbage collection: collecting a scene while Dr.Jit records a frozen function aborts the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _resize(sensor: Any, size: tuple[int, int]) -> None:
    if film_size(sensor) != size:
        film = mi.traverse(sensor)
        film["film.size"] = list(size)
        film.update()
