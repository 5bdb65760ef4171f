"""What a result is compared with, in words: for ``info`` and for the note below its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ..protocols import Capabilities, Renderer
from ._baselines import Baselines, Values, matches, table_of
from ._wording import value_in_words

_UNCHANGED = "unchanged"
_MAX_CHANNELS = 4
_MAX_NAMED = 6  # of the keys of a mapping, in its order: the effects are not known yet
_MAX_LISTED = 3  # baselines of a list
_DEFAULT = "lights and reflectances 0"
_DEFAULT_OF_UNKNOWN = "0"  # without a table of the parameters
DEFAULT_OF_OCCLUSION = "the mean of each channel"
_OTHERS_UNCHANGED = ", all other inputs unchanged"
_PRESETS = {
    "dark": "all lights off, everything else unchanged",
    "black": "all reflectances 0, everything else unchanged",
    "grey": "each reflectance at its own mean, everything else unchanged",
}


def describe_baselines(
    renderer: Renderer,
    values: Values,
    baselines: Baselines,
    resolved: Values,
    *,
    default: str = _DEFAULT,
) -> dict[str, Any]:
    """Return ``"baselines"``, that of each input in words, and ``"compared_with"``.

    Default baselines that change every input need no words. ``resolved`` are the tensors that
    ``resolve_baselines`` returned, ``default`` says what those of None are.
    """
    info: dict[str, Any] = {"baselines": {n: _written(resolved[n], value) for n, value in values.items()}}
    if baselines is None:
        if _UNCHANGED not in info["baselines"].values():
            return info
        return info | {"compared_with": _default_words(renderer, default) + _OTHERS_UNCHANGED}
    if isinstance(baselines, str):
        return info | {"compared_with": _PRESETS[baselines]}
    if Capabilities(baselines).inputs is not None:
        return info | {"compared_with": "the values of another scene"}
    if isinstance(baselines, Mapping):
        return info | {"compared_with": _of_mapping(renderer, values, baselines, resolved, default)}
    return info | {
        "compared_with": f"all inputs at {_written(torch.as_tensor(baselines, dtype=torch.float32))}"
    }


def describe_several(
    renderer: Renderer, values: Values, baselines: Sequence[Baselines], resolved: Sequence[Values]
) -> dict[str, Any]:
    """Return the same for a list of baselines, of which the first few are in words."""
    described = [
        describe_baselines(renderer, values, one, tensors).get("compared_with", _DEFAULT)
        for one, tensors in zip(baselines[:_MAX_LISTED], resolved, strict=False)
    ]
    parts = [f"({number}) {text}" for number, text in enumerate(described, 1)]
    more = len(baselines) - len(parts)
    parts += [f"{more} more"] if more else []
    count = f"{len(baselines)} baselines"
    return {"baselines": count, "compared_with": f"{count} with equal probability: {'; '.join(parts)}"}


def _of_mapping(
    renderer: Renderer, values: Values, baselines: Mapping[str, Any], resolved: Values, default: str
) -> str:
    """Return what the inputs that a mapping names are compared with, and the others."""
    changed = {name for name, value in values.items() if not torch.equal(resolved[name], value)}
    labels = Capabilities(renderer).labels or {}
    named: set[str] = set()
    moved, kept = [], []
    for key, given in baselines.items():
        names = matches(renderer, values, key)[1]
        named |= set(names)
        if changed.isdisjoint(names):
            kept.append(labels.get(key, key))
        else:
            moved.append(f"{labels.get(key, key)} {_written(torch.as_tensor(given, dtype=torch.float32))}")
    parts = moved[:_MAX_NAMED]
    if len(moved) > _MAX_NAMED:
        parts.append(f'and {len(moved) - _MAX_NAMED} more changed (see info["baselines"])')
    others = "all other inputs" if moved or kept else "all inputs"
    if changed - named:
        parts += [f"{name} unchanged" for name in kept[:_MAX_NAMED]]
        parts += [f"{len(kept) - _MAX_NAMED} more unchanged"] if len(kept) > _MAX_NAMED else []
        parts.append(f"{others} at their default baselines ({_default_words(renderer, default)})")
    elif kept or named != set(values):
        parts.append(f"{others if moved else 'all inputs'} unchanged")
    return "; ".join(parts)


def _default_words(renderer: Renderer, default: str) -> str:
    return default if table_of(renderer) is not None else _DEFAULT_OF_UNKNOWN


def have_same_baselines(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether the ``info`` of two results says that they are compared with the same.

    The same default baselines change all inputs of one scene, and of another all but those that are 0 there.
    """
    defaults = {words + _OTHERS_UNCHANGED for words in (_DEFAULT, _DEFAULT_OF_UNKNOWN, DEFAULT_OF_OCCLUSION)}
    first, second = (one.get("compared_with") for one in (a, b))
    return first == second or defaults | {None} >= {first, second}


def _written(baseline: torch.Tensor, value: torch.Tensor | None = None) -> str:
    """Return a baseline in words: a number, a colour, or the mean of a map."""
    if value is not None and torch.equal(baseline, value):
        return _UNCHANGED
    channels = baseline.reshape(-1, baseline.shape[-1]) if baseline.ndim > 1 else baseline.reshape(1, -1)
    if channels.shape[-1] > _MAX_CHANNELS:
        return "the given values"
    is_uniform = torch.equal(channels, channels[:1].expand_as(channels))
    return f"{'' if is_uniform else 'with a mean of '}{value_in_words(baseline)}"
