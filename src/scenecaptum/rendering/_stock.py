"""Derivatives as Mitsuba's own integrators give them, to compare with.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ._engine import Engine, Values, _call, _done
from ._state import flat, owned


class StockEngine(Engine):
    """Path replay over evenly spread samples; 0 for what Mitsuba does not track, and nothing put right.

    The scene is ours all the same: smooth and rough plastics are those of this package.
    """

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
        """Return the vector–Jacobian product; samples go to all pixels alike, whether ``choose`` or not."""
        able = [name for name in tracked if self._parameters[name].tracked]
        with self.at_hand():
            stale = self._state.stale(values, able)

            def backward(*arrays: Any) -> Any:
                self._state.write(stale, arrays, able)
                for one in self._passes(seed, spp):
                    weighted = owned(mi.TensorXf(one.share * adjoint.detach().float()))
                    number = dr.opaque(mi.UInt32, one.seed)
                    self._render_backward(self._scene, weighted, number, one.spp, self._state.scalars)
                    _done()
                return [flat(dr.grad(self._state.leaves[name])) for name in able]

            found = dict(zip(able, _call(backward, *stale.values()), strict=True))
        return tuple(
            found[name].reshape(values[name].shape).to(values[name])
            if name in found
            else torch.zeros_like(values[name])
            for name in tracked
        )

    def spread(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        spp: int,
        replicates: int,
    ) -> dict[str, tuple[float, float]]:
        """Return nothing: Mitsuba's own integrators have no pilot."""
        return {}
