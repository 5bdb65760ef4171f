"""Compact storage of the gradients of large textures: exact where a pixel shows the texel, block means elsewhere.

A map needs the gradients of the visible texels only, and a ranking their sum. The others are millions of noisy
numbers that do not compress.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ._data import AttributionData

# The smallest textures of a result are exact, up to this number of texels in all.
MAX_EXACT_TEXELS = 2**14

MESH_ATTRIBUTE = 2  # number of axes: those of vertices or faces, and the channels

# Of all other textures of a result.
MAX_BLOCKS = 2**15


@dataclass(frozen=True)
class TexelBlocks:
    """Divides the texels of a texture into visible ones and blocks of the others.

    ``shape`` is ``(H, W, C)``, with blocks of ``side`` × ``side`` texels, or ``(N, C)`` for the vertices or faces
    of a mesh, with as many successive ones in a block. ``visible`` are sorted indices of texels.
    """

    shape: tuple[int, ...]
    visible: NDArray[np.int32]
    side: int

    @cached_property
    def _hidden(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The indices of the hidden texels, and the block of each."""
        is_hidden = np.ones(math.prod(self.shape[:-1]), bool)
        is_hidden[self.visible] = False
        texel = np.flatnonzero(is_hidden)
        grid = _Grid.of(self.shape, self.side)
        y, x = np.divmod(texel, grid.width)
        return texel, y // grid.block_height * grid.columns + x // grid.block_width

    def split(self, values: torch.Tensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the values of the visible texels, and the means over blocks of the others."""
        rows = self._rows(values)
        texel, _ = self._hidden
        return rows[self.visible], self._means(rows[texel]).astype(np.float32)

    def split_errors(
        self, errors: torch.Tensor, values: torch.Tensor
    ) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        """Return the standard errors of what ``split`` returns, as the bits of bfloat16.

        Those of a block's texels are the root mean square of their own errors and of the distances to the mean.
        """
        rows, (texel, block) = self._rows(errors), self._hidden
        hidden = self._rows(values)[texel].astype(np.float64)
        distances = hidden - self._means(hidden).astype(np.float32)[block]
        squares = self._means(rows[texel].astype(np.float64) ** 2 + distances**2)
        return _to_bits(rows[self.visible]), _to_bits(np.sqrt(squares))

    def join(self, visible: NDArray[np.float32], means: NDArray[np.float32]) -> torch.Tensor:
        """Return the texture with these values; inverse of ``split``."""
        texel, block = self._hidden
        rows = np.empty((len(self.visible) + len(texel), self.shape[-1]), np.float32)
        rows[self.visible], rows[texel] = visible, means[block]
        return torch.from_numpy(rows.reshape(self.shape))

    def join_errors(self, visible: NDArray[np.int16], means: NDArray[np.int16]) -> torch.Tensor:
        """Return the errors of a texture; inverse of ``split_errors``."""
        return self.join(_from_bits(visible), _from_bits(means))

    def _rows(self, values: torch.Tensor) -> NDArray[np.float32]:
        rows: NDArray[np.float32] = values.numpy(force=True).reshape(-1, self.shape[-1])
        return rows

    def _means(self, hidden: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the ``(blocks, C)`` means of rows of hidden texels; 0 for blocks without any."""
        _, block = self._hidden
        blocks = _Grid.of(self.shape, self.side).blocks
        counts = np.maximum(np.bincount(block, minlength=blocks), 1)
        return np.stack([np.bincount(block, channel, blocks) / counts for channel in hidden.T], axis=-1)


class _Grid(NamedTuple):
    """The size of a texture and of its blocks; a mesh attribute is one texel wide."""

    height: int
    width: int
    block_height: int
    block_width: int

    @classmethod
    def of(cls, shape: tuple[int, ...], side: int) -> _Grid:
        if len(shape) == MESH_ATTRIBUTE:
            return cls(shape[0], 1, side**2, 1)
        return cls(shape[0], shape[1], side, side)

    @property
    def columns(self) -> int:
        return -(-self.width // self.block_width)

    @property
    def blocks(self) -> int:
        return -(-self.height // self.block_height) * self.columns


def choose_blocks(attribution: AttributionData) -> dict[str, TexelBlocks]:
    """Return the blocks of the textures that are not stored exactly.

    They are the largest textures of a result, as far as it is known which of their texels the pixels show.
    """
    surfaces = attribution.surfaces
    if surfaces is None:
        return {}
    shapes = {n: tuple(attribution[n].shape) for n in surfaces.texels if n in attribution}
    texels, large = 0, {}
    for name, shape in sorted(shapes.items(), key=lambda item: math.prod(item[1][:-1])):
        texels += math.prod(shape[:-1])
        if texels > MAX_EXACT_TEXELS:
            large[name] = shape
    side = 2
    while sum(_Grid.of(shape, side).blocks for shape in large.values()) > max(MAX_BLOCKS, len(large)):
        side += 1
    visible = {name: np.unique(surfaces.texels[name].texel) for name in large}
    return {name: TexelBlocks(shape, visible[name], side) for name, shape in large.items()}


def _to_bits(values: NDArray[np.floating]) -> NDArray[np.int16]:
    bits: NDArray[np.int16] = torch.from_numpy(values).bfloat16().view(torch.int16).numpy()
    return bits


def _from_bits(bits: NDArray[np.int16]) -> NDArray[np.float32]:
    values: NDArray[np.float32] = torch.from_numpy(bits).view(torch.bfloat16).float().numpy()
    return values
