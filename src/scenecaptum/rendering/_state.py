"""The values that a live Mitsuba scene holds: reading, writing, tracking and restoring them.

Imported only once a variant is active (see ``SceneRenderer``).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import torch


class SceneState:
    """Writes parameter values into a scene, and only those that differ from what it holds.

    A write is not free (a rough plastic makes its tables anew, 20 to 60 ms each), so a scene keeps the last values
    until others are asked for or ``restore`` is called.

    Parameters
    ----------
    scene
        The live ``mi.Scene``.
    shapes
        The parameters that may be written, and their shapes in torch. Where that has one number and the scene a
        colour, which a material looks up as one number, it is the mean of its channels, or a bitmap's luminance,
        as Mitsuba takes it; what is written goes to all channels alike.
    """

    def __init__(self, scene: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self._params = mi.traverse(scene)
        self._params.properties = {n: p for n, p in self._params.properties.items() if n in shapes}
        self._shapes = shapes
        self._types = {name: type(self._params[name]) for name in shapes}
        self._grey = {
            name
            for name, shape in shapes.items()
            if shape[2:] in ((), (1,)) and flat(self._params[name]).shape == (*shape[:2], 3)
        }
        self._found: dict[str, Any] = {}
        self.leaves: dict[str, Any] = {}
        self.original = {name: self._to_torch(name, self._params[name]) for name in shapes}
        self._held = dict(self.original)

    @property
    def scalars(self) -> tuple[float, ...]:
        """What the scene holds of the values that Mitsuba keeps as plain numbers, which it writes into kernels."""
        return tuple(self._params[name] for name, kind in self._types.items() if kind is float)

    def look(self) -> None:
        """Take what the scene holds now for its own values: its owner may have changed them."""
        self._found = {name: kind(self._params[name]) for name, kind in self._types.items()}
        self.original = {name: self._to_torch(name, value) for name, value in self._found.items()}
        self._held = dict(self.original)

    def stale(self, values: Mapping[str, torch.Tensor], tracked: Collection[str]) -> dict[str, torch.Tensor]:
        """Return what must be written so that the scene holds ``values`` and tracks ``tracked``.

        Values of the caller's are copied: Dr.Jit borrows torch's memory, which the caller may change at any time.
        """
        return {
            name: self.original[name] if torch.equal(tensor, self.original[name]) else tensor.clone()
            for name, tensor in {**self.original, **values}.items()
            if (name in tracked) != (name in self.leaves) or not self._holds(name, tensor)
        }

    def write(
        self, stale: Mapping[str, torch.Tensor], arrays: Sequence[Any], tracked: Collection[str]
    ) -> None:
        """Put ``arrays``, the ``stale`` tensors as Dr.Jit sees them, into the scene."""
        leaves = {name: leaf for name, leaf in self.leaves.items() if name not in stale}
        for name, array in zip(stale, arrays, strict=True):
            # Until the write has gone through, nothing is known of what the scene holds.
            self._held.pop(name, None)
            value = _from_tensor(self._leaf_type(name), array)
            if name in tracked:
                dr.enable_grad(value)
                # The scene may derive its own array from this one (a padded environment map), so the gradient
                # is read here, not from the scene.
                leaves[name] = value
            self._params[name] = self._in_scene(name, value)
        if stale:
            self._params.update()
        self._held.update(stale)
        self.leaves = leaves
        self.forget_gradients()

    def forget_gradients(self) -> None:
        """Set the gradients of all leaves to 0."""
        dr.clear_grad(list(self.leaves.values()))

    def set_tangents(self, tangents: Mapping[str, Any]) -> None:
        """Give the leaves their tangents and carry them to the arrays that the scene derives from the leaves."""
        for name, tangent in tangents.items():
            leaf = self.leaves[name]
            dr.set_grad(leaf, _from_tensor(type(leaf), tangent))
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        # That used up the edges between leaves and scene: the next write starts afresh.
        self._held.clear()

    def release(self) -> None:
        """Stop tracking: what remains of this scene's graph must not reach another's."""
        self._assign({name: self._in_scene(name, dr.detach(leaf)) for name, leaf in self.leaves.items()})

    def restore(self) -> None:
        """Put back what ``look`` found, where anything has changed."""
        changed = {
            n: v for n, v in self._found.items() if n in self.leaves or not self._holds(n, self.original[n])
        }
        self._assign(changed)
        self._held = dict(self.original)
        self._found = {}

    def _assign(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            self._params[name] = self._types[name](value)
        if values:
            self._params.update()
        self.leaves = {}

    def _to_torch(self, name: str, value: Any) -> torch.Tensor:
        tensor: torch.Tensor = flat(dr.detach(value)).torch()
        if name in self._grey:
            weights = torch.tensor(_LUMINANCE if self._shapes[name] else _MEAN).to(tensor)
            tensor = (tensor * weights).sum(-1, keepdim=bool(self._shapes[name]))
        # The attributes of a mesh are rows; a texture may have got another size since it was loaded.
        rows = (-1, *self._shapes[name][1:]) if len(self._shapes[name]) == 2 else tensor.shape
        return tensor.to(torch.float32).clone().reshape(rows)

    def _leaf_type(self, name: str) -> type:
        """Return what a parameter is tracked as."""
        if name not in self._grey:
            return self._types[name]
        kind: type = mi.TensorXf if self._shapes[name] else mi.Float
        return kind

    def _in_scene(self, name: str, leaf: Any) -> Any:
        """Return what the scene is to hold for a leaf."""
        if name not in self._grey:
            return leaf
        if dr.is_tensor_v(leaf):
            return self._types[name](dr.repeat(leaf.array, 3), shape=(*leaf.shape[:2], 3))
        return self._types[name](leaf)

    def _holds(self, name: str, tensor: torch.Tensor) -> bool:
        held = self._held.get(name)
        return held is not None and torch.equal(held, tensor)


_MEAN = (1 / 3, 1 / 3, 1 / 3)
_LUMINANCE = (0.212671, 0.715160, 0.072169)


def flat(value: Any) -> Any:
    """Return a scalar, colour or tensor of Dr.Jit as the tensor that stands for it in torch."""
    if isinstance(value, float):
        return mi.TensorXf(mi.Float(value), shape=())
    if dr.is_tensor_v(value):
        return value
    if dr.depth_v(value) > 1:
        return mi.TensorXf(dr.ravel(value), shape=(dr.size_v(value),))
    width = dr.width(value)
    return mi.TensorXf(value, shape=() if width == 1 else (width,))


def owned(value: Any) -> Any:
    """Copy into Dr.Jit's own memory: a frozen function would go on reading memory that was borrowed."""
    array = value.array if dr.is_tensor_v(value) else value
    # Adding what Dr.Jit takes for unknown is what it cannot optimise away.
    copied = array + dr.opaque(type(array), 0)
    dr.eval(copied)
    return type(value)(copied, shape=value.shape) if dr.is_tensor_v(value) else copied


def _from_tensor(kind: type, tensor: Any) -> Any:
    if kind is float:
        return float(tensor.array[0])
    tensor = owned(tensor)
    if dr.is_tensor_v(kind):
        return kind(tensor)
    # A vector built from a flat array would be broadcast (a colour becomes 3×3), so it is unravelled.
    return dr.unravel(kind, tensor.array) if dr.depth_v(kind) > 1 else kind(tensor.array)
