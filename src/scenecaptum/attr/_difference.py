"""Arithmetic of attributions, with errors: differences, sums and multiples."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

import torch

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
        info={**info, "metric": f"{factor:g} × {_metric_name(a)}", "measure": None},
    )


def add(a: A, b: A) -> A:
    """Return ``a + b`` for attributions to the same parameters."""
    total = subtract(a, multiply(b, -1.0))
    info = {key: value for key, value in total.info.items() if key != "minus"}
    return dataclasses.replace(
        total,
        info={
            **info,
            "metric": f"{_metric_name(a)} + {_metric_name(b)}",
            "measure": a.info.get("measure") if a.info.get("measure") == b.info.get("measure") else None,
            "plus": dict(b.info),
        },
    )


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
    info |= {
        "metric": f"{_metric_name(a)} − {_metric_name(b)}",
        "minus": dict(b.info),
        "verdict": "",
    }
    if a.info.get("measure") != b.info.get("measure"):
        info["measure"] = None
    delta = _minus(a.convergence_delta, b.convergence_delta)
    explained_a, explained_b = a.info.get("explained"), b.info.get("explained")
    if delta is None or explained_a is None or explained_b is None:
        return info
    error = _hypot(a.convergence_delta_error, b.convergence_delta_error)
    magnitude = abs(explained_a) + abs(explained_b)
    return info | convergence(delta, error, explained_a - explained_b, magnitude)


def _metric_name(a: AttributionData) -> str:
    """Return what is measured in words, such as ``logit of cube``, or the name of the metric's class."""
    return str((a.info.get("measure") or {}).get("name") or a.info.get("metric"))


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
