"""What the properties of Mitsuba's plugins mean: kind and physical bounds, by the name of the property.

A plugin with a new property needs a line here. Where path replay is wrong for it, it also needs a rule in
``rendering._derivative_routes``; see ``docs/extending.md``.
"""

from __future__ import annotations

from typing import NamedTuple

from ._bounds import Bounds

UNIT = Bounds(0.0, 1.0)
POSITIVE_UNIT = Bounds(0.0, 1.0, open_low=True)
NON_NEGATIVE = Bounds(0.0)
POSITIVE = Bounds(0.0, open_low=True)
GLASS = Bounds(1.45, 1.95)  # indices of refraction from fused silica to dense flint glass


class MaterialRole(NamedTuple):
    """A property of a material, with kind, bounds and range as in ``Parameter``."""

    kind: str = "surface"
    bounds: Bounds = Bounds()
    range: Bounds | None = None  # by default the bounds
    is_number: bool = False  # whether materials read the mean of a colour's channels, or a bitmap's luminance
    is_lobe_weight: bool = (
        False  # whether it weighs a lobe that is never sampled where the weight is at a bound
    )


_REFLECTANCE = MaterialRole("reflectance", UNIT)
_ROUGHNESS = MaterialRole("roughness", POSITIVE_UNIT, is_number=True)
_HAIR_ROUGHNESS = MaterialRole("roughness", POSITIVE_UNIT)
_OPACITY = MaterialRole("opacity", UNIT, is_number=True)
_ABSORPTION = MaterialRole(bounds=NON_NEGATIVE)
_SHAPE_OF_LOBE = MaterialRole(bounds=UNIT, is_number=True)
_LOBE_WEIGHT = MaterialRole(bounds=UNIT, is_number=True, is_lobe_weight=True)

MATERIAL_ROLES = {
    "reflectance": _REFLECTANCE,
    "diffuse_reflectance": _REFLECTANCE,
    "specular_reflectance": _REFLECTANCE,
    "specular_transmittance": _REFLECTANCE,
    "diffuse_transmittance": _REFLECTANCE,
    "base_color": _REFLECTANCE,
    "alpha": _ROUGHNESS,
    "alpha_u": _ROUGHNESS,
    "alpha_v": _ROUGHNESS,
    "roughness": _ROUGHNESS,
    "longitudinal_roughness": _HAIR_ROUGHNESS,
    "azimuthal_roughness": _HAIR_ROUGHNESS,
    "eta": MaterialRole("ior", POSITIVE, GLASS),
    "k": MaterialRole("ior", NON_NEGATIVE),
    "specular": MaterialRole("ior", UNIT, is_lobe_weight=True),
    "opacity": _OPACITY,
    "weight": _OPACITY,
    "eumelanin": _ABSORPTION,
    "pheomelanin": _ABSORPTION,
    "sigma_a": _ABSORPTION,
    "anisotropic": _SHAPE_OF_LOBE,
    "clearcoat_gloss": _SHAPE_OF_LOBE,
    "metallic": _LOBE_WEIGHT,
    "spec_tint": _LOBE_WEIGHT,
    "sheen": _LOBE_WEIGHT,
    "sheen_tint": _LOBE_WEIGHT,
    "clearcoat": _LOBE_WEIGHT,
    "spec_trans": _LOBE_WEIGHT,
    "flatness": _LOBE_WEIGHT,
    "diff_trans": MaterialRole(bounds=Bounds(0.0, 2.0), is_number=True, is_lobe_weight=True),
    "normalmap": MaterialRole(bounds=UNIT),
}

# Properties of a material that bend the normals of its shading.
BENDING = ("normalmap", "nested_texture")

EMITTER_BOUNDS = {
    "cutoff_angle": Bounds(0.0, 180.0),
    "beam_width": Bounds(0.0, 180.0),
    "turbidity": Bounds(1.0, 10.0),
    "albedo": UNIT,
    "sun_aperture": Bounds(0.0, 90.0, open_low=True),
}
# The angles of a spot change little beyond their value: their effects are from 0 to it, as those of other lights.
EMITTER_RANGES = {"cutoff_angle": NON_NEGATIVE, "beam_width": NON_NEGATIVE}

MEDIUM_BOUNDS = {"albedo": UNIT, "g": Bounds(-1.0, 1.0)}

# Position of an emitter in space or time: changing it moves shadows.
# What is differentiated in place of a parameter of the camera.
CAMERA_INPUTS = {
    "x_fov": "it moves everything in the image; select camera.fov instead",
    "to_world": "it moves the camera; select camera.pose.translation or camera.pose.rotation instead",
}
EMITTER_POSES = {"position", "direction", "sun_direction", "latitude", "longitude", "timezone"}
EMITTER_POSES |= {"year", "month", "day", "hour", "minute", "second"}
