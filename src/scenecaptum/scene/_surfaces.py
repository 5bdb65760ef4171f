"""Which object each pixel shows."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
    """

    shape: tuple[int, int]
    pixel: NDArray[np.int32]
    object_index: NDArray[np.int32]
    fraction: NDArray[np.float32]
    objects: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]

    def shown(self, names: Collection[str]) -> NDArray[np.float32]:
        """Return the fraction of each pixel whose object shows any of the named parameters, ``(H, W)``."""
        shows = np.array([any(name in names for name in below) for below in self.parameters])
        fraction = self.fraction * shows[self.object_index]
        covered = np.bincount(self.pixel, weights=fraction, minlength=self.shape[0] * self.shape[1])
        return covered.reshape(self.shape).astype(np.float32)
