"""Arithmetic of attributions, with errors: differences, sums and multiples."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import torch

from ..visualization import rounded
from ._convergence import convergence
from ._data import AttributionData, Tensors, covariances
from ._quadrature_error import covariance_of_quadrature

A = TypeVar("A", bound=AttributionData)


def multiply(a: A, factor: float) -> A:
    """Return a multiple of an attribution: of the same metric times the factor."""
    size = abs(factor)

    def times(tensors: Tensors, by: float) -> dict[str, torch.Tensor]:
        return {name: by * value for name, value in tensors.items()}

    info = {key: value for key, value in a.info.items() if key not in ("verdict", "metric_bias")}
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
        info={**info, "metric": f"{factor:g} × {_measured(a)}", "measure": None},
    )


def add(a: A, b: A) -> A:
    """Return ``a + b`` for attributions to the same parameters."""
    total = subtract(a, multiply(b, -1.0))
    info = {key: value for key, value in total.info.items() if key != "minus"}
    return dataclasses.replace(total, info={**info, **_combined(a, b, "+"), "plus": dict(b.info)})


def subtract(a: A, b: A) -> A:
    """Return ``a - b`` for attributions to the same parameters."""
    replicates = {n: a.replicates[n] - b.replicates[n] for n in a} if _has_common_random_numbers(a, b) else {}
    bias = None if a.bias is None or b.bias is None else {n: a.bias[n] - b.bias[n] for n in a}
    values = {name: a[name] - b[name] for name in a}
    quadrature_error = _quadrature_error(a, b)
    covariance = _covariance(a, b, replicates, bias)
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
        metric_standard_error=_hypot(a.metric_standard_error, b.metric_standard_error),
        info=_info(a, b),
    )


def _info(a: AttributionData, b: AttributionData) -> dict[str, Any]:
    not_shared = ("explained", "convergence", "quadrature_error")
    info = {key: value for key, value in a.info.items() if key not in not_shared}
    info |= {**_combined(a, b, "−"), "minus": dict(b.info), "verdict": ""}
    delta = _minus(a.convergence_delta, b.convergence_delta)
    explained_a, explained_b = a.info.get("explained"), b.info.get("explained")
    if delta is None or explained_a is None or explained_b is None:
        return info
    error = _hypot(a.convergence_delta_error, b.convergence_delta_error)
    magnitude = abs(explained_a) + abs(explained_b)
    return info | convergence(delta, error, explained_a - explained_b, magnitude)


def _combined(a: AttributionData, b: AttributionData, sign: str) -> dict[str, Any]:
    """Return the metric of a sum or difference, by a name that tells the sides apart, and the unit they share."""
    measures = [side.info.get("measure") or {} for side in (a, b)]
    units = [str(measure.get("unit") or "") for measure in measures]
    name = _name(a, b, [_measured(side) for side in (a, b)], sign)
    info: dict[str, Any] = {"metric": name, "measure": None}
    if any(measures):
        info["measure"] = {"name": name, "unit": units[0] if units[0] == units[1] else ""}
    if all(measures) and units[0] != units[1]:
        info["units"] = units
    return info


def _measured(a: AttributionData) -> str:
    """Return what is measured in words, such as ``logit of cube``, or the name of the metric's class."""
    return str((a.info.get("measure") or {}).get("name") or a.info.get("metric", "metric"))


def _name(a: AttributionData, b: AttributionData, metrics: Sequence[str], sign: str) -> str:
    """Return ``'UGR − DGP'``, or for one metric what its two results differ by, ``'UGR (first − second)'``."""
    if metrics[0] != metrics[1]:
        return f"{metrics[0]} {sign} {metrics[1]}"
    subject, (first, second) = _sides(a, b)
    return f"{metrics[0]} ({subject}{first} {sign} {second})"


def _sides(a: AttributionData, b: AttributionData) -> tuple[str, tuple[str, str]]:
    """Return what differs between two results of one metric, if it needs to be said, and its two values."""
    changed = [
        name
        for name, value in a.parameter_values.items()
        if name in b.parameter_values and not torch.equal(value, b.parameter_values[name])
    ]
    if a.info.get("scene") == b.info.get("scene") and len(changed) > 1:
        return "", ("first design", "second design")
    if a.info.get("scene") == b.info.get("scene") and changed:
        label, values = a.labels.get(changed[0], changed[0]), [s.parameter_values[changed[0]] for s in (a, b)]
        written = [rounded(float(value.mean())) for value in values]
        if written[0] != written[1] and all(value.unique().numel() == 1 for value in values):
            return f"{label} ", (written[0], written[1])
        return f"{label}, ", ("first", "second")
    for key, subject in _SETTINGS.items():
        settings = str(a.info.get(key)), str(b.info.get(key))
        if settings[0] != settings[1]:
            return subject, settings
    return "", ("first", "second")


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
