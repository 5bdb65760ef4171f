"""Parameter values of a live Mitsuba scene: reading, writing, tracking and restoring them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from ..images import LUMINANCE_WEIGHTS
from ._dr_arrays import flat, owned
from ._poses import Poses


class Snapshot(dict[str, torch.Tensor]):
    """The values of all parameters, in tensors that nobody changes."""

    def replace(self, changes: Mapping[str, torch.Tensor]) -> Snapshot:
        """Return the snapshot with other values of some parameters, in tensors that nobody else has."""
        return Snapshot({**self, **changes})


class SceneState:
    """Writes parameter values into a scene, but only those that differ from its current ones.

    Writing is expensive (a rough plastic rebuilds its tables in 20 to 60 ms), so the scene keeps the last values
    until others are written or ``restore`` is called.

    ``shapes`` are those of the writable parameters in torch. A parameter may be a number here but a colour in the
    scene, where a material uses it as a number: then it reads as the mean of the channels, or as the luminance of
    a bitmap, as in Mitsuba, and is written to all channels. Those in ``unused``, which no image depends on, are
    never written: a plain number among them would be another literal in the kernels. ``poses`` are written by
    moving their objects.
    """

    def __init__(
        self, scene: Any, shapes: Mapping[str, tuple[int, ...]], unused: Collection[str], poses: Poses
    ) -> None:
        self._params = mi.traverse(scene)
        self._params.properties = {n: p for n, p in self._params.properties.items() if n in shapes}
        self._shapes = shapes
        self._unused = frozenset(unused)
        self._poses = poses
        self._types = {name: type(self._params[name]) for name in shapes}
        self._monochrome = {
            name
            for name, shape in shapes.items()
            if shape[2:] in ((), (1,)) and flat(self._params[name]).shape == (*shape[:2], 3)
        }
        self._snapshot: dict[str, Any] = {}
        self.leaves: dict[str, Any] = {}
        self.original = {name: self._to_torch(name, self._params[name]) for name in shapes} | poses.original
        self._current = dict(self.original)
        self._latest = Snapshot(self.original)

    @property
    def scalars(self) -> tuple[float, ...]:
        """The current values that Mitsuba stores as plain numbers, which become literals in kernels."""
        return tuple(self._params[name] for name, kind in self._types.items() if kind is float)

    def enable_lobes(self, names: Collection[str]) -> None:
        """Make materials evaluate lobes whose weights are 0, given the names of these weights.

        A principled material skips a lobe whose weight was 0 when it was loaded, until the weight is written. A
        frozen kernel, which was recorded before, would go on skipping it.
        """
        for name in names:
            self._params.set_dirty(name)
        self._params.update()

    def refresh_originals(self) -> None:
        """Read the scene's own values again, because its owner may have changed them."""
        self._snapshot = {name: kind(self._params[name]) for name, kind in self._types.items()}
        self._poses.remember()
        found = {name: self._to_torch(name, value) for name, value in self._snapshot.items()}
        found |= self._poses.original
        # Caches are kept as long as this is the same dictionary.
        if any(not torch.equal(value, self.original[name]) for name, value in found.items()):
            self.original = found
        self._current = dict(self.original)

    def snapshot(self, values: Mapping[str, torch.Tensor]) -> Snapshot:
        """Return the values of all parameters, those that are not given as in the scene itself.

        The caller's tensors are copied: Dr.Jit borrows torch's memory, which the caller may change at any time. A
        value of the latest snapshot, or one that the scene has now, is the same tensor again, and tensors of a
        snapshot are recognized without a comparison.
        """
        owned = {name: self._owned(name, value) for name, value in values.items()}
        self._latest = Snapshot({**self.original, **owned})
        return self._latest

    def _owned(self, name: str, value: torch.Tensor) -> torch.Tensor:
        """Return a tensor with this value that nobody changes: one that there is already, or a copy."""
        value = value.to(self.original[name].device)
        for own in (self._latest[name], self._current.get(name), self.original[name]):
            if own is not None and _equal(own, value):
                return own
        return value.clone()

    def is_original(self, name: str, value: torch.Tensor) -> bool:
        """Whether a parameter's value is the scene's own."""
        return _equal(self.original[name], value)

    def pending_writes(self, values: Snapshot, tracked: Collection[str]) -> dict[str, torch.Tensor]:
        """Return the writes that give the scene these values and track ``tracked``."""
        return {
            name: value
            for name, value in values.items()
            if name not in self._unused
            and ((name in tracked) != (name in self.leaves) or self._current.get(name) is not value)
        }

    def write(
        self, pending: Mapping[str, torch.Tensor], arrays: Sequence[Any], tracked: Collection[str]
    ) -> None:
        """Write ``pending`` into the scene; ``arrays`` are its tensors as Dr.Jit arrays."""
        leaves = {name: leaf for name, leaf in self.leaves.items() if name not in pending}
        for name, array in zip(pending, arrays, strict=True):
            # The scene's value is unknown until the update has succeeded.
            self._current.pop(name, None)
            if name in self._poses:
                continue
            value = _from_tensor(self._leaf_type(name), array)
            if name in tracked:
                dr.enable_grad(value)
                # The scene may derive another array from this one (a padded environment map), so the gradient is
                # read from this leaf, not from the scene.
                leaves[name] = value
            self._params[name] = self._in_scene(name, value)
        if pending:
            self._params.update()
        self._poses.write(pending, {**self.original, **self._current, **pending})
        self._current.update(pending)
        self.leaves = leaves
        self.forget_gradients()

    def forget_gradients(self) -> None:
        """Clear the gradients of all leaves."""
        dr.clear_grad(list(self.leaves.values()))

    def set_tangents(self, tangents: Mapping[str, Any]) -> None:
        """Set the tangents of leaves and propagate them to the arrays that the scene derives from these."""
        for name, tangent in tangents.items():
            leaf = self.leaves[name]
            dr.set_grad(leaf, _from_tensor(type(leaf), tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        # This has cleared the edges between leaves and scene, so the next call must write everything again.
        self._current.clear()

    def release(self) -> None:
        """Stop tracking, so that the rest of this scene's graph cannot affect another scene's derivatives."""
        self._assign({name: self._in_scene(name, dr.detach(leaf)) for name, leaf in self.leaves.items()})

    def restore(self) -> None:
        """Write back the values that ``refresh_originals`` found, where they have changed."""
        changed = {
            n: v
            for n, v in self._snapshot.items()
            if n in self.leaves or not self._is_current(n, self.original[n])
        }
        self._assign(changed)
        moved = [name for name in self._poses if not self._is_current(name, self.original[name])]
        self._poses.write(moved, self.original)
        self._current = dict(self.original)
        self._snapshot = {}

    def _assign(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            self._params[name] = self._types[name](value)
        if values:
            self._params.update()
        self.leaves = {}

    def _to_torch(self, name: str, value: Any) -> torch.Tensor:
        tensor: torch.Tensor = flat(dr.detach(value)).torch()
        if name in self._monochrome:
            weights = torch.tensor(LUMINANCE_WEIGHTS if self._shapes[name] else _MEAN).to(tensor)
            tensor = (tensor * weights).sum(-1, keepdim=bool(self._shapes[name]))
        # A mesh attribute is a table of rows; a texture may have been resized since it was loaded.
        rows = (-1, *self._shapes[name][1:]) if len(self._shapes[name]) == 2 else tensor.shape
        return tensor.to(torch.float32).clone().reshape(rows)

    def _leaf_type(self, name: str) -> type:
        """Return the Dr.Jit type of a parameter's leaf."""
        if name not in self._monochrome:
            return self._types[name]
        kind: type = mi.TensorXf if self._shapes[name] else mi.Float
        return kind

    def _in_scene(self, name: str, leaf: Any) -> Any:
        """Return the scene's value for a leaf."""
        if name not in self._monochrome:
            return leaf
        if dr.is_tensor_v(leaf):
            return self._types[name](dr.repeat(leaf.array, 3), shape=(*leaf.shape[:2], 3))
        return self._types[name](leaf)

    def _is_current(self, name: str, tensor: torch.Tensor) -> bool:
        current = self._current.get(name)
        return current is not None and _equal(current, tensor)


_MEAN = (1 / 3, 1 / 3, 1 / 3)


def _equal(left: torch.Tensor, right: torch.Tensor) -> bool:
    """Whether two tensors without NaN are equal; tensors that share their memory are not compared."""
    return _memory(left) == _memory(right) or torch.equal(left, right)


def _memory(tensor: torch.Tensor) -> tuple[Any, ...]:
    return tensor.data_ptr(), tensor.shape, tensor.stride(), tensor.dtype


def _from_tensor(kind: type, tensor: Any) -> Any:
    if kind is float:
        return float(tensor.array[0])
    tensor = owned(tensor)
    if dr.is_tensor_v(kind):
        return kind(tensor)
    # A vector built from a flat array would be broadcast (a colour becomes 3×3), so it is unravelled.
    return dr.unravel(kind, tensor.array) if dr.depth_v(kind) > 1 else kind(tensor.array)
