"""Derivatives as Mitsuba's own integrators compute them, for comparison.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ._engine import Engine, Values, call_with_torch, evaluate
from ._state import flat, owned


class StockEngine(Engine):
    """Plain path replay: uniform samples, no corrections, and 0 for parameters that Mitsuba does not track.

    The scene is still loaded by this package, with its own smooth and rough plastics.
    """

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
        """Return the vector–Jacobian product; ``importance_sampling`` is ignored."""
        supported = [name for name in tracked if self._parameters[name].tracked]
        with self.exclusive_scene():
            pending = self._state.pending_writes(values, supported)

            def backward(*arrays: Any) -> Any:
                self._state.write(pending, arrays, supported)
                for chunk in self._chunks(seed, spp):
                    weighted = owned(mi.TensorXf(chunk.weight * adjoint.detach().float()))
                    chunk_seed = dr.opaque(mi.UInt32, chunk.seed)
                    self._render_backward(self._scene, weighted, chunk_seed, chunk.spp, self._state.scalars)
                    evaluate()
                return [flat(dr.grad(self._state.leaves[name])) for name in supported]

            gradients = dict(zip(supported, call_with_torch(backward, *pending.values()), strict=True))
        return tuple(
            gradients[name].reshape(values[name].shape).to(values[name])
            if name in gradients
            else torch.zeros_like(values[name])
            for name in tracked
        )

    def cumulants(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        spp: int,
        replicates: int,
    ) -> dict[str, tuple[float, float]]:
        """Return nothing: Mitsuba's own integrators have no pilot."""
        return {}
