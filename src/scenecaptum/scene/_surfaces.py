"""Which object, and which texels of its textures, each pixel shows."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TexelMap:
    """The texels of one texture, or the vertices or faces of one mesh, that the entries of a ``SurfaceMap`` show.

    It is a sparse matrix in coordinate form: entry ``entry[k]`` of the map shows texel ``texel[k]``, counted along
    the rows of the texture, with ``weight[k]``. The weight is the part that the texel has, by the texture's own
    filter, in what the entry shows, divided by its part of the whole texture: of its area, or of all directions
    for an environment map. What it makes of the gradients of texels is a gradient per unit of texture: a texture
    with the same gradient at every texel has at every pixel their sum, which is what a plain colour in its place
    would have.

    Attributes
    ----------
    entry, texel, weight
        ``(K,)`` arrays of int32, int32 and float32.
    """

    entry: NDArray[np.int32]
    texel: NDArray[np.int32]
    weight: NDArray[np.float32]

    def density(self, gradient: NDArray[np.float32], entries: int) -> NDArray[np.float64]:
        """Return the gradient per unit of texture that each entry shows, ``(entries, C)``.

        Parameters
        ----------
        gradient
            That of the texels, ``(H, W, C)``, or of vertices or faces, ``(N, C)``.
        entries
            How many entries the ``SurfaceMap`` has.
        """
        texels = gradient.reshape(-1, gradient.shape[-1])
        columns = [
            np.bincount(self.entry, weights=self.weight * channel[self.texel], minlength=entries)
            for channel in texels.T
        ]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class SurfaceMap:
    """The objects that each pixel shows, with the fraction of the pixel that each covers.

    It is a sparse matrix in coordinate form: entry ``k`` says that object ``object_index[k]`` covers the
    fraction ``fraction[k]`` of pixel ``pixel[k]`` (row-major). The fractions of a pixel sum to 1, or to what lies
    within a fisheye's circle.

    Attributes
    ----------
    shape
        ``(H, W)`` of the picture.
    pixel, object_index, fraction
        ``(K,)`` arrays of int32, int32 and float32.
    objects
        The name of every object of the scene, visible or not; the last is what a ray that hits nothing sees.
    parameters
        For each object the names of the scene parameters that its appearance depends on directly.
    texels
        For the textures that were asked for, by parameter name, which texels each entry shows.
    """

    shape: tuple[int, int]
    pixel: NDArray[np.int32]
    object_index: NDArray[np.int32]
    fraction: NDArray[np.float32]
    objects: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    texels: Mapping[str, TexelMap] = field(default_factory=dict)

    def objects_on(self, pixels: NDArray[np.bool_]) -> list[str]:
        """Return the names of the objects that a mask of pixels ``(H, W)`` shows, in the scene's order."""
        here = pixels.ravel()[self.pixel] & (self.fraction > 0)
        return [self.objects[index] for index in np.unique(self.object_index[here])]

    def shown(self, names: Collection[str]) -> NDArray[np.float32]:
        """Return the fraction of each pixel whose object shows any of the named parameters, ``(H, W)``."""
        shows = np.array([any(name in names for name in below) for below in self.parameters])
        fraction = self.fraction * shows[self.object_index]
        covered = np.bincount(self.pixel, weights=fraction, minlength=self.shape[0] * self.shape[1])
        return covered.reshape(self.shape).astype(np.float32)
