"""A point light with the distribution of an IES file, and its luminous flux as a parameter.

Imported only once a variant is active (see ``ies_lamp`` and ``load_scene``).

Mitsuba's own lights do not serve: spot lights and projectors cover less than a hemisphere, with a falloff or with
pixels of their own, and the radiance of an area light does not depend on direction.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ._color import white_of
from ._file import read_ies

PLUGIN = "scenecaptum_ies"

EFFICACY = 179.0  # lm/W, as in Radiance and the metrics of luminance


class IesLamp(mi.Emitter):
    """A point light: the image is linear in ``lumens``, and ``to_world`` turns and moves it.

    It samples no rays, so Mitsuba's particle tracer cannot use it.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        photometry = read_ies(str(mi.file_resolver().resolve(props["filename"])))
        self.lumens = mi.Float(props.get("lumens", photometry.lumens))
        self.color = mi.Color3f(white_of(list(props.get("color", [1.0, 1.0, 1.0]))))
        self.to_world = _rigid(props["to_world"]) if "to_world" in props else mi.Transform4f()
        self.vertical = mi.Float(torch.deg2rad(photometry.vertical).tolist())
        self.horizontal = mi.Float(torch.deg2rad(photometry.horizontal).tolist())
        # Per lumen, in W/(lm sr), by planes of equal C.
        table = photometry.table / (photometry.lumens * EFFICACY)
        self.table = mi.Float(table.flatten().tolist())
        self.m_flags = int(mi.EmitterFlags.DeltaPosition)
        dr.make_opaque(self.color, self.vertical, self.horizontal, self.table)
        self.parameters_changed()

    def class_name(self) -> str:
        """Return the name of the class, as Mitsuba's own emitters do."""
        return "IesLamp"

    def to_string(self) -> str:
        """List the parameters."""
        return f"IesLamp[\n  lumens = {self.lumens},\n  to_world = {self.to_world}\n]"

    def traverse(self, callback: Any) -> None:
        """Report the flux and the pose."""
        super().traverse(callback)
        callback.put("lumens", self.lumens, mi.ParamFlags.Differentiable)
        callback.put("to_world", self.to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Keep flux and pose out of the code of kernels."""
        dr.make_opaque(self.lumens, self.to_world)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the direction to the lamp, and its intensity over the distance squared."""
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.p = self.to_world.translation()
        ds.time = it.time
        ds.pdf = mi.Float(1.0)
        ds.delta = mi.Bool(True)
        ds.emitter = mi.EmitterPtr(self)
        offset = ds.p - it.p
        ds.dist = dr.norm(offset)
        ds.d = offset / ds.dist
        ds.n = -ds.d
        return ds, self.eval_direction(it, ds, active)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        """Return the intensity in the direction of a point, over the distance squared."""
        intensity = self._intensity(self.to_world.inverse() @ -ds.d, active)
        return dr.select(active, intensity / dr.square(ds.dist), 0.0)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        """Return 0: the light comes from a point."""
        return mi.Float(0.0)

    def eval(self, si: Any, active: Any = True) -> Any:
        """Return 0: a ray never hits a point."""
        return mi.Spectrum(0.0)

    def _intensity(self, direction: Any, active: Any) -> Any:
        """Return the radiant intensity, interpolated bilinearly in γ and C, in W/sr."""
        gamma = dr.atan2(dr.hypot(direction.x, direction.y), -direction.z)
        azimuth = dr.atan2(direction.y, direction.x)
        azimuth = dr.select(azimuth < self.horizontal[0], azimuth + dr.two_pi, azimuth)
        row, along = _place(self.horizontal, azimuth)
        column, down = _place(self.vertical, gamma)
        verticals = dr.width(self.vertical)

        def at(row: Any, column: Any) -> Any:
            return dr.gather(mi.Float, self.table, row * verticals + column, active)

        below = dr.lerp(at(row, column), at(row + 1, column), along)
        above = dr.lerp(at(row, column + 1), at(row + 1, column + 1), along)
        inside = (gamma >= self.vertical[0]) & (gamma <= self.vertical[verticals - 1])
        return self.lumens * self.color * dr.select(inside, dr.lerp(below, above, down), 0.0)


def _place(angles: Any, at: Any) -> tuple[Any, Any]:
    """Return where angles lie in a table: the index of the angle below, and the weight of the one above."""
    last = dr.width(angles) - 1
    above = dr.binary_search(1, last, lambda index: dr.gather(mi.Float, angles, index) <= at)
    low = mi.UInt32(above - 1)
    start, end = dr.gather(mi.Float, angles, low), dr.gather(mi.Float, angles, low + 1)
    return low, dr.clip((at - start) / (end - start), 0.0, 1.0)


def _rigid(transform: Any) -> Any:
    """Return a transformation in the variant's precision; raise unless it keeps lengths."""
    matrix = np.array(transform.matrix, dtype=np.float64)
    linear = matrix[:3, :3]
    if not np.allclose(linear @ linear.T, np.eye(3), atol=1e-4):
        raise ValueError("The to_world of an IES lamp must only turn and move it: leave out its scale.")
    return mi.Transform4f(mi.Matrix4f(matrix.tolist()))


mi.register_emitter(PLUGIN, IesLamp)
