"""The light from each patch of the sky along the paths of an integrator: recorded, or weighted by an adjoint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..daylight import SkyPatches


@dataclass(frozen=True)
class PatchIndex:
    """The patch of a direction of the scene, as in ``SkyPatches.index``; ``up`` is the scene's vertical axis."""

    patches: SkyPatches
    up: int

    def __call__(self, direction: Any) -> Any:
        """Return the index of the patch that a direction points to."""
        east, north, height = self._to_sky(direction)
        rows = self.patches.rows
        azimuth = dr.atan2(east, north) / (2 * math.pi)
        index = mi.UInt32(0)
        # From the horizon up: each row replaces those below it.
        for altitude, count, first in zip(rows.altitudes, rows.counts, rows.first, strict=False):
            column = mi.Int32(dr.floor(azimuth * count + 0.5))
            column = dr.select(column < 0, column + count, dr.select(column >= count, column - count, column))
            index = dr.select(height >= math.sin(altitude), first + mi.UInt32(column), index)
        return index

    def _to_sky(self, d: Any) -> tuple[Any, Any, Any]:
        """Return a direction's parts to the east, north and zenith: x is east, and the other axes follow."""
        if self.up == 0:
            return d.y, d.z, d.x
        return (d.x, -d.z, d.y) if self.up == 1 else (d.x, d.y, d.z)


class SkyLight:
    """What becomes of the light that an integrator finds: only that of the sky counts.

    The scene has a sky of radiance 1, so that this is the weight of the path. ``row`` is that of each path in the
    picture of coefficients. ``direct``: only the light that reaches the point without being reflected.
    """

    def __init__(self, index: PatchIndex, row: Any, *, direct: bool) -> None:
        self.direct = direct
        self._index = index
        self._row = row

    def escaped(self, light: Any, si: Any, direction: Any) -> Any:
        """Return what counts of the light that a ray finds at its end."""
        return self._take(light, ~si.is_valid(), direction)

    def sampled(self, light: Any, ds: Any) -> Any:
        """Return what counts of the light of a sampled emitter."""
        is_sky = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite) & ~ds.delta
        return self._take(light, is_sky, ds.d)

    def _take(self, light: Any, active: Any, direction: Any) -> Any:
        entry = self._row * self._index.patches.count + self._index(direction)
        return self._value(dr.select(active, light, 0), entry, active)

    def _value(self, light: Any, entry: Any, active: Any) -> Any:
        raise NotImplementedError


class RecordedSky(SkyLight):
    """Adds the light, times ``weight``, to the coefficient of its patch: ``target`` has three channels of each."""

    def __init__(self, index: PatchIndex, row: Any, target: Any, weight: Any, *, direct: bool) -> None:
        super().__init__(index, row, direct=direct)
        self._target = target
        self._weight = weight

    def _value(self, light: Any, entry: Any, active: Any) -> Any:
        for channel in range(3):
            dr.scatter_add(self._target, self._weight * light[channel], 3 * entry + channel, active)
        return light


class WeightedSky(SkyLight):
    """Weights the light by the adjoint of its coefficient: the adjoint takes the place of the sky."""

    def __init__(self, index: PatchIndex, row: Any, adjoint: Any, *, direct: bool) -> None:
        super().__init__(index, row, direct=direct)
        self._adjoint = adjoint

    def _value(self, light: Any, entry: Any, active: Any) -> Any:
        return light * dr.gather(mi.Color3f, self._adjoint, entry, active)
