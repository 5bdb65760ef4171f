"""From ``baselines=`` to the scene that an attribution starts from: what "absent" means for each parameter."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import torch

from ..errors import SceneCaptumError, near_misses
from ..scene import Parameter

Baselines: TypeAlias = "str | float | torch.Tensor | Mapping[str, Any] | Any | None"
Values: TypeAlias = "Mapping[str, torch.Tensor]"

PRESETS = ("dark", "black", "grey")
KINDS = ("emitters", "reflectance", "roughness", "ior", "opacity", "surface", "media")

# What shapes a light or its sky without being its power: 0 would be no darkness but another, or no, light.
_SHAPE_OF_LIGHT = {"cutoff_angle", "beam_width", "turbidity", "albedo", "sun_aperture"}


def resolve_baselines(
    renderer: Any,
    values: Values,
    baselines: Baselines = None,
    *,
    default: Values | None = None,
) -> dict[str, torch.Tensor]:
    """Return the baseline of every parameter: a tensor of its own for each, shaped like its value.

    Example
    -------
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", inputs=["reflectance", "emitters"])
    >>> resolve_baselines(renderer, renderer.inputs, {"emitters": 0.0, "*_wall.*": 0.5})["floor.reflectance.value"]
    tensor([0., 0., 0.])

    Parameters
    ----------
    renderer
        Its ``parameters_table()`` tells kinds and bounds; without one, its ``bounds`` are used where it has them.
    values
        The current values by parameter name.
    baselines
        - None: lights and reflectances are 0, and everything else keeps its current value, since a roughness or
          an index of refraction of 0 is unphysical. Without a ``parameters_table()`` everything is 0.
        - ``"dark"``: all lights are off. ``"black"``: all reflectances are 0. ``"grey"``: each reflectance is its
          own mean over texels and channels. Everything else keeps its current value.
        - A number or a tensor: the baseline of every parameter.
        - A mapping whose keys are exact names, globs, or kinds (``"emitters"``, ``"reflectance"``,
          ``"roughness"``, ``"ior"``, ``"opacity"``, ``"surface"``, ``"media"``), and whose values are numbers or
          tensors that broadcast to the parameter. A name counts before a glob, a glob before a kind, and of two
          globs the first. What none of them names is as with None.
        - Another scene, which is anything with ``inputs``: its values of the same names.
    default
        Stands in for the rule of None, by parameter name.

    Raises
    ------
    SceneCaptumError
        Where a preset, name, shape or scene does not fit, or a baseline lies outside the physical bounds.
    """
    others: Values | None = getattr(baselines, "inputs", None)
    if isinstance(baselines, str):
        chosen = _preset(renderer, values, baselines)
    elif others is not None:
        chosen = _other_scene(values, others)
    else:
        chosen = dict(default) if default is not None else _absent(renderer, values)
        if isinstance(baselines, Mapping):
            chosen |= _named(renderer, values, baselines)
        elif baselines is not None:
            chosen = dict.fromkeys(values, baselines)
    resolved = {name: _fitted(name, chosen[name], value) for name, value in values.items()}
    for name, baseline in resolved.items():
        # A scene's own value is what its renderer accepted, be it at a bound or beyond.
        if not torch.equal(baseline, values[name]):
            _check_bounds(renderer, name, baseline)
    return resolved


def table_of(renderer: Any) -> Mapping[str, Parameter] | None:
    """Return what the renderer knows of its parameters, if it knows anything."""
    describe: Callable[[], Mapping[str, Parameter]] | None = getattr(renderer, "parameters_table", None)
    return None if describe is None else describe()


def _absent(renderer: Any, values: Values) -> dict[str, Any]:
    table = table_of(renderer)
    if table is None:
        return dict.fromkeys(values, 0.0)
    return {n: 0.0 if _is_light(table[n]) or _reflects(table[n]) else value for n, value in values.items()}


def _preset(renderer: Any, values: Values, preset: str) -> dict[str, Any]:
    if preset not in PRESETS:
        raise SceneCaptumError(
            f"baselines={preset!r} is no preset.{near_misses(preset, PRESETS)} Presets are "
            f"{', '.join(PRESETS)}; a number, a mapping by parameter name, or another renderer will do as well."
        )
    table = table_of(renderer)
    if table is None:
        raise SceneCaptumError(
            f"baselines={preset!r} needs to know which parameters are lights and which reflectances, and this "
            "renderer has no parameters_table() to tell. Give numbers or tensors by parameter name."
        )
    concerned = [name for name in values if (_is_light if preset == "dark" else _reflects)(table[name])]
    if not concerned:
        what = "light" if preset == "dark" else "reflectance"
        raise SceneCaptumError(
            f"baselines={preset!r} changes nothing: there is no {what} among the {len(values)} inputs. "
            'Select some with SceneRenderer(…, inputs=["reflectance", "emitters"]), or give other baselines.'
        )
    return {**values, **{n: values[n].mean().item() if preset == "grey" else 0.0 for n in concerned}}


def _is_light(parameter: Parameter) -> bool:
    return parameter.kind == "emitters" and parameter.role not in _SHAPE_OF_LIGHT


def _reflects(parameter: Parameter) -> bool:
    return parameter.kind == "reflectance"


def _other_scene(values: Values, others: Values) -> dict[str, Any]:
    missing = [name for name in values if name not in others]
    if missing:
        raise SceneCaptumError(
            f"The scene given as baselines has no input {missing[0]!r}{_and_more(missing)}."
            f"{near_misses(missing[0], others)} Build its renderer with the same inputs=, or give a mapping."
        )
    return {name: others[name] for name in values}


def _and_more(names: list[str]) -> str:
    return f" (nor {len(names) - 1} more)" if len(names) > 1 else ""


def _named(renderer: Any, values: Values, baselines: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the baselines that a mapping gives, the vaguest keys first, so that the exact ones win."""
    ranked: list[tuple[int, dict[str, Any]]] = []
    for key, baseline in reversed(list(baselines.items())):
        rank, names = _matches(renderer, values, key)
        ranked.append((rank, dict.fromkeys(names, baseline)))
    ranked.sort(key=lambda entry: entry[0])
    return {name: baseline for _, chosen in ranked for name, baseline in chosen.items()}


def _matches(renderer: Any, values: Values, key: Any) -> tuple[int, list[str]]:
    """Return how exact a key is (0: a kind, 1: a glob, 2: a name), and the parameters that it means."""
    if not isinstance(key, str):
        raise SceneCaptumError(f"baselines must be keyed by names, globs or kinds, not {type(key).__name__}.")
    if key in values:
        return 2, [key]
    table = table_of(renderer)
    if key in KINDS and table is None:
        raise SceneCaptumError(
            f"baselines names the kind {key!r}, but this renderer has no parameters_table() that tells kinds. "
            f"Use the names of its parameters: {', '.join(values)}."
        )
    if key in KINDS and table is not None:
        rank, names = 0, [name for name in values if table[name].kind == key]
    else:
        rank, names = 1, [name for name in values if fnmatchcase(name, key)]
    if not names:
        raise SceneCaptumError(
            f"baselines names {key!r}, which matches none of the {len(values)} inputs."
            f"{near_misses(key, [*values, *KINDS])} Use a parameter's name, a glob, or a kind "
            f"({', '.join(KINDS)})."
        )
    return rank, names


def _fitted(name: str, baseline: Any, value: torch.Tensor) -> torch.Tensor:
    """Return a baseline as a tensor of its own, with the shape, type and device of its parameter."""
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


def _check_bounds(renderer: Any, name: str, baseline: torch.Tensor) -> None:
    if not torch.isfinite(baseline).all():
        raise SceneCaptumError(f"The baseline of {name!r} holds a value that is not finite.")
    low, high, open_low, written = _bounds(renderer, name)
    least, most = baseline.min().item(), baseline.max().item()
    if least < low or most > high or (open_low and least == low):
        raise SceneCaptumError(
            f"The baseline of {name!r} is {most if most > high else least:.6g}, outside its physical bounds "
            f'{written}. Give one inside: baselines={{"{name}": …}}.'
        )


def _bounds(renderer: Any, name: str) -> tuple[float, float, bool, str]:
    table = table_of(renderer)
    if table is not None:
        bounds = table[name].bounds
        return bounds.low, bounds.high, bounds.open_low, str(bounds)
    low, high = getattr(renderer, "bounds", {}).get(name, (-math.inf, math.inf))
    return low, high, False, f"[{low:g}, {high:g}]"
