"""How the derivative of each parameter is found: by path replay where that is right, else by finite differences.

Which is right where was measured, see ``benchmarks/derivatives.py`` and ``docs/derivatives.md``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from ..scene import Parameter

# Path replay divides by what a surface passes on, so the indirect part of the derivative is lost where that is
# exactly 0; and Mitsuba's Fresnel term loses its slope to rounding where an index is. The slope a little above is
# taken, which is that at 0 to within as little.
LIFT = {"reflectance": 1e-3, "ior": 3e-3}

JUST_ABOVE_ONE = 1.001

# Up to this roughness the derivative is so noisy that samples start on the surface itself.
SHINY = 0.2

# Half the distance of a central difference, by kind: long enough for the events that it moves to be many, short
# enough for the curve to be straight.
STEPS = {"reflectance": 0.02, "opacity": 0.02, "ior": 0.02, "surface": 0.02, "media": 0.02, "emitters": 0.05}
NEAR_ONE = 0.004  # for an index near 1, where the curve bends more
RELATIVE = 0.05  # of the value itself, for what has no scale of its own

# Factors of the light of an emitter, in which the picture is linear, but which Mitsuba does not track; and the
# other light of the same emitter.
SCALES = {"sky_scale": "sun_scale", "sun_scale": "sky_scale"}

# Lobes that a principled material leaves out where their weight is at a bound, so that nothing samples them there.
SWITCHED = (
    "metallic",
    "spec_trans",
    "clearcoat",
    "sheen",
    "flatness",
    "diff_trans",
    "specular",
    "spec_tint",
    "sheen_tint",
)


@dataclass(frozen=True)
class Difference:
    """A finite difference with common random numbers.

    Attributes
    ----------
    points
        Where to render, as shifts from the value, and the weight of each picture in the derivative.
    reason
        Why path replay does not serve.
    off
        Other parameters that are 0 in all of these pictures.
    """

    points: tuple[tuple[torch.Tensor, torch.Tensor], ...]
    reason: str
    off: tuple[str, ...] = ()


def difference(parameter: Parameter, value: torch.Tensor) -> Difference | None:
    """Return the finite difference that a parameter requires at a value, or None where path replay is right."""
    reason = reason_against_replay(parameter, value)
    if reason is None:
        return None
    if parameter.kind == "emitters" and parameter.role in SCALES:
        # Mitsuba samples sky and sun by their brightness, so that the other one would be noise, and take samples.
        other = parameter.name.removesuffix(parameter.role) + SCALES[parameter.role]
        return Difference(_off_to_on(value), reason, (other,))
    step = _step(parameter, value)
    low, high = _room(parameter, value)
    if bool((value - step > low).all() and (value + step < high).all()):
        return Difference(_central(step), reason)
    upwards = value + 2 * step <= high
    return Difference(_one_sided(torch.where(upwards, step, -step)), reason)


def _central(h: torch.Tensor) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    return (h, 1 / (2 * h)), (-h, -1 / (2 * h))


def _one_sided(h: torch.Tensor) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    """Return the points of a difference of second order on one side."""
    # Not from the bound itself, where the picture may jump: a lobe is left out, a formula branches.
    first = 1e-3
    return (
        (first * h, -3 / ((1 - first) * (2 - first) * h)),
        (h, (2 + first) / ((1 - first) * h)),
        (2 * h, -(1 + first) / ((2 - first) * h)),
    )


def _off_to_on(value: torch.Tensor) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    """Return the points of a difference between a light that is off and the same light on.

    The picture is linear in the scale of a light: any distance is exact, and the longest has the least noise.
    """
    on = torch.where(value > 0, value, 1.0)
    return (on - value, 1 / on), (-value, -1 / on)


def shiny_ones(parameters: Mapping[str, Parameter], values: Mapping[str, torch.Tensor]) -> list[str]:
    """Return the low roughnesses where they are half of the parameters or more: others would pay for them."""
    shiny = [n for n, v in values.items() if parameters[n].kind == "roughness" and bool((v <= SHINY).any())]
    return shiny if 2 * len(shiny) >= len(values) else []


def lifted(parameter: Parameter, value: torch.Tensor) -> torch.Tensor:
    """Return the value at which path replay takes the derivative: near its own, where that would lose it."""
    if value.ndim > 1:
        # A copy is held of a texture that has black texels, and of no other.
        return torch.where(value == 0, LIFT["reflectance"], value) if _has_black(parameter, value) else value
    if parameter.role == "eta" and "Plastic" in parameter.plugin:
        # Without a step of the index there is no Fresnel term; rounding drowns it below this.
        return torch.where(value == 1, JUST_ABOVE_ONE, value)
    return value.clamp_min(LIFT[parameter.kind]) if parameter.kind in LIFT else value


def _has_black(parameter: Parameter, texels: torch.Tensor) -> bool:
    return parameter.kind == "reflectance" and not bool(texels.all())


def is_constant(parameter: Parameter, values: Mapping[str, torch.Tensor]) -> bool:
    """Whether the picture does not depend on a parameter: a metal of index 0 reflects all, whatever its ``k``.

    Said outright, because the lifted index would give ``k`` a slope.
    """
    if parameter.role != "k":
        return False
    index = values.get(re.sub(r"\bk\b(?!.*\bk\b)", "eta", parameter.name))
    return index is not None and not index.any()


def reason_against_replay(parameter: Parameter, value: torch.Tensor) -> str | None:
    """Why path replay would be wrong for a parameter at a value, or None."""
    if len(parameter.shape) > 1:
        return None
    if not parameter.tracked:
        return (
            f"Mitsuba's {parameter.plugin} keeps it, or what it derives from it, outside the derivative graph"
        )
    for applies, reason in _RULES:
        if applies(parameter, value):
            return reason
    return None


def _blends_specular(p: Parameter, value: torch.Tensor) -> bool:
    return p.specular_inside and p.plugin in ("MaskBSDF", "BlendBSDF") and p.role in ("opacity", "weight")


def _ior_near_one(p: Parameter, value: torch.Tensor) -> bool:
    # Our own plastics take their slopes from one side of 1.
    dielectric = p.role == "eta" and "Conductor" not in p.plugin and "Plastic" not in p.plugin
    return dielectric and bool(((value - 1).abs() < 0.1).any())


def _lobe_switched_off(p: Parameter, value: torch.Tensor) -> bool:
    at_bound = bool(((value == p.bounds.low) | (value == p.bounds.high)).any())
    return at_bound and (p.role in SWITCHED or p.kind == "opacity")


def _narrow_hair(p: Parameter, value: torch.Tensor) -> bool:
    return p.plugin == "Hair" and p.kind == "roughness" and bool((value <= 0.1).any())


def _blocked(p: Parameter, value: torch.Tensor) -> bool:
    return p.role in ("specular_transmittance", "specular_reflectance") and bool((value == 0).any())


_RULES = (
    (_blends_specular, "it weighs a perfectly specular lobe against others"),
    (_ior_near_one, "near 1 the reflectance has a kink, and few samples tell its slope"),
    (_lobe_switched_off, "at its bound a lobe is left out, and nothing samples it"),
    (_narrow_hair, "this plugin samples narrow lobes otherwise than it evaluates them"),
    (_blocked, "at 0 the lobe passes nothing on that could be replayed"),
)


def _step(p: Parameter, value: torch.Tensor) -> torch.Tensor:
    if p.kind == "roughness":
        return RELATIVE * value
    if p.kind in STEPS and p.kind != "emitters" and p.bounds.high <= 2:
        return torch.full_like(value, STEPS[p.kind])
    if p.kind == "ior":
        return torch.where((value - 1).abs() < 0.1, NEAR_ONE, torch.full_like(value, STEPS["ior"]))
    return torch.where(value == 0, torch.full_like(value, 0.02), RELATIVE * value.abs())


def _room(p: Parameter, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the interval around the value in which the picture is a smooth function of it."""
    low = torch.full_like(value, p.bounds.low)
    high = torch.full_like(value, p.bounds.high)
    if p.role == "eta" and "Conductor" not in p.plugin:
        low = torch.where(value >= 1, low.clamp_min(1.0), low)
        high = torch.where(value < 1, high.clamp_max(1.0), high)
    return low, high
