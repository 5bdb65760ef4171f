"""Resolving ``baselines=`` to the value that represents the absence of each parameter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import torch

from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ..protocols import Capabilities, Renderer
from ..scene import Parameter

Baselines: TypeAlias = "str | float | torch.Tensor | Mapping[str, Any] | Any | None"
Values: TypeAlias = "Mapping[str, torch.Tensor]"

PRESETS = ("dark", "black", "grey")
KINDS = ("emitters", "reflectance", "roughness", "ior", "opacity", "surface", "media")

# Emitter parameters that do not scale the power: setting them to 0 would not switch the light off.
_NON_POWER_ROLES = {"cutoff_angle", "beam_width", "turbidity", "albedo", "sun_aperture"}


def resolve_baselines(
    renderer: Renderer, values: Values, baselines: Baselines = None, *, default: Values | None = None
) -> dict[str, torch.Tensor]:
    """Return the baseline of every parameter, a new tensor with the shape of its value.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"])
    >>> resolve_baselines(renderer, renderer.inputs, {"emitters": 0.0, "*_wall.*": 0.5})["floor.reflectance.value"]
    tensor([0., 0., 0.])

    Parameters
    ----------
    renderer, values
        The current values. The renderer may provide kinds by ``parameters_table()``, and bounds by it or
        ``bounds``.
    baselines
        - None: emitters and reflectances are 0, and everything else keeps its current value, since a roughness or
          an index of refraction of 0 is unphysical. Without a ``parameters_table()`` everything is 0.
        - ``"dark"``: all emitters are off. ``"black"``: all reflectances are 0. ``"grey"``: each reflectance is
          its own mean over texels and channels. Everything else keeps its current value.
        - A number or a tensor: the baseline of every parameter.
        - A mapping whose keys are exact names, globs, or kinds (``"emitters"``, ``"reflectance"``,
          ``"roughness"``, ``"ior"``, ``"opacity"``, ``"surface"``, ``"media"``), and whose values are numbers or
          tensors that broadcast to the parameter. Names take precedence over globs, globs over kinds, and earlier
          globs over later ones. Parameters that no key matches are treated as with None; to leave them unchanged,
          start from the values: ``{**renderer.inputs, "floor.reflectance.value": 0.2}``.
        - Another scene (any object with ``inputs``): its values of the same names.
    default
        Replaces the rule for None, by parameter name.

    Raises
    ------
    SceneCaptumError
        If a preset or name is unknown, a shape or scene does not match, or a baseline is outside the physical
        bounds.
    """
    others = Capabilities(baselines).inputs
    if isinstance(baselines, str):
        given = _preset(renderer, values, baselines)
    elif others is not None:
        given = _other_scene(values, others)
    else:
        given = dict(default) if default is not None else _absent(renderer, values)
        if isinstance(baselines, Mapping):
            given |= _from_mapping(renderer, values, baselines)
        elif baselines is not None:
            given = dict.fromkeys(values, baselines)
    resolved = {name: _broadcast(name, given[name], value) for name, value in values.items()}
    for name, baseline in resolved.items():
        # The renderer has already accepted the current values, even if they are out of bounds.
        if not torch.equal(baseline, values[name]):
            _check_bounds(renderer, name, baseline)
    return resolved


def table_of(renderer: Renderer) -> Mapping[str, Parameter] | None:
    """Return the renderer's table of parameters, or None."""
    describe = Capabilities(renderer).parameters_table
    return None if describe is None else describe()


def own_texels(renderer: Renderer, values: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the values without the columns that Mitsuba adds to an environment map, so that means are its own."""
    table = table_of(renderer) or {}
    repeating = [name for name in values if name in table and table[name].repeats_columns]
    return {**values, **{name: values[name][:, 1:-1] for name in repeating}}


def _absent(renderer: Renderer, values: Values) -> dict[str, Any]:
    table = table_of(renderer)
    if table is None:
        return dict.fromkeys(values, 0.0)
    return {
        name: 0.0 if is_emitted_power(table[name]) or _is_reflectance(table[name]) else value
        for name, value in values.items()
    }


def _preset(renderer: Renderer, values: Values, preset: str) -> dict[str, Any]:
    if preset not in PRESETS:
        raise SceneCaptumError(
            f"baselines={preset!r} is not a preset.{near_misses(preset, PRESETS)} Presets are "
            f"{', '.join(PRESETS)}; or give a number, a mapping by parameter name, or another renderer."
        )
    table = table_of(renderer)
    if table is None:
        raise SceneCaptumError(
            f"baselines={preset!r} needs the kinds of the parameters, and this renderer has no "
            "parameters_table(). Give numbers or tensors by parameter name."
        )
    is_affected = is_emitted_power if preset == "dark" else _is_reflectance
    affected = [name for name in values if is_affected(table[name])]
    if not affected:
        kind = "light" if preset == "dark" else "reflectance"
        raise SceneCaptumError(
            f"baselines={preset!r} changes nothing: there is no {kind} among the {len(values)} inputs. "
            'Select some with SceneRenderer(…, inputs=["reflectance", "emitters"]), or give other baselines.'
        )
    return {**values, **{n: values[n].mean().item() if preset == "grey" else 0.0 for n in affected}}


def is_emitted_power(parameter: Parameter) -> bool:
    """Whether a parameter is how much light an emitter emits."""
    return parameter.kind == "emitters" and parameter.role not in _NON_POWER_ROLES


def _is_reflectance(parameter: Parameter) -> bool:
    return parameter.kind == "reflectance"


def _other_scene(values: Values, others: Values) -> dict[str, Any]:
    missing = [name for name in values if name not in others]
    if missing:
        more = f" (nor {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise SceneCaptumError(
            f"The scene given as baselines has no input {missing[0]!r}{more}."
            f"{near_misses(missing[0], others)} Build its renderer with the same inputs=, or give a mapping."
        )
    return {name: others[name] for name in values}


def _from_mapping(renderer: Renderer, values: Values, baselines: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the baselines given by a mapping; more specific keys override less specific ones."""
    matched = [(*matches(renderer, values, key), baselines[key]) for key in reversed(list(baselines))]
    matched.sort(key=lambda entry: entry[0])
    return {name: baseline for _, names, baseline in matched for name in names}


def matches(renderer: Renderer, values: Values, key: Any) -> tuple[int, list[str]]:
    """Return how specific a key is (0: a kind, 1: a glob, 2: a name), and the parameters that it matches."""
    if not isinstance(key, str):
        raise SceneCaptumError(f"baselines must be keyed by names, globs or kinds, not {type(key).__name__}.")
    if key in values:
        return 2, [key]
    rank, names = 1, [name for name in values if fnmatchcase(name, key)]
    if key in KINDS:
        table = table_of(renderer)
        if table is None:
            raise SceneCaptumError(
                f"baselines names the kind {key!r}, but this renderer has no parameters_table(). "
                f"Use the names of its parameters: {', '.join(values)}."
            )
        rank, names = 0, [name for name in values if table[name].kind == key]
    if not names:
        raise SceneCaptumError(
            f"baselines names {key!r}, which matches none of the {len(values)} inputs."
            f"{near_misses(key, [*values, *KINDS], instead=INPUT_NAMES)} Use a parameter's name, a glob, or a "
            f"kind ({', '.join(KINDS)})."
        )
    return rank, names


def _broadcast(name: str, baseline: Any, value: torch.Tensor) -> torch.Tensor:
    """Return a baseline as a new tensor with the shape, dtype and device of its parameter."""
    try:
        tensor = torch.as_tensor(baseline, dtype=value.dtype, device=value.device).detach()
    except (TypeError, ValueError, RuntimeError):
        raise SceneCaptumError(
            f"The baseline of {name!r} must be a number or a tensor, not {type(baseline).__name__}."
        ) from None
    try:
        return tensor.broadcast_to(value.shape).clone()
    except RuntimeError:
        raise SceneCaptumError(
            f"The baseline of {name!r} has shape {tuple(tensor.shape)}, which does not broadcast to the "
            f"parameter's {tuple(value.shape)}. Give a number, or a tensor of the parameter's shape."
        ) from None


def _check_bounds(renderer: Renderer, name: str, baseline: torch.Tensor) -> None:
    if not torch.isfinite(baseline).all():
        raise SceneCaptumError(f"The baseline of {name!r} contains a value that is not finite.")
    low, high, open_low, interval = _bounds(renderer, name)
    smallest, largest = baseline.min().item(), baseline.max().item()
    if smallest < low or largest > high or (open_low and smallest == low):
        raise SceneCaptumError(
            f"The baseline of {name!r} is {largest if largest > high else smallest:.6g}, outside its physical "
            f'bounds {interval}. Give a value inside: baselines={{"{name}": …}}.'
        )


def _bounds(renderer: Renderer, name: str) -> tuple[float, float, bool, str]:
    table = table_of(renderer)
    if table is not None:
        bounds = table[name].bounds
        return bounds.low, bounds.high, bounds.open_low, str(bounds)
    low, high = (Capabilities(renderer).bounds or {}).get(name, (-math.inf, math.inf))
    return low, high, False, f"[{low:g}, {high:g}]"
