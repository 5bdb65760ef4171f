"""How each parameter is differentiated: by path replay where that is correct, else by finite differences.

Where path replay is correct was measured: see ``benchmarks/derivatives.py`` and ``docs/derivatives.md``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch

from ..scene import Parameter

# Path replay divides by the BSDF value, so the indirect part of the derivative is lost where that is exactly 0.
# Mitsuba's Fresnel term loses its slope to rounding where an index is 0. The slope at this small value is used
# instead, which equals the slope at 0 up to an error of the same order.
SINGULARITY_OFFSETS = {"reflectance": 1e-3, "ior": 3e-3}

# Mitsuba evaluates a lobe of weight 0 as 0, with its slope, so the same holds for the weights of these lobes of a
# principled material: its diffuse lobe samples all of their directions.
REFLECTED_LOBES = {"metallic", "spec_tint", "sheen", "sheen_tint", "clearcoat", "flatness"}
LOBE_OFFSET = 1e-3

# Light enters and leaves a solid, so the slope of a black transmission is 0, and that at a value near 0 twice the
# value. These lobes are sampled whatever their transmission, so float32 alone limits how small it may be.
SPECULAR_OFFSET = 1e-5

# In texels where the weight of a lobe is 0 or 1, one lobe is never sampled. The slope at these distances is used
# instead. It is one of a scene of its own: in that of the other parameters, what is opaque must let no light pass.
TEXEL_OFFSET = 0.02

JUST_ABOVE_ONE = 1.001

# Up to this α of the microfacets the derivative of path replay is so noisy that light tracing from the surface is
# used.
LOW_ROUGHNESS = 0.2

# Step of a central difference, by kind: large enough for its signal to exceed the noise, small enough for the
# curvature to be negligible.
STEPS = {"reflectance": 0.02, "opacity": 0.02, "ior": 0.02, "surface": 0.02, "media": 0.02, "emitters": 0.05}
STEP_NEAR_ONE = 0.004  # for an index near 1, where the curvature is greater
RELATIVE_STEP = 0.05  # relative to the value, for parameters without a natural scale

# With importance sampling a finite difference, of renders or of paths, takes this many times fewer samples: common
# random numbers remove most of its noise.
DIFFERENCE_SPP_DIVISOR = 4

MOVES = "it moves visibility, which path replay does not differentiate"

# Scale factors of emitters that Mitsuba does not track, each with that of the same emitter's other light. The
# image is linear in them.
EMITTER_SCALES = {"sky_scale": "sun_scale", "sun_scale": "sky_scale"}


Values = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class FiniteDifference:
    """A finite difference with common random numbers."""

    points: tuple[tuple[torch.Tensor, torch.Tensor], ...]  # shift from the value, weight of the image there
    off: tuple[str, ...] = ()  # other parameters that are set to 0 in all of these renders
    # Whether each element is shifted by itself. The channels of a colour are shifted together, because each
    # channel of the image depends only on its own.
    by_element: bool = False


@dataclass(frozen=True)
class DerivativeRoute:
    """How a parameter is differentiated at a value."""

    replay_value: torch.Tensor  # where path replay differentiates: the value, moved off a singularity
    difference: FiniteDifference | None  # replaces path replay; None where that is correct
    reason: str | None  # why path replay is not used; None where it is
    is_low_roughness: bool  # whether light tracing has less noise than path replay
    is_constant: bool  # whether the image does not depend on the parameter
    has_own_scene: bool = False  # whether other parameters must not be differentiated at its replay value


Routes = Mapping[str, DerivativeRoute]


def derivative_routes(
    parameters: Mapping[str, Parameter], values: Values, tracked: Iterable[str]
) -> dict[str, DerivativeRoute]:
    """Decide how each tracked parameter is differentiated, given the values of all parameters."""
    return {name: _derivative_route(parameters[name], values) for name in tracked}


def _derivative_route(parameter: Parameter, values: Values) -> DerivativeRoute:
    value = values[parameter.name]
    is_constant = _is_constant(parameter, values)
    reason = None if is_constant else _reason_against_replay(parameter, values)
    has_own_scene = value.ndim > 1 and not is_constant and _lobe_switched_off(parameter, values)
    replay_value = value if reason else _clamp_off_singularity(parameter, value)
    if has_own_scene:
        low, high = parameter.bounds.low + TEXEL_OFFSET, parameter.bounds.high - TEXEL_OFFSET
        replay_value = value.clamp(low, high)
    return DerivativeRoute(
        replay_value=replay_value,
        difference=_finite_difference(parameter, value) if reason else None,
        reason=reason,
        is_low_roughness=_is_low_roughness(parameter, value),
        is_constant=is_constant,
        has_own_scene=has_own_scene,
    )


def _is_low_roughness(parameter: Parameter, value: torch.Tensor) -> bool:
    # The principled materials square their roughness.
    alpha = value**2 if parameter.plugin.startswith("Principled") else value
    return parameter.kind == "roughness" and bool((alpha <= LOW_ROUGHNESS).any())


def uncorrected_routes(
    parameters: Mapping[str, Parameter], values: Values, tracked: Iterable[str]
) -> dict[str, DerivativeRoute]:
    """Return path replay at the value itself for each parameter that Mitsuba tracks, as stock integrators do."""
    return {
        name: DerivativeRoute(values[name], None, None, is_low_roughness=False, is_constant=False)
        for name in tracked
        if parameters[name].tracked
    }


def replayed_names(routes: Routes) -> list[str]:
    """Return the parameters that are differentiated by path replay or light tracing."""
    return [name for name, route in routes.items() if route.difference is None and not route.is_constant]


def by_scene(routes: Routes, names: Iterable[str]) -> list[list[str]]:
    """Divide replayed parameters into those that are differentiated in one scene, and each that has its own."""
    names = list(names)
    alone = [name for name in names if routes[name].has_own_scene]
    shared = [name for name in names if name not in alone]
    return [*([shared] if shared else []), *([name] for name in alone)]


def low_roughness_names(routes: Routes) -> list[str]:
    """Return the replayed parameters with a low roughness, or none where they are less than half of all replayed.

    Their light tracing takes samples from the other parameters.
    """
    names = _low_roughness(routes)
    return names if 2 * len(names) >= len(replayed_names(routes)) else []


def noisy_roughness_names(routes: Routes) -> list[str]:
    """Return the low roughnesses that the other parameters leave to path replay, with more noise."""
    return [] if low_roughness_names(routes) else _low_roughness(routes)


def _low_roughness(routes: Routes) -> list[str]:
    return [name for name in replayed_names(routes) if routes[name].is_low_roughness]


def _finite_difference(parameter: Parameter, value: torch.Tensor) -> FiniteDifference:
    if parameter.moves:
        return pose_difference(parameter, value)
    if parameter.kind == "emitters" and parameter.role in EMITTER_SCALES:
        # Mitsuba divides its samples between sky and sun by brightness: the other would add noise and cost
        # samples.
        other = parameter.name.removesuffix(parameter.role) + EMITTER_SCALES[parameter.role]
        return FiniteDifference(_off_to_on(value), (other,))
    step = _step(parameter, value)
    low, high = _smooth_interval(parameter, value)
    if bool((value - step > low).all() and (value + step < high).all()):
        return FiniteDifference(((step, 1 / (2 * step)), (-step, -1 / (2 * step))))
    upwards = value + 2 * step <= high
    return FiniteDifference(_one_sided(torch.where(upwards, step, -step)))


def pose_difference(parameter: Parameter, value: torch.Tensor, factor: float = 1.0) -> FiniteDifference:
    """Return the central difference over the range of a pose, or over ``factor`` times that."""
    step = torch.full_like(value, factor * (parameter.range.high - parameter.range.low) / 2)
    return FiniteDifference(((step, 1 / (2 * step)), (-step, -1 / (2 * step))), by_element=True)


def _one_sided(h: torch.Tensor) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    """Return the points of a one-sided difference of second order."""
    # Not at the bound itself, where the image may jump because a lobe is skipped or a formula branches.
    first = 1e-3
    return (
        (first * h, -3 / ((1 - first) * (2 - first) * h)),
        (h, (2 + first) / ((1 - first) * h)),
        (2 * h, -(1 + first) / ((2 - first) * h)),
    )


def _off_to_on(value: torch.Tensor) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
    """Return the points of a difference between a light switched off and on.

    The image is linear in the scale of a light: any step is exact, and the largest has the least noise.
    """
    on = torch.where(value > 0, value, 1.0)
    return (on - value, 1 / on), (-value, -1 / on)


def _clamp_off_singularity(parameter: Parameter, value: torch.Tensor) -> torch.Tensor:
    """Return the value, moved away from where path replay would lose the derivative; the same tensor elsewhere."""
    if value.ndim > 1:
        # Only textures with black texels are copied.
        is_black = parameter.kind == "reflectance" and not bool(value.all())
        return torch.where(value == 0, SINGULARITY_OFFSETS["reflectance"], value) if is_black else value
    if parameter.role == "eta" and "Plastic" in parameter.plugin:
        # At an index of exactly 1 there is no Fresnel term; closer to 1 its slope is lost to rounding.
        clamped = torch.where(value == 1, JUST_ABOVE_ONE, value)
    elif parameter.role in REFLECTED_LOBES:
        clamped = value.clamp_min(LOBE_OFFSET)
    elif parameter.role == "specular_transmittance":
        clamped = value.clamp_min(SPECULAR_OFFSET)
    else:
        clamped = value.clamp_min(SINGULARITY_OFFSETS.get(parameter.kind, -math.inf))
    return value if torch.equal(clamped, value) else clamped


def _is_constant(parameter: Parameter, values: Values) -> bool:
    """Whether the image does not depend on a parameter: no shape uses its material, or the metal is white.

    A metal of index 0 reflects all light, whatever its ``k``. ``_clamp_off_singularity`` of the index would give
    ``k`` a slope.
    """
    if not parameter.is_used:
        return True
    index = _sibling(parameter, "eta", values) if parameter.role == "k" else None
    return index is not None and not index.any()


def _sibling(parameter: Parameter, role: str, values: Values) -> torch.Tensor | None:
    """Return the value of another property of the same material, or None if it has none of that name."""
    own = re.escape(parameter.role)
    return values.get(re.sub(rf"\b{own}\b(?!.*\b{own}\b)", role, parameter.name))


def _reason_against_replay(parameter: Parameter, values: Values) -> str | None:
    """Return why path replay is wrong for a parameter at its value, or None where it is correct."""
    if parameter.moves:
        return MOVES
    if len(parameter.shape) > 1:
        return None
    if parameter.plugin == "SmoothDielectric" and parameter.role == "eta":
        return "it turns refracted light, and with it all later directions of a path"
    if not parameter.tracked and parameter.unknown_sampling:
        return "how the directions and the choice of a lobe of your specular plugin depend on it is not known"
    if not parameter.tracked:
        return (
            f"Mitsuba's {parameter.plugin} keeps it, or values derived from it, outside the derivative graph"
        )
    for applies, reason in _RULES:
        if applies(parameter, values):
            return reason
    return None


def _blends_specular(p: Parameter, values: Values) -> bool:
    return p.mixes_specular


def _ior_near_one(p: Parameter, values: Values) -> bool:
    # Our own plastics use one-sided slopes at 1.
    dielectric = p.role == "eta" and "Conductor" not in p.plugin and "Plastic" not in p.plugin
    return dielectric and bool(((values[p.name] - 1).abs() < 0.1).any())


def _lobe_switched_off(p: Parameter, values: Values) -> bool:
    if not (p.lobe_weight or p.kind == "opacity"):
        return False
    value = values[p.name]
    at_low, at_high = bool((value == p.bounds.low).any()), bool((value == p.bounds.high).any())
    return at_high or (at_low and not (p.role in REFLECTED_LOBES and _has_diffuse_lobe(p, values)))


def _has_diffuse_lobe(p: Parameter, values: Values) -> bool:
    """Whether a principled material samples all directions of reflection."""
    others = (_sibling(p, role, values) for role in ("metallic", "spec_trans"))
    return not any(other is not None and bool((other == 1).any()) for other in others)


def _narrow_hair(p: Parameter, values: Values) -> bool:
    return p.plugin == "Hair" and p.kind == "roughness" and bool((values[p.name] <= 0.1).any())


def _never_sampled(p: Parameter, values: Values) -> bool:
    # A plastic samples its coating in proportion to this reflectance.
    return p.role == "specular_reflectance" and "Plastic" in p.plugin and bool((values[p.name] == 0).any())


_RULES = (
    (_blends_specular, "it blends a perfectly specular lobe with others"),
    (_ior_near_one, "near 1 the reflectance has a kink, and few samples contribute to its slope"),
    (_lobe_switched_off, "at this bound a lobe is skipped and never sampled"),
    (_never_sampled, "at 0 the coating is never sampled"),
    (_narrow_hair, "this plugin samples narrow lobes differently from how it evaluates them"),
)


def _step(p: Parameter, value: torch.Tensor) -> torch.Tensor:
    if p.kind == "roughness":
        return RELATIVE_STEP * value
    if p.kind in STEPS and p.kind != "emitters" and p.bounds.high <= 2:
        return torch.full_like(value, STEPS[p.kind])
    if p.kind == "ior":
        return torch.where((value - 1).abs() < 0.1, STEP_NEAR_ONE, torch.full_like(value, STEPS["ior"]))
    return torch.where(value == 0, torch.full_like(value, 0.02), RELATIVE_STEP * value.abs())


def _smooth_interval(p: Parameter, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the interval around the value in which the image is a smooth function of it."""
    low = torch.full_like(value, p.bounds.low)
    high = torch.full_like(value, p.bounds.high)
    if p.role == "eta" and "Conductor" not in p.plugin:
        low = torch.where(value >= 1, low.clamp_min(1.0), low)
        high = torch.where(value < 1, high.clamp_max(1.0), high)
    return low, high
