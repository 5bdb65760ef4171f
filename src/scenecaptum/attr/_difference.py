"""Arithmetic of attributions, with errors: differences, sums and multiples."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch.nn.functional import pad

from ..student import degrees_of_freedom
from ..visualization import rounded
from ._baseline_words import have_same_baselines
from ._convergence import convergence
from ._data import AttributionData, Tensors, covariances
from ._quadrature_error import covariance_of_quadrature

A = TypeVar("A", bound=AttributionData)


def multiply(a: A, factor: float) -> A:
    """Return a multiple of an attribution: of the same metric times the factor."""
    size = abs(factor)

    def times(tensors: Tensors, by: float) -> dict[str, torch.Tensor]:
        return {name: by * value for name, value in tensors.items()}

    not_scaled = ("verdict", "metric_bias", "proportional_errors")
    info = {key: value for key, value in a.info.items() if key not in not_scaled}
    if a.info.get("explained") is not None:
        info["explained"] = factor * a.info["explained"]
    return dataclasses.replace(
        a,
        attributions=times(a.attributions, factor),
        standard_error=None if a.standard_error is None else times(a.standard_error, size),
        bias=None if a.bias is None else times(a.bias, factor),
        quadrature_error=None if a.quadrature_error is None else times(a.quadrature_error, size),
        replicates=times(a.replicates, factor),
        covariance=None if a.covariance is None else times(a.covariance, factor**2),
        convergence_delta=None if a.convergence_delta is None else factor * a.convergence_delta,
        convergence_delta_error=None
        if a.convergence_delta_error is None
        else size * a.convergence_delta_error,
        metric_value=factor * a.metric_value,
        metric_standard_error=None if a.metric_standard_error is None else size * a.metric_standard_error,
        metric_error_parts=None if a.metric_error_parts is None else factor * a.metric_error_parts,
        info={**info, **_described([term.times(factor) for term in _terms(a)], [a])},
    )


def add(a: A, b: A) -> A:
    """Return ``a + b`` for attributions to the same parameters."""
    total = subtract(a, multiply(b, -1.0))
    info = {key: value for key, value in total.info.items() if key != "minus"}
    return dataclasses.replace(total, info={**info, **_described(_sum(a, b), [a, b]), "plus": dict(b.info)})


def subtract(a: A, b: A) -> A:
    """Return ``a - b`` for attributions to the same parameters.

    Where the range of a parameter differs, as that of a lamp that was dimmed, the difference is that of its
    effects, over the range that it has in each: a lamp that is off in one of them has no effect there.
    """
    ranged = with_different_ranges(a, b)
    a, b = _over_own_ranges(a, ranged), _over_own_ranges(b, ranged)
    replicates = {n: a.replicates[n] - b.replicates[n] for n in a} if _has_common_random_numbers(a, b) else {}
    bias = None if a.bias is None or b.bias is None else {n: a.bias[n] - b.bias[n] for n in a}
    values = {name: a[name] - b[name] for name in a}
    quadrature_error = _quadrature_error(a, b)
    covariance = _covariance(a, b, replicates, bias)
    parts = _error_parts(a, b)
    if replicates and covariance is not None:  # replicates contain the noise only
        for name, error in (quadrature_error or {}).items():
            covariance[name] = covariance[name] + covariance_of_quadrature(error, values[name])
    return dataclasses.replace(
        a,
        attributions=values,
        standard_error=_errors(a, b, covariance if replicates else None),
        bias=bias,
        quadrature_error=quadrature_error,
        replicates=replicates,
        covariance=covariance,
        parameter_values=_common(a.parameter_values, b.parameter_values),
        convergence_delta=_minus(a.convergence_delta, b.convergence_delta),
        convergence_delta_error=_hypot(a.convergence_delta_error, b.convergence_delta_error),
        metric_value=a.metric_value - b.metric_value,
        metric_standard_error=_hypot(a.metric_standard_error, b.metric_standard_error)
        if parts is None
        else parts.norm().item(),
        metric_error_parts=parts,
        info=_info(a, b),
    )


def with_different_ranges(a: AttributionData, b: AttributionData) -> list[str]:
    """Return the parameters whose ranges differ in two results: also lights that are off in one of them."""
    switched = lights_switched(a, b)
    if not (a.kind.is_gradient_per_unit and b.kind.is_gradient_per_unit):
        return [name for name in a if name in switched]
    return [
        name
        for name, length in a.extents.items()
        if name in a and name in b.extents and (name in switched or not torch.equal(length, b.extents[name]))
    ]


def lights_switched(a: AttributionData, b: AttributionData) -> frozenset[str]:
    """Return the lights, and groups of them, that are off in one of two results and on in the other."""
    return (a.lights_off() ^ b.lights_off()) & frozenset(a) & frozenset(b)


def _over_own_ranges(one: A, names: Sequence[str]) -> A:
    """Return a result in which some parameters are per range, and no longer per unit."""
    if not names:
        return one
    off = one.lights_off()
    lengths = {name: one.extents.get(name, torch.ones(1)) for name in names}
    ranges = {name: torch.zeros_like(length) if name in off else length for name, length in lengths.items()}

    def per_range(tensors: Tensors) -> dict[str, torch.Tensor]:
        scaled = {
            name: tensors[name] * length.reshape(tensors[name].shape[-1:])
            for name, length in ranges.items()
            if name in tensors
        }
        return {**tensors, **scaled}

    def covariance_per_range(tensors: Tensors) -> dict[str, torch.Tensor]:
        rows = {name: length[:, None] * tensors[name] for name, length in ranges.items()}
        return per_range({**tensors, **rows})

    return dataclasses.replace(
        one,
        attributions=per_range(one.attributions),
        standard_error=one.standard_error and per_range(one.standard_error),
        quadrature_error=one.quadrature_error and per_range(one.quadrature_error),
        bias=one.bias and per_range(one.bias),
        replicates=one.replicates and per_range(one.replicates),
        covariance=one.covariance and covariance_per_range(one.covariance),
        extents={name: torch.ones_like(e) if name in ranges else e for name, e in one.extents.items()},
        info={**one.info, "own_ranges": [*one.info.get("own_ranges", ()), *names]},
    )


def _info(a: AttributionData, b: AttributionData) -> dict[str, Any]:
    not_shared = ("explained", "convergence", "quadrature_error", "metric_bias", "proportional_errors")
    info = {key: value for key, value in a.info.items() if key not in not_shared}
    info |= {**_described(_difference(a, b), [a, b]), "minus": dict(b.info), "verdict": ""}
    info["sampled"] = [list(one) for one in dict.fromkeys(_sampled(a) + _sampled(b))]
    info |= _without_derivative(a.info, b.info)
    off = b.info.get("lights_off", ())
    info["lights_off"] = [name for name in a.info.get("lights_off", ()) if name in off]
    info["lights_on"] = list(dict.fromkeys([*a.info.get("lights_on", ()), *b.info.get("lights_on", ())]))
    info["linear_in_light"] = all(side.info.get("linear_in_light") for side in (a, b))
    own = [*a.info.get("own_ranges", ()), *b.info.get("own_ranges", ())]
    info["own_ranges"] = list(dict.fromkeys(own))
    for key in ("local", "nonlinear", "untested"):
        info[key] = list(dict.fromkeys([*a.info.get(key, ()), *b.info.get(key, ())]))
    info["range_changes"] = {}
    if not have_same_baselines(a.info, b.info):
        info["compared_with"] = "different baselines"
    delta = _minus(a.convergence_delta, b.convergence_delta)
    explained_a, explained_b = a.info.get("explained"), b.info.get("explained")
    if delta is None or explained_a is None or explained_b is None:
        return info
    error = _hypot(a.convergence_delta_error, b.convergence_delta_error)
    magnitude = abs(explained_a) + abs(explained_b)
    freedom = min(degrees_of_freedom(side.info) for side in (a, b))
    return info | convergence(delta, error, explained_a - explained_b, magnitude, freedom)


def _sampled(a: AttributionData) -> list[tuple[Any, ...]]:
    """Return method, samples and replicates of a result, or of the results that it was computed from."""
    own = [[a.info.get(key) for key in ("method", "spp", "replicates")]]
    return [tuple(one) for one in a.info.get("sampled") or own]


def _without_derivative(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    """Return the poses, and the directions of others, that have no derivative on either side."""
    one, other = (side.get("kept_directions", {}) for side in (a, b))
    kept = {
        name: [min(pair) for pair in zip(one.get(name, mask), other.get(name, mask), strict=True)]
        for name, mask in {**one, **other}.items()
    }
    shared = {key: {**b.get(key, {}), **a.get(key, {})} for key in ("jumps", "left_out_directions")}
    return {**shared, "kept_directions": kept}


class _Term(NamedTuple):
    """One metric of a sum, how often it is taken, and how many results that is the sum of."""

    name: str
    factor: float = 1.0
    results: int = 1

    def times(self, factor: float) -> _Term:
        return self._replace(factor=factor * self.factor)

    def __str__(self) -> str:
        """Return ``'cube'``, ``'2 × cube'``, or ``'cube (mean of 4)'``, without the sign of the factor."""
        if not math.isclose(abs(self.factor), 1):
            return f"{abs(self.factor):g} × {self.name}"
        return self.name if self.results == 1 else f"{self.name} (mean of {self.results})"


def _terms(a: AttributionData) -> list[_Term]:
    """Return the metrics that a result is the sum of: of a single one its name in words, or that of its class."""
    name = str((a.info.get("measure") or {}).get("name") or a.info.get("metric", "metric"))
    return [_Term(*term) for term in a.info.get("terms") or [(name,)]]


def _written(terms: Sequence[_Term]) -> str:
    """Return ``'cube − 2 × sphere'``, or with a common factor ``'0.5 × (cube + sphere)'``."""
    sizes = {abs(term.factor) for term in terms}
    common = sizes.pop() if len(terms) > 1 and len(sizes) == 1 else 1.0
    if len(terms) > 1 and all(term.factor < 0 for term in terms):
        common = -common
    if common not in (0, 1):
        return _written([_Term(f"({_written([term.times(1 / common) for term in terms])})", common)])
    first, *others = terms
    rest = "".join(f" {'−' if term.factor < 0 else '+'} {term}" for term in others)
    return f"{'−' if first.factor < 0 else ''}{first}{rest}"


def _described(terms: Sequence[_Term], sides: Sequence[AttributionData]) -> dict[str, Any]:
    """Return the metric of a sum, and the unit that its sides share."""
    measures = [side.info.get("measure") or {} for side in sides]
    units = [str(measure.get("unit") or "") for measure in measures]
    name = _written(terms)
    info: dict[str, Any] = {"metric": name, "measure": None, "terms": [list(term) for term in terms]}
    if any(measures):
        info["measure"] = {"name": name, "unit": units[0] if len(set(units)) == 1 else ""}
    if any(measures) and len(set(units)) > 1:  # of a metric that does not say what it measures, a number
        info["units"] = units
    return info


def _sum(a: AttributionData, b: AttributionData) -> list[_Term]:
    """Return the terms of a sum; equal ones of results that differ at most by their seed are one."""
    terms, others = _terms(a), _terms(b)
    subject, values = _sides(a, b)
    if subject != "seed " and (subject, values) != _ALIKE:
        return _paired(a, b, "+") or terms + others
    for other in others:
        for index, term in enumerate(terms):
            if term.name == other.name and term.factor * other.factor > 0:
                terms[index] = _Term(term.name, term.factor + other.factor, term.results + other.results)
                break
        else:
            terms.append(other)
    return terms


def _difference(a: AttributionData, b: AttributionData) -> list[_Term]:
    """Return the terms of a difference."""
    return _paired(a, b, "−") or _terms(a) + [term.times(-1) for term in _terms(b)]


def _paired(a: AttributionData, b: AttributionData, sign: str) -> list[_Term]:
    """Return for results of one metric the one term ``'UGR (first − second)'``, with what they differ by."""
    names = [_written(_terms(side)) for side in (a, b)]
    if names[0] != names[1]:
        return []
    subject, (first, second) = _sides(a, b)
    name = names[0] if len(_terms(a)) == 1 else f"({names[0]})"
    return [_Term(f"{name} ({subject}{first} {sign} {second})")]


def _sides(a: AttributionData, b: AttributionData) -> tuple[str, tuple[str, str]]:
    """Return what differs between two results of one metric, if it needs to be said, and its two values."""
    changed = [
        name
        for name, value in a.parameter_values.items()
        if name in b.parameter_values and not torch.equal(value, b.parameter_values[name])
    ]
    is_one_scene = _setting(a, "scene") == _setting(b, "scene")
    if is_one_scene and len(changed) > 1:
        return "", ("first design", "second design")
    if is_one_scene and changed:
        label, values = a.labels.get(changed[0], changed[0]), [s.parameter_values[changed[0]] for s in (a, b)]
        written = [rounded(float(value.mean())) for value in values]
        if written[0] != written[1] and all(value.unique().numel() == 1 for value in values):
            return f"{label} ", (written[0], written[1])
        return f"{label}, ", ("first", "second")
    for key, subject in _SETTINGS.items():
        settings = _setting(a, key), _setting(b, key)
        if settings[0] != settings[1] and all(settings):
            return subject, settings
    return _ALIKE


def _setting(side: AttributionData, key: str) -> str:
    """Return a setting of a result; for the scene of a renderer that has none, its class; empty if unknown."""
    value = side.info.get(key, side.info.get("renderer") if key == "scene" else None)
    return "" if value is None else str(value)


_ALIKE = "", ("first", "second")

# What may tell two results of one metric apart, by its key in ``info``, and what to write before its values.
_SETTINGS = {"scene": "", "integrator": "", "method": "", "max_depth": "depth ", "seed": "seed "}


def _quadrature_error(a: AttributionData, b: AttributionData) -> dict[str, torch.Tensor] | None:
    """Combine the quadrature errors as if they were independent, because their signs are unknown."""
    errors = [side.quadrature_error for side in (a, b) if side.quadrature_error is not None]
    if not errors:
        return None
    return {name: torch.stack([error[name] for error in errors]).norm(dim=0) for name in a}


def _has_common_random_numbers(a: AttributionData, b: AttributionData) -> bool:
    same = all(a.info.get(key) == b.info.get(key) for key in ("seed", "spp", "replicates", "resolution"))
    return same and bool(a.replicates) and bool(b.replicates)


def _error_parts(a: AttributionData, b: AttributionData) -> torch.Tensor | None:
    """Return the parts of the error of the metric's difference; None without common random numbers.

    A metric without draws of noise has fewer parts than one with them.
    """
    first, second = a.metric_error_parts, b.metric_error_parts
    if first is None or second is None or not _has_common_random_numbers(a, b):
        return None
    length = max(len(first), len(second))
    return pad(first, (0, length - len(first))) - pad(second, (0, length - len(second)))


def _covariance(
    a: AttributionData,
    b: AttributionData,
    replicates: dict[str, torch.Tensor],
    bias: dict[str, torch.Tensor] | None,
) -> dict[str, torch.Tensor] | None:
    if a.covariance is None or b.covariance is None:
        return None
    if replicates:
        return covariances(replicates, bias)
    return {name: a.covariance[name] + b.covariance[name] for name in a}


def _errors(
    a: AttributionData, b: AttributionData, paired_covariance: Mapping[str, torch.Tensor] | None
) -> dict[str, torch.Tensor] | None:
    """Return elementwise errors; ``paired_covariance`` is given if both sides use common random numbers."""
    if a.standard_error is None or b.standard_error is None:
        return None
    errors = {name: torch.hypot(a.standard_error[name], b.standard_error[name]) for name in a}
    for name, covariance in (paired_covariance or {}).items():
        if a[name].ndim < 2:  # its elements are its channel totals
            errors[name] = covariance.diagonal().sqrt().reshape(a[name].shape).to(a[name])
    return errors


def _common(a: Tensors, b: Tensors) -> dict[str, torch.Tensor]:
    """Return the values that are equal in both designs."""
    return {name: value for name, value in a.items() if name in b and torch.equal(value, b[name])}


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _hypot(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else math.hypot(a, b)
