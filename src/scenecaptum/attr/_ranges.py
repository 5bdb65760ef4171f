"""Ranges of parameters, over which effects of different kinds are compared, and noise relative to these ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from numbers import Real
from typing import Any

import torch

from ..errors import INPUT_NAMES, SceneCaptumError, near_misses
from ..estimation import Stream, derived_seeds
from ..protocols import Capabilities, Renderer
from ..scene import reflect
from ._baselines import is_emitted_power, own_texels, table_of

Tensors = Mapping[str, torch.Tensor]


def extents(renderer: Renderer, values: Tensors) -> dict[str, torch.Tensor]:
    """Return the change of each parameter over its range, a ``(C,)`` tensor by channel; none without ranges.

    For an infinite range (the radiance of an emitter, the index of refraction of a metal) this is the value, for a
    texture the mean of its texels: the change from off to its value. If all channels are 0, it is that of the
    scene's own value, and 1 if that is 0, too.
    """
    ranges = _ranges(renderer)
    if ranges is None:
        return {}
    shown = own_texels(renderer, _not_off(renderer, values))
    return {name: _extent(value, *_range(ranges, name)) for name, value in shown.items()}


def unit_ranges(renderer: Renderer, values: Tensors) -> list[str]:
    """Return the parameters whose range is one unit because they are 0 in the scene, as a lamp that is off."""
    ranges = _ranges(renderer)
    if ranges is None:
        return []
    return [
        name
        for name, value in _not_off(renderer, values).items()
        if not _is_finite(ranges, name) and not value.any()
    ]


def lights(renderer: Renderer, values: Tensors) -> tuple[list[str], list[str]]:
    """Return the radiances and other powers of light that are 0, in the scene or in a design, and the others."""
    table = table_of(renderer)
    if table is None:
        return [], []
    powers = {name: bool(value.any()) for name, value in values.items() if is_emitted_power(table[name])}
    return [name for name, is_on in powers.items() if not is_on], [n for n, is_on in powers.items() if is_on]


def range_lengths(renderer: Renderer, values: Tensors) -> dict[str, torch.Tensor]:
    """Return the length of each parameter's range, a 0-d tensor.

    For an infinite range this is the largest magnitude of its value; if that is 0, of the scene's own value, or 1.
    Raises if the renderer has neither ``ranges`` nor ``bounds``.
    """
    ranges = _ranges(renderer)
    if ranges is None:
        raise SceneCaptumError(
            "Ranges require physical bounds: give the renderer an attribute `bounds`, a dict from parameter name "
            "to (low, high)."
        )
    return {name: _length(value, *_range(ranges, name)) for name, value in _not_off(renderer, values).items()}


class Noise:
    """Gaussian noise on parameters, relative to their ranges and reflected at their bounds.

    ``stdevs`` are fractions of each parameter's range: a number, or a mapping from names, globs or kinds to
    numbers, 0 for all others. The renderer must have ``bounds``, and for kinds a ``parameters_table()``.
    """

    def __init__(self, renderer: Renderer, values: Tensors, stdevs: float | Mapping[str, float]) -> None:
        self.values = values
        self._scales = dict.fromkeys(values, 0.0)
        fractions = _stdevs(renderer, values, stdevs)
        if any(fractions.values()):
            length = range_lengths(renderer, values)
            self._scales = {name: fractions[name] * length[name].item() for name in values}
            self._bounds = Capabilities(renderer).bounds or {}
        table = table_of(renderer)
        self._open = {name: table is not None and table[name].bounds.open_low for name in values}

    def sample(self, seed: int) -> dict[str, torch.Tensor]:
        """Return noisy values. Each parameter has its own random stream."""
        seeds = derived_seeds(seed, Stream.PARAMETER_NOISE, len(self.values))
        return {
            name: self._noisy(name, value, state) if self._scales[name] else value
            for (name, value), state in zip(self.values.items(), seeds, strict=True)
        }

    def _noisy(self, name: str, value: torch.Tensor, seed: int) -> torch.Tensor:
        noise = torch.randn(value.shape, generator=torch.Generator().manual_seed(seed)).to(value)
        low, high = self._bounds.get(name, (-math.inf, math.inf))
        return reflect(noise.mul_(self._scales[name]).add_(value), low, high, open_low=self._open[name])


def _ranges(renderer: Renderer) -> Mapping[str, tuple[float, float]] | None:
    offered = Capabilities(renderer)
    return offered.bounds if offered.ranges is None else offered.ranges


def _range(ranges: Mapping[str, tuple[float, float]], name: str) -> tuple[float, float]:
    return ranges.get(name, (-math.inf, math.inf))


def _is_finite(ranges: Mapping[str, tuple[float, float]], name: str) -> bool:
    low, high = _range(ranges, name)
    return math.isfinite(high - low)


def _not_off(renderer: Renderer, values: Tensors) -> dict[str, torch.Tensor]:
    """Return the values, and in place of 0 the scene's own: what was switched off has the range that it has on.

    Values with finite ranges, which do not depend on them, are returned as they are: textures are large.
    """
    ranges = _ranges(renderer) or {}
    off = [name for name, value in values.items() if not _is_finite(ranges, name) and not value.any()]
    own = (Capabilities(renderer).inputs or {}) if off else {}
    return {**values, **{name: own.get(name, values[name]).to(values[name]) for name in off}}


def _extent(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    if math.isfinite(high - low):
        return value.new_full((value.shape[-1] if value.ndim > 1 else value.numel(),), high - low)
    channels = value.reshape(-1, value.shape[-1]).mean(0) if value.ndim > 1 else value.reshape(-1)
    return channels.abs() if bool(channels.any()) else torch.ones_like(channels)


def _length(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    if math.isfinite(high - low):
        return value.new_tensor(high - low)
    return value.abs().amax() if bool(value.any()) else value.new_ones(())


def _stdevs(renderer: Renderer, values: Tensors, stdevs: float | Mapping[str, float]) -> dict[str, float]:
    if not isinstance(stdevs, Mapping):
        return {name: _stdev("stdevs", stdevs) for name in values}
    table = table_of(renderer)
    kinds = {name: table[name].kind if table is not None else None for name in values}
    by_name = dict.fromkeys(values, 0.0)
    # Kinds first, so that globs and then names override them.
    for matches in (lambda name, key: kinds[name] == key, fnmatchcase, lambda name, key: name == key):
        for key, stdev in stdevs.items():
            for name in values:
                if matches(name, key):
                    by_name[name] = _stdev(f"stdevs[{key!r}]", stdev)
    for key in stdevs:
        if not any(key in (name, kinds[name]) or fnmatchcase(name, key) for name in values):
            raise SceneCaptumError(
                f"stdevs names {key!r}, which no input matches."
                f"{near_misses(key, values, instead=INPUT_NAMES)}"
            )
    return by_name


def _stdev(name: str, value: Any) -> float:
    if not isinstance(value, Real) or not 0 <= float(value) < math.inf:
        raise SceneCaptumError(
            f"{name} must be a number of at least 0, the fraction of a parameter's range, not {value!r}."
        )
    return float(value)
