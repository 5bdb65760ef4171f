"""Maps from pixels to the visible objects and texels."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneCaptumError, near_misses


@dataclass(frozen=True)
class TexelMap:
    """The texels of one texture, or the vertices or faces of one mesh, visible in each entry of a ``SurfaceMap``.

    A sparse matrix in coordinate (COO) format: entry ``entry[k]`` of the surface map shows texel ``texel[k]``
    (row-major) with ``weight[k]``. The weight is the texel's filter weight within the entry, divided by the
    fraction of the texture that the texel covers: of the area, or of all directions for an environment map.
    Multiplied with the gradients of texels it gives a gradient per unit of texture. For a texture with the same
    gradient at every texel this is, at every pixel, their sum: the gradient of a uniform colour in its place.

    Attributes
    ----------
    entry, texel, weight
        ``(K,)`` arrays of int32, int32 and float32.
    """

    entry: NDArray[np.int32]
    texel: NDArray[np.int32]
    weight: NDArray[np.float32]

    def density(self, gradient: NDArray[np.float32], entries: int) -> NDArray[np.float64]:
        """Return the gradient per unit of texture of each of the map's ``entries``, ``(entries, C)``.

        ``gradient`` is that of the texels, ``(H, W, C)``, or of vertices or faces, ``(N, C)``.
        """
        texels = gradient.reshape(-1, gradient.shape[-1])
        columns = [
            np.bincount(self.entry, weights=self.weight * channel[self.texel], minlength=entries)
            for channel in texels.T
        ]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class SurfaceMap:
    """The objects visible in each pixel, with the fraction of the pixel that each covers.

    A sparse matrix in coordinate (COO) format: object ``object_index[k]`` covers the fraction ``fraction[k]`` of
    pixel ``pixel[k]`` (row-major). The fractions of a pixel sum to 1, or to the part of the pixel inside a
    fisheye's image circle.

    Attributes
    ----------
    shape
        ``(H, W)`` of the image.
    pixel, object_index, fraction
        ``(K,)`` arrays of int32, int32 and float32.
    objects
        The name of every object of the scene, visible or not; the last is the background.
    parameters
        For each object, the names of the scene parameters that its appearance directly depends on.
    texels
        By parameter name, the texels visible in each entry, for the textures that were requested.
    """

    shape: tuple[int, int]
    pixel: NDArray[np.int32]
    object_index: NDArray[np.int32]
    fraction: NDArray[np.float32]
    objects: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    texels: Mapping[str, TexelMap] = field(default_factory=dict)

    def objects_on(self, pixels: NDArray[np.bool_]) -> list[str]:
        """Return the names of the objects visible in a mask of pixels ``(H, W)``, in the scene's order."""
        visible = pixels.ravel()[self.pixel] & (self.fraction > 0)
        return [self.objects[index] for index in np.unique(self.object_index[visible])]

    def visible_parameters(self) -> set[str]:
        """Return the names of the parameters of all visible objects."""
        visible = np.unique(self.object_index[self.fraction > 0])
        return {name for index in visible for name in self.parameters[index]}

    def shown(self, names: Collection[str]) -> NDArray[np.float32]:
        """Return the fraction of each pixel covered by objects that use any of these parameters, ``(H, W)``."""
        return self._covered_by([any(name in names for name in used) for used in self.parameters])

    def mask(self, objects: str | Collection[str]) -> NDArray[np.float32]:
        """Return the fraction of each pixel covered by objects, by name or glob, ``(H, W)``.

        Raises
        ------
        SceneCaptumError
            If a name matches no object.
        """
        patterns = [objects] if isinstance(objects, str) else list(objects)
        matched = {name for pattern in patterns for name in self._matching(pattern)}
        return self._covered_by([name in matched for name in self.objects])

    def _matching(self, pattern: str) -> list[str]:
        exact = [name for name in self.objects if name == pattern]
        matched = exact or [name for name in self.objects if fnmatchcase(name, pattern)]
        if not matched:
            raise SceneCaptumError(
                f"The scene has no object {pattern!r}.{near_misses(pattern, self.objects)} "
                "renderer.surfaces.objects lists all."
            )
        return matched

    def _covered_by(self, chosen: Sequence[bool]) -> NDArray[np.float32]:
        fraction = self.fraction * np.array(chosen)[self.object_index]
        covered = np.bincount(self.pixel, weights=fraction, minlength=self.shape[0] * self.shape[1])
        return covered.reshape(self.shape).astype(np.float32)
